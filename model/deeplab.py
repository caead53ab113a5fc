"""DeepLab v3+ (Chen, Zhu, Papandreou, Schroff and Adam, ECCV 2018) on a small residual backbone of its own.

Theirs stands on a network that ImageNet taught; such weights are not part of this package, so the backbone is small and
learns with the rest. What makes it a DeepLab is here: atrous convolutions that keep features at 1/16 of the size, a
pyramid of them at several rates beside the mean of the image, and a decoder that joins it with features at 1/4.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from rainstereo.model.group_convolution import convolved, group_norm, separable


@dataclass(frozen=True)
class DeepLabConfig:
    """classes: channels of scores out. base_channels: at half the size; 2, 4, 8 times as many deeper, 8 times in the
    pyramid. rates: of the pyramid's atrous convolutions, in pixels of 1/16 of the size. low_channels: at 1/4, for the
    decoder."""

    classes: int = 11
    base_channels: int = 32
    rates: tuple[int, ...] = (6, 12, 18)
    low_channels: int = 48

    def __post_init__(self) -> None:
        object.__setattr__(self, "rates", tuple(self.rates))
        if min(self.classes, self.base_channels, self.low_channels) < 1 or not self.rates or min(self.rates) < 1:
            raise ValueError(f"{self}: expected classes, channels and rates of 1 or more, and at least one rate")

    def build(self) -> DeepLab:
        """The network, with weights as torch draws them."""
        return DeepLab(self)


class DeepLab(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to scores (B, classes, H, W), of any size."""

    def __init__(self, config: DeepLabConfig) -> None:
        super().__init__()
        self.config = config
        n = config.base_channels
        self.stem = convolved(3, n, stride=2)
        self.quarter = nn.Sequential(_Residual(n, 2 * n, stride=2), _Residual(2 * n, 2 * n))
        self.sixteenth = nn.Sequential(
            _Residual(2 * n, 4 * n, stride=2), _Residual(4 * n, 4 * n), _Residual(4 * n, 8 * n, stride=2),
            _Residual(8 * n, 8 * n, rate=2), _Residual(8 * n, 8 * n, rate=4),
        )  # fmt: skip
        self.pyramid = AtrousPyramid(8 * n, 8 * n, config.rates)
        self.low = convolved(2 * n, config.low_channels, 1)
        self.decoder = nn.Sequential(separable(8 * n + config.low_channels, 8 * n), separable(8 * n, 8 * n))
        self.head = nn.Conv2d(8 * n, config.classes, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Scores at 1/4 of the size, interpolated."""
        quarter = self.quarter(self.stem((images - 0.5) / 0.25))
        deep = _sized(self.pyramid(self.sixteenth(quarter)), quarter)
        scores = self.head(self.decoder(torch.cat([deep, self.low(quarter)], 1)))
        return _sized(scores, images)


class AtrousPyramid(nn.Module):
    """Each pixel alone, its surroundings at several rates, and the mean of the image; (B, C, H, W), same size out."""

    def __init__(self, channels_in: int, channels_out: int, rates: tuple[int, ...]) -> None:
        super().__init__()
        self.alone = convolved(channels_in, channels_out, 1)
        self.around = nn.ModuleList(separable(channels_in, channels_out, rate) for rate in rates)
        self.mean = nn.Sequential(
            nn.Conv2d(channels_in, channels_out, 1), nn.ReLU()
        )  # of one pixel: nothing to normalise
        self.join = convolved(channels_out * (len(rates) + 2), channels_out, 1)

    def forward(self, features: Tensor) -> Tensor:
        """The joined features."""
        mean = self.mean(features.mean((2, 3), keepdim=True)).expand(-1, -1, *features.shape[2:])
        found: Tensor = self.join(torch.cat([self.alone(features), *(a(features) for a in self.around), mean], 1))
        return found


class _Residual(nn.Module):
    """Two convolutions beside a way past them."""

    def __init__(self, channels_in: int, channels_out: int, stride: int = 1, rate: int = 1) -> None:
        super().__init__()
        self.change = nn.Sequential(
            convolved(channels_in, channels_out, 3, stride, rate),
            nn.Conv2d(channels_out, channels_out, 3, padding=rate, dilation=rate, bias=False),
            group_norm(channels_out),
        )
        same = stride == 1 and channels_in == channels_out
        # pixels are left out before, not by a stride: in torch 2.13 on the processor the gradient of a strided 1x1
        # convolution of few channels in channels-last order writes beyond its memory
        self.stride = stride
        self.past = nn.Identity() if same else nn.Conv2d(channels_in, channels_out, 1)

    def forward(self, features: Tensor) -> Tensor:
        beside = features[..., :: self.stride, :: self.stride]
        return functional.relu(self.past(beside) + self.change(features))


def _sized(features: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(features, like.shape[2:], mode="bilinear", align_corners=False)
