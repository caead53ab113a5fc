"""Caps of a batch as tensors: each image as the numpy tracer has it, and gradients against differences."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch

from rainstereo import trace as core
from rainstereo.droplet import SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.model.cap_table import COLUMNS, CapTable
from rainstereo.model.drop_trace import trace, trace_caps
from rainstereo.trace import Fate
from tests.core.test_trace import CAMERA, cap, pane, two_panels, window

from .test_drop_trace import DISTORTED, GRID, agree, on, scatter

# -- batches -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_image_has_its_own_drops(
    device: torch.device, face: str, dtype: torch.dtype, rng: np.random.Generator
) -> None:
    """Images of a batch, with 0, 1, 2 and 30 drops, are each as the numpy tracer has them alone."""
    images = [scatter(rng, count, face) for count in (0, 1, 2, 30)]
    pixels = GRID.reshape(-1, 2).astype(np.float32 if dtype == torch.float32 else np.float64)
    table = CapTable.of(images, device=device, dtype=torch.float64)
    depth = torch.tensor([[3.0], [4.0], [5.0], [math.inf]], device=device)
    t = trace_caps(on(pixels, device)[None], table, CAMERA, pane(20), depth)
    repeated = trace_caps(on(pixels, device).expand(4, -1, 2), table, CAMERA, pane(20), depth)
    torch.testing.assert_close(t.source, repeated.source, rtol=0, atol=0, equal_nan=True)
    for i, (drops, z) in enumerate(zip(images, depth[:, 0].tolist(), strict=True)):
        own = replace(t, source=t.source[i], transmittance=t.transmittance[i], status=t.status[i], fate=t.fate[i])
        agree(own, core.trace(pixels, drops, CAMERA, pane(20), z), 2e-4 if dtype == torch.float32 else 0, steep=True)


def test_labels_of_a_batch(rng: np.random.Generator) -> None:
    """`which` counts within an image; wrong labels are obeyed as by numpy."""
    images, pixels = [scatter(rng, 5), scatter(rng, 7)], GRID.reshape(-1, 2)
    which = np.stack([rng.integers(-1, 5, len(pixels)), rng.integers(-1, 7, len(pixels))])
    table = CapTable.of(images, dtype=torch.float64)
    t = trace_caps(on(pixels)[None], table, CAMERA, pane(), 5.0, which=on(which))
    for i, drops in enumerate(images):
        expected = core.trace(pixels, drops, CAMERA, pane(), 5.0, which=which[i])
        own = replace(t, source=t.source[i], transmittance=t.transmittance[i], status=t.status[i], fate=t.fate[i])
        assert agree(own, expected) > 5
    padding = trace_caps(on(pixels)[None], table, CAMERA, pane(), 5.0, which=torch.full((2, len(pixels)), 6))
    assert (padding.status[0] == Fate.NO_DROP).all()


def test_empty_batches(device: torch.device) -> None:
    pixels = on(GRID[0], device)[None]
    no_images = CapTable.of([], device=device)
    for depth in (5.0, torch.zeros(0, 1, device=device)):
        assert trace_caps(pixels, no_images, CAMERA, pane(), depth).source.shape == (0, 160, 2)
        assert trace_caps(pixels[:0], no_images, DISTORTED, pane(), depth).source.shape == (0, 160, 2)
    nothing = trace_caps(pixels, CapTable.of([[], []], device=device), CAMERA, pane(), 5.0)
    assert nothing.status.shape == (2, 160)
    assert (nothing.status == Fate.NO_DROP).all()
    assert trace_caps(pixels[:, :0], CapTable.of([[cap(30)]], device=device), CAMERA, pane()).source.shape == (1, 0, 2)


# -- gradients ---------------------------------------------------------------------------------------------------------


def columns_of(drops: list[list[SphericalCap]], device: object = "cpu") -> list[torch.Tensor]:
    """The table's columns as leaves, lengths in millimetres, so that steps of one size suit them all."""
    table = CapTable.of(drops, dtype=torch.float64)
    scale = {"x": 1e3, "y": 1e3, "radius": 1e3}
    return [(getattr(table, name) * scale.get(name, 1)).to(device).requires_grad_() for name in COLUMNS]


def table_of(columns: list[torch.Tensor], panel: int, face: str) -> CapTable:
    x, y, radius, angle, index = columns
    return CapTable(x * 1e-3, y * 1e-3, radius * 1e-3, angle, index, panel, face)


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize(("angle", "index", "tilt"), [(40, 1.333, 20), (85, 1.333, 0), (60, 0.75, 20), (130, 1.2, 45)])
def test_gradients_of_drops(
    device: torch.device, face: str, angle: float, index: float, tilt: float, rng: np.random.Generator
) -> None:
    """Analytic against numerical derivatives of source and transmittance, by every number of the drop."""
    drop, chamber = cap(angle, face, 1, 2e-3, index, (0.003, -0.002)), two_panels(tilt)
    pixels = window(drop, chamber, rng, 400)
    status = core.trace(pixels, drop, CAMERA, chamber).status
    # away from edges, where a step of the drop's changes a ray's fate, and derivatives have no limit
    inner = core.trace(pixels, replace(drop, radius=1.9e-3), CAMERA, chamber).status
    pixels = pixels[(status == 0) & (inner == 0)][:4]
    assert len(pixels) == 4

    def answers(*columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        t = trace_caps(on(pixels, device)[None], table_of(list(columns), 1, face), CAMERA, chamber, 3.0)
        return t.source, t.transmittance

    assert torch.autograd.gradcheck(answers, columns_of([[drop]], device), eps=1e-6, atol=1e-3, rtol=1e-4)


def test_gradients_of_pixels_and_depth() -> None:
    """For a pinhole; a height map's by the implicit function."""
    pixels = on(np.array([[642.0, 475.0], [636.0, 482.0]])).requires_grad_()
    depth = torch.tensor([2.0, 0.7], dtype=torch.float64, requires_grad=True)
    for face in ("far", "near"):
        for drop in (cap(40, face), HeightMap.of(cap(40, face), 65), HeightMap.of(cap(30, face), 65, steps=2)):
            for camera in (CAMERA, DISTORTED):
                moving = pixels if camera is CAMERA else pixels.detach()

                def source(pixels: torch.Tensor, depth: torch.Tensor, drop=drop, camera=camera) -> torch.Tensor:  # type: ignore[no-untyped-def]
                    return trace(pixels, drop, camera, pane(15), depth).source

                assert torch.autograd.gradcheck(source, (moving, depth), eps=1e-6, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lost_rays_leave_gradients_alone(
    device: torch.device, face: str, dtype: torch.dtype, rng: np.random.Generator
) -> None:
    """With total reflection, sides, dry pixels and NaN in the batch, gradients are those of the other rays alone."""
    index = 1.333 if face == "far" else 0.75
    images = [
        [cap(85, face, 1, 3e-3, index), cap(120, face, 1, 2e-3, index, (0.004, 0.001))],
        [cap(60, face, 1, 1e-3, 1.4)],
    ]
    pixels = np.concatenate([window(cap(60, radius=6e-3), two_panels(45), rng, 3000), [[np.nan, 0], [5, np.inf]]])
    chamber, p = two_panels(45), on(pixels, device).to(dtype)
    depth = torch.tensor(3.0, dtype=dtype, device=device, requires_grad=True)

    def total(pixels: torch.Tensor) -> list[torch.Tensor]:
        columns = columns_of(images, device)
        t = trace_caps(pixels, table_of(columns, 1, face), CAMERA, chamber, depth)
        seen = t.status == 0
        loss = (t.source[seen] / 1000).sum() + t.transmittance[seen].sum()
        return [t.status, *torch.autograd.grad(loss, [*columns, depth])]

    status, *gradients = total(p[None])
    fates = set(status.unique().tolist())
    assert {Fate.THROUGH, Fate.NO_DROP, Fate.NOT_FINITE, Fate.TOTAL_REFLECTION} <= fates
    assert all(gradient.isfinite().all() for gradient in gradients)
    for i in range(2):  # the other image's rays are lost, by pixels that are NaN
        only = torch.where((status[i] == 0)[:, None], p, math.nan)
        rest = torch.stack([only, torch.full_like(only, math.nan)][:: 1 if i == 0 else -1])
        alone = total(rest)[1:]
        for whole, part in zip(gradients[:5], alone[:5], strict=True):
            torch.testing.assert_close(whole[i], part[i], rtol=1e-4 if dtype == torch.float32 else 1e-9, atol=1e-9)
            assert (part[1 - i] == 0).all()


def test_gradients_find_a_drop(rng: np.random.Generator) -> None:
    """What the gradients are for: the drop is found again from where it bends the light to."""
    pixels = window(cap(40, radius=1.2e-3), pane(), rng, 60)
    true = cap(40, radius=2e-3, centre=(2e-4, -1e-4))
    target = trace(on(pixels), true, CAMERA, pane()).source
    columns = columns_of([[cap(33, radius=2e-3)]])
    x, y, radius, angle, index = columns
    for _ in range(8):

        def residual(x: torch.Tensor, y: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
            table = table_of([x, y, radius.detach(), angle, index.detach()], 0, "far")
            return (trace_caps(on(pixels)[None], table, CAMERA, pane()).source[0] - target).reshape(-1)

        J = torch.cat([j.reshape(-1, 1) for j in torch.autograd.functional.jacobian(residual, (x, y, angle))], 1)
        step = torch.linalg.lstsq(J, residual(x, y, angle)[:, None]).solution
        x, y, angle = (a.detach() - b for a, b in zip((x, y, angle), step[:, :, None], strict=True))
    found = [c.item() for c in (x, y, angle)]
    assert found == pytest.approx([0.2, -0.1, math.radians(40)], abs=1e-9)


# -- bad input --------------------------------------------------------------------------------------------------------


def test_bad_tables_are_named() -> None:
    one = torch.ones(1, 2)
    with pytest.raises(ValueError, match="of the same shape as x"):
        CapTable(one, one, one[0], one, one)
    with pytest.raises(ValueError, match="expected floating-point numbers"):
        CapTable(one.long(), one.long(), one, one, one)
    for radius, angle in ((1.0, 1.0), (-1e-3, 1.0), (math.nan, 1.0), (1e-3, 0.0), (1e-3, 3.2)):
        with pytest.raises(ValueError, match="drop 1 of image 0 has x 0, y 0, radius"):
            CapTable(0 * one, 0 * one, torch.tensor([[1e-3, radius]]), torch.tensor([[1.0, angle]]), one)
    with pytest.raises(ValueError, match="expected one face of one panel"):
        CapTable.of([[cap(40), cap(40, "near")]])
