"""Adherent drops on a batch of images, on any device, with gradients: the torch renderer.

Only what drops cover is traced; the rest of an image is copied bit by bit. Gradients reach the images and, through the
places that are looked at and their brightness, the caps; what a drop covers, and how coarse a copy of the image a place
is looked up in, counts as constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.model.cap_table import COLUMNS, CapTable
from rainstereo.model.disc_blur import disc_blur
from rainstereo.model.drop_cover import Canvas
from rainstereo.model.drop_looks import DropLooks, Shown
from rainstereo.model.image_pyramid import ImagePyramid

SHARP = 1.0
"""Diameter in pixels below which a disc blurs no more than a pixel does."""

ACROSS = 8.0
"""Cells across the disc, at least, of a blurred layer."""

FAINT = 1e-5
"""Opacity below which there is nothing."""

TOGETHER, TOGETHER_ELSEWHERE = 1 << 19, 1 << 25
"""Pixels of images rendered at a time, on the processor and on other devices: this bounds memory."""


@dataclass(frozen=True, eq=False)
class RainLayer:
    """Images with drops. image: (B, C, H, W), as given. opacity: (B, 1, H, W), share of each pixel that drops hide.

    unknown: (B, 1, H, W) bool, pixels that show something beyond the image's edge.
    """

    image: Tensor
    opacity: Tensor
    unknown: Tensor

    @property
    def mask(self) -> Tensor:
        """(B, 1, H, W) bool: pixels that a drop touches."""
        return self.opacity > 0


def render(
    images: Tensor,
    caps: CapTable,
    camera: Camera,
    chamber: Chamber,
    depth: float = math.inf,
    *,
    model: str = "exact",
    discs: Tensor | None = None,
    rays: int = 8,
    clip: tuple[float, float] | None = None,
) -> RainLayer:
    """Images of the camera's size, (B, C, H, W) floating point, with caps of their own; never changed.

    depth: of the scene, metres. model: "exact", or "texture" for the paper's model with the surface's slope
    (`Texture.slopes`), whose transmittance is that of the bare panels.
    discs: (B,) diameter in pixels of the disc that the lens makes of a point of the pane; None: a pinhole.
    rays: along a pixel's side where it shows an edge, 2 or more; 8 is within 2 gray levels RMS of 8 bits of
    `rainstereo.rain.render` inside drops, 4 takes half the time.
    clip: to which the values of covered pixels are clipped; None: they may be a little brighter than any of the image,
    since water passes a few per cent more light than bare acrylic.

    Beyond the image it is mirrored. Half precision is rendered in single, double in double.
    """
    _check(images, caps, camera, discs, rays)
    size = max(1, (TOGETHER if images.device.type == "cpu" else TOGETHER_ELSEWHERE) // camera.width // camera.height)
    parts = [
        _render(images[rows], _rows(caps, rows), camera, chamber, depth, model, None if discs is None else discs[rows],
                rays, clip)
        for rows in (slice(i, i + size) for i in range(0, len(images), size))
    ]  # fmt: skip
    if not parts:
        opacity = images.new_zeros(0, 1, *images.shape[2:])
        return RainLayer(images.clone(), opacity, opacity > 0)
    if len(parts) == 1:
        return parts[0]
    return RainLayer(*(torch.cat([getattr(part, name) for part in parts]) for name in ("image", "opacity", "unknown")))


def _check(images: Tensor, caps: CapTable, camera: Camera, discs: Tensor | None, rays: int) -> None:
    if images.ndim != 4 or not images.is_floating_point():
        raise ValueError(f"images are {images.dtype} {tuple(images.shape)}; expected floating point (B, C, H, W)")
    if (images.shape[3], images.shape[2]) != camera.size:
        raise ValueError(
            f"images have {images.shape[3]} x {images.shape[2]} pixels; the camera has {camera.width} x {camera.height}"
        )
    if len(caps.x) != len(images) or caps.x.device != images.device:
        raise ValueError(
            f"the table holds caps of {len(caps.x)} images on {caps.x.device}; expected a row for each of "
            f"{len(images)} images, on their device, {images.device}"
        )
    if discs is not None and discs.shape != images.shape[:1]:
        raise ValueError(f"discs have shape {tuple(discs.shape)}; expected a diameter for each of {len(images)} images")
    if not 2 <= rays <= 16:
        raise ValueError(f"{rays} rays along a pixel's side were asked for; expected 2 to 16")


def _rows(caps: CapTable, rows: slice | Tensor) -> CapTable:
    """The caps of some images."""
    return replace(caps, **{name: getattr(caps, name)[rows] for name in COLUMNS})


def _render(
    images: Tensor, caps: CapTable, camera: Camera, chamber: Chamber, depth: float, model: str,
    discs: Tensor | None, rays: int, clip: tuple[float, float] | None,
) -> RainLayer:  # fmt: skip
    count, _, height, width = images.shape
    dtype = torch.promote_types(images.dtype, torch.float32)
    out, given = images.clone(), images.to(dtype)
    opacity = torch.zeros(count, 1, height, width, dtype=images.dtype, device=images.device)
    layer = RainLayer(out, opacity, torch.zeros_like(opacity, dtype=torch.bool))
    steps = _steps(count if discs is None else discs.detach())
    for step in sorted(set(steps)):
        rows = torch.tensor([i for i, each in enumerate(steps) if each == step], device=images.device)
        everyone = len(rows) == count
        own = caps if everyone else _rows(caps, rows)
        if not bool((own.radius.detach() > 0).any()):
            continue
        some = given if everyone else given[rows]
        looks, pyramid = DropLooks(own, camera, chamber, depth, model), ImagePyramid.of(some)
        if step == 0 or discs is None:
            _paste_sharp(layer, some, rows, looks.shown(pyramid, Canvas(width, height), rays), clip)
        else:
            _paste_blurred(layer, some, rows, looks, pyramid, discs[rows].to(dtype), step, clip)
    return layer


def _steps(discs: Tensor | int) -> list[int]:
    """Pixels along the side of the cells in which each image's layer is blurred, a power of two; 0: it is sharp."""
    if isinstance(discs, int):
        return [0] * discs
    return [0 if d < SHARP else 2 ** max(0, math.floor(math.log2(d / ACROSS))) for d in discs.tolist()]


def _paste_sharp(layer: RainLayer, given: Tensor, rows: Tensor, shown: Shown, clip: tuple[float, float] | None) -> None:
    """Write what drops show into images, at pixels."""
    image, number = shown.cells.image, shown.cells.number
    below = given.flatten(2).transpose(1, 2)[image, number]
    colour = shown.colour + (1 - shown.opacity).unsqueeze(1) * below
    if clip is not None:
        colour = colour.clamp(*clip)
    to = (rows[image], number)
    layer.image.flatten(2).transpose(1, 2)[to] = colour.to(layer.image.dtype)
    layer.opacity.flatten(1)[to] = shown.opacity.to(layer.opacity.dtype)
    layer.unknown.flatten(1)[to] = shown.unknown


def _paste_blurred(
    layer: RainLayer, given: Tensor, rows: Tensor, looks: DropLooks, pyramid: ImagePyramid, discs: Tensor, step: int,
    clip: tuple[float, float] | None,
) -> None:  # fmt: skip
    """Put blurred layers, made in cells of step x step pixels, over images."""
    count, channels, height, width = given.shape
    pad = step * (math.ceil(0.5 * float(discs.max()) / step) + 2)  # a cell for the average, one for the interpolation
    canvas = Canvas(-(-(width + 2 * pad) // step), -(-(height + 2 * pad) // step), step, pad)
    shown = looks.shown(pyramid, canvas, 4 if step == 1 else 2)  # the disc averages further
    planes = torch.cat([shown.colour, shown.opacity.unsqueeze(1), shown.unknown.to(given.dtype).unsqueeze(1)], 1)
    cells = given.new_zeros(count, canvas.rows * canvas.columns, channels + 2)
    cells = cells.index_put((shown.cells.image, shown.cells.number), planes)
    cells = cells.transpose(1, 2).reshape(count, channels + 2, canvas.rows, canvas.columns)
    # averaging and interpolating widen a disc; see `rainstereo.defocus`
    narrower = (discs / step).square() - (16 / 3 if step > 1 else 0)
    fine = disc_blur(cells, narrower.sqrt())
    if step > 1:
        fine = functional.interpolate(fine, scale_factor=step, mode="bilinear", align_corners=False)
    fine = fine[..., pad : pad + height, pad : pad + width]
    colour, opacity, unknown = fine[:, :channels], fine[:, channels : channels + 1], fine[:, channels + 1 :]
    opacity = opacity.detach().clamp(max=1)
    mixed = colour + (1 - opacity) * given
    if clip is not None:
        mixed = mixed.clamp(*clip)
    touched = opacity > FAINT
    layer.image[rows] = torch.where(touched, mixed.to(layer.image.dtype), layer.image[rows])
    layer.opacity[rows] = torch.where(touched, opacity, 0).to(layer.opacity.dtype)
    layer.unknown[rows] = touched & (unknown.detach() > FAINT)
