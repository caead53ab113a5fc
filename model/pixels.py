"""Images of OpenCV's as the networks' tensors, and back: uint8 or uint16, gray or BGR; float32 RGB in 0..1."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from rainstereo.types import Image

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
    """(N, H, W[, 3]) images of one size as (N, 3, H, W) float32 in 0..1, channels last."""
    raw = turned(images) if images.ndim == 4 else np.ascontiguousarray(images)
    if raw.dtype == np.uint16:
        raw = raw.astype(np.int32)
    elif not raw.flags.writeable:
        raw = raw.copy()
    return unpacked(torch.from_numpy(raw).to(device), _most(images))


def from_rgb(rgb: Tensor, like: Image) -> Image:
    """(3, H, W) in 0..1 as an image of the type and channels of another; gray is the mean of the channels."""
    found: Image = from_batch(rgb.unsqueeze(0), like[None])[0]
    return found


def from_batch(rgb: Tensor, like: Image) -> Image:
    """(N, 3, H, W) in 0..1 as (N, H, W[, 3]) images of the type and channels of others."""
    levels = packed(rgb, _most(like), like.ndim == 3, RAW[like.dtype.name]).cpu().numpy()
    levels = levels.astype(like.dtype, copy=False)
    return turned(levels) if like.ndim == 4 else np.ascontiguousarray(levels)


def turned(images: Image) -> Image:
    """(..., H, W, 3) BGR to RGB, or back; a copy."""
    shape = images.shape
    found: Image = cv2.cvtColor(np.ascontiguousarray(images).reshape(-1, *shape[-2:]), cv2.COLOR_BGR2RGB)
    return found.reshape(shape)


def unpacked(raw: Tensor, most: int) -> Tensor:
    """(N, H, W[, 3]) values up to `most`, gray or RGB, as (N, 3, H, W) float32 in 0..1, on the tensor's device."""
    rgb = raw.unsqueeze(1).expand(-1, 3, -1, -1) if raw.ndim == 3 else raw.permute(0, 3, 1, 2)
    return rgb.float().div_(float(most))


def packed(rgb: Tensor, most: int, gray: bool, kind: torch.dtype) -> Tensor:
    """What `unpacked` unpacks, rounded, on the tensor's device; gray is the mean of the channels."""
    values = rgb.float().mean(1, keepdim=True) if gray else rgb.float()
    levels = values.mul(most).round_().clamp_(0, most).to(kind)
    return levels[:, 0] if gray else levels.permute(0, 2, 3, 1)


def _most(image: Image) -> int:
    return int(np.iinfo(image.dtype).max)
