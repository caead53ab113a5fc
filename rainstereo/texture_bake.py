"""What a drop's texture holds at each texel: the thin drop to first order, the literal reading, the exact trace.

A thin drop of height h and slope g = grad h turns the transverse part k of a ray's wave vector, to first order in h, by

    dk = (sqrt(n_w^2 - k^2) - sqrt(1 - k^2)) g

(Snell's law at a surface whose normal is along (-g, 1); n_w - 1 where light falls squarely), towards its thicker part,
on near and far faces alike, and shifts it as a plane sheet of water of that height does. k is that of the bare ray:
parallel panels keep it, so that panels and their tilt cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .camera import Camera
from .chamber import Chamber
from .drop_stack import DropStack
from .droplet import Drop
from .panel_plane import PanelFrame
from .trace import Trace, trace
from .types import Array, Mask

Window = tuple[slice, slice]

AROUND = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def texels(window: Window) -> Array:
    """Pixels, (H, W, 2), at the centres of a window's texels."""
    rows, columns = window
    grid = np.empty((rows.stop - rows.start, columns.stop - columns.start, 2))
    grid[..., 0], grid[..., 1] = np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop)[:, None]
    return grid


def undistorted(pixels: Array, camera: Camera) -> Array:
    """Where the camera without its distortion would have these pixels, (..., 2); NaN where the lens has no ray."""
    if camera.model == "LENSMODEL_PINHOLE":
        return pixels
    rays = camera.unproject(pixels)
    with np.errstate(invalid="ignore", divide="ignore"):
        straight = np.where(rays[..., 2:] > 0, rays[..., :2] / rays[..., 2:], np.nan)
    ideal: Array = straight * camera.intrinsics[:2] + camera.intrinsics[2:4]
    return ideal.astype(pixels.dtype)


def continued(values: Array, known: Mask) -> Array:
    """Values, (H, W, C), continued by one texel beyond where they are known, so that interpolation needs no edges.

    Along rows, columns and diagonals as a straight line through the two texels before, on average over the directions
    in which there are two; as the mean of known neighbours where there are none; 0 where no neighbour is known.
    """
    full = np.where(known[..., None], values, 0)
    if not known.any():
        return full
    ring = cv2.dilate(known.view(np.uint8), np.ones((3, 3), np.uint8)).view(np.bool_) & ~known
    row, column = np.nonzero(ring)
    wide, mask = np.pad(full, ((2, 2), (2, 2), (0, 0))), np.pad(known, 2)
    lines, neighbours = np.zeros((2, len(row), values.shape[-1]))
    line_count, neighbour_count = np.zeros((2, len(row), 1))
    for dy, dx in AROUND:
        first, second = ((row + 2 + k * dy, column + 2 + k * dx) for k in (1, 2))
        one = mask[first][:, None]
        both = one & mask[second][:, None]
        lines += both * (2 * wide[first] - wide[second])
        line_count += both
        neighbours += wide[first]
        neighbour_count += one
    full[row, column] = np.where(line_count > 0, lines / np.maximum(line_count, 1), neighbours / neighbour_count)
    return full


@dataclass(frozen=True, eq=False)
class ThinDrop:
    """The drop under each of N pixels, taken to be thin. Panel frame, metres.

    wet: (N,) whose bare ray crosses the face where the drop covers it; the other arrays hold the M of those.
    height: (M,), gradient: (M, 2) of the surface there. k: (M, 2) transverse wave vector of the bare ray.
    ideal: (M, 2) those pixels without the lens's distortion. bare: their trace without the drop.
    R: (3, 3), from the camera's frame to the panels'.
    """

    wet: Mask
    height: Array
    gradient: Array
    k: Array
    ideal: Array
    bare: Trace
    R: Array
    stack: DropStack
    drop: Drop
    camera: Camera

    @classmethod
    def under(cls, pixels: Array, drop: Drop, camera: Camera, chamber: Chamber) -> ThinDrop:
        """The drop under pixels, (N, 2)."""
        stack, R = DropStack(chamber, [drop]), PanelFrame.of(chamber).R_panel_cam
        face = next(face for face in stack.faces if face.drops)
        rays = camera.unproject(pixels) @ R.T
        k = np.where(rays[:, 2:] > 0, rays[:, :2], np.nan)
        before = stack.faces[: stack.faces.index(face)]
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = stack.faces[0].z / _along(k, 1.0)
            for near, far in zip(before, stack.faces[1:], strict=False):
                reach = reach + (far.z - near.z) / _along(k, near.n2)
            x, y = (reach[:, None] * k - face.origin[:2] - drop.centre).T
            wet = np.isfinite(x) & drop.covers(x, y)
        height, *slopes = drop.surface(x[wet], y[wet])
        ideal, bare = undistorted(pixels[wet], camera), trace(pixels[wet], None, camera, chamber)
        return cls(wet, height, np.stack(slopes, -1), k[wet], ideal, bare, R, stack, drop, camera)

    def in_image(self, vectors: Array) -> Array:
        """Components along the camera's x and y, (M, 2), of vectors in the panel's plane, (M, 2)."""
        seen: Array = vectors @ self.R[:2, :2]
        return seen

    def shift(self) -> tuple[Array, Array]:
        """What the thin drop adds to the bare panels' offset, (M, 2) pixels, and slope in 1/Z, (M, 2) pixel metres.

        First order in the height, like the wave vector's turn: both are derivatives, along it, of the source's
        offset f d_xy/d_z and slope f (o_xy - o_z d_xy/d_z) for a ray o, d behind the chamber.
        """
        k, water, air = self.k, _along(self.k, self.drop.index), _along(self.k, 1.0)
        dk = (water - air)[:, None] * self.gradient
        moved = (self.height * (1 / water - 1 / air))[:, None] * k
        faces = self.stack.faces
        first = next(i for i, face in enumerate(faces) if face.drops)
        across = (k * dk).sum(-1)
        for near, far in zip(faces[first:], faces[first + 1 :], strict=False):
            kz = _along(k, near.n2)
            moved += (far.z - near.z) * (dk / kz[:, None] + k * (across / kz**3)[:, None])
        kz = _along(k, faces[-1].n2)
        d, turned = np.c_[k, kz] @ self.R, np.c_[dk, -across / kz] @ self.R
        focal = self.camera.intrinsics[:2]
        straight = d[:, :2] / d[:, 2:]
        offset = focal * (turned[:, :2] - straight * turned[:, 2:]) / d[:, 2:]
        o = np.c_[moved, np.zeros(len(moved))] @ self.R
        slope = focal * (o[:, :2] - straight * o[:, 2:]) - self.bare.start[:, None] * offset
        return offset, slope


def _along(k: Array, index: float) -> Array:
    """Component along the normal, (M,), of wave vectors with the transverse part k, (M, 2), in a medium."""
    kz: Array = np.sqrt(index * index - (k * k).sum(-1))
    return kz


def best_scale(unscaled: Array, exact: Trace, ideal: Array) -> float:
    """The s with which ideal + s * unscaled, (N, 2), comes closest to the exact source in least squares.

    Both in pixels without the lens's distortion. Judged where the exact source lies in the frame; if that is less than
    a tenth of where it is known, at the rim alone, then wherever it is known; 0 if that too is nowhere.
    """
    known = exact.status == 0
    with np.errstate(invalid="ignore"):
        inside = known & ((exact.source >= -0.5) & (exact.source <= np.array(exact.camera.size) - 0.5)).all(-1)
    use = inside if 10 * np.count_nonzero(inside) >= np.count_nonzero(known) > 0 else known
    shape, goal = unscaled[use], (exact.offset + exact.slope / exact.depth - ideal)[use]
    power = float((shape * shape).sum())
    return float((shape * goal).sum()) / power if power > 0 else 0.0
