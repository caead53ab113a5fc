"""What cells of images show through drops: rays, where they look, and how coarse a copy of the image they look at.

Four rays a cell, and more where these meet an edge - a contact line, a dark rim, a seam between drops. n x n looks a
cell are wrong by about 1.35 F^0.55 n^-1.6 gray levels RMS, F the side of the cell's footprint in pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.model.cap_table import COLUMNS, CapTable
from rainstereo.model.drop_cover import Canvas, CapCircles, CellRays, Cells, cells_near
from rainstereo.model.drop_trace import Trace, trace, trace_caps
from rainstereo.model.image_pyramid import ImagePyramid
from rainstereo.model.pane_rays import PaneOptics
from rainstereo.model.tensor_rows import rows_at
from rainstereo.model.thin_drop import thin_caps
from rainstereo.patch import UNCOVERED
from rainstereo.ray_bundle import Fate

MODELS = ("exact", "texture")
RAYS = 2  # along a cell's side, to begin with
SIDES = (1, 2, 3, 4, 6)
LOOKS, POWER = 1.45, 0.34375
"""Looks along a cell's side: a factor and a power of its footprint's side in pixels. This is good for 2 gray levels
RMS of 8 bits."""
SHARPER = 0.6  # octaves by which the copies looked at are finer than the spacing of looks
EVEN, STRETCH = 0.9, 1.15  # least ratio of gains, largest of steps between looks, within a cell that has no edge


@dataclass(frozen=True, eq=False)
class Shown:
    """What M covered cells show.

    colour: (M, C) premultiplied by opacity, and dimmed. opacity: (M,) share that drops hide. unknown: (M,) whether
    something of it lies beyond the image.
    """

    cells: Cells
    colour: Tensor
    opacity: Tensor
    unknown: Tensor


@dataclass(frozen=True, eq=False)
class Samples:
    """S rays of M cells each: source (M, S, 2) finite; gain, 0 where it is dark, covered and owner (M, S)."""

    source: Tensor
    gain: Tensor
    covered: Tensor
    owner: Tensor

    def take(self, at: Tensor) -> Samples:
        """Those of some cells."""
        return Samples(*(rows_at(each, at) for each in (self.source, self.gain, self.covered, self.owner)))


class DropLooks:
    """Caps of a batch of images, seen through a pinhole. depth: of the scene, metres. model: one of `MODELS`."""

    def __init__(self, caps: CapTable, camera: Camera, chamber: Chamber, depth: float, model: str) -> None:
        if model not in MODELS:
            raise ValueError(f"model {model!r} is unknown; expected {' or '.join(map(repr, MODELS))}")
        self.caps, self.camera, self.chamber, self.depth, self.model = caps, camera, chamber, depth, model
        self.optics = PaneOptics(camera, chamber, caps.panel, caps.face)
        self.circles = CapCircles.of(caps)
        self.row = replace(caps, **{name: getattr(caps, name).reshape(1, -1) for name in COLUMNS})

    def shown(self, pyramid: ImagePyramid, canvas: Canvas, rays: int) -> Shown:
        """What every cell of the canvas that a drop covers shows.

        rays: along a cell's side at edges; inside a drop a cell has at most so many looks along its side.
        """
        cells, dtype = cells_near(self.caps, canvas, self.optics), pyramid.colours.dtype
        samples, touched = self._rays(cells, RAYS, dtype)
        even = _is_even(samples)
        inside = even.nonzero().squeeze(-1)
        edges = (~even & (touched | samples.covered.any(1))).nonzero().squeeze(-1)
        near_edges = cells.take(edges)
        fine, _ = self._rays(near_edges, rays, dtype)
        covered = fine.covered.any(1).nonzero().squeeze(-1)
        edges, near_edges, fine = edges[covered], near_edges.take(covered), fine.take(covered)
        samples = samples.take(inside)
        colour = torch.cat([
            _inside(pyramid, cells.image[inside], samples, rays), _mixed(pyramid, near_edges.image, fine),
        ])  # fmt: skip
        opacity = torch.cat([torch.ones_like(samples.gain[:, 0]), fine.covered.to(dtype).mean(1)])
        unknown = torch.cat([_is_unknown(each, self.camera.size) for each in (samples, fine)])
        return Shown(cells.take(torch.cat([inside, edges])), colour, opacity, unknown)

    def _rays(self, cells: Cells, side: int, dtype: torch.dtype) -> tuple[Samples, Tensor]:
        """Rays of cells, side x side each; and which cells, (M,), a contact line may cross."""
        rays = CellRays.of(cells, side, self.optics)
        owner, shape = self.circles.owners(cells, rays), rays.x.shape
        at = (owner.reshape(-1) >= 0).nonzero().squeeze(-1)
        which, given = owner.reshape(-1)[at], rows_at(rays.pixels.reshape(-1, 2), at).to(dtype)
        if self.model == "exact":
            t = trace_caps(given.unsqueeze(0), self.row, self.camera, self.chamber, self.depth, which=which[None])
            hidden = torch.ones_like(t.fate, dtype=torch.bool)
            for fate in UNCOVERED:
                hidden &= t.fate != int(fate)
            t, hidden = _first(t), hidden[0]
        else:
            bare = trace(given, None, self.camera, self.chamber)
            t, hidden = thin_caps(given, which, self.row, self.optics, bare, self.depth)
        # what the lens model cannot say lies outside the image; there its undistorted place will do
        beyond = (t.status == Fate.NO_IMAGE) & (t.fate == Fate.THROUGH)
        source = torch.where(beyond.unsqueeze(-1), t.offset, t.source)
        lit = hidden & ((t.status == Fate.THROUGH) | beyond)
        clear = self.optics.transmittance(rays.middle).to(dtype)
        gain = torch.where(lit, t.transmittance / clear[torch.div(at, shape[1], rounding_mode="floor")], 0.0)
        source = torch.where(lit.unsqueeze(-1), source, 0.0)
        count = owner.numel()
        covered = torch.zeros(count, dtype=torch.bool, device=at.device).index_copy(0, at, hidden)
        samples = Samples(
            source.new_zeros(count, 2).index_copy(0, at, source).reshape(*shape, 2),
            gain.new_zeros(count).index_copy(0, at, gain).reshape(shape), covered.reshape(shape), owner,
        )  # fmt: skip
        return samples, self.circles.touch(cells, rays)


def _first(t: Trace) -> Trace:
    """The trace of the only image."""
    source, transmittance, status, offset, slope, start, fate = (
        c[0] for c in (t.source, t.transmittance, t.status, t.offset, t.slope, t.start, t.fate)
    )
    return Trace(source, transmittance, status, offset, slope, start, t.depth, t.camera, fate)


def _is_even(samples: Samples) -> Tensor:
    """Cells, (M,), that one drop covers wholly and evenly."""
    gain = samples.gain.detach()
    even = gain.amin(1) > EVEN * gain.amax(1)
    for steps in _steps(samples.source, RAYS):
        even &= STRETCH * steps.amin(1) >= steps.amax(1)
    return even & samples.covered.all(1) & (samples.owner == samples.owner[:, :1]).all(1)


def _steps(source: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """Distances between looks of neighbouring rays, (M, side (side - 1)) each, along x and y."""
    grid = source.detach().reshape(-1, side, side, 2)
    right, down = (grid.diff(dim=axis).square().sum(-1).sqrt().flatten(1) for axis in (2, 1))
    return right, down


def _is_unknown(samples: Samples, size: tuple[int, int]) -> Tensor:
    """Cells, (M,), with a ray that shows something beyond the image."""
    source = samples.source.detach()
    last = torch.tensor([size[0] - 1, size[1] - 1], dtype=source.dtype, device=source.device)
    return (((source < 0) | (source > last)).any(-1) & (samples.gain > 0)).any(1)


def _inside(pyramid: ImagePyramid, image: Tensor, samples: Samples, most: int) -> Tensor:
    """Colours, (M, C), of cells without an edge: looks between and beside their four rays."""
    right, down = (steps.mean(1) for steps in _steps(samples.source, RAYS))
    footprint, area = RAYS * torch.maximum(right, down), RAYS * RAYS * right * down
    sides = torch.tensor([side for side in SIDES if side <= most], device=image.device)
    wanted = (LOOKS * footprint.clamp(min=0.5) ** POWER).clamp(max=sides[-1])
    needed = sides[torch.searchsorted(sides.to(wanted), wanted).clamp(max=len(sides) - 1)]
    gain = samples.gain.mean(1)
    colour = gain.new_zeros(len(gain), pyramid.colours.shape[1])
    for side in sides.tolist():
        at = (needed == side).nonzero().squeeze(-1)
        looks = _spread(rows_at(samples.source, at), side)
        weights = (gain[at] / side**2).unsqueeze(1).expand(-1, side**2)
        level = _level(pyramid, area[at] / side**2)
        colour = colour.index_copy(0, at, pyramid.sums(image[at], level, looks, weights))
    return colour


def _mixed(pyramid: ImagePyramid, image: Tensor, samples: Samples) -> Tensor:
    """Colours, (M, C), of cells with an edge: each ray is a look."""
    count = samples.gain.shape[1]
    side = math.isqrt(count)
    lit = (samples.gain > 0).reshape(-1, side, side)
    both = [(lit.narrow(i, 0, side - 1) & lit.narrow(i, 1, side - 1)).flatten(1) for i in (2, 1)]
    step = torch.where(torch.cat(both, 1), torch.cat(_steps(samples.source, side), 1), math.nan)
    usual = step.nanmedian(1).values.nan_to_num(nan=1.0)
    return pyramid.sums(image, _level(pyramid, usual * usual), samples.source, samples.gain / count)


def _level(pyramid: ImagePyramid, area: Tensor) -> Tensor:
    """Level for looks that stand for so many square pixels, (M,)."""
    octave = 0.5 * area.clamp(min=1e-6).log2() - SHARPER
    return octave.round().clamp(0, len(pyramid.sizes) - 1).to(torch.int64)


def _spread(source: Tensor, side: int) -> Tensor:
    """Looks of side x side parts of cells, (M, side^2, 2), from those of 2 x 2: bilinear, also beyond them."""
    along = RAYS * (torch.arange(side, device=source.device, dtype=source.dtype) + 0.5) / side - 0.5
    one = torch.stack([1 - along, along])  # (2, side) weights
    weights = torch.einsum("ai,bj->ijab", one, one).reshape(side * side, RAYS * RAYS)
    return torch.einsum("lr,mrc->mlc", weights, source)
