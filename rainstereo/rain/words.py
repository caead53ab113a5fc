"""Three bytes in a word of 64 bits, 21 bits apart: a sum of words times whole numbers is the three sums at once.

That holds as long as each of the sums stays within 2^21 (L. Lamport, "Multiple byte processing with full-word
instructions", CACM 18, 1975).
"""

from __future__ import annotations

import sys
from typing import Any

import cv2
import numpy as np

from rainstereo.compiled.layout import BELOW, EVERY, FIELD, PACKED
from rainstereo.types import Image

LITTLE = sys.byteorder == "little"
CHUNK = 1 << 14  # words: few enough for the caches


def packed(values: Image) -> Any:
    """Words, (N,), of up to three channels of bytes, (N, C)."""
    words: Any = np.empty(len(values), dtype=np.uint64)
    if values.shape[1] < PACKED or not len(values) or not LITTLE:
        _pack(values, words)
        return words
    four = cv2.cvtColor(np.ascontiguousarray(values)[None], cv2.COLOR_BGR2BGRA).view(np.uint32).ravel()
    first, last, middle = np.uint64(255 | 255 << (2 * FIELD)), np.uint64(2 * FIELD - 16), np.uint64(FIELD - 8)
    for start in range(0, len(words), CHUNK):
        some = words[start : start + CHUNK]
        own = four[start : start + CHUNK].astype(np.uint64)
        np.left_shift(own, last, out=some)
        some |= own
        some &= first
        own <<= middle
        own &= np.uint64(255 << FIELD)
        some |= own
    return words


def _pack(values: Image, words: Any) -> None:
    for first in range(0, len(words), CHUNK):
        some, channels = words[first : first + CHUNK], values[first : first + CHUNK]
        some[...] = channels[:, -1]
        for channel in range(channels.shape[1] - 2, -1, -1):
            some <<= np.uint64(FIELD)
            some |= channels[:, channel]


def unpack(words: Any, values: Image) -> None:
    """Write the lowest bytes of the words' fields, (N, C); spoils the words."""
    for channel in range(values.shape[1]):
        if channel:
            words >>= np.uint64(FIELD)
        values[:, channel] = words.view(np.uint8)[:: words.itemsize] if LITTLE else words & np.uint64(255)


def clip(words: Any) -> None:
    """Bring fields, whose lowest 9 bits are values + `BELOW`, between 0 and 255."""
    words &= np.uint64(EVERY * 511)
    words += np.uint64(EVERY * (256 - BELOW))  # now bit 9 says that a value is above 255, bit 8 that it is not negative
    over = words & np.uint64(EVERY << 9)
    words |= (over >> np.uint64(1)) - (over >> np.uint64(9))
    over >>= np.uint64(1)
    over |= words
    over &= np.uint64(EVERY << 8)
    over -= over >> np.uint64(8)
    words &= over


def mean(parts: list[Any], up: bool) -> Any:
    """Means of bytes in two or four words; whether halves are rounded up."""
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    total += np.uint64((len(parts) // 2 - (not up)) * EVERY)
    total >>= np.uint64(len(parts) // 2)
    total &= np.uint64(EVERY * 255)
    return total
