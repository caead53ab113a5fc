"""Drops on batches of images: against the numpy renderer and plain supersampling, its limits, and its gradients."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("torch", reason="torch is not installed")

import torch
from skimage import data

from rainstereo import Camera, Chamber, Panel
from rainstereo.defocus import apparent_distance, disc_parts
from rainstereo.droplet import SphericalCap
from rainstereo.model import drop_cover, rain_layer
from rainstereo.model.cap_table import CapTable
from rainstereo.model.disc_blur import disc_blur, discs
from rainstereo.model.drop_cover import Canvas, CapCircles, CellRays, cells_near
from rainstereo.model.drop_trace import trace, trace_caps
from rainstereo.model.image_pyramid import ImagePyramid, mirrored
from rainstereo.model.pane_rays import PaneOptics
from rainstereo.model.rain_layer import RainLayer, render
from rainstereo.model.tensor_rows import number_by_number
from rainstereo.model.thin_drop import thin_caps
from rainstereo.panel_plane import PanelFrame
from rainstereo.patch import folded
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import Population
from rainstereo.rain.render import Renderer
from rainstereo.ray_bundle import Fate
from rainstereo.refraction import backproject
from rainstereo.texture import Texture
from rainstereo.thin_lens import ThinLens

ACRYLIC = Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49),))
TILTED = Chamber((0.1, 0.05, 1), 0.05, (Panel(0.004, 1.49), Panel(0.003, 1.6)), (0.02,))
SMALL = Camera.pinhole(48.0, 48.0, 23.5, 17.5, 48, 36)


def camera(width: int, height: int) -> Camera:
    return Camera.pinhole(float(width), float(width), (width - 1) / 2, (height - 1) / 2, width, height)


def scatter(seed: int, count: int, *, radius: float = 2e-3, panel: int = 0, face: str = "far") -> list[SphericalCap]:
    rng = np.random.default_rng(seed)
    return [
        SphericalCap(tuple(rng.uniform([-0.02, -0.015], [0.02, 0.015])), rng.uniform(0.3, 1) * radius,
                     rng.uniform(0.5, 1.4), panel=panel, face=face)
        for _ in range(count)
    ]  # fmt: skip


def batch(image: np.ndarray, device: object = "cpu") -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].float().div(255).to(device)


def grays(layer: RainLayer) -> np.ndarray:
    return layer.image[0].permute(1, 2, 0).cpu().numpy().astype(np.float64) * 255


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference))))


def photograph(width: int, height: int) -> np.ndarray:
    return cv2.resize(data.astronaut(), (width, height), interpolation=cv2.INTER_AREA)


# -- the whole, against other formulations -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "population", "chamber"), [((320, 240), "drops", ACRYLIC), ((240, 320), "large", TILTED)]
)
def test_agrees_with_the_numpy_renderer(device, size, population, chamber):
    cam, image = camera(*size), photograph(*size)
    drops = Population.preset(population).with_cover(0.1).sample(3, Pane.seen(cam, chamber, margin=1e-3))
    expected = Renderer(cam, chamber).plan(drops).render(image)
    caps = CapTable.of([drops.shapes()], device=device)
    found = render(batch(image, device), caps, cam, chamber, rays=16)  # as many as that has at outlines
    covered = expected.opacity > 0
    assert covered.sum() > 4000
    assert rms((grays(found) - expected.image)[covered]) < 2.0
    assert rms((found.opacity[0, 0].cpu().numpy() - expected.opacity)[covered]) < 0.006
    assert (found.mask[0, 0].cpu().numpy() != covered).mean() < 5e-4  # slivers that only one of them samples
    assert (found.unknown[0, 0].cpu().numpy() != expected.unknown).mean() < 0.005


def test_agrees_through_a_distorting_lens():
    image = photograph(320, 240)
    barrel = Camera("LENSMODEL_OPENCV5", np.array([300, 300, 160, 118, -0.2, 0.05, 1e-3, 0, 0.0]), 320, 240)
    drops = Population.preset("large").with_cover(0.1).sample(1, Pane.seen(barrel, ACRYLIC, margin=1e-3))
    expected = Renderer(barrel, ACRYLIC, depth=3.0).plan(drops).render(image)
    found = render(batch(image), CapTable.of([drops.shapes()]), barrel, ACRYLIC, 3.0)
    covered = expected.opacity > 0
    assert covered.sum() > 4000
    assert rms((grays(found) - expected.image)[covered]) < 2.0


@pytest.mark.parametrize(("population", "f_number"), [("drops", 8.0), ("large", 2.0)])
def test_agrees_with_the_numpy_renderer_through_a_lens(device, population, f_number):
    cam, image, lens = camera(320, 240), photograph(320, 240), ThinLens(4.5e-3, f_number)
    drops = Population.preset(population).with_cover(0.1).sample(3, Pane.seen(cam, ACRYLIC, margin=3e-3))
    expected = Renderer(cam, ACRYLIC, lens=lens).plan(drops).render(image)
    diameter = lens.blur(apparent_distance(drops.shapes()[0], ACRYLIC), cam)
    caps = CapTable.of([drops.shapes()], device=device)
    found = render(batch(image, device), caps, cam, ACRYLIC, discs=torch.tensor([diameter], device=device))
    covered = expected.opacity > 0
    assert rms((image - expected.image.astype(np.float64))[covered]) > 25  # what the drops do
    assert rms((grays(found) - expected.image)[covered]) < 2.5
    assert rms((found.opacity[0, 0].cpu().numpy() - expected.opacity)[covered]) < 0.01  # of few rays at edges


@pytest.mark.parametrize(("model", "tolerance"), [("exact", 0.004), ("texture", 0.004)])
def test_is_the_mean_over_many_rays(model, tolerance):
    """A ramp needs no pyramid, so that 24 x 24 rays a pixel, each looked up by itself, are the truth."""
    caps = CapTable.of([scatter(1, 6, radius=3e-3)], dtype=torch.float64)
    x, y = torch.meshgrid(torch.arange(48.0), torch.arange(36.0), indexing="xy")
    ramp = (0.2 + 0.01 * x + 0.005 * y).double()
    n = 24
    inside = (torch.arange(n).double() + 0.5) / n - 0.5
    rays = torch.stack(torch.meshgrid(inside, inside, indexing="xy"), -1).reshape(1, -1, 2)
    pixels = (torch.stack([x, y], -1).double().reshape(-1, 1, 2) + rays).reshape(-1, 2)
    if model == "exact":
        t = trace_caps(pixels[None], caps, SMALL, ACRYLIC)
        source, light, met = t.source[0], t.transmittance[0], t.fate[0] != int(Fate.NO_DROP)
    else:
        optics, circles = PaneOptics(SMALL, ACRYLIC), CapCircles.of(caps)
        at = optics.rays(pixels)
        distance = torch.hypot(at.x[:, None] - circles.x, at.y[:, None] - circles.y)
        which = (distance**2 - circles.reach**2).argmin(1)
        t, met = thin_caps(pixels, which, caps, optics, trace(pixels, None, SMALL, ACRYLIC), math.inf)
        source, light = t.source, t.transmittance
    clear = trace(pixels, None, SMALL, ACRYLIC).transmittance
    folded_source = torch.from_numpy(folded(source.nan_to_num(0).numpy(), (48, 36))).double()
    shown = (0.2 + folded_source @ torch.tensor([0.01, 0.005]).double()) * light.nan_to_num(0) / clear
    own = 0.2 + pixels @ torch.tensor([0.01, 0.005]).double()
    truth = torch.where(met, shown, own).reshape(36, 48, -1).mean(-1)
    found = render(ramp[None, None], caps, SMALL, ACRYLIC, model=model)
    known = found.mask[0, 0] & ~found.unknown[0, 0]
    assert known.sum() > 50
    assert float((found.image[0, 0] - truth)[known].square().mean().sqrt()) < tolerance


def test_water_like_air_changes_nothing():
    caps = replace(table := CapTable.of([scatter(2, 8)], dtype=torch.float64), index=torch.ones_like(table.index))
    x, y = torch.meshgrid(torch.arange(48.0), torch.arange(36.0), indexing="xy")
    ramp = (0.2 + 0.01 * x + 0.005 * y).double()[None, None]
    found = render(ramp, caps, SMALL, ACRYLIC)
    inside = (found.opacity == 1) & ~found.unknown
    assert inside.sum() > 20
    # the bare panels' transmittance is that of the pixel's middle for all of its rays
    assert float((found.image - ramp).abs()[inside].max()) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_clear_pixels_are_untouched(device, dtype):
    torch.manual_seed(0)
    images = torch.rand(2, 3, 36, 48).to(device, dtype)
    before = images.clone()
    caps = CapTable.of([scatter(3, 4), scatter(4, 7)], device=device)
    for diameters in (None, torch.tensor([0.5, 3.0], device=device), torch.tensor([20.0, 2.0], device=device)):
        found = render(images, caps, SMALL, ACRYLIC, discs=diameters)
        clear = ~found.mask.expand_as(images)
        assert torch.equal(found.image[clear], images[clear])
        assert clear.any()
        assert (found.image != images).any()
        assert found.image.dtype == found.opacity.dtype == dtype
        assert found.image.device == images.device
        assert torch.equal(images, before)


def test_images_do_not_meet(device, monkeypatch):
    """A batch is its images one by one, whatever their discs are, however many are rendered at a time."""
    torch.manual_seed(0)
    images = torch.rand(4, 3, 36, 48, device=device)
    everyone = [scatter(seed, count) for seed, count in ((1, 5), (2, 0), (3, 9), (4, 2))]
    diameters = torch.tensor([0.0, 9.0, 2.0, 30.0], device=device)
    caps = CapTable.of(everyone, device=device)
    together = render(images, caps, SMALL, ACRYLIC, discs=diameters)
    for i in range(4):
        alone = render(images[i : i + 1], CapTable.of(everyone[i : i + 1], device=device), SMALL, ACRYLIC,
                       discs=diameters[i : i + 1])  # fmt: skip
        assert torch.allclose(together.image[i], alone.image[0], atol=2e-6)
        assert torch.equal(together.unknown[i], alone.unknown[0])
    monkeypatch.setattr(rain_layer, "TOGETHER", 1)
    monkeypatch.setattr(rain_layer, "TOGETHER_ELSEWHERE", 1)
    assert torch.allclose(render(images, caps, SMALL, ACRYLIC, discs=diameters).image, together.image, atol=2e-6)


def test_nothing_to_do():
    images = torch.rand(2, 1, 36, 48)
    for caps in (CapTable.of([[], []]), CapTable.of([[SphericalCap((0.5, 0.5), 1e-3, 1.0)]] * 2)):
        for diameters in (None, torch.full((2,), 5.0)):
            found = render(images, caps, SMALL, ACRYLIC, discs=diameters)
            assert torch.equal(found.image, images)
            assert not found.mask.any()
    assert render(images[:0], CapTable.of([]), SMALL, ACRYLIC).image.shape == (0, 1, 36, 48)


def test_refuses():
    images, caps = torch.rand(1, 1, 36, 48), CapTable.of([scatter(0, 2)])
    with pytest.raises(ValueError, match="floating point"):
        render(images.to(torch.uint8), caps, SMALL, ACRYLIC)
    with pytest.raises(ValueError, match="the camera has 48 x 36"):
        render(images[..., 1:], caps, SMALL, ACRYLIC)
    with pytest.raises(ValueError, match="a row for each of 2"):
        render(images.repeat(2, 1, 1, 1), caps, SMALL, ACRYLIC)
    with pytest.raises(ValueError, match="a diameter for each"):
        render(images, caps, SMALL, ACRYLIC, discs=torch.ones(2))
    with pytest.raises(ValueError, match="expected 2 to 16"):
        render(images, caps, SMALL, ACRYLIC, rays=1)
    with pytest.raises(ValueError, match="'exact' or 'texture'"):
        render(images, caps, SMALL, ACRYLIC, model="thin")
    with pytest.raises(ValueError, match="overhangs"):
        render(images, CapTable.of([[SphericalCap((0.0, 0.0), 2e-3, 2.0)]]), SMALL, ACRYLIC, model="texture")


# -- gradients ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("diameters", [None, [2.5]])
@pytest.mark.parametrize("model", ["texture", "exact"])
def test_gradients(model, diameters):
    cam = Camera.pinhole(16.0, 16.0, 7.5, 5.5, 16, 12)
    caps = CapTable.of([[SphericalCap((0.002, 0.001), 0.006, 0.6), SphericalCap((-0.008, -0.004), 0.005, 0.5)]])
    torch.manual_seed(1)
    image = torch.rand(1, 1, 12, 16, dtype=torch.float64, requires_grad=True)
    names = ("x", "y", "radius", "contact_angle")
    units = (1e-3, 1e-3, 1e-3, 1.0)
    columns = [(getattr(caps, name).double() / unit).requires_grad_() for name, unit in zip(names, units, strict=True)]
    blur = None if diameters is None else torch.tensor(diameters)

    def shown(image, *columns):
        table = {name: c * unit for name, c, unit in zip(names, columns, units, strict=True)}
        drops = CapTable(**table, index=caps.index.double())
        return render(image, drops, cam, ACRYLIC, model=model, discs=blur, rays=3).image

    found = torch.autograd.grad(shown(image, *columns).sum(), [image, *columns])
    assert all(bool(g.isfinite().all()) and bool((g != 0).any()) for g in found)
    assert torch.autograd.gradcheck(shown, [image, *columns], eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-2, 2), st.sampled_from(["exact", "texture"]))
def test_is_linear_in_the_image(seed, factor, model):
    torch.manual_seed(seed)
    a, b = torch.rand(2, 1, 2, 36, 48, dtype=torch.float64)
    caps = CapTable.of([scatter(seed, 5)])
    one, other, both = (
        render(x, caps, SMALL, ACRYLIC, model=model, rays=3).image for x in (a, b, a + factor * b)
    )  # fmt: skip
    assert torch.allclose(both, one + factor * other, atol=1e-12)


# -- parts -------------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(1, 12), st.floats(3e-4, 6e-3), st.booleans(),
    st.sampled_from([(0, "far"), (1, "near")]),
)  # fmt: skip
def test_cells_hold_all_that_drops_show(seed, count, radius, tilted, place):
    """Tracing every pixel with the search of the tracer finds the same as tracing the cells with their owners."""
    chamber = TILTED if tilted else replace(TILTED, normal=(0, 0, 1))
    everyone = [scatter(seed, count, radius=radius, panel=place[0], face=place[1]), []]
    caps = CapTable.of(everyone, dtype=torch.float64)
    optics = PaneOptics(SMALL, chamber, *place)
    cells = cells_near(caps, Canvas(48, 36), optics)
    keys = cells.image * 48 * 36 + cells.number
    assert bool((keys.diff() > 0).all())
    owners = CapCircles.of(caps).owners(cells, CellRays.of(cells, 1, optics)).squeeze(1)
    which = torch.full((2, 36 * 48), -1, dtype=torch.int64)
    which[cells.image, cells.number] = torch.where(owners >= 0, owners - cells.image * count, -1)
    pixels = torch.stack(torch.meshgrid(torch.arange(48.0), torch.arange(36.0), indexing="xy"), -1).double()
    pixels = pixels.reshape(1, -1, 2)
    found = trace_caps(pixels, caps, SMALL, chamber, which=which)
    expected = trace_caps(pixels, caps, SMALL, chamber)
    assert torch.equal(found.fate, expected.fate)
    assert torch.equal(found.source.nan_to_num(-1), expected.source.nan_to_num(-1))


def test_cells_are_found_in_parts(monkeypatch):
    caps, optics = CapTable.of([scatter(1, 12), scatter(2, 7)]), PaneOptics(SMALL, ACRYLIC)
    whole = cells_near(caps, Canvas(48, 36), optics)
    monkeypatch.setattr(drop_cover, "PAIRS", 100)
    parts = cells_near(caps, Canvas(48, 36), optics)
    for name in ("image", "number"):
        assert torch.equal(getattr(parts, name), getattr(whole, name))
    assert set(zip(parts.pairs.tolist(), parts.drops.tolist(), strict=True)) == set(
        zip(whole.pairs.tolist(), whole.drops.tolist(), strict=True)
    )


@pytest.mark.parametrize("shape", [(7,), (7, 2), (7, 3, 2), (7, 0), (1, 5)])
def test_rows_number_by_number(shape):
    """As torch takes them, gradients too; what a GPU does."""
    table = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    at = torch.randint(shape[0], (11,), generator=torch.Generator().manual_seed(0))
    found, expected = number_by_number(table, at), table[at]
    assert torch.equal(found, expected)
    weight = torch.randn_like(expected)
    gradients = [torch.autograd.grad((each * weight).sum(), table)[0] for each in (found, expected)]
    torch.testing.assert_close(*gradients)
    assert number_by_number(table, at[:0]).shape == (0, *shape[1:])


@pytest.mark.parametrize("place", [(0, "near"), (0, "far"), (1, "near"), (1, "far")])
def test_pane_rays_are_those_of_the_chamber(place):
    grid = np.stack(np.meshgrid(np.arange(0, 48, 5.0), np.arange(0, 36, 5.0)), -1).reshape(-1, 2)
    rays = PaneOptics(SMALL, TILTED, *place).rays(torch.from_numpy(grid))
    layer = 2 * place[0] + (1 if place[1] == "near" else 2)
    expected, _ = backproject(grid, SMALL, TILTED, layer)
    frame = PanelFrame.of(TILTED)
    at = expected @ frame.R_panel_cam.T - frame.origin(TILTED, place[0])
    np.testing.assert_allclose(torch.stack([rays.x, rays.y], -1).numpy(), at[:, :2], atol=1e-14)
    light = PaneOptics(SMALL, TILTED).transmittance(rays)
    clear = trace(torch.from_numpy(grid), None, SMALL, TILTED).transmittance
    assert torch.allclose(light, clear, atol=1e-14)


@pytest.mark.parametrize("place", [(0, "far"), (1, "near")])
def test_texture_is_the_core_s(place):
    cap = SphericalCap((0.002, 0.001), 0.004, 0.6, panel=place[0], face=place[1])
    grid = np.stack(np.meshgrid(np.arange(48.0), np.arange(36.0)), -1).reshape(-1, 2)
    expected = Texture.slopes(cap, SMALL, TILTED).trace(grid, SMALL, 5.0)
    pixels = torch.from_numpy(grid)
    caps, optics = CapTable.of([[cap]], dtype=torch.float64), PaneOptics(SMALL, TILTED, *place)
    nobody = torch.zeros(len(grid), dtype=torch.int64)
    found, wet = thin_caps(pixels, nobody, caps, optics, trace(pixels, None, SMALL, TILTED), 5.0)
    np.testing.assert_array_equal(wet.numpy(), expected.status == 0)
    assert wet.sum() > 20
    np.testing.assert_allclose(found.source.numpy()[wet], expected.source[wet.numpy()], atol=1e-5)  # its textures are
    # held in single precision
    np.testing.assert_allclose(found.transmittance.numpy()[wet], expected.transmittance[wet.numpy()], atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(1, 50), st.integers(1, 50))
def test_mirror(x, y, width, height):
    found = mirrored(torch.tensor([[x, y]], dtype=torch.float64), (width, height))
    np.testing.assert_allclose(found.numpy(), folded(np.array([[x, y]]), (width, height)), atol=2e-3)  # in float32


@pytest.mark.parametrize(("width", "height"), [(48, 36), (37, 29), (5, 4), (3, 1)])
def test_pyramid_interpolates(width, height):
    """Level 0 as OpenCV interpolates; a ramp is a ramp at every level, away from the edges."""
    rng = np.random.default_rng(0)
    image = rng.random((height, width, 2), dtype=np.float32)
    at = rng.uniform(0, [width - 1, height - 1], (200, 2)).astype(np.float32)
    pyramid = ImagePyramid.of(torch.from_numpy(image).permute(2, 0, 1)[None].repeat(2, 1, 1, 1))
    places, one = torch.from_numpy(at)[:, None], torch.ones(200, 1)
    image_of, level = torch.arange(200) % 2, torch.zeros(200, dtype=torch.int64)
    found = pyramid.sums(image_of, level, places, one).numpy()
    expected = cv2.remap(image, at[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
    np.testing.assert_allclose(found, expected, atol=0.04)  # OpenCV rounds places to 1/32 px
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    ramp = torch.from_numpy((0.1 * x + 0.3 * y)[None, None])
    levels = ImagePyramid.of(ramp)
    for number in range(len(levels.sizes)):
        margin = 2.0 ** (number + 1)  # a last row or column without a partner stands aside
        if min(width, height) <= 2 * margin + 2:
            break
        places = torch.from_numpy(rng.uniform(margin, [width - 1 - margin, height - 1 - margin], (50, 2)))[:, None]
        found = levels.sums(image_of[:50] * 0, torch.full((50,), number), places, torch.ones(50, 1))
        np.testing.assert_allclose(found[:, 0], places[:, 0] @ torch.tensor([0.1, 0.3]).double(), atol=1e-6)


def test_disc_blur_is_a_convolution(device):
    torch.manual_seed(0)
    layers = torch.rand(3, 2, 21, 30, dtype=torch.float64, device=device)
    diameters = torch.tensor([0.7, 4.3, 11.0], device=device)
    found, kernels = disc_blur(layers, diameters), discs(diameters.double())
    assert torch.equal(kernels[0].nonzero(), torch.tensor([[6, 6]], device=device) - 1 + kernels.shape[1] // 2 - 5)
    for one, kernel, expected in zip(found, kernels, layers, strict=True):
        weight = kernel.reshape(1, 1, *kernel.shape)
        direct = torch.nn.functional.conv2d(expected[:, None], weight, padding=kernel.shape[0] // 2)[:, 0]
        assert torch.allclose(one, direct, atol=1e-12)
        assert float(kernel.sum()) == pytest.approx(1)
    core = disc_parts(4.3)[0]
    middle = kernels.shape[1] // 2
    reach = core.shape[0] // 2
    ours = kernels[1, middle - reach : middle + reach + 1, middle - reach : middle + reach + 1].cpu().numpy()
    np.testing.assert_allclose(ours, core, atol=0.002)  # 8 x 8 points a cell instead of 16 x 16
    with pytest.raises(ValueError, match="expected"):
        disc_blur(layers, diameters[:2])
