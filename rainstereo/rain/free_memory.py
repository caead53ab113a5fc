"""Memory that a large plan needed while it was made, given back to the system."""

from __future__ import annotations

import ctypes
import sys


def give_back() -> None:
    """On Linux with glibc, which otherwise keeps free memory below what is still in use, tens of MB; else nothing."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(ctypes.c_size_t(0))
