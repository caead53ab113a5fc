"""Images and their halves as one table of colours, and weighted sums of places in it.

For drops that make the image small: a place is looked up, bilinearly, in the copy that is averaged over about the area
that it stands for (L. Williams, "Pyramidal parametrics", SIGGRAPH 1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

SMALLEST = 4  # pixels along the shorter side
DEEPEST = 7


@dataclass(frozen=True, eq=False)
class ImagePyramid:
    """Colours, (B P, C), of B images with P pixels each in all their levels; sizes: (width, height) of the levels."""

    colours: Tensor
    sizes: list[tuple[int, int]]

    @classmethod
    def of(cls, images: Tensor, deepest: int = DEEPEST) -> ImagePyramid:
        """The pyramid of images, (B, C, H, W), with up to `deepest` halvings by area averages."""
        levels = [images]
        while len(levels) <= deepest and min(levels[-1].shape[2:]) >= 2 * SMALLEST:
            # a last row or column without a partner is averaged alone
            levels.append(functional.avg_pool2d(levels[-1], 2, ceil_mode=True, count_include_pad=False))
        flat = torch.cat([level.flatten(2) for level in levels], -1)
        colours = flat.transpose(1, 2).reshape(-1, images.shape[1])
        return cls(colours, [(level.shape[3], level.shape[2]) for level in levels])

    def sums(self, image: Tensor, level: Tensor, places: Tensor, weights: Tensor) -> Tensor:
        """Weighted sums of looks, (M, C), n of them for each of M pixels.

        image: (M,) whose colours. level: (M,) at which all looks of a pixel are taken. places: (M, n, 2) finite, in
        pixels of the image; beyond it the image is mirrored about its outermost pixels. weights: (M, n).
        """
        widths, heights = torch.tensor(self.sizes, device=places.device).unbind(-1)
        ends = (widths * heights).cumsum(0)
        width, height = widths[level], heights[level]
        first = image * ends[-1] + ends[level] - width * height
        last = (torch.stack([width, height], -1) - 1).unsqueeze(1)
        scale = torch.exp2(level.to(places.dtype)).reshape(-1, 1, 1)
        at = (mirrored(places, self.sizes[0]) + 0.5) / scale - 0.5
        at = torch.minimum(at.clamp(min=0), last.to(at.dtype))
        corner = torch.minimum(at.detach().to(torch.int64), (last - 1).clamp(min=0))
        share = at - corner
        step = torch.minimum(last, torch.ones_like(last))  # to the next column and row, where there is one
        x, y = share.unbind(-1)
        here = first.unsqueeze(1) + corner[..., 1] * width.unsqueeze(1) + corner[..., 0]
        right, down = step[..., 0], step[..., 1] * width.unsqueeze(1)
        index = torch.stack([here, here + right, here + down, here + right + down], -1)
        weight = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], -1) * weights.unsqueeze(-1)
        return functional.embedding_bag(
            index.flatten(1), self.colours, mode="sum", per_sample_weights=weight.flatten(1).to(self.colours.dtype)
        )  # fmt: skip


def mirrored(places: Tensor, size: tuple[int, int]) -> Tensor:
    """Places, (..., 2), any distance outside an image of `size`, (width, height), reflected into it."""
    last = torch.tensor([size[0] - 1, size[1] - 1], dtype=places.dtype, device=places.device)
    period = (2 * last).clamp(min=1)
    folded = last - (last - torch.remainder(places.abs(), period)).abs()
    return torch.minimum(folded.clamp(min=0), last)
