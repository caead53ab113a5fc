"""A 256-bit hash under which images that look alike differ in few bits, and distances between many of them.

The signs of the 16 x 16 lowest DCT coefficients of a 64 x 64 reduction, against their median, as in the DCT hash of
C. Zauner, "Implementation and benchmarking of perceptual image hash functions", 2010, with four times its bits: 64 bits
cannot tell one street from the next.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo.types import Array, Image, Indices

SIDE, LOWEST = 64, 16
BITS = LOWEST * LOWEST
NEAR_DUPLICATE = 56
"""Bits, of 256, up to which two images count as one; how it was measured: docs/select.md."""
Hashes = npt.NDArray[np.uint8]
"""(N, 32): a hash a row."""
BLOCK = 4096


def perceptual_hash(gray: Image) -> Hashes:
    """(32,) uint8 of a gray image, (H, W), 8 bits. A flat image has all bits alike."""
    if gray.ndim != 2 or min(gray.shape) < 8:
        raise ValueError(f"an image of shape {gray.shape} was given; expected gray, (H, W), 8 pixels or more")
    small = cv2.resize(gray, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    low = cv2.dct(small)[:LOWEST, :LOWEST].ravel()
    bits = low > np.median(low[1:])
    bits[0] = False  # the mean brightness
    return np.packbits(bits)


def to_text(row: Hashes) -> str:
    """64 hexadecimal digits."""
    return row.tobytes().hex()


def from_text(text: str) -> Hashes:
    """The hash of `to_text`; ValueError for anything else."""
    try:
        row = np.frombuffer(bytes.fromhex(text), np.uint8)
    except ValueError:
        row = np.zeros(0, np.uint8)
    if len(row) != BITS // 8:
        raise ValueError(f"{text[:80]!r} is no hash; expected {BITS // 4} hexadecimal digits")
    return row


def signs(hashes: Hashes) -> npt.NDArray[np.float32]:
    """(N, 256) float32 of -1 and 1: the distance of two rows is (256 - their product) / 2."""
    if hashes.ndim != 2 or hashes.shape[1] != BITS // 8:
        raise ValueError(f"hashes of shape {hashes.shape} were given; expected (N, {BITS // 8})")
    return np.unpackbits(hashes, axis=1).astype(np.float32) * 2 - 1


def nearest(hashes: Hashes, others: Hashes) -> tuple[Indices, Array]:
    """For each hash the nearest of the others, (N,), and its distance, (N,) bits: inf where there is none."""
    which, bits = np.zeros(len(hashes), np.intp), np.full(len(hashes), np.inf)
    if not len(others):
        return which, bits
    target = signs(others).T.copy()
    for start in range(0, len(hashes), BLOCK):
        rows = slice(start, start + BLOCK)
        for first in range(0, len(others), BLOCK):
            product = signs(hashes[rows]) @ target[:, first : first + BLOCK]
            best = product.argmax(1)
            found = (BITS - product[np.arange(len(best)), best].astype(np.float64)) / 2
            closer = found < bits[rows]
            which[rows] = np.where(closer, best + first, which[rows])
            bits[rows] = np.minimum(bits[rows], found)
    return which, bits
