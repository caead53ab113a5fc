"""Frames that carry a number in their pixels, so that a pair that does not belong together is seen."""

import numpy as np

from rainstereo.hardware.pair_frame import CameraFrame, PairFrame, PairStatus
from rainstereo.types import Image


def stamped(number: int, shape: tuple[int, int] = (12, 16), seed: int = 0) -> Image:
    """A noisy image whose first eight pixels are the number."""
    image = np.random.default_rng([seed, number]).integers(0, 256, shape, dtype=np.uint8)
    image.ravel()[:8] = np.frombuffer(int(number).to_bytes(8, "little"), np.uint8)
    return image


def number_in(image: Image) -> int:
    """The number that `stamped` put into an image."""
    return int.from_bytes(np.ascontiguousarray(image).ravel()[:8].tobytes(), "little")


def pair(
    number: int, shape: tuple[int, int] = (12, 16), pixel_format: str = "Mono8", regime: str = "mist"
) -> PairFrame:
    """A pair of stamped frames."""
    at = 1_000_000_000 + number * 62_500_000
    dry = CameraFrame(stamped(number, shape, 1), number % 65535 + 1, at, at + 7_000_000, pixel_format)
    wet = CameraFrame(stamped(number, shape, 2), number % 65535 + 1, at + 13_000, at + 8_000_000, pixel_format)
    return PairFrame(number, dry, wet, PairStatus.OK, 13.0, regime)
