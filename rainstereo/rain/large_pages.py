"""Memory on large pages, where the system has them.

Of what lies on few pages the processor knows all addresses, and what is side by side in memory gets into no other's way
in the caches.
"""

from __future__ import annotations

import contextlib
import mmap
from typing import Any

import numpy as np

LARGE = 1 << 21  # bytes of a page, on most systems that have them


def zeros(kind: type, size: int) -> Any:
    """(size,) numbers of a kind, all 0. A process that is forked has its own."""
    length = max(-(-np.dtype(kind).itemsize * size // LARGE), 1) * LARGE
    if hasattr(mmap, "MAP_PRIVATE"):
        block = mmap.mmap(-1, length, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    else:
        block = mmap.mmap(-1, length)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # a system without them
            block.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(block, dtype=kind, count=size)
