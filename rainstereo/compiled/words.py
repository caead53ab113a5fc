"""Words of pixels, three bytes in 64 bits (`rain.words`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .layout import FIELD

U = np.uint64


@inlined
def word_of(values: Any, row: Any, first: Any, channels: int) -> Any:
    """The word of a row of bytes, (N, C) uint8, from some channels on: up to three of them."""
    word = U(values[row, first])
    if channels > 1:
        word |= U(values[row, first + U(1)]) << U(FIELD)
    if channels > 2:
        word |= U(values[row, first + U(2)]) << U(2 * FIELD)
    return word


@compiled
def pack(values: Any, first: int, channels: int, words: Any) -> None:
    """Write a word for each row of bytes, (N, C) uint8, from some channels on: up to three of them; words: (N,)."""
    for i in range(U(len(words))):
        words[i] = word_of(values, i, U(first), channels)
