"""Exact optics of drops on tensors: the formulas of `rainstereo.trace` for torch, on any device and with gradients.

`trace` takes the drops that the numpy tracer takes, spherical caps and height maps. `trace_caps` takes a batch of
images with caps of their own as tensors (`CapTable`), and its answers can be differentiated with respect to them,
to the depth and, for a camera without distortion, to the pixels. Rays that have no answer get NaN there and a gradient
of 0.

Rays start in double precision, which the device must know, and go on in the pixels' precision from the first drop on.
Light, limits, frames and status codes are those of `rainstereo.trace`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from rainstereo import panel_plane
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.drop_grid import NOBODY
from rainstereo.drop_stack import DropStack
from rainstereo.droplet import Drop
from rainstereo.model.cap_table import CapTable
from rainstereo.model.drop_faces import DropFace
from rainstereo.model.lens_tensors import directions, distorted
from rainstereo.model.ray_tensors import Rays, is_empty
from rainstereo.ray_bundle import Fate
from rainstereo.trace import ALONG
from rainstereo.types import Array

BLOCK, BLOCK_ELSEWHERE = 1 << 16, 1 << 22
"""Rays traced at a time: few enough for the processor's caches, on other devices enough to fill them."""


@dataclass(frozen=True, eq=False)
class Trace:
    """What each pixel shows, as `rainstereo.trace.Trace`; NaN, and a status other than 0, where there is no answer.

    source: (..., 2) pixel of the clear image, for the plane z = `depth`. transmittance: (...,). status: (...,) uint8,
    `rainstereo.trace.Fate`. offset, slope: (..., 2) pixels and pixel metres of the camera without its distortion.
    start: (...,) metres, z where the ray leaves its last interface. fate: (...,) before the ray meets the plane.
    """

    source: Tensor
    transmittance: Tensor
    status: Tensor
    offset: Tensor
    slope: Tensor
    start: Tensor
    depth: float | Tensor
    camera: Camera = field(repr=False)
    fate: Tensor = field(repr=False)

    def at(self, depth: float | Tensor) -> Trace:
        """The same rays meeting the plane at another depth, metres: a number, or a tensor that broadcasts to (...)."""
        inverse = _inverse(depth, self.offset)
        through = self.fate == Fate.THROUGH
        if isinstance(inverse, Tensor):  # 0 times the NaN of a lost ray must not reach its gradient
            slope = torch.where(through.unsqueeze(-1), self.slope, 0.0)
            source = self.offset + slope * inverse.unsqueeze(-1)
        else:
            source = self.offset + self.slope * inverse
        lost, status = through & ~(self.start * inverse < 1), self.fate
        if not is_empty(lost):
            status = torch.where(lost, int(Fate.BEHIND), status)
        if self.camera.model != "LENSMODEL_PINHOLE":
            source, seen = distorted(source, self.camera)
            status = torch.where((status == Fate.THROUGH) & ~seen, int(Fate.NO_IMAGE), status)
            lost = status != Fate.THROUGH
        if not is_empty(lost):
            source = torch.where(lost.unsqueeze(-1), math.nan, source)
        return replace(self, source=source, status=status, depth=depth)


def trace(
    pixels: Tensor,
    drops: Drop | Sequence[Drop] | None,
    camera: Camera,
    chamber: Chamber | None,
    depth: float | Tensor = math.inf,
    *,
    which: Tensor | None = None,
) -> Trace:
    """Trace pixels, (..., 2) float32 or float64, through spherical caps and height maps.

    Arguments and answers are those of `rainstereo.trace.trace`, as tensors on the device and of the precision of
    `pixels`. ValueError for other shapes of drops: sample them with `HeightMap.of`.
    """
    _check_pixels(pixels)
    everyone = [] if drops is None else [drops] if isinstance(drops, Drop) else list(drops)
    stack = DropStack(chamber, everyone)
    stack.check_depth(_nearest(depth))
    faces = [DropFace.of(face, pixels.dtype, pixels.device, len(everyone)) for face in stack.faces]
    scene = _Scene(stack, camera, faces, drops is not None)
    labels = None if which is None else _labels(which, pixels, pixels.shape[:-1], len(everyone)).reshape(1, -1)
    rays = scene.trace(pixels.reshape(1, -1, 2), 1, labels, pixels.shape[:-1])
    return rays.at(depth)


def trace_caps(
    pixels: Tensor,
    caps: CapTable,
    camera: Camera,
    chamber: Chamber,
    depth: float | Tensor = math.inf,
    *,
    which: Tensor | None = None,
) -> Trace:
    """Trace the pixels of a batch of images, each with its own caps; answers are (B, N), with gradients.

    pixels: (B, N, 2), or (1, N, 2) for the same pixels of all images; float32 or float64, on the caps' device.
    depth: of the plane z = depth in the camera's frame, metres: a number, or a tensor that broadcasts to (B, N), such
    as (B, 1) for a depth for each image. which: (B, N) number of the drop in its image's row of the table that the
    pixel may meet, -1 for none; None: find out.
    """
    _check_pixels(pixels)
    images, drops = caps.x.shape
    if pixels.ndim != 3 or pixels.shape[0] not in (1, images) or pixels.device != caps.x.device:
        raise ValueError(
            f"pixels are {tuple(pixels.shape)} on {pixels.device}; expected ({images}, N, 2) or (1, N, 2) for a table "
            f"of {images} images, on its device, {caps.x.device}"
        )
    caps.check_room(panel_plane.room(chamber, caps.panel, caps.face))
    stack = DropStack(chamber, [])
    z = float(chamber.faces[caps.panel]) + (chamber.panels[caps.panel].thickness if caps.face == "far" else 0.0)
    own = next(face for face in stack.faces if face.side == caps.face and face.z == z)
    faces = [DropFace.of_table(face, caps) if face is own else DropFace(face) for face in stack.faces]
    scene = _Scene(stack, camera, faces, True)
    scene.check_depth(depth, caps, own.origin, z)
    shape = (images, pixels.shape[1])
    labels = None
    if which is not None:
        labels = _labels(which, pixels, torch.Size(shape), drops)
        first = drops * torch.arange(images, device=labels.device).unsqueeze(-1)
        labels = torch.where(labels >= 0, labels + first, NOBODY)
    return scene.trace(pixels, images, labels, torch.Size(shape)).at(depth)


class _Scene:
    """What all blocks of a trace share."""

    def __init__(self, stack: DropStack, camera: Camera, faces: Sequence[DropFace], asked: bool) -> None:
        self.stack, self.camera, self.faces, self.asked = stack, camera, faces, asked
        self.R = np.eye(3) if stack.frame is None else stack.frame.R_panel_cam

    def trace(self, pixels: Tensor, images: int, labels: Tensor | None, shape: torch.Size) -> Trace:
        """Rays of pixels, (images or 1, N, 2), before they meet the plane; block by block."""
        look = directions(pixels, self.camera, self.R)
        size, count = BLOCK if pixels.device.type == "cpu" else BLOCK_ELSEWHERE, pixels.shape[1]
        several, step = max(1, size // max(1, count)), min(max(count, 1), size)
        blocks = [  # of whole images, or of a part of one
            self._block(pixels, look, slice(first, min(first + several, images)), slice(begin, begin + step), labels)
            for first in range(0, max(images, 1), several)
            for begin in range(0, max(count, 1), step)
        ]
        offset, slope, start, transmittance, fate = (
            torch.cat(columns).reshape(*shape, *columns[0].shape[1:]) for columns in zip(*blocks, strict=True)
        )
        return Trace(offset, transmittance, fate, offset, slope, start, math.inf, self.camera, fate)

    def _block(
        self,
        pixels: Tensor,
        look: Callable[[slice, slice], tuple[Tensor, ...]],
        images: slice,
        columns: slice,
        labels: Tensor | None,
    ) -> tuple[Tensor, ...]:
        """Offset, slope, start, transmittance and fate of some pixels of some images, (images x pixels, ...)."""
        own = images if len(pixels) > 1 else slice(0, 1)
        given = pixels[own, columns]
        shape = (images.stop - images.start, given.shape[1])
        kx, ky, kz = (c.expand(shape).reshape(-1) for c in look(own, columns))
        rays = Rays.of(kx, ky, kz, given.expand(*shape, 2).reshape(-1, 2), bool(self.faces))
        met, here = torch.zeros_like(rays.fate, dtype=torch.bool), 0.0
        which = None if labels is None else labels[images, columns].reshape(-1)
        for face in self.faces:
            rays, touched = face.cross(rays.advance(face.face.z - here), images, which, pixels.dtype)
            here, met = face.face.z, met | touched
        if self.asked:
            rays = rays.lose(~met, Fate.NO_DROP)
        return self._image(rays, pixels.dtype)

    def _image(self, rays: Rays, dtype: torch.dtype) -> tuple[Tensor, ...]:
        """Where rays behind the chamber go, in pixels."""
        fx, fy, cx, cy = (float(c) for c in self.camera.intrinsics[:4])
        to_image = (np.diag([fx, fy, 1]) @ self.R.T).tolist()
        z = rays.rise + self.stack.end
        du, dv, dz = (a * rays.kx + b * rays.ky + c * rays.kz for a, b, c in to_image)
        ou, ov, oz = (a * rays.x + b * rays.y + c * z for a, b, c in to_image)
        ahead = dz > ALONG
        dz = torch.where(ahead, dz, 1.0)
        du, dv = du / dz, dv / dz
        fate = torch.where((rays.fate == Fate.THROUGH) & ~ahead, int(Fate.BEHIND), rays.fate)
        through = fate == Fate.THROUGH
        answers = (du + cx, dv + cy, ou - du * oz, ov - dv * oz, oz, rays.transmittance)
        u, v, su, sv, start, share = (torch.where(through, c, math.nan).to(dtype) for c in answers)
        return torch.stack([u, v], -1), torch.stack([su, sv], -1), start, share, fate

    def check_depth(self, depth: float | Tensor, caps: CapTable, origin: Array, z: float) -> None:
        """ValueError if the plane lies before a cap of the table."""
        n = self.R[:, 2]
        with torch.no_grad():
            along = float(n[0]) * (float(origin[0]) + caps.x) + float(n[1]) * (float(origin[1]) + caps.y)
            along = along[caps.radius > 0]
            behind = float(n[2]) * z + (float(along.max()) if len(along) else -math.inf)
        if not _nearest(depth) > behind:
            raise ValueError(
                f"the plane at depth {_nearest(depth):g} m lies before a drop, which is at {behind:.4g} m from the "
                "camera; expected a depth in metres beyond the chamber, or inf"
            )


def _check_pixels(pixels: Tensor) -> None:
    if (
        not isinstance(pixels, Tensor)
        or pixels.dtype not in (torch.float32, torch.float64)
        or pixels.shape[-1:] != (2,)
    ):
        kind = f"{pixels.dtype} {tuple(pixels.shape)}" if isinstance(pixels, Tensor) else type(pixels).__name__
        raise ValueError(f"pixels are {kind}; expected a tensor (..., 2) of float32 or float64")


def _labels(which: Tensor, pixels: Tensor, shape: torch.Size, count: int) -> Tensor:
    if which.shape != shape or which.is_floating_point() or which.dtype == torch.bool:
        raise ValueError(
            f"which is {which.dtype} {tuple(which.shape)}; expected integers of shape {tuple(shape)}, one a pixel"
        )
    if which.numel() and not (int(which.min()) >= NOBODY and int(which.max()) < count):
        raise ValueError(
            f"which holds {int(which.min())} to {int(which.max())}; expected -1 for none or the number of one of "
            f"{count} drops"
        )
    return which.to(pixels.device, torch.int64)


def _nearest(depth: float | Tensor) -> float:
    if isinstance(depth, Tensor):
        return float(depth.detach().min()) if depth.numel() else math.inf
    return float(depth)


def _inverse(depth: float | Tensor, pixels: Tensor) -> float | Tensor:
    """1 / depth, in the pixels' precision."""
    if not _nearest(depth) > 0:
        raise ValueError(f"a depth of {_nearest(depth):g} m was given; expected metres in front of the camera, or inf")
    if not isinstance(depth, Tensor):
        return 1 / float(depth)
    shape = pixels.shape[:-1]
    if depth.ndim > len(shape) or any(a not in (1, b) for a, b in zip(depth.shape[::-1], shape[::-1], strict=False)):
        raise ValueError(f"depth has shape {tuple(depth.shape)}; expected one that broadcasts to {tuple(shape)}")
    return (1 / depth.double()).to(pixels)
