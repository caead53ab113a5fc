"""Memory on large pages, where the system has them.

Of what lies on few pages the processor knows all addresses, and what is side by side in memory gets into no other's way
in the caches.
"""

from __future__ import annotations

import contextlib
import mmap
from typing import Any

import numpy as np


def numbers(kind: type, size: int) -> Any:
    """(size,) numbers of a kind, all 0."""
    block = mmap.mmap(-1, max(np.dtype(kind).itemsize * size, 1))
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # a system without them
            block.madvise(mmap.MADV_HUGEPAGE)
    return np.frombuffer(block, dtype=kind, count=size)
