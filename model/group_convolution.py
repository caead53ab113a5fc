"""Convolutions of the segmentation networks: each with group normalisation, which depends on no batch, and ReLU."""

from __future__ import annotations

import math

from torch import nn

GROUPS = 8


def convolved(channels_in: int, channels_out: int, kernel: int = 3, stride: int = 1, rate: int = 1) -> nn.Sequential:
    """Convolution, normalisation, ReLU. (B, C, H, W) to (B, channels_out, ceil(H / stride), ceil(W / stride)).

    rate: distance of the taps, 1 for a plain convolution; the field grows by it, the work does not.
    """
    around = rate * (kernel // 2)
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, kernel, stride, around, dilation=rate, bias=False),
        group_norm(channels_out),
        nn.ReLU(),
    )


def separable(channels_in: int, channels_out: int, rate: int = 1) -> nn.Sequential:
    """The same as a 3x3 convolution of each channel for itself and one across channels: a ninth of the work."""
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_in, 3, 1, rate, dilation=rate, groups=channels_in, bias=False),
        convolved(channels_in, channels_out, 1),
    )


def group_norm(channels: int) -> nn.GroupNorm:
    """In eight groups, or as many as divide the channels."""
    return nn.GroupNorm(math.gcd(GROUPS, channels), channels)
