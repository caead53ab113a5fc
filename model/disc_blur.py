"""Blur by discs, each image of a batch by its own, in the frequency domain.

An aperture averages the pinhole's layer of a drop over a disc (Potmesil and Chakravarty, "A lens and aperture camera
model for synthetic image generation", SIGGRAPH 1981).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

CELL = 8
"""Points along a cell's side that decide how much of it a disc covers."""


def disc_blur(layers: Tensor, diameters: Tensor) -> Tensor:
    """Layers, (B, C, H, W), averaged over discs of these diameters, (B,) in cells; nothing lies beyond the layers.

    A disc narrower than a cell changes nothing.
    """
    if layers.ndim != 4 or diameters.shape != layers.shape[:1]:
        raise ValueError(
            f"layers are {tuple(layers.shape)} and diameters {tuple(diameters.shape)}; expected (B, C, H, W) and (B,)"
        )
    if not layers.numel():
        return layers
    kernels = discs(diameters.to(layers))
    side, (height, width) = kernels.shape[-1], layers.shape[2:]
    size = (_fast(height + side - 1), _fast(width + side - 1))
    spectrum = torch.fft.rfft2(layers, s=size) * torch.fft.rfft2(kernels, s=size).unsqueeze(1)
    blurred: Tensor = torch.fft.irfft2(spectrum, s=size)
    first = side // 2
    return blurred[..., first : first + height, first : first + width]


def discs(diameters: Tensor) -> Tensor:
    """Discs as kernels, (B, n, n), n odd, that sum to 1: each element holds the share of its cell that is covered."""
    radius = 0.5 * diameters.clamp(min=0)
    reach = max(0, math.ceil(float(radius.max()) - 0.5))
    at = (torch.arange((2 * reach + 1) * CELL, device=radius.device) + 0.5) / CELL - reach - 0.5
    square = at.square().to(radius)
    inside = square + square.unsqueeze(1) <= radius.square().reshape(-1, 1, 1)
    shares = inside.reshape(len(radius), 2 * reach + 1, CELL, 2 * reach + 1, CELL).to(radius).mean((2, 4))
    narrow = (radius <= 0.5).reshape(-1, 1, 1)
    point = torch.zeros_like(shares)
    point[:, reach, reach] = 1
    return torch.where(narrow, point, shares / shares.sum((1, 2), keepdim=True).clamp(min=1e-12))


def _fast(size: int) -> int:
    """The next size without prime factors above 5, of which transforms are fast."""
    while True:
        rest = size
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return size
        size += 1
