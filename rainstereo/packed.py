"""Many patches applied to a frame at once: their covered pixels packed side by side, one interpolation for all.

A call to OpenCV costs microseconds, so hundreds of small drops are cheaper as one narrow map of the pixels that they
cover than one by one, and that map costs in proportion to the cover. Scattering its pixels back costs too: where nearly
all of the frame is covered, a map of the whole frame, the identity beside drops, is cheaper. Either way the tables are
made once and serve every frame of a scene whose drops stand still.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from . import types
from .layer import depth_of, like
from .patch import LONGEST, Patch, folded, ratio, sample_pixels
from .types import Array, Image, Mask

ACROSS = 1024  # samples in a row of the packed map
FULL = 0.9  # cover from which one map of the whole frame is faster than packed pixels; measured
UNIT = 224  # a gain of 1 in 8 bits; 255 is a gain of 1.14
OPAQUE = 1 - 1e-6


class PackedPatches:
    """Patches of an image of one size, ready to be applied to many frames. Later patches lie over earlier ones.

    patches: of 1 or more samples a pixel (coarse ones are blurred layers: paste them). size: (width, height).
    border: what samples beyond the image show, "mirror" or "edge". full: whether to make one map of the whole frame;
    None: where that is faster.

    8-bit results are within 1.6 gray levels of exact arithmetic, since gain is held in steps of 1/224 and rounding
    happens twice.
    """

    def __init__(
        self, patches: Sequence[Patch], size: tuple[int, int], border: str = "mirror", *, full: bool | None = None
    ) -> None:
        self.size = (int(size[0]), int(size[1]))
        width, height = self.size
        entries = _Entries(self.size)
        for patch in reversed(patches):
            entries.add(patch)
        self.cover = np.count_nonzero(entries.over) / max(1, width * height)
        rounds = entries.rounds()
        single = len(rounds) == 1 and rounds[0].samples == 1
        self.full = single and (self.cover >= FULL if full is None else full)
        if full and not single:
            raise ValueError("one map of the whole frame was asked for; that needs patches of one sample a pixel")
        if self.full:
            rounds = [_whole(rounds[0], self.size)]
        self.rounds = [_Packed(chosen, self.size, border) for each in rounds for chosen in each.parts()]

    def apply(self, image: Image, out: Image | None = None) -> Image:
        """The frame with all patches over it, in `out` if given (contiguous, not the image itself), else a new array.

        image: (H, W[, 1 to 4]) uint8, uint16 or float32; never changed, and copied bit for bit beside the drops.
        """
        depth_of(image)
        if image.shape[1::-1] != self.size:
            raise ValueError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels; the patches were packed for images of "
                f"{self.size[0]} x {self.size[1]}"
            )
        if out is None:
            out = np.empty_like(image, order="C")
        elif out.shape != image.shape or out.dtype != image.dtype or not out.flags.c_contiguous:
            raise ValueError(
                f"out is {out.dtype} {out.shape}; expected a contiguous array of {image.dtype} "
                f"{image.shape}, like the image"
            )
        elif np.may_share_memory(image, out):
            raise ValueError("out is the image itself; give another array, since drops read what lies beside them")
        if self.full:
            self.rounds[0].fill(image, out)
            return out
        np.copyto(out, image)
        for packed in self.rounds:
            packed.scatter(image, out)
        return out


@dataclass(frozen=True, eq=False)
class _Round:
    """Pixels of which none appears twice, in raster order, with their s x s samples each."""

    samples: int
    pixels: types.Indices  # (N,) number of the pixel, row by row
    source: Array  # (N, s, s, 2)
    weight: Array  # (N, s, s): gain times opacity
    opacity: Array  # (N,)

    def parts(self) -> list[_Round]:
        """The same in pieces that OpenCV's maps can hold."""
        most = (LONGEST // self.samples) * max(1, ACROSS // self.samples)
        pieces = [slice(i, i + most) for i in range(0, len(self.pixels), most)]
        return [
            _Round(self.samples, self.pixels[at], self.source[at], self.weight[at], self.opacity[at]) for at in pieces
        ]


class _Entries:
    """Which patch each pixel shows, built from the topmost patch down."""

    def __init__(self, size: tuple[int, int]) -> None:
        self.size = size
        self.hidden = np.zeros(size[::-1], dtype=np.bool_)
        self.over = np.zeros(size[::-1], dtype=np.uint16)  # how many patches already lie over a pixel
        self.found: dict[tuple[int, int], list[tuple[Any, ...]]] = {}

    def add(self, patch: Patch) -> None:
        """Put a patch below all that have been added."""
        s, coarse = ratio(patch.density)
        if coarse > 1:
            raise ValueError(
                f"a patch has a density of {patch.density:g} samples a pixel; only 1 or more can be packed. Paste the "
                "layer of a coarse patch"
            )
        width, height = self.size
        rows = slice(max(patch.rows.start, 0), min(patch.rows.stop, height))
        columns = slice(max(patch.columns.start, 0), min(patch.columns.stop, width))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        window = rows, columns
        down, across = (
            slice((new.start - old.start) * s, (new.stop - old.start) * s)
            for new, old in ((rows, patch.rows), (columns, patch.columns))
        )
        covers = _blocks(patch.opacity[down, across], s)
        opacity = covers.mean((2, 3))
        seen = (opacity > 0) & ~self.hidden[window]
        y, x = np.nonzero(seen)
        pixels = (y + rows.start) * width + x + columns.start
        source = _blocks(patch.source[down, across], s)[y, x]
        weight = _blocks(patch.gain[down, across], s)[y, x] * covers[y, x]
        over = self.over[window]
        for level in np.unique(over[seen]):
            at = over[y, x] == level
            self.found.setdefault((int(level), s), []).append((pixels[at], source[at], weight[at], opacity[y, x][at]))
        over += seen
        self.hidden[window] |= opacity >= OPAQUE

    def rounds(self) -> list[_Round]:
        """In the order in which they are to be drawn, those that others lie over first."""
        rounds = []
        for (_, s), parts in sorted(self.found.items(), key=lambda item: -item[0][0]):
            pixels, source, weight, opacity = (np.concatenate(column) for column in zip(*parts, strict=True))
            order = np.argsort(pixels)
            rounds.append(_Round(s, pixels[order], source[order], weight[order], opacity[order]))
        return rounds


class _Packed:
    """The tables of a round."""

    def __init__(self, chosen: _Round, size: tuple[int, int], border: str) -> None:
        s, count = chosen.samples, len(chosen.pixels)
        self.samples, self.count = s, count
        whole = count == size[0] * size[1] and s == 1 and size[0] <= LONGEST
        self.across = size[0] if whole else min(max(1, ACROSS // s), max(count, 1))
        self.rows = -(-count // self.across)
        source = folded(self._spread(chosen.source, (2,)), size, border)
        self.tables: tuple[Any, Any] = cv2.convertMaps(source, None, cv2.CV_16SC2)  # type: ignore[call-overload]
        self.weight = self._spread(chosen.weight, ())
        self.even = bool((chosen.weight == 1).all())  # nothing is dimmed
        self._repeated: Image | None = None
        soft = np.flatnonzero(chosen.opacity < OPAQUE)
        self.soft, self.soft_pixels, self.clear = soft, chosen.pixels[soft], 1 - chosen.opacity[soft]
        self.first, self.last = (int(chosen.pixels[i]) for i in (0, -1))
        self.mask: Mask = np.zeros(self.last + 1 - self.first, dtype=np.bool_)
        self.mask[chosen.pixels - self.first] = True

    def fill(self, image: Image, out: Image) -> None:
        """Write every pixel of the frame; the round holds them all."""
        self._shown(image, out)
        self._blend(_flat(out), _flat(np.ascontiguousarray(image)))

    def scatter(self, image: Image, out: Image) -> None:
        """Write the round's pixels into a frame."""
        shown = _flat(self._shown(image))[: self.count]
        frame = _flat(out)
        self._blend(shown, frame)
        words = np.dtype((np.void, frame.itemsize * frame.shape[1]))
        frame.view(words)[self.first : self.last + 1, 0][self.mask] = shown.view(words)[:, 0]

    def _shown(self, image: Image, out: Image | None = None) -> Image:
        """What the drops show, (rows, across[, C])."""
        depth, s = depth_of(image), self.samples
        found: Image = cv2.remap(image, *self.tables, cv2.INTER_LINEAR, dst=out, borderMode=cv2.BORDER_REPLICATE)
        gain = self._bytes(1 if image.ndim == 2 else image.shape[2]) if image.dtype == np.uint8 else None
        if gain is not None and not self.even:
            found = cv2.multiply(found, gain, dst=found, scale=1 / UNIT)
        elif not self.even:
            found = cv2.multiply(found, like(self.weight, image).reshape(found.shape), dst=found, dtype=depth)
        if s > 1:
            found = cv2.resize(found, (self.across, self.rows), interpolation=cv2.INTER_AREA)
        return found

    def _blend(self, shown: Image, below: Image) -> None:
        """Let what lies below, (pixels, C), through where a pixel, (N, C), is covered in part."""
        if not self.soft.size:
            return
        mixed = shown[self.soft] + below[self.soft_pixels] * self.clear[:, None]
        if shown.dtype.kind == "u":
            mixed = np.clip(np.rint(mixed), 0, np.iinfo(shown.dtype).max)
        shown[self.soft] = mixed

    def _spread(self, values: Array, trailing: tuple[int, ...]) -> Array:
        """(N, s, s, ...) as a map, (rows s, across s, ...), the samples of a pixel side by side; 0 at the end."""
        s = self.samples
        padded: Image = np.zeros((self.rows * self.across, s, s, *trailing), dtype=np.float32)
        padded[: self.count] = values
        padded = padded.reshape(self.rows, self.across, s, s, *trailing).swapaxes(1, 2)
        return np.ascontiguousarray(padded.reshape(self.rows * s, self.across * s, *trailing))

    def _bytes(self, channels: int) -> Image | None:
        """The weights in 8 bits for every channel, made for the first frame; None if they do not fit."""
        if self._repeated is None or self._repeated.shape[2:] != (channels,) * (channels > 1):
            if self.weight.max(initial=0) > 255 / UNIT:
                return None
            self._repeated = cv2.merge([np.rint(self.weight * UNIT).astype(np.uint8)] * channels)
        return self._repeated


def _blocks(values: Array, s: int) -> Array:
    """(h s, w s, ...) as (h, w, s, s, ...), without a copy."""
    height, width = values.shape[0] // s, values.shape[1] // s
    return values.reshape(height, s, width, s, *values.shape[2:]).swapaxes(1, 2)


def _flat(image: Image) -> Image:
    """(pixels, channels), without a copy."""
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])


def _whole(chosen: _Round, size: tuple[int, int]) -> _Round:
    """The round with every other pixel of the frame showing itself."""
    count = size[0] * size[1]
    source: Image = sample_pixels(slice(0, size[1]), slice(0, size[0])).reshape(count, 1, 1, 2)
    weight: Image = np.ones((count, 1, 1), dtype=np.float32)
    opacity: Image = np.ones(count, dtype=np.float32)
    for every, some in ((source, chosen.source), (weight, chosen.weight), (opacity, chosen.opacity)):
        every[chosen.pixels] = some
    return _Round(1, np.arange(count), source, weight, opacity)
