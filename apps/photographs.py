"""The photographs that scikit-image's package carries, read from its folder: nothing is ever downloaded."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import cv2
import numpy as np

from rainstereo.types import Image

NAMES = {
    "astronaut": "astronaut.png",
    "brick": "brick.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "hubble": "hubble_deep_field.jpg",
    "motorcycle": "motorcycle_left.png",
    "rocket": "rocket.jpg",
}
"""What may be asked for, and the file that it is."""


@cache
def photograph(name: str) -> Image:
    """A photograph, (H, W, 3) uint8 BGR, read-only. FileNotFoundError where scikit-image lacks it."""
    if name not in NAMES:
        raise ValueError(f"there is no photograph {name!r}; expected one of {', '.join(NAMES)}")
    try:
        data = _without_profile((files("skimage.data") / NAMES[name]).read_bytes())
    except (ModuleNotFoundError, FileNotFoundError) as error:
        raise FileNotFoundError(
            f"scikit-image's photograph {NAMES[name]} is not installed; get it with: pip install scikit-image"
        ) from error
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"scikit-image's photograph {NAMES[name]} is damaged; reinstall scikit-image")
    image.setflags(write=False)
    return image


def _without_profile(data: bytes) -> bytes:
    """A PNG file without its colour profile, of which libpng would complain on stderr; other files as they are."""
    if not data.startswith(b"\x89PNG"):
        return data
    kept, at = [data[:8]], 8
    while at + 12 <= len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4])
        if data[at + 4 : at + 8] != b"iCCP":
            kept.append(data[at:end])
        at = end
    return b"".join(kept)
