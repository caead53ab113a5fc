"""U-Net (Ronneberger, Fischer and Brox, MICCAI 2015), here with borders kept and group normalisation.

Down by pooling with twice the channels at each level, up by 2x2 transposed convolutions, each level joined by what the
way down had there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from rainstereo.model.group_convolution import convolved


@dataclass(frozen=True)
class UNetConfig:
    """classes: channels of scores out; 1 for a binary question. base_channels: at full size; the paper's has 64.
    levels: how often the size is halved."""

    classes: int = 1
    base_channels: int = 32
    levels: int = 4

    def __post_init__(self) -> None:
        if self.classes < 1 or self.base_channels < 1 or not 1 <= self.levels <= 8:
            raise ValueError(f"{self}: expected classes and base_channels of 1 or more, and 1 to 8 levels")

    def build(self) -> UNet:
        """The network, with weights as torch draws them."""
        return UNet(self)


class UNet(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to scores (B, classes, H, W), of any size."""

    def __init__(self, config: UNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = [config.base_channels << level for level in range(config.levels + 1)]
        self.down = nn.ModuleList(_twice(a, b) for a, b in zip([3, *widths], widths, strict=False))
        pairs = list(zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.grow = nn.ModuleList(nn.ConvTranspose2d(a, b, 2, 2) for a, b in pairs)
        self.up = nn.ModuleList(_twice(a, b) for a, b in pairs)
        self.head = nn.Conv2d(widths[0], config.classes, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Scores; sides that are no multiple of 2 ** levels are repeated at the border inside, and cropped."""
        height, width = images.shape[2:]
        step = 1 << self.config.levels
        features = functional.pad((images - 0.5) / 0.25, (0, -width % step, 0, -height % step), mode="replicate")
        kept: list[Tensor] = []
        for level, block in enumerate(self.down):
            features = block(functional.max_pool2d(features, 2) if level else features)
            kept.append(features)
        kept.pop()
        for grow, block in zip(self.grow, self.up, strict=True):
            features = block(torch.cat([kept.pop(), grow(features)], 1))
        scores: Tensor = self.head(features)
        return scores[:, :, :height, :width]


def _twice(channels_in: int, channels_out: int) -> nn.Sequential:
    return nn.Sequential(convolved(channels_in, channels_out), convolved(channels_out, channels_out))
