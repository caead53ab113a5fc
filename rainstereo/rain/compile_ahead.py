"""Loops compiled before a large plan needs the memory that the compiler takes: some 100 MB, the first time."""

from __future__ import annotations

from functools import cache

import numpy as np

from rainstereo import compiled
from rainstereo.compiled.layout import LONG_BITS, SHORT_BITS
from rainstereo.types import Indices

from .free_memory import give_back
from .lookups import Lookups
from .paste import Paste
from .pursuit import Pursuit
from .quadtree import Quadtree, Taps

SIDE = 8  # pixels
SPAN = 40  # of the rays of a pixel


def compile_ahead(sums: Pursuit | Quadtree) -> None:
    """Find the taps of one pixel, order, pack and draw them; nothing without numba."""
    if compiled.available():
        along = np.linspace(0, SPAN, SIDE, dtype=np.float32)
        x, y = (at.reshape(-1, 1) for at in np.meshgrid(along, along))
        sums.taps(x, y, np.full(x.shape, 1 / SIDE**2, dtype=np.float32))
        _draw()
        give_back()


@cache
def _draw() -> None:
    texels, weights = np.arange(4, dtype=np.int32), np.full(4, 256, dtype=np.int16)
    one: Indices = np.zeros(1, dtype=np.intp)
    taps = Taps(texels, weights, one + len(texels), np.zeros(1))
    table = Lookups.of(one, one, taps, np.zeros(1), np.zeros((1, 2)), np.zeros(1, dtype=np.bool_)).ordered(SIDE)
    image = np.zeros((SIDE, SIDE, 3), dtype=np.uint8)
    for of_tap in ((np.int32, SHORT_BITS), (np.int64, LONG_BITS)):
        for some in (table, table.narrow((SIDE, SIDE))[0]):
            paste = Paste([some], (SIDE, SIDE))
            paste.__dict__["_of_tap"] = of_tap  # as of an image of so many texels
            paste.paste(image, image, image.copy())
