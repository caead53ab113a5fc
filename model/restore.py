"""A rainy image in, a clear one out: the trained generator behind a drop detector, in tiles where it must be.

    from rainstereo.model.restore import Restorer

    restorer = Restorer()  # the weights in the package
    clear = restorer(cv2.imread("photo.png"))

An image without drops costs the detector and a copy, and comes back bit for bit; so does every cell of 16 pixels of
any image in which the detector sees no drop. What is left is computed cell by cell, or, by networks that cannot do
that, in rectangles with some of the image around them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch

from rainstereo.model import checkpoint as checkpoints
from rainstereo.model import detector
from rainstereo.model.architecture import ARCHITECTURES
from rainstereo.model.cell_generator import CellGenerator, patches
from rainstereo.model.detector import CELL, CERTAIN, EVIDENT, THRESHOLD, UNIT, Detector, factor_for
from rainstereo.model.image_batch import INPUT
from rainstereo.model.networks import Network, OnnxNetwork, TorchNetwork, pick_device
from rainstereo.model.pixels import check, from_batch, from_rgb, to_batch, to_rgb
from rainstereo.model.tiles import Grid, Rect, Rows, coarser, covering, mixed, ramped, strips
from rainstereo.model.whole_frames import WholeFrames
from rainstereo.types import Image, Mask

Backend = Literal["torch", "onnx"]
Checkpoint = str | os.PathLike[str]

MAX_PIXELS = 4 << 20
"""What is computed at once, halo included; larger images are tiled."""
CELLS_HALO, PARTS_HALO = 0, 32
"""Pixels of the image around what holds drops that the generator sees, when the rest is skipped: computed by cells,
or in rectangles. From the curve of `rainstereo bench derain`: more costs time, and hardly raises the quality."""
BY_CELLS, LOOKING = 1.3, 0.28
"""What a pixel costs when single cells are computed, over what it costs in a whole image; and one in a cell that is
only looked at, over one that is computed."""
AROUND = 0.35
"""Share of a whole image's cost up to which the cells around those computed are looked at: they are context."""
RAMP = 4
"""Pixels within a marked cell over which the restored image replaces the given one."""
OVERLAP = 32
CALL = 8192
"""Pixels that could be computed in the time that one more call takes."""
WHOLE = 0.9
"""Share of an image from which on it is computed whole."""


@dataclass(frozen=True)
class Restored:
    """image: as given, restored. marked: share of cells that hold drops. computed: pixels that went through the
    generator, over those of the image; more than 1 where tiles overlap."""

    image: Image
    marked: float
    computed: float


class Restorer:
    """Restores images, uint8 or uint16, gray or BGR of any size, to the same type and shape; never changes its input.

    checkpoint: NAME.safetensors with its card, or for the backend "onnx" a file that `rainstereo export` wrote; None:
    the package's own. device: "auto", "cpu", "cuda", ... precision: "auto" (what pays there), "float32", "bf16",
    "float16". backend: "torch" or "onnx".
    tile: side, pixels, of the tiles of large images; None: by what may be computed at once, max_pixels.
    skip: whether cells without drops are left as they are; threshold, certain, evident: see `Detector`. halo: pixels
    that the generator sees around what has drops; None: what pays. around: share of a whole image's cost up to which
    cells next to those computed are looked at, too. A detector of one's own may be given.
    network: in place of a checkpoint, anything that is a `Network`.

    ValueError where the checkpoint is not for such images.
    """

    def __init__(
        self, checkpoint: Checkpoint | None = None, device: str | torch.device = "auto", precision: str = "auto",
        tile: int | None = None, skip: bool = True, backend: Backend = "torch", *, threshold: float = THRESHOLD,
        certain: float = CERTAIN, evident: float = EVIDENT, halo: int | None = None, around: float = AROUND,
        max_pixels: int = MAX_PIXELS, detector: Detector | None = None, network: Network | None = None,
    ) -> None:  # fmt: skip
        if (halo is not None and halo < 0) or (tile is not None and tile < 4 * CELL) or max_pixels < 1 << 16:
            raise ValueError(
                f"halo {halo}, tile {tile}, max_pixels {max_pixels} were given; expected a halo of 0 or more, a tile "
                f"of at least {4 * CELL} and at least {1 << 16} pixels at once"
            )
        self.network = network or _network(checkpoint, device, precision, backend)
        looks_on = self.network.device if self.network.device.type == "cuda" else "cpu"
        self.detector = (detector or Detector.shipped(looks_on, threshold, certain, evident)) if skip else None
        step = self.network.multiple
        self.step = step if step % CELL == 0 else int(np.lcm(step, CELL))
        self.by_cells: CellGenerator | None = getattr(self.network, "cells", None)
        wide = halo if halo is not None else CELLS_HALO if self.by_cells else PARTS_HALO
        self.halo, self.max_pixels = -(-wide // self.step) * self.step, max_pixels
        self.around = around
        self._tile = tile
        self.unit = max(self.step, UNIT)

    def __call__(self, image: Image) -> Image:
        """The image, restored."""
        return self.restored(image).image

    def restored(self, image: Image) -> Restored:
        """The image, restored, and how much of it had to be."""
        check(image)
        height, width = image.shape[:2]
        if height * width <= self.max_pixels:
            return self._at_once(image, factor_for(height, width))
        out, top, told = np.empty_like(image), 0, _Counted()
        for strip in self._strips(lambda first, last: image[first:last], (height, width), told):
            out[top : top + len(strip)] = strip
            top += len(strip)
        return Restored(out, told.marked / told.calls, told.computed / (height * width))

    def many(self, images: Sequence[Image]) -> list[Restored]:
        """Images, restored; those of one size that are computed whole go through the generator as one batch."""
        found: dict[int, Restored] = {}
        whole: dict[tuple[int, ...], list[tuple[int, Mask]]] = {}
        for i, image in enumerate(images):
            check(image)
            if _area(image) > self.max_pixels:
                found[i] = self.restored(image)
                continue
            cells = self.marked(image)
            plan = self.plan(cells, image) if cells.any() else []
            if isinstance(plan, list) and plan == [_whole(image)]:
                whole.setdefault((*image.shape, image.dtype.itemsize), []).append((i, cells))
            else:
                found[i] = self.with_cells(image, cells)
        for alike in whole.values():
            batch = to_batch(np.stack([images[i] for i, _ in alike]), self.network.device)
            for (i, cells), rgb in zip(alike, self.network(batch), strict=True):
                out = images[i].copy()
                _pasted(out, from_rgb(rgb, out), _whole(out), cells)
                found[i] = Restored(out, float(cells.mean()), 1.0)
        return [found[i] for i in range(len(images))]

    def stream(self, frames: Iterable[Image], batch: int = 1) -> Iterator[Image]:
        """Frames, restored in order. Where nothing is skipped, batches of one size are computed together, and on a
        CUDA device the next ones are sent before the last have come back; frames that need tiles come one by one."""
        if self.detector is not None:
            yield from (self.restored(frame).image for frame in frames)
            return
        whole = WholeFrames(self.network, batch)

        def small_enough(frame: Image) -> bool:
            check(frame)
            return _area(frame) <= self.max_pixels

        for small, run in groupby(frames, small_enough):
            if small:
                yield from whole(run)
            else:
                yield from map(self, run)

    def rows(
        self, read: Rows, size: tuple[int, int], told: Callable[[int, int], None] = lambda done, total: None
    ) -> Iterator[Image]:
        """An image of (height, width) that need not fit into memory, restored strip by strip from the top.

        read: rows first .. last - 1 of it; each is asked for about once. told: tiles done, of how many.
        """
        return self._strips(read, size, told)

    def grid(self, size: tuple[int, int]) -> Grid:
        """The tiles of a large image."""
        step, around = self.step, -(-self.network.halo // self.step) * self.step
        side = self._tile or int(self.max_pixels**0.5) - 2 * around
        side = max(4 * CELL, side // step * step)
        overlap = min(OVERLAP, side // 2) // step * step
        return Grid(size, side, around, overlap)

    # -- what is computed ----------------------------------------------------------------------------------------------

    def marked(self, image: Image, factor: int | None = None) -> Mask:
        """Which cells of 16 pixels are restored: those with drops, or all where nothing is skipped."""
        if self.detector is None:
            return np.ones((-(-image.shape[0] // CELL), -(-image.shape[1] // CELL)), bool)
        return self.detector.cells(image, factor, self.unit)

    def plan(self, cells: Mask, image: Image) -> list[Rect] | Mask:
        """What the generator computes for these cells: rectangles of the image, or the whole of it, or cells of its
        own size; the least work."""
        if self.network.device.type == "cuda":  # which is through with a frame before cells are cut out and put back
            return [_whole(image)]
        size = image.shape[0], image.shape[1]
        if self.by_cells is not None:
            where = coarser(cells, CELL, self.by_cells.cell, self.halo, size)
            return where if BY_CELLS * where.sum() < WHOLE * where.size else [_whole(image)]
        parts = covering(cells, CELL, self.halo, self.step, size, CALL)
        return [_whole(image)] if sum(part.area for part in parts) >= WHOLE * _area(image) else parts

    def with_cells(self, image: Image, cells: Mask, base: Image | None = None) -> Restored:
        """The image with only these cells restored; the others are the given ones, or those of a base, bit for bit."""
        out = (image if base is None else base).copy()
        if not cells.any():
            return Restored(out, 0.0, 0.0)
        plan = self.plan(cells, image)
        if not isinstance(plan, list):
            return Restored(out, float(cells.mean()), self._cell_by_cell(image, cells, plan, out) / _area(image))
        for part in plan:
            restored = self.whole(image[part.slices])
            top, left, bottom, right = (
                part.top // CELL,
                part.left // CELL,
                -(-part.bottom // CELL),
                -(-part.right // CELL),
            )
            _pasted(out, restored, part, cells[top:bottom, left:right])
        return Restored(out, float(cells.mean()), sum(part.area for part in plan) / _area(image))

    def looked_at(self, where: Mask) -> Mask:
        """Cells that the generator sees when it computes some of its own size: those around, too, if that is cheap."""
        wide: Mask = cv2.dilate(where.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        cost = BY_CELLS * (where.sum() + LOOKING * (wide.sum() - where.sum())) / where.size
        return wide if cost <= self.around else where

    def _cell_by_cell(self, image: Image, cells: Mask, where: Mask, out: Image) -> int:
        """Restore the marked cells, which lie in the cells `where` something is computed; how many pixels were."""
        made = self.by_cells
        assert made is not None  # noqa: S101
        looked = self.looked_at(where)
        given = patches(image, looked, made.cell, made.border)
        like = given[:1, : made.cell, : made.cell]  # whose kind and channels count
        restored = from_batch(made(to_batch(given, self.network.device), where, looked), like)
        weight = patches(ramped(cells, CELL, (image.shape[0], image.shape[1]), RAMP), where, made.cell, 0)
        tall = [each.reshape(-1, *each.shape[2:]) for each in (restored, patches(out, where, made.cell, 0), weight)]
        found = mixed(*tall).reshape(restored.shape)
        for square, row, column in zip(found, *np.nonzero(where), strict=True):
            part = out[row * made.cell : (row + 1) * made.cell, column * made.cell : (column + 1) * made.cell]
            part[...] = square[: part.shape[0], : part.shape[1]]
        return len(restored) * made.cell**2

    def whole(self, image: Image) -> Image:
        """The image through the generator, as it is: no skipping, no tiles."""
        return from_rgb(self.network(to_rgb(image, self.network.device))[0], image)

    def _at_once(self, image: Image, factor: int) -> Restored:
        if self.detector is None:
            return Restored(self.whole(image), 1.0, 1.0)
        return self.with_cells(image, self.marked(image, factor))

    def _strips(self, read: Rows, size: tuple[int, int], told: Callable[[int, int], None]) -> Iterator[Image]:
        factor = factor_for(*size)

        def restore(part: Image) -> Image:
            found = self._at_once(part, factor)
            if isinstance(told, _Counted):
                told.add(found, _area(part))
            return found.image

        return strips(read, self.grid(size), restore, told)


class _Counted:
    """Sums over the tiles of an image."""

    def __init__(self) -> None:
        self.calls, self.marked, self.computed = 0, 0.0, 0.0

    def add(self, found: Restored, area: int) -> None:
        self.calls += 1
        self.marked += found.marked
        self.computed += found.computed * area

    def __call__(self, done: int, total: int) -> None:
        """Progress, which nobody asked for."""


def _area(image: Image) -> int:
    return int(image.shape[0] * image.shape[1])


def _whole(image: Image) -> Rect:
    return Rect(0, 0, image.shape[0], image.shape[1])


def _pasted(out: Image, restored: Image, part: Rect, cells: Mask) -> Image:
    """Put the restored part into the image, in its marked cells only, with soft edges inside them."""
    if cells.all():
        out[part.slices] = restored
        return out
    weight = ramped(cells, CELL, (part.bottom - part.top, part.right - part.left), RAMP)
    out[part.slices] = mixed(restored, out[part.slices], weight)
    return out


def leaves_out() -> str:
    """Changes when anything does that decides, by default, which cells are left as they are."""
    weights = detector.shipped().read_bytes()
    settings = THRESHOLD, CERTAIN, EVIDENT, UNIT, CELLS_HALO, PARTS_HALO, RAMP, BY_CELLS, LOOKING, AROUND, WHOLE, CALL
    return hashlib.sha256(weights + repr(settings).encode()).hexdigest()


# -- checkpoints -------------------------------------------------------------------------------------------------------


def _network(checkpoint: Checkpoint | None, device: str | torch.device, precision: str, backend: str) -> Network:
    if backend == "onnx":
        if checkpoint is None:
            raise ValueError(
                "the onnx backend needs a file: make one with rainstereo export --out derain.onnx, then give it as the "
                "checkpoint"
            )
        return OnnxNetwork(Path(checkpoint))
    if backend != "torch":
        raise ValueError(f"backend {backend!r} is unknown; expected torch or onnx")
    pick_device(device)  # says what is wrong with it before anything is read
    return TorchNetwork(opened(checkpoint).build(), device, precision)


def opened(checkpoint: Checkpoint | None) -> checkpoints.Checkpoint:
    """A checkpoint that restores RGB images in 0..1; ValueError for another. None: the package's own."""
    path = checkpoints.shipped() if checkpoint is None else Path(checkpoint)
    if checkpoint is None and not path.is_file():
        raise FileNotFoundError(
            f"this package was built without its weights ({path.name}); give a checkpoint of rainstereo train"
        )
    if path.suffix == ".onnx":
        raise ValueError(f"{path} is an ONNX file; choose the backend onnx for it")
    found = checkpoints.load(path)
    restores(found)
    return found


def restores(found: checkpoints.Checkpoint) -> None:
    """ValueError where a checkpoint is no de-rainer of RGB images in 0..1."""
    if found.architecture not in ARCHITECTURES:
        raise ValueError(
            f"{found.path} holds {found.architecture or 'something unnamed'}; expected what restores images: "
            + ", ".join(sorted(ARCHITECTURES))
        )
    told = found.card.get("input", {})  # cards without it are of RGB in 0 .. 1
    told = told if isinstance(told, dict) else {"channels": told}
    wrong = ", ".join(f"{name} {told[name]}" for name, ours in INPUT.items() if told.get(name, ours) != ours)
    if wrong:
        raise ValueError(
            f"{found.path} is for other images than photographs are: {wrong}; expected "
            + ", ".join(f"{name} {ours}" for name, ours in INPUT.items())
            + ". Take another checkpoint"
        )
