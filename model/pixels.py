"""Images of OpenCV's as the networks' tensors, and back: uint8 or uint16, gray or BGR; float32 RGB in 0..1."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rainstereo.types import Image


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
    if image.dtype == np.uint16:  # torch on the processor computes little with unsigned 16 bits
        tensor = torch.from_numpy(image.astype(np.int32)).to(device)
    else:
        own = np.ascontiguousarray(image)
        tensor = torch.from_numpy(own if own.flags.writeable else own.copy()).to(device)
    rgb = tensor.expand(3, *tensor.shape) if image.ndim == 2 else tensor.permute(2, 0, 1).flip(0)
    return rgb.float().div_(float(np.iinfo(image.dtype).max)).unsqueeze(0)


def to_batch(images: Image, device: torch.device) -> Tensor:
    """(N, H, W[, 3]) images of one size as (N, 3, H, W) float32 in 0..1."""
    count, height, width = images.shape[:3]
    tall = to_rgb(images.reshape(count * height, width, *images.shape[3:]), device)
    return tall.view(3, count, height, width).transpose(0, 1)


def from_rgb(rgb: Tensor, like: Image) -> Image:
    """(3, H, W) in 0..1 as an image of the type and channels of another; gray is the mean of the channels."""
    found: Image = from_batch(rgb.unsqueeze(0), like[None])[0]
    return found


def from_batch(rgb: Tensor, like: Image) -> Image:
    """(N, 3, H, W) in 0..1 as (N, H, W[, 3]) images of the type and channels of others."""
    most = int(np.iinfo(like.dtype).max)
    kind = torch.uint8 if like.dtype == np.uint8 else torch.int32
    values = rgb.float() if like.ndim == 4 else rgb.float().mean(1, keepdim=True)
    levels = values.mul(most).round_().clamp_(0, most).to(kind).permute(0, 2, 3, 1)
    levels = levels.flip(3) if like.ndim == 4 else levels[..., 0]
    found: Image = np.ascontiguousarray(levels.cpu().numpy()).astype(like.dtype, copy=False)
    return found
