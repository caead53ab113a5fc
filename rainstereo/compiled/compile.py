"""How loops are compiled: once for each machine and kind of argument, and kept on disk beside the module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Loop = TypeVar("Loop", bound=Callable[..., Any])


SETTINGS: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}


def inlined(loop: Loop) -> Loop:
    """A part of compiled loops, made anew into each: for what is called for every pixel."""
    return cast(Loop, numba.njit(forceinline=True, **SETTINGS)(loop))


def compiled(loop: Loop) -> Loop:
    """The loop in machine code: it releases the lock, checks no index and divides as IEEE 754 says.

    numba compiles anew when the loop's own file has changed. After a change to a part of it that another file holds,
    remove `__pycache__/*.nb?`. Where neither the package's folder nor the user's cache can be written to, loops are
    compiled in every process.
    """
    try:
        found = numba.njit(cache=True, **SETTINGS)(loop)
    except RuntimeError:  # numba: no place for the cache
        found = numba.njit(**SETTINGS)(loop)
    return cast(Loop, found)
