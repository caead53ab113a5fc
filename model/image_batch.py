"""Images as networks take them, (B, 3, H, W) RGB floats in 0..1: checked, and brought to sides that a network needs."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

RGB = 3
INPUT = {"channels": RGB, "range": [0.0, 1.0], "colour": "rgb"}
"""What a card says of the images that its network takes, and what networks of this package do take."""


def check(images: Tensor) -> None:
    """ValueError, with what is wrong, for anything else than (B, 3, H, W) floats, at least one of each."""
    if images.ndim != 4 or images.shape[1] != RGB or 0 in images.shape:
        raise ValueError(
            f"images have shape {tuple(images.shape)}; expected (batch, 3, height, width) of at least 1 each"
        )
    if not images.is_floating_point():
        raise ValueError(f"images are {images.dtype}; expected floats in 0..1: divide by the largest value")


def padded(images: Tensor, multiple: int, smallest: int) -> Tensor:
    """Sides brought to multiples, and to a smallest one, at the right and at the bottom.

    Mirrored where the image is large enough for that, otherwise its last row or column is repeated.
    """
    for axis, size in ((3, images.shape[3]), (2, images.shape[2])):
        more = max(-size % multiple, smallest - size)
        if more:
            sides = (0, more, 0, 0) if axis == 3 else (0, 0, 0, more)
            images = pad(images, sides, mode="reflect" if more < size else "replicate")
    return images
