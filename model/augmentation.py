"""What training does to a window: kornia's augmentations, the same geometry for image, truth and drop mask."""

from __future__ import annotations

from typing import Any

import torch
from kornia.augmentation import (
    AugmentationSequential,
    ColorJiggle,
    RandomAffine,
    RandomGaussianNoise,
    RandomHorizontalFlip,
)
from torch import Tensor

from rainstereo.model.recipe import AugmentOptions


class Augmentation:
    """Draws anew for each window, from its seed alone: batches, processes and devices do not matter."""

    def __init__(self, options: AugmentOptions) -> None:
        o = options
        low, high = o.scale
        if not (0 <= o.flip <= 1 and 0 <= o.rotate <= 180 and 0.1 <= low <= high <= 10 and 0 <= o.noise <= 1):
            raise ValueError(
                f"[augment] flip {o.flip}, rotate {o.rotate}, scale {o.scale}, noise {o.noise}; expected 0 to 1, 0 to "
                "180 degrees, 0.1 <= smallest <= largest <= 10, 0 to 1"
            )
        both: list[Any] = []
        if o.flip:
            both.append(RandomHorizontalFlip(p=o.flip))
        if o.rotate or o.scale != (1.0, 1.0):
            both.append(RandomAffine(o.rotate, scale=o.scale, padding_mode="reflection", p=1.0))
        if o.brightness or o.contrast or o.saturation or o.hue:
            both.append(ColorJiggle(o.brightness, o.contrast, o.saturation, o.hue, p=1.0))
        self.both = AugmentationSequential(*both, data_keys=["input", "input", "mask"]) if both else None
        self.rainy = (
            AugmentationSequential(RandomGaussianNoise(0.0, o.noise, p=1.0), data_keys=["input"]) if o.noise else None
        )

    def __call__(self, rainy: Tensor, clear: Tensor, mask: Tensor, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """The same of a rainy image and its truth, (3, H, W), and a mask, (1, H, W); torch's generator stays as it
        was."""
        if self.both is None and self.rainy is None:
            return rainy, clear, mask
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            parts = [rainy[None], clear[None], mask[None]]
            if self.both is not None:
                parts = list(self.both(*parts))
            if self.rainy is not None:
                parts[0] = self.rainy(parts[0]).clamp(0, 1)
        a, b, c = (part[0] for part in parts)
        return a, b, c
