"""Baseline: Isola et al., "Image-to-Image Translation with Conditional Adversarial Networks" (Pix2Pix), CVPR 2017.

The U-Net of its appendix, section 6.1: 8 convolutions of 4x4 and stride 2 down to 1x1 for 256x256 pixels, as many up,
and the way down's features concatenated on the way up. Learned by L1 and a discriminator that sees the rainy image too.
Normalisation is over the image, which is what the paper's batch normalisation is for its batches of one, in training
and in use. Dropout, the paper's noise, acts in training only, so that the same image gives the same result.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rainstereo.model.image_batch import RGB, check, padded

KERNEL = 4
SLOPE = 0.2
WIDEST = 8
DROPPING = 3
RANGES = {"base_channels": (1, 512), "downs": (2, 10)}


@dataclass(frozen=True)
class Pix2PixConfig:
    """The U-Net's shape; the defaults are the paper's: 54.4 M parameters.

    base_channels: of the first layer; doubled with each step down, up to 8 times. downs: steps down, and as many up;
    sides are padded to multiples of 2^downs inside. dropout: share dropped in the 3 coarsest steps up, in training.
    """

    base_channels: int = 64
    downs: int = 8
    dropout: float = 0.5

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise ValueError(f"{name} {value!r} was given; expected a whole number in {low}..{high}")
        if isinstance(self.dropout, bool) or not isinstance(self.dropout, int | float) or not 0 <= self.dropout < 1:
            raise ValueError(f"dropout {self.dropout!r} was given; expected a share in 0..1, less than 1")

    @property
    def multiple(self) -> int:
        """Sides are padded to multiples of this inside."""
        return 1 << self.downs

    def build(self) -> Pix2Pix:
        """The module, with random weights from torch's generator."""
        return Pix2Pix(self)


class Pix2Pix(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to the same shape, any H, W >= 1."""

    def __init__(self, config: Pix2PixConfig) -> None:
        super().__init__()
        self.config = config
        self.reach = (config.multiple, config.multiple, False)  # multiple, margin, whether a tile equals the frame
        widths = [config.base_channels * min(1 << level, WIDEST) for level in range(config.downs)]
        coarsest = config.downs - 1
        self.downs = nn.ModuleList()
        self.ups = nn.ModuleList()
        for level, width in enumerate(widths):
            # at the coarsest scale there may be one pixel, of which nothing would be left by normalising
            normalised = 0 < level < coarsest
            self.downs.append(
                nn.Sequential(
                    nn.LeakyReLU(SLOPE) if level else nn.Identity(),
                    nn.Conv2d(widths[level - 1] if level else RGB, width, KERNEL, 2, 1, bias=False),
                    nn.InstanceNorm2d(width, affine=True) if normalised else nn.Identity(),
                )
            )
        for level in reversed(range(config.downs)):
            given = widths[level] * (1 if level == coarsest else 2)
            made = widths[level - 1] if level else RGB
            drops = 0 < level and coarsest - level < DROPPING
            self.ups.append(
                nn.Sequential(
                    nn.ReLU(),
                    nn.ConvTranspose2d(given, made, KERNEL, 2, 1, bias=level == 0),
                    nn.InstanceNorm2d(made, affine=True) if level else nn.Identity(),
                    nn.Dropout(config.dropout) if drops else nn.Identity(),
                )
            )
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.normal_(module.weight, 0.0, 0.02)
            elif isinstance(module, nn.InstanceNorm2d):
                nn.init.normal_(module.weight, 1.0, 0.02)

    def forward(self, images: Tensor) -> Tensor:
        """The derained images."""
        check(images)
        height, width = images.shape[2:]
        features = 2 * padded(images, self.config.multiple, self.config.multiple) - 1
        skips: list[Tensor] = []
        for step in self.downs:
            features = step(features)
            skips.append(features)
        features = skips.pop()
        for step in self.ups:
            features = step(features)
            if skips:
                features = torch.cat([skips.pop(), features], 1)
        return ((features.tanh() + 1) / 2)[:, :, :height, :width]
