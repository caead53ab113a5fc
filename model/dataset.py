"""Training windows and validation images: rainy, clear, and where the drops are.

Window number n is the same whatever the number of workers, processes or restarts: its image comes from a shuffled
order of (seed, epoch), everything else from a generator of (seed, n).
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from rainstereo import imagefile
from rainstereo.model.augment import RandomAdherentRain
from rainstereo.model.augmentation import Augmentation
from rainstereo.model.pair_folders import Item
from rainstereo.model.recipe import AugmentOptions, DataOptions, RainOptions
from rainstereo.types import Array, Image

TRIES = 12
"""Windows that are looked at for drops."""
ENOUGH = 0.02
"""Share of a window that drops must cover for it to be taken at once."""
CHANGED = 12 / 255
"""Difference in any channel from which a pixel counts as covered, where there is no mask."""
MOST_PIXELS = 2048 * 2048
"""Of an image on which rain is rendered; of larger ones a part is."""
WINDOW, WHOLE = 1, 2
"""What a generator is for, part of its seed."""


@dataclass(frozen=True, eq=False)
class Batch:
    """rainy, clear: (B, 3, H, W) RGB, 0 to 1. mask: (B, 1, H, W), 1 where drops are. seeds: (B,) for augmentation still
    to be done, and names of the images, in order."""

    rainy: Tensor
    clear: Tensor
    mask: Tensor
    seeds: tuple[int, ...]
    names: tuple[str, ...]

    def pin_memory(self) -> Batch:
        """Called by the loader."""
        return Batch(self.rainy.pin_memory(), self.clear.pin_memory(), self.mask.pin_memory(), self.seeds, self.names)


@dataclass(frozen=True, eq=False)
class Sample:
    """One of a batch: rainy, clear (3, H, W) and mask (1, H, W)."""

    rainy: Tensor
    clear: Tensor
    mask: Tensor
    seed: int
    name: str


class Rain:
    """Rain on a whole image, drawn from a seed."""

    def __init__(self, options: RainOptions) -> None:
        o = options
        if not o.populations:
            raise ValueError("rain.populations is empty; name at least one, such as 'drops'")
        self.focal = o.focal
        self.kinds = [
            RandomAdherentRain(
                name, o.cover, o.focal, o.distance, f_number=o.f_number, model=o.model, rays=o.rays, p=1.0
            )
            for name in o.populations
        ]  # fmt: skip

    def __call__(self, clear: Tensor, seed: int, across: int) -> tuple[Tensor, Tensor]:
        """The rainy image and its mask. clear: (3, h, w), a part of an image that is `across` pixels wide."""
        with torch.random.fork_rng(devices=[]), torch.inference_mode():
            torch.manual_seed(seed)
            kind = self.kinds[int(torch.randint(len(self.kinds), ()))]
            focal = self.focal * across / clear.shape[2]
            if kind.scene.camera != focal:
                kind.scene.camera, kind.scene.last = focal, None
            rainy = kind(clear[None])[0]
        if kind.layer is None:
            raise RuntimeError("rain was not rendered")
        return rainy.clone(), kind.layer.mask[0].float().clone()


class Windows(Dataset[Sample]):
    """Windows by number, without end. augment: None where that is done later, on the device."""

    def __init__(
        self, items: Sequence[Item], data: DataOptions, rain: RainOptions, augment: AugmentOptions | None, seed: int
    ) -> None:
        if not items:
            raise ValueError("there are no training images; name some in [[data.train]]")
        self.items, self.data, self.seed = list(items), data, seed
        self.rain = Rain(rain) if any(not item.rainy for item in items) else None
        self.augmentation = None if augment is None else Augmentation(augment)

    def __getitem__(self, number: int) -> Sample:
        """Window `number`; ValueError with the file's name where an image cannot be read."""
        if self.data.only:
            number %= self.data.only
        epoch, position = divmod(number, len(self.items))
        item = self.items[int(order(self.seed, epoch, len(self.items))[position])]
        rng = np.random.default_rng([self.seed, WINDOW, number])
        dry = rng.random() < self.data.clear
        choice, seed = int(rng.integers(2**31)), int(rng.integers(2**62))
        if item.rainy or dry or self.rain is None:
            rainy, clear, mask = _read(item, None if dry or not item.rainy else choice % len(item.rainy))
            rainy, clear, mask = self._window(rng, rainy, clear, mask)
            parts = tensor(rainy), tensor(clear), _tensor(mask[..., None])
        else:
            image = read(item.clear)
            shown = tensor(_part(image, rng))
            rained, wet = self.rain(shown, seed, image.shape[1])
            rainy, clear, mask = self._window(rng, _array(rained), _array(shown), _array(wet)[..., 0])
            parts = _tensor(rainy), _tensor(clear), _tensor(mask[..., None])
        if self.augmentation is not None:
            parts = self.augmentation(*parts, seed)
        return Sample(*parts, seed, item.name)

    def _window(self, rng: np.random.Generator, rainy: Array, clear: Array, mask: Array | None) -> tuple[Any, Any, Any]:
        """The same window of all, one that holds drops if it shall; mirrored where images are smaller."""
        side = self.data.crop
        arrays = [rainy, clear, *([] if mask is None else [mask])]
        if side:
            arrays = [_at_least(a, side) for a in arrays]
            height, width = arrays[0].shape[:2]
            wanted = rng.random() < self.data.crop_drops
            best, place = -1.0, (0, 0)
            for _ in range(TRIES if wanted else 1):
                top, left = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
                cut = [a[top : top + side, left : left + side] for a in arrays]
                share = float(_mask(cut[0], cut[1], cut[2] if len(cut) > 2 else None).mean()) if wanted else 0.0
                if share > best:
                    best, place = share, (top, left)
                if share >= ENOUGH:
                    break
            top, left = place
            arrays = [a[top : top + side, left : left + side] for a in arrays]
        rainy, clear = arrays[:2]
        return rainy, clear, _mask(rainy, clear, arrays[2] if mask is not None else None)


@lru_cache(maxsize=4)
def order(seed: int, epoch: int, count: int) -> Array:
    """The order of images in an epoch."""
    found: Array = np.random.default_rng([seed, epoch]).permutation(count)  # type: ignore[assignment]
    return found


class Steps(Sampler[list[int]]):
    """Numbers of the windows that a process takes at each step: its share of the step's batch."""

    def __init__(self, first: int, last: int, batch: int, rank: int = 0, world: int = 1) -> None:
        self.steps, self.batch, self.share, self.rank = range(first, last), batch, batch // world, rank

    def __iter__(self) -> Iterator[list[int]]:
        for step in self.steps:
            start = step * self.batch + self.rank * self.share
            yield list(range(start, start + self.share))

    def __len__(self) -> int:
        return len(self.steps)


def loader(windows: Windows, steps: Steps, workers: int, pin: bool = False) -> DataLoader[Sample]:
    """Batches of `steps`, read ahead by worker processes."""
    if workers:
        multiprocessing.set_forkserver_preload(["rainstereo.model.dataset"])
    generator = torch.Generator()  # the loader's own, so that torch's stays as it is
    return DataLoader(
        windows, batch_sampler=steps, num_workers=workers, collate_fn=collate, generator=generator, pin_memory=pin,
        worker_init_fn=_quiet, prefetch_factor=4 if workers else None,
        # fork would copy locks of threads that do not live on in the copy, once anything has been computed here
        multiprocessing_context="forkserver" if workers else None,
    )  # fmt: skip


def collate(samples: Sequence[Sample]) -> Batch:
    """A batch; ValueError with names where windows differ in size."""
    first = samples[0]
    odd = next((s for s in samples if s.clear.shape != first.clear.shape), None)
    if odd is not None:
        raise ValueError(
            f"{first.name} has {_size(first.clear)} pixels and {odd.name} {_size(odd.clear)}; a batch needs one "
            "size: set data.crop, or optimizer.batch = 1"
        )
    rainy, clear, mask = (torch.stack([getattr(s, key) for s in samples]) for key in ("rainy", "clear", "mask"))
    return Batch(rainy, clear, mask, tuple(s.seed for s in samples), tuple(s.name for s in samples))


def whole(item: Item, rain: Rain | None, seed: int, crop: int = 0) -> Sample:
    """An image for validation: the first rainy version, or rain drawn from the seed. crop: side of its middle."""
    if item.rainy or rain is None:
        rainy, clear = (_middle(a, crop) for a in _read(item, 0 if item.rainy else None)[:2])
        return Sample(tensor(rainy), tensor(clear), _tensor(_mask(rainy, clear, None)[..., None]), seed, item.name)
    image = read(item.clear)
    shown = tensor(_part(image, np.random.default_rng([seed, WHOLE])))
    rained, wet = rain(shown, seed, image.shape[1])
    a, b, c = (_tensor(_middle(_array(t), crop)) for t in (rained, shown, wet))
    return Sample(a, b, c, seed, item.name)


# -- images ------------------------------------------------------------------------------------------------------------


def read(path: Path) -> Image:
    """(H, W, 3) RGB, 8 or 16 bits; gray is repeated. ValueError with the file's name."""
    try:
        image = imagefile.read(path)
    except imagefile.UnreadableImageError as error:
        raise ValueError(f"{path}: {error}") from error
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, 2)
    return np.ascontiguousarray(image[..., 2::-1])


def tensor(image: Image) -> Tensor:
    """(3, H, W) in 0 to 1 of an image of 8 or 16 bits."""
    most = np.float32(np.iinfo(image.dtype).max)
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)).astype(np.float32) / most)


def _array(tensor: Tensor) -> Array:
    """(H, W, C) of (C, H, W)."""
    found: Array = tensor.numpy().transpose(1, 2, 0)
    return found


def _tensor(array: Array) -> Tensor:
    """(C, H, W) float of (H, W, C)."""
    return torch.from_numpy(np.ascontiguousarray(array.transpose(2, 0, 1), np.float32))


def _read(item: Item, version: int | None) -> tuple[Image, Image, Array | None]:
    """Rainy, clear and, where there is one, the mask. version None: the clear image twice."""
    clear = read(item.clear)
    if version is None:
        return clear, clear, np.zeros(clear.shape[:2], np.float32)
    rainy = read(item.rainy[version])
    if rainy.shape != clear.shape:
        raise ValueError(
            f"{item.rainy[version]} has {_hw(rainy)} pixels, its clear partner {item.clear} has {_hw(clear)}; "
            "align them first"
        )
    if rainy.dtype != clear.dtype:
        rainy, clear = _eight(rainy), _eight(clear)
    mask: Array | None = None
    if item.masks:
        mask = (read(item.masks[version])[..., 0] > 0).astype(np.float32)  # red: `rainstereo rain --masks`
        if mask.shape != clear.shape[:2]:
            raise ValueError(f"{item.masks[version]} has {_hw(mask)} pixels; expected {_hw(clear)}")
    return rainy, clear, mask


def _eight(image: Image) -> Image:
    return image if image.dtype == np.uint8 else (image // 257).astype(np.uint8)


def _mask(rainy: Array, clear: Array, mask: Array | None) -> Array:
    """(H, W) float, 1 where drops are: the mask, or where the images differ."""
    if mask is not None:
        return mask
    scale = np.iinfo(cast(Any, clear.dtype)).max if clear.dtype.kind == "u" else 1
    difference = cv2.absdiff(rainy, clear).max(2)
    found: Array = (difference > CHANGED * scale).astype(np.float32)
    return found


def _part(image: Image, rng: np.random.Generator) -> Image:
    """The image, or a part of it that is not too large to render rain on."""
    height, width = image.shape[:2]
    if height * width <= MOST_PIXELS:
        return image
    h, w = min(height, 2048), min(width, 2048)
    top, left = int(rng.integers(height - h + 1)), int(rng.integers(width - w + 1))
    return image[top : top + h, left : left + w]


def _at_least(image: Array, side: int) -> Array:
    height, width = image.shape[:2]
    if height >= side and width >= side:
        return image
    down, right = max(side - height, 0), max(side - width, 0)
    return np.pad(image, [(0, down), (0, right), *[(0, 0)] * (image.ndim - 2)], "symmetric")


def _middle(image: Array, side: int) -> Array:
    if not side:
        return image
    height, width = image.shape[:2]
    top, left = max(height - side, 0) // 2, max(width - side, 0) // 2
    return image[top : top + side, left : left + side]


def _hw(image: Array) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"


def _size(image: Tensor) -> str:
    return f"{image.shape[-1]} x {image.shape[-2]}"


def _quiet(worker: int) -> None:
    """A worker leaves the processor's other cores to the training."""
    del worker
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
