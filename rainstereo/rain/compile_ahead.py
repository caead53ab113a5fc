"""Loops compiled before a large plan needs the memory that the compiler takes: some 100 MB, the first time."""

from __future__ import annotations

from functools import cache

import numpy as np

from rainstereo import compiled
from rainstereo.compiled.layout import LONG_BITS, SHORT_BITS

from .free_memory import give_back
from .lookups import Lookups
from .paste import Paste

SIDE = 8  # pixels


@cache
def compile_ahead() -> None:
    """Order, pack and draw a table of one pixel; nothing without numba."""
    if not compiled.available():
        return
    texels, weights = np.arange(4, dtype=np.int32), np.full(4, 256, dtype=np.int16)
    one, clear = np.zeros(1, dtype=np.int32), np.zeros(1, dtype=np.float32)
    nowhere, unknown = np.zeros((1, 2), dtype=np.float32), np.zeros(1, dtype=np.bool_)
    table = Lookups(one, one, one + 4, texels, weights, clear, nowhere, unknown).ordered(SIDE)
    image = np.zeros((SIDE, SIDE, 3), dtype=np.uint8)
    for of_tap in ((np.int32, SHORT_BITS), (np.int64, LONG_BITS)):
        for some in (table, table.narrow((SIDE, SIDE))[0]):
            paste = Paste([some], (SIDE, SIDE))
            paste.__dict__["_of_tap"] = of_tap  # as of an image of so many texels
            paste.paste(image, image, image.copy())
    give_back()
