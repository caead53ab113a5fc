"""The tracer on tensors: against the numpy tracer and the 50-digit reference, its limits, and its gradients."""

import math
import subprocess
import sys
from dataclasses import replace
from itertools import product

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("torch", reason="torch is not installed")

import torch

from rainstereo import Camera, Chamber, Panel
from rainstereo import trace as core
from rainstereo.bezier_drop import BezierDrop
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.model.cap_table import COLUMNS, CapTable
from rainstereo.model.drop_trace import Trace, trace, trace_caps
from rainstereo.trace import Fate
from tests.core.drop_reference import Lost, march
from tests.core.test_trace import CAMERA, NAMES, cap, normal, pane, reference_scene, two_panels, window

GRID = np.stack(np.meshgrid(np.arange(0, 1280, 8.0), np.arange(0, 960, 8.0)), -1)
DISTORTED = Camera(
    "LENSMODEL_OPENCV8",
    np.array([1200, 1190, 639.5, 479.5, -0.3, 0.1, 1e-3, -5e-4, 0.01, 0.02, 0.03, 0.001]),
    1280,
    960,
)


def agree(
    t: Trace, expected: core.Trace, near_critical: float = 0.0, steep: bool = False, rounding: np.ndarray | None = None
) -> int:
    """Compare a trace with numpy's; the number of pixels compared within the frame.

    near_critical: share of the pixels that may differ in status, where rays are at a limit but for rounding.
    rounding: what the last bit of a pixel's coordinates changes of its transmittance; other rounding may do as much.
    """
    single = expected.source.dtype == np.float32
    source, share, status = (c.detach().cpu().numpy() for c in (t.source, t.transmittance, t.status))
    assert source.dtype == share.dtype == expected.source.dtype
    assert status.dtype == np.uint8
    assert source.shape == expected.source.shape
    assert status.shape == expected.status.shape
    assert (status != expected.status).sum() <= near_critical * status.size
    np.testing.assert_array_equal(np.isnan(source).any(-1), status != 0)
    np.testing.assert_array_equal(np.isnan(share), t.fate.cpu().numpy() != 0)
    size = [expected.camera.width - 1, expected.camera.height - 1]
    with np.errstate(invalid="ignore"):
        both = (status == 0) & (expected.status == 0) & ((expected.source >= 0) & (expected.source <= size)).all(-1)
    if not (single and steep):
        assert np.abs(source - expected.source)[both].max(initial=0) <= (0.02 if single else 1e-9)
        bound = np.full(share.shape, 1e-4 if single else 1e-12)
        if rounding is not None:
            bound = np.fmax(bound, 4 * rounding)
        assert (np.abs(share - expected.transmittance)[both] <= bound[both]).all()
    return int(both.sum())


def last_bit(pixels: np.ndarray, drop: Drop, chamber: Chamber, expected: core.Trace) -> np.ndarray:
    """Largest change of a trace's transmittance by the last bit of either coordinate; a traced pixel's only."""
    largest = np.zeros(pixels.shape[:-1])
    for axis, towards in product(range(2), (-np.inf, np.inf)):
        moved = pixels.copy()
        moved[..., axis] = np.nextafter(moved[..., axis], towards)
        found = core.trace(moved, drop, CAMERA, chamber, 3.0)
        largest = np.fmax(largest, np.abs(found.transmittance - expected.transmittance))
    return largest


def on(pixels: np.ndarray, device: object = "cpu") -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(pixels)).to(device)


def scatter(rng: np.random.Generator, count: int, face: str = "far", panel: int = 0) -> list[SphericalCap]:
    return [
        cap(rng.uniform(15, 90), face, panel, 10 ** rng.uniform(-3.6, -2.6), rng.choice([1.333, 1.4]),
            tuple(rng.uniform([-0.03, -0.024], [0.03, 0.024])))
        for _ in range(count)
    ]  # fmt: skip


def bumps(face: str) -> HeightMap:
    """A drop with hills: not convex."""
    x, y = np.meshgrid(*(np.arange(-20, 21) * 1e-4,) * 2)
    heights = 4e-4 * (1 - (x**2 + y**2) / 1.8e-3**2) + 1e-4 * np.sin(6e3 * x) * np.sin(5e3 * y)
    edge = np.maximum(np.abs(x), np.abs(y)) > 1.85e-3
    return HeightMap((0.003, -0.002), np.where(edge, np.minimum(heights, -1e-6), heights), 1e-4, panel=1, face=face)


# -- against numpy -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize(("tilt", "azimuth"), [(0, 0), (45, 200)])
@pytest.mark.parametrize("index", [1.333, 0.75])
def test_one_cap_equals_numpy(
    device: torch.device, dtype: type, face: str, tilt: float, azimuth: float, index: float, rng: np.random.Generator
) -> None:
    """Both faces of the second panel, tilted or not, water and bubbles, of every contact angle."""
    chamber, compared = two_panels(tilt, azimuth), 0
    for angle in (1, 20, 60, 90, 130):
        drop = cap(angle, face, 1, 2e-3, index, (0.003, -0.002))
        pixels = window(drop, chamber, rng, 800).astype(dtype)
        expected = core.trace(pixels, drop, CAMERA, chamber, 3.0)
        t = trace(on(pixels, device), drop, CAMERA, chamber, 3.0)
        compared += agree(t, expected, 0.005 if dtype is np.float32 else 0.0, steep=angle > 60)
    assert compared > 500


@pytest.mark.parametrize("tilt", [0, 15, 45])
@pytest.mark.parametrize("face", ["far", "near"])
def test_single_precision(device: torch.device, tilt: float, face: str, rng: np.random.Generator) -> None:
    """Up to 60 degrees and in frame, single precision is good to 0.02 px; fates differ at the limits only."""
    for angle in (1, 20, 40, 60):
        for radius in (1e-4, 1e-3, 5e-3):
            drop, chamber = cap(angle, face, 1, radius, centre=(0.003, -0.002)), two_panels(tilt, 130)
            pixels = on(window(drop, chamber, rng, 1500).astype(np.float32), device)
            single, double = (trace(p, drop, CAMERA, chamber, 3.0) for p in (pixels, pixels.double()))
            assert (single.status != double.status).float().mean() < 2e-3
            size = torch.tensor([1279.0, 959.0], device=device)
            seen = (single.status == 0) & ((double.source >= 0) & (double.source <= size)).all(-1)
            assert seen.sum() > 300
            assert (single.source - double.source)[seen].abs().max() <= 0.02


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    tilt=st.sampled_from([0.0, 15.0, 60.0, 85.0]),
    azimuth=st.floats(0, 360),
    angle=st.floats(1, 150),
    radius=st.floats(5e-5, 8e-3),
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    face=st.sampled_from(["near", "far"]),
    panel=st.integers(0, 1),
    index=st.floats(0.6, 2.4),
    depth=st.sampled_from([50.0, 1e4, math.inf]),
    camera=st.sampled_from([CAMERA, DISTORTED]),
)
def test_anything_goes(
    tilt: float, azimuth: float, angle: float, radius: float, x: float, y: float, face: str, panel: int, index: float,
    depth: float, camera: Camera,
) -> None:  # fmt: skip
    """Random drops, chambers and cameras: as in numpy, and with finite gradients whatever becomes of the rays."""
    drop = cap(angle, face, panel, radius, index, (x, y))
    chamber = Chamber(normal(tilt, azimuth), 0.1, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.08,))
    pixels = np.concatenate([GRID[::4, ::4].reshape(-1, 2), [[639.5, -1e7]]])
    table = CapTable.of([[drop]], dtype=torch.float64)
    given_columns = [getattr(table, name).requires_grad_() for name in COLUMNS]
    t = trace_caps(on(pixels)[None], table, camera, chamber, depth)
    expected = core.trace(pixels, drop, camera, chamber, depth)
    assert (t.status[0].numpy() != expected.status).sum() == 0
    seen = expected.status == 0
    # a millionth of a pixel a pixel outside the frame
    scale = np.maximum(1, np.abs(expected.source[seen]) / 1000) ** 2
    assert (np.abs(t.source[0].detach().numpy()[seen] - expected.source[seen]) / scale).max(initial=0) <= 1e-6
    if seen.any():
        (torch.nansum(t.source) + torch.nansum(t.transmittance)).backward()
        for column in given_columns:
            assert column.grad is None or column.grad.isfinite().all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("tilt", [0, 45])
def test_height_maps_equal_numpy(
    device: torch.device, dtype: type, face: str, tilt: float, rng: np.random.Generator
) -> None:
    """Convex and not, bicubic and bilinear, by true intersection and by parallax steps."""
    chamber, slack = two_panels(tilt, 200), 0.005 if dtype is np.float32 else 0.0
    smooth = cap(55, face, 1, 2e-3, 1.333, (0.003, -0.002))
    for drop in (
        HeightMap.of(smooth, 65), HeightMap.of(smooth, 33, "bilinear"), bumps(face),
        HeightMap.of(smooth, 65, steps=2), replace(bumps(face), steps=0),
    ):  # fmt: skip
        pixels = window(smooth, chamber, rng, 500).astype(dtype)
        expected = core.trace(pixels, drop, CAMERA, chamber, 3.0)
        rounding = None if dtype is np.float32 else last_bit(pixels, drop, chamber, expected)
        assert agree(trace(on(pixels, device), drop, CAMERA, chamber, 3.0), expected, slack, rounding=rounding) > 80


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("face", ["far", "near"])
def test_many_drops_equal_numpy(device: torch.device, camera: Camera, face: str, rng: np.random.Generator) -> None:
    """Caps and a height map on one face: every pixel belongs to the same drop; and to the one it is said to."""
    drops: list[Drop] = [*scatter(rng, 40, face), HeightMap.of(cap(50, face, radius=4e-3, centre=(0.01, 0.005)), 65)]
    chamber, labels = pane(20), rng.integers(-1, len(drops), GRID.shape[:2])
    for pixels in (GRID, GRID.astype(np.float32)):
        t = trace(on(pixels, device), drops, camera, chamber, 5.0)
        slack = 2e-4 if pixels.dtype == np.float32 else 0.0
        assert agree(t, core.trace(pixels, drops, camera, chamber, 5.0), slack, steep=True) > 500
        t = trace(on(pixels, device), drops, camera, chamber, 5.0, which=on(labels, device))
        agree(t, core.trace(pixels, drops, camera, chamber, 5.0, which=labels), slack, steep=True)


@pytest.mark.parametrize("face", ["far", "near"])
def test_drops_in_the_bay_of_a_body_equal_numpy(device: torch.device, face: str, rng: np.random.Generator) -> None:
    """A body around a bay, whose circle holds some caps; and one of them alone there shows what it does by itself."""
    x, y = np.meshgrid(*(np.linspace(-2e-2, 2e-2, 81),) * 2)
    ring = HeightMap((0.0, 0.0), 3e-3 - 90 * (np.hypot(x, y) - 1.2e-2) ** 2, 5e-4, face=face)
    inner = [cap(40, face, radius=1.5e-3, centre=(a, -a)) for a in (-3e-3, 0.0, 3e-3)]
    outer = [cap(40, face, radius=1e-3, centre=(0.021, b)) for b in (-0.01, 0.01)]
    drops: list[Drop] = [*inner, ring, *outer]
    found = trace(on(GRID, device), drops, CAMERA, pane(20), 5.0)
    expected = core.trace(GRID, drops, CAMERA, pane(20), 5.0)
    assert agree(found, expected, 0.0, steep=True) > 500
    alone = core.trace(GRID, inner[1], CAMERA, pane(20), 5.0)
    mine = alone.status == 0
    assert mine.sum() > 20
    np.testing.assert_array_equal(expected.source[mine], alone.source[mine])


def test_a_lens_of_mrcals(rng: np.random.Generator) -> None:
    mrcal = pytest.importorskip("mrcal", reason="mrcal is not installed")
    model = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=8_Ny=6_fov_x_deg=80"
    bends = rng.normal(scale=0.01, size=mrcal.lensmodel_num_params(model) - 4)
    camera, drop = Camera(model, np.r_[1200.0, 1200, 639.5, 479.5, bends], 1280, 960), cap(50, radius=5e-3)
    expected = core.trace(GRID, drop, camera, pane(20), 5.0)
    assert agree(trace(on(GRID), drop, camera, pane(20), 5.0), expected) > 200


def test_drops_on_several_faces(device: torch.device) -> None:
    """Rays that a first drop has turned meet a second one, and then a panel."""
    drops = [cap(15, "far", 0, 5e-3), cap(20, "near", 1, 8e-3), cap(60, "near", 0, 3e-3, centre=(0.02, 0)),
             HeightMap.of(cap(40, "far", 1, 4e-3), 65)]  # fmt: skip
    for tilt in (10, 50):
        expected = core.trace(GRID, drops, CAMERA, two_panels(tilt), 3.0)
        assert agree(trace(on(GRID, device), drops, CAMERA, two_panels(tilt), 3.0), expected) > 200
    touching = Chamber((0, 0.1, 1), 0.05, (Panel(0.003, 1.49), Panel(0.004, 1.52)), (0.0,))
    drop = cap(50, "far", 1, 4e-3)
    assert agree(trace(on(GRID), drop, CAMERA, touching), core.trace(GRID, drop, CAMERA, touching)) > 50


def test_no_drops_and_no_chamber(device: torch.device) -> None:
    pixels = np.array([[639.5, 479.5], [100, 20], [639.5, -1e7], [np.nan, 1], [np.inf, 1]])
    for drops in (None, []):
        for chamber in (None, pane(60), Chamber((0, 0, 1), 0.1, ())):
            for camera in (CAMERA, DISTORTED):
                t = trace(on(pixels[:3], device), drops, camera, chamber, 5.0)
                agree(t, core.trace(pixels[:3], drops, camera, chamber, 5.0))
                t = trace(on(pixels[3:], device), drops, camera, chamber, 5.0)
                assert t.status.tolist() == [Fate.NOT_FINITE] * 2
                assert t.source.isnan().all()
    assert trace(torch.zeros(0, 2), cap(30), CAMERA, pane(), 5.0).source.shape == (0, 2)
    assert trace(torch.zeros(3, 0, 2), [], CAMERA, None).status.shape == (3, 0)


def test_drops_out_of_the_frame_and_across_its_border(device: torch.device) -> None:
    for centre in ((0.033, 0.0), (0.0, -0.025), (0.2, 0.1)):
        drop = cap(60, radius=4e-3, centre=centre)
        agree(trace(on(GRID, device), drop, CAMERA, pane(), 5.0), core.trace(GRID, drop, CAMERA, pane(), 5.0))
    whole = cap(30, radius=0.09)
    assert agree(trace(on(GRID), whole, CAMERA, pane(), 5.0), core.trace(GRID, whole, CAMERA, pane(), 5.0)) > 1000


def test_one_trace_serves_every_depth(rng: np.random.Generator) -> None:
    """`at` gives what a trace at that depth gives; behind a tilted pane the plane may lie before the ray's start."""
    chamber = Chamber(normal(70, 0), 0.05, (Panel(0.003, 1.49),))
    a, b = core.trace(GRID, None, CAMERA, chamber), trace(on(GRID), None, CAMERA, chamber)
    agree(b.at(0.2), a.at(0.2))
    assert (b.at(0.2).status == Fate.BEHIND).any()
    depth = rng.uniform(0.2, 5, GRID.shape[:2])
    agree(b.at(on(depth)), a.at(depth))
    agree(b.at(on(depth[:, :1])), a.at(np.broadcast_to(depth[:, :1], depth.shape)))


# -- against the reference, and limits ---------------------------------------------------------------------------------


def test_against_the_reference(rng: np.random.Generator) -> None:
    """The same 50 digits that the numpy tracer is held to."""
    compared = 0
    for face, angle, index in (("far", 60, 1.333), ("near", 80, 1.333), ("far", 40, 0.75)):
        drop, chamber = cap(angle, face, 1, 2e-3, index, (0.003, -0.002)), two_panels(15, 77)
        pixels, scene = window(drop, chamber, rng, 15), reference_scene(drop, chamber)
        t = trace(on(pixels), drop, CAMERA, chamber, 3.0)
        for pixel, source, share, status in zip(pixels, t.source, t.transmittance, t.status, strict=True):
            why = None
            try:
                exact, transmittance, _ = march(scene, pixel, mp.mpf(3))
            except Lost as lost:
                why = NAMES[str(lost.args[0])]
            assert int(status) == (why or Fate.THROUGH)
            if why:
                continue
            size = max(1.0, *(abs(float(c)) / 2000 for c in exact))
            assert max(abs(float(a) - float(b)) for a, b in zip(source, exact, strict=True)) <= 1e-8 * size
            assert abs(float(share) - float(transmittance)) <= 1e-10
            compared += 1
    assert compared > 12


@pytest.mark.parametrize("angle", [10, 35, 60, 90])
def test_slope_in_the_middle(angle: float) -> None:
    """Paraxial optics, by the gradient: d source / d pixel = 1 - (d + t/n_p + h/n_w)(n_w - 1)/R at infinity."""
    drop, pixel = cap(angle), torch.tensor([[639.5, 479.5]], dtype=torch.float64, requires_grad=True)
    trace(pixel, drop, CAMERA, pane()).source[0, 0].backward()
    expected = 1 - (0.06 + 0.003 / 1.49 + drop.top / 1.333) * 0.333 / drop.sphere_radius
    assert pixel.grad is not None
    assert pixel.grad[0, 0].item() == pytest.approx(expected, rel=1e-12)
    assert abs(pixel.grad[0, 1].item()) < 1e-12


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input_is_named() -> None:
    pixels = torch.zeros(1, 2)
    for wrong, match in (
        (np.zeros((1, 2)), "ndarray; expected a tensor"),
        (torch.zeros(1, 2, dtype=torch.float16), "float16"),
        (torch.zeros(4, 3), r"expected a tensor \(\.\.\., 2\)"),
    ):
        with pytest.raises(ValueError, match=match):
            trace(wrong, cap(40), CAMERA, pane())
    for drop, chamber, depth, match in (
        (cap(40, panel=1), pane(), 5.0, "panel 1, but this chamber has 1 panel"),
        (cap(40), None, 5.0, "a drop needs a panel"),
        (cap(90, "far", 0, radius=0.03), two_panels(0), 5.0, "30 mm tall"),
        (cap(40), pane(), 0.05, "before a drop, which is at 0.063 m"),
        (cap(40), pane(), torch.tensor(-3.0), "depth"),
    ):
        with pytest.raises(ValueError, match=match):
            trace(pixels, drop, CAMERA, chamber, depth)
        if chamber is not None:
            with pytest.raises(ValueError, match=match):
                trace_caps(pixels[None], CapTable.of([[drop]]), CAMERA, chamber, depth)
    with pytest.raises(ValueError, match="expected integers of shape"):
        trace(pixels, [cap(40)], CAMERA, pane(), which=torch.zeros(3, dtype=torch.long))
    with pytest.raises(ValueError, match="which holds 1 to 1"):
        trace(pixels, [cap(40)], CAMERA, pane(), which=torch.ones(1, dtype=torch.long))
    with pytest.raises(ValueError, match="depth has shape"):
        trace(pixels, cap(40), CAMERA, pane()).at(torch.ones(7))
    with pytest.raises(ValueError, match=r"expected \(2, N, 2\) or \(1, N, 2\)"):
        trace_caps(torch.zeros(3, 5, 2), CapTable.of([[], []]), CAMERA, pane())


def test_other_shapes_are_sent_to_height_maps() -> None:
    drop = BezierDrop((0.0, 0.0), 1e-3, 0.7, 1.0)
    with pytest.raises(ValueError, match=r"a BezierDrop was given.*HeightMap\.of\(drop\)"):
        trace(torch.zeros(1, 2), drop, CAMERA, pane())


def test_inputs_are_not_changed() -> None:
    pixels = on(GRID)
    before, t = pixels.clone(), trace(pixels, [cap(40), cap(30, centre=(1e-3, 0))], CAMERA, pane(), 5.0)
    offset = t.offset.clone()
    t.at(0.5).source[:] = 0
    assert torch.equal(pixels, before)
    torch.testing.assert_close(t.offset, offset, rtol=0, atol=0, equal_nan=True)


# -- memory ------------------------------------------------------------------------------------------------------------

MILLION = """
import re, numpy as np, torch
from pathlib import Path
from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import SphericalCap
from rainstereo.model.drop_trace import trace
rng = np.random.default_rng(0)
drops = [SphericalCap(tuple(rng.uniform(-0.03, 0.03, 2)), 1e-3, 1.0) for _ in range(50)]
pixels = torch.from_numpy(rng.uniform(0, 959, (1_000_000, 2)))
camera, chamber = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960), Chamber((0, 0, 1), 0.06, (Panel(0.003, 1.49),))
trace(pixels[:100], drops, camera, chamber)
def most():  # not ru_maxrss, which a process inherits from the one that started it
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
before = most()
assert (trace(pixels, drops, camera, chamber).status == 0).sum() > 10_000
print((most() - before) / 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from Linux's /proc")
def test_memory_of_a_million_pixels_and_fifty_drops() -> None:
    """Answers take 58 MB in double precision; what the way there takes does not grow with pixels times drops."""
    done = subprocess.run([sys.executable, "-c", MILLION], capture_output=True, text=True, timeout=120, check=True)
    assert 50 < float(done.stdout) < 500
