"""Caps on a far face that are traced as they are drawn, in machine code: for drops that move from frame to frame.

A table holds caps, not what their pixels look at: that is found on the way to each frame. Where it is asked for, and
for images of other types than bytes, it is tabulated, by the same loops, once for a plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from scipy.sparse import csr_array

from rainstereo import fresnel, panel_plane
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.compiled.layout import COUNT, DRAW, FILL
from rainstereo.drop_stack import DropStack
from rainstereo.droplet import SphericalCap
from rainstereo.lens import fold_radius
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import backproject
from rainstereo.types import Array, Image, Indices, Mask

from .boxes import Boxes
from .cap_rivals import Rivals
from .drops import Drops
from .outlines import BETWEEN, MARGIN, RING

STEP = 8  # pixels between nodes, as in `compiled.cap_rays`
LENSES = ("LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8", "LENSMODEL_OPENCV12")
FAR = 1e7  # pixels: of an outline without end
FINE = (25.0, 9), (math.inf, 12)
COARSE = (36.0, 4), (math.inf, 6)
"""Square root of the area, pixels, up to which what a pixel shows gets how many looks."""
COARSE_FROM = 2.5  # gray levels that a renderer allows


@dataclass(frozen=True, eq=False)
class FaceLattice:
    """Where rays of the camera meet a panel's far face, every few pixels; and what is behind it.

    nodes: (h, w, 4) float64: x, y in metres of the panel frame, and the transverse wave vector; of pixels 0, STEP, ...
    later, view: see `compiled.cap_rays`. origin: of the face's coordinates. index: the panel's.
    """

    nodes: Array
    later: Array
    view: Array
    origin: Array
    index: float

    @classmethod
    def of(cls, camera: Camera, chamber: Chamber, panel: int, depth: float) -> FaceLattice:
        """The lattice of a camera and a chamber."""
        frame = PanelFrame.of(chamber)
        columns, rows = (STEP * np.arange(max(-(-(n - 1) // STEP), 2) + 1.0) for n in camera.size)
        rays = backproject(np.stack(np.meshgrid(columns, rows), -1), camera, chamber, 2 * panel + 2)
        points, waves = (part @ frame.R_panel_cam.T for part in (rays.origins, rays.directions))
        nodes = np.concatenate([points[..., :2], waves[..., :2]], -1)
        later, end = _behind(chamber, panel)
        view: Image = _view(camera, frame, end, depth).astype(np.float32)
        return cls(nodes, later, view, frame.origin(chamber, panel), float(chamber.panels[panel].index))

    @property
    def is_whole(self) -> bool:
        """Whether every node has a ray."""
        return bool(np.isfinite(self.nodes).all())

    def dimming(self, index: float) -> Array:
        """What enters drops of an index, over what reaches the scene through the bare panels, at each node."""
        with np.errstate(invalid="ignore"):
            square = np.square(self.nodes[..., 2:]).sum(-1)
            panel, drop, air = (np.sqrt(n * n - square) for n in (self.index, index, 1.0))
            bare = fresnel.transmittance(panel, air, self.index, 1.0)
            for _, before, behind in self.later.astype(np.float64):
                one, two = (np.sqrt(n * n - square) for n in (before, behind))
                bare *= fresnel.transmittance(one, two, float(before), float(behind))
            found: Array = fresnel.transmittance(panel, drop, self.index, index) / bare
        return found


@dataclass(frozen=True, eq=False)
class CapScene:
    """What all tables of caps on one face share: camera, panes, and the images that hold the scene."""

    camera: Camera
    chamber: Chamber
    depth: float
    tolerance: float
    size: tuple[int, int]
    shift: tuple[int, int]
    border: str
    panel: int

    @classmethod
    def suits(cls, camera: Camera) -> bool:
        """Whether the loops know the camera's lens."""
        return camera.model in LENSES

    @cached_property
    def lattice(self) -> FaceLattice:
        """Of the far face."""
        return FaceLattice.of(self.camera, self.chamber, self.panel, self.depth)

    @cached_property
    def frame(self) -> PanelFrame:
        """The chamber's."""
        return PanelFrame.of(self.chamber)

    @cached_property
    def place(self) -> tuple[Array, Array, Array]:
        """Where the face is, what is before it, and how the camera sees it: see `compiled.cap_outlines`."""
        foot = self.frame.base(self.chamber, (0.0, 0.0), self.panel, "far")
        layers = [(panel.thickness, panel.index) for panel in self.chamber.panels[: self.panel + 1]]
        return foot, np.array(layers, dtype=np.float64), _view(self.camera, self.frame, 0.0, math.inf)

    def nodes(self, indices: tuple[float, ...]) -> Array:
        """The lattice, and how drops of each index dim."""
        if indices not in self._nodes:
            self._nodes.clear()
            dimming = [self.lattice.dimming(index)[..., None] for index in indices]
            self._nodes[indices] = np.concatenate([self.lattice.nodes, *dimming], -1)
        return self._nodes[indices]

    @cached_property
    def _nodes(self) -> dict[tuple[float, ...], Array]:
        return {}

    @cached_property
    def boxes(self) -> Boxes:
        """Of the images that hold the scene."""
        return Boxes.of(self.size)

    @property
    def fineness(self) -> tuple[tuple[float, int], ...]:
        """`FINE` or `COARSE`."""
        return COARSE if self.tolerance >= COARSE_FROM else FINE

    @cached_property
    def bands(self) -> Array:
        """How many looks a patch gets, by its area: see `compiled.cap_tiles`."""
        return np.array([(min(side * side, FAR), aim) for side, aim in self.fineness], dtype=np.float32)

    def go(self, mode: int, out: Any, scene: Any, words: Any, caps: CapTable, record: Any) -> None:
        """Run the loops over caps, see `compiled.cap_frames.frame`."""
        from rainstereo.compiled.cap_frames import desk, frame

        from .compile_ahead import MANY, compile_ahead  # which needs `render`

        if math.pi * float(np.square(caps.circles[:, 2]).sum()) > MANY:
            compile_ahead("moving")
        lattice, boxes = self.lattice, self.boxes
        border = 0 if self.border == "mirror" else 1
        shift = np.float32(self.shift[0]), np.float32(self.shift[1])
        flat, sizes = out.reshape(-1), (boxes.start, boxes.width, boxes.inverse)
        room = desk()
        for first, last, rivals, starts in caps.rivals.blocks:
            frame(
                mode, flat, self.camera.size, scene, words, sizes, border, shift, self.bands, caps.nodes, caps.columns,
                caps.circles, (first, last), rivals, starts, lattice.later, lattice.view, record, room,
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class CapTable:
    """Caps to be traced for a frame. It has the fields of `lookups.Lookups` but taps, made when they are asked for.

    caps: their columns, (N, 6) float64: centre on the face, contact radius and angle, index, and number of the group.
    circles: (N, 3) outlines in the image.
    """

    scene: CapScene
    caps: Array
    circles: Array = field(repr=False)

    @classmethod
    def of(cls, scene: CapScene, caps: Sequence[SphericalCap], numbers: Indices) -> CapTable:
        """Those that the image shows of caps on the scene's face; numbers: (N,) kept with them."""
        rows = np.array([(*cap.centre, cap.radius, cap.contact_angle, cap.index) for cap in caps], dtype=np.float64)
        columns = np.ascontiguousarray(rows.T)
        columns.setflags(write=False)
        x, y, radius, angle, index = columns
        table = cls._shown(scene, x, y, radius, angle, index, caps)
        table.caps[:, 5] = numbers[table.caps[:, 5].astype(np.intp)]
        return table

    @classmethod
    def of_table(cls, scene: CapScene, drops: Drops) -> CapTable:
        """The same of drops in a table, numbered as they come."""
        index = np.array([drops.index])
        index.setflags(write=False)
        caps = cast(Sequence[SphericalCap], drops.lazily())
        return cls._shown(scene, drops.x, drops.y, drops.radius, drops.contact_angle, index, caps)

    @classmethod
    def _shown(
        cls, scene: CapScene, x: Array, y: Array, radius: Array, angle: Array, index: Array,
        caps: Sequence[SphericalCap],
    ) -> CapTable:  # fmt: skip
        from rainstereo.compiled.cap_outlines import outline

        from .compile_ahead import MANY, compile_ahead  # which needs `render`

        if len(x) > MANY:
            compile_ahead("moving")
        _check_places(scene, caps, x, y, radius, angle)
        limits = MARGIN, FAR
        return cls(
            scene, *outline(x, y, radius, angle, index, *scene.place, RING, BETWEEN, limits, scene.camera.size)
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: list[CapTable]) -> list[CapTable]:
        """The same in one table for each face."""
        from rainstereo.compiled.cap_outlines import ordered

        found: dict[CapScene, list[CapTable]] = {}
        for part in parts:
            found.setdefault(part.scene, []).append(part)
        return [
            cls(
                scene,
                *ordered(*(np.concatenate([getattr(part, name) for part in some]) for name in ("caps", "circles"))),
            )
            for scene, some in found.items()
        ]

    def of_groups(self, groups: Indices) -> CapTable:
        """Those of some groups."""
        keep = np.isin(self.caps[:, 5], groups)
        return self if keep.all() else replace(self, caps=self.caps[keep], circles=self.circles[keep])

    # -- for the loops -------------------------------------------------------------------------------------------------

    @property
    def columns(self) -> Array:
        """(N, 7), see `compiled.cap_rays`."""
        return self._made[0]

    @property
    def nodes(self) -> Array:
        """The lattice, and how drops of each index dim."""
        return self.scene.nodes(tuple(self._made[1].tolist()))

    @cached_property
    def rivals(self) -> Rivals:
        """Caps whose circles meet each cap's."""
        return Rivals.of(self.circles, self.scene.camera.size)

    @cached_property
    def _made(self) -> tuple[Array, Array]:
        from rainstereo.compiled.cap_outlines import tabulated

        made: tuple[Array, Array] = tabulated(self.caps, self.scene.lattice.origin)
        return made

    # -- drawn ---------------------------------------------------------------------------------------------------------

    def draw(self, image: Image, out: Image, words: Any) -> None:
        """Draw into a frame of up to three channels of bytes, (H, W, C), which holds the clear image."""
        self.scene.go(DRAW, out, image, words, self, _record(0, 0))

    def values(self, image: Image, below: Image) -> Array:
        """What the table's pixels show, (M, C) float32, of any image (h, w, C); below: the frame's part of it."""
        found = self._looks
        texels = np.concatenate([self.scene.boxes.numbers(image), image.reshape(-1, image.shape[2]).astype(np.float32)])
        ends = np.concatenate([[0], np.cumsum(found.counts)])
        taps = csr_array((found.weights, found.texels, ends), shape=(len(found.pixels), len(texels)))
        own = below.reshape(-1, image.shape[2])[found.pixels].astype(np.float32)
        shown: Array = taps @ texels + found.clear[:, None] * own
        return shown

    @property
    def pixels(self) -> Any:
        """(M,) numbers of pixels, row by row of the frame."""
        return self._rows.pixels

    @property
    def groups(self) -> Any:
        """(M,) of the caps that were planned together."""
        return self.caps[self._rows.caps, 5].astype(np.int32)

    @property
    def clear(self) -> Array:
        """(M,) share of each pixel that no cap hides."""
        return self._rows.clear

    @property
    def displacement(self) -> Array:
        """(M, 2) from a pixel to the mean of what it looks at; NaN where it is dark."""
        return self._rows.displacement

    @property
    def unknown(self) -> Mask:
        """(M,) whether a ray may fall beyond the image."""
        return self._rows.unknown

    @cached_property
    def _rows(self) -> _Tabulated:
        """What is known of pixels, without what they look at, which takes ten times the memory."""
        return self._tabulated(False)

    @cached_property
    def _looks(self) -> _Tabulated:
        return self._tabulated(True)

    def _tabulated(self, with_taps: bool) -> _Tabulated:
        width, height = self.scene.camera.size
        out, image = (np.zeros((h, w, 0), dtype=np.uint8) for w, h in ((width, height), self.scene.size))
        words = np.zeros(self.scene.boxes.count, dtype=np.uint32)
        record = _record(0, 0)
        self.scene.go(COUNT, out, image, words, self, record)
        pixels, taps = record[-1].tolist()
        record = _record(pixels, taps if with_taps else 0)
        self.scene.go(FILL, out, image, words, self, record)
        return _Tabulated(*record[:-1])


@dataclass(frozen=True, eq=False)
class _Tabulated:
    """What the loops wrote down: of M pixels, and of T taps or none."""

    pixels: Any
    caps: Any
    counts: Any
    clear: Array
    displacement: Array
    unknown: Mask
    texels: Any
    weights: Array


def _check_places(
    scene: CapScene, caps: Sequence[SphericalCap], x: Array, y: Array, radius: Array, angle: Array
) -> None:
    """ValueError unless the chamber has room for caps on a far face, and the scene lies beyond them.

    The caps themselves are looked at only where something is wrong.
    """
    space = panel_plane.room(scene.chamber, scene.panel, "far")
    if math.isfinite(space) and not (radius * np.tan(angle / 2)).max() < space:
        for cap in caps:
            cap.check_room(space)
    if math.isfinite(scene.depth):
        foot, along = scene.place[0], scene.frame.R_panel_cam[:, 2]
        if not scene.depth > foot @ along + (x * along[0] + y * along[1]).max():
            DropStack(scene.chamber, caps).check_depth(scene.depth)


def _record(pixels: int, taps: int) -> tuple[Any, ...]:
    return (
        np.zeros(pixels, np.int32), np.zeros(pixels, np.int32), np.zeros(pixels, np.int32),
        np.zeros(pixels, np.float32), np.zeros((pixels, 2), np.float32), np.zeros(pixels, np.bool_),
        np.zeros(taps, np.int32), np.zeros(taps, np.float32), np.zeros(2, np.int64),
    )  # fmt: skip


def _behind(chamber: Chamber, panel: int) -> tuple[Any, float]:
    """Faces behind a panel's far one, (F, 3), and the distance of the last face of all: see `compiled.cap_rays`."""
    later, here, index = [], float(chamber.faces[panel]) + chamber.panels[panel].thickness, 1.0
    for i in range(panel + 1, len(chamber.panels)):
        near, n = float(chamber.faces[i]), float(chamber.panels[i].index)
        later.append((near - here, index, n))
        here, index = near, n
        touching_next = i + 1 < len(chamber.panels) and chamber.gaps[i] == 0
        if math.isfinite(chamber.panels[i].thickness) and not touching_next:
            later.append((chamber.panels[i].thickness, n, 1.0))
            here, index = near + chamber.panels[i].thickness, 1.0
    faces: Image = np.array(later, dtype=np.float32).reshape(-1, 3)
    return faces, here


def _view(camera: Camera, frame: PanelFrame, end: float, depth: float) -> Array:
    fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
    matrix = np.diag([fx, fy, 1.0]) @ frame.R_panel_cam.T
    view = [*matrix.ravel(), cx, cy, end, 1 / depth, 0.0]
    if len(camera.distortion):
        fold = 0.999 * min(float(fold_radius(camera.distortion)), 1e6)
        view[-1] = fold * fold
        view += [fx, fy, *camera.distortion.tolist(), *[0.0] * (12 - len(camera.distortion))]
    return np.array(view, dtype=np.float64)


__all__ = ["CapScene", "CapTable"]
