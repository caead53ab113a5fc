"""What the generator is made of: normalisations, residual blocks, and steps from one scale to the next."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

NORMALISATIONS = ("instance", "batch", "channel", "none")
UP_SAMPLINGS = ("transposed", "nearest", "pixel_shuffle")
Padding = Literal["reflect", "replicate", "zeros"]
PADDINGS: tuple[Padding, ...] = ("reflect", "replicate", "zeros")
BLOCK_KINDS = ("dense", "separable")
ACTIVATIONS = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU}


class ChannelNorm(nn.Module):
    """Each pixel on its own: mean 0 and variance 1 over its channels, then a scale and an offset a channel.

    (B, C, H, W). A pixel's value depends on no other pixel, so a tile of an image gives what the image gives.
    """

    def __init__(self, channels: int, eps: float = 1e-5) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.eps = eps

    def forward(self, features: Tensor) -> Tensor:
        """The features, normalised."""
        centred = features - features.mean(1, keepdim=True)
        scale = (centred.square().mean(1, keepdim=True) + self.eps).rsqrt()
        return centred * scale * self.weight[:, None, None] + self.bias[:, None, None]


def normalisation(name: str, channels: int) -> nn.Module:
    """A layer for (B, C, H, W) by its name.

    instance: over the image, without parameters, as in Pix2PixHD; each pixel then depends on the whole image.
    batch: over the batch in training, constants afterwards. channel: `ChannelNorm`. none: nothing.
    """
    if name == "instance":
        return nn.InstanceNorm2d(channels)
    if name == "batch":
        return nn.BatchNorm2d(channels)
    return ChannelNorm(channels) if name == "channel" else nn.Identity()


def convolution(channels_in: int, channels_out: int, kernel: int, padding: Padding, groups: int = 1) -> nn.Conv2d:
    """Stride 1, same size out; the border as `padding` says."""
    return nn.Conv2d(
        channels_in, channels_out, kernel, padding=kernel // 2, padding_mode=padding if kernel > 1 else "zeros",
        groups=groups,
    )  # fmt: skip


class ResidualBlock(nn.Module):
    """features + change(features); same shape out.

    dense: convolution, normalisation, activation, convolution, normalisation, as in Pix2PixHD; `expansion` widens what
    is between the convolutions. separable: a depthwise convolution and normalisation, then pointwise out to `expansion`
    times the channels, activation, and pointwise back: a ninth of the work and less.
    """

    def __init__(
        self, kind: str, channels: int, kernel: int, expansion: int, norm: str, activation: str, padding: Padding
    ) -> None:
        super().__init__()
        wide, act = channels * expansion, ACTIVATIONS[activation]
        if kind == "dense":
            self.change = nn.Sequential(
                convolution(channels, wide, kernel, padding),
                normalisation(norm, wide),
                act(),
                convolution(wide, channels, kernel, padding),
                normalisation(norm, channels),
            )
        else:
            self.change = nn.Sequential(
                convolution(channels, channels, kernel, padding, groups=channels),
                normalisation(norm, channels),
                convolution(channels, wide, 1, padding),
                act(),
                convolution(wide, channels, 1, padding),
            )

    def forward(self, features: Tensor) -> Tensor:
        """Same shape out."""
        changed: Tensor = self.change(features)
        return features + changed


def down(channels_in: int, channels_out: int, norm: str, activation: str) -> nn.Sequential:
    """To half the size: a 3x3 convolution of stride 2."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride=2, padding=1),
        normalisation(norm, channels_out),
        ACTIVATIONS[activation](),
    )


def up(
    channels_in: int, channels_out: int, up_sampling: str, norm: str, activation: str, padding: Padding
) -> nn.Sequential:
    """To twice the size.

    transposed: a 3x3 transposed convolution, as in Pix2PixHD. nearest: pixels repeated, then a 3x3 convolution: four
    times the work, no checkerboard. pixel_shuffle: a 3x3 convolution to four times the channels, which become pixels.
    """
    if up_sampling == "transposed":
        step: list[nn.Module] = [
            nn.ConvTranspose2d(channels_in, channels_out, 3, stride=2, padding=1, output_padding=1)
        ]
    elif up_sampling == "nearest":
        step = [nn.Upsample(scale_factor=2, mode="nearest"), convolution(channels_in, channels_out, 3, padding)]
    else:
        step = [convolution(channels_in, 4 * channels_out, 3, padding), nn.PixelShuffle(2)]
    return nn.Sequential(*step, normalisation(norm, channels_out), ACTIVATIONS[activation]())
