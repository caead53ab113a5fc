"""Baseline: Eigen et al., "Restoring an Image Taken through a Window Covered with Dirt or Rain", ICCV 2013.

Three convolutions, section 3.1: 16x16 to 512 units, tanh; 1x1 to 512 units, tanh; 8x8 to RGB. An output pixel is the
overlap of 8x8 patches that each see 16x16 pixels: 23x23 in all. Learned by the mean squared error.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn.functional import pad

from rainstereo.model.image_batch import RGB, check

FIRST, LAST = 16, 8
MARGIN = (FIRST + LAST - 2) // 2
MIDDLE = 0.5
LARGEST = 4096


@dataclass(frozen=True)
class EigenConfig:
    """units: of both hidden layers; the paper's 512 make 754,691 parameters."""

    units: int = 512

    def __post_init__(self) -> None:
        if type(self.units) is not int or not 1 <= self.units <= LARGEST:
            raise ValueError(f"units {self.units!r} was given; expected a whole number in 1..{LARGEST}")

    def build(self) -> Eigen:
        """The module, with random weights from torch's generator."""
        return Eigen(self)


class Eigen(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to the same shape, any H, W >= 1; the output is clamped to 0..1 in eval mode only."""

    def __init__(self, config: EigenConfig) -> None:
        super().__init__()
        self.config = config
        self.reach = (1, MARGIN, True)  # multiple, pixels to the farthest that counts, whether a tile equals the frame
        self.network = nn.Sequential(
            nn.Conv2d(RGB, config.units, FIRST),
            nn.Tanh(),
            nn.Conv2d(config.units, config.units, 1),
            nn.Tanh(),
            nn.Conv2d(config.units, RGB, LAST),
        )

    def forward(self, images: Tensor) -> Tensor:
        """The derained images. Beyond its borders an image is mirrored, or its last pixels repeated if it is small."""
        check(images)
        for sides, size in (((MARGIN, MARGIN, 0, 0), images.shape[3]), ((0, 0, MARGIN, MARGIN), images.shape[2])):
            images = pad(images, sides, mode="reflect" if size > MARGIN else "replicate")
        derained: Tensor = self.network(images - MIDDLE) + MIDDLE
        return derained if self.training else derained.clamp(0, 1)
