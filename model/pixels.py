"""Images of OpenCV's as the networks' tensors, and back: uint8 or uint16, gray or BGR; float32 RGB in 0..1."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rainstereo.types import Array, Image

RAW = {"uint8": torch.uint8, "uint16": torch.int32}
"""What an image's values are as a tensor; torch computes little with unsigned 16 bits."""


def check(image: Image) -> None:
    """ValueError for what is no image that can be restored."""
    if not isinstance(image, np.ndarray) or image.dtype not in (np.uint8, np.uint16):
        kind = getattr(image, "dtype", type(image).__name__)
        raise ValueError(f"the image is {kind}; expected uint8 or uint16, as OpenCV reads files")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or 0 in image.shape:
        raise ValueError(
            f"the image has shape {image.shape}; expected gray (H, W) or BGR (H, W, 3) of at least one pixel. Drop an "
            "alpha channel with image[..., :3]"
        )


def to_rgb(image: Image, device: torch.device) -> Tensor:
    """(1, 3, H, W) float32 in 0..1; gray is repeated."""
    return to_batch(image[None], device)


def to_batch(images: Image, device: torch.device) -> Tensor:
    """(N, H, W[, 3]) images of one size as (N, 3, H, W) float32 in 0..1."""
    if images.dtype == np.uint16:
        raw = torch.from_numpy(images.astype(np.int32))
    else:
        own = np.ascontiguousarray(images)
        raw = torch.from_numpy(own if own.flags.writeable else own.copy())
    return unpacked(raw.to(device), _most(images))


def from_rgb(rgb: Tensor, like: Image) -> Image:
    """(3, H, W) in 0..1 as an image of the type and channels of another; gray is the mean of the channels."""
    found: Image = from_batch(rgb.unsqueeze(0), like[None])[0]
    return found


def from_batch(rgb: Tensor, like: Image) -> Image:
    """(N, 3, H, W) in 0..1 as (N, H, W[, 3]) images of the type and channels of others."""
    levels = packed(rgb, _most(like), like.ndim == 3, RAW[like.dtype.name])
    found: Image = np.ascontiguousarray(levels.cpu().numpy()).astype(like.dtype, copy=False)
    return found


def unpacked(raw: Tensor, most: int) -> Tensor:
    """(N, H, W[, 3]) values up to `most`, gray or BGR, as (N, 3, H, W) float32 RGB in 0..1, on the tensor's device."""
    if raw.ndim == 3:
        rgb = raw.unsqueeze(1).expand(-1, 3, -1, -1)
    else:  # planes are turned about one by one: cheaper than a flip of the last axis
        rgb = torch.stack([raw[..., channel] for channel in (2, 1, 0)], 1)
    return rgb.float().div_(float(most))


def packed(rgb: Tensor, most: int, gray: bool, kind: torch.dtype) -> Tensor:
    """What `unpacked` unpacks, rounded, on the tensor's device; gray is the mean of the channels."""
    values = rgb.float().mean(1, keepdim=True) if gray else rgb.float()
    levels = values.mul(most).round_().clamp_(0, most).to(kind)
    return levels[:, 0] if gray else torch.stack([levels[:, channel] for channel in (2, 1, 0)], 3)


def _most(image: Image | Array) -> int:
    return int(np.iinfo(image.dtype).max)
