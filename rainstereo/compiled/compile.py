"""How loops are compiled: once for each machine and kind of argument, and kept on disk beside the module."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Loop = TypeVar("Loop", bound=Callable[..., Any])
SETTINGS: dict[str, Any] = {"nogil": True, "boundscheck": False, "error_model": "numpy"}
FUSED: dict[str, Any] = {**SETTINGS, "fastmath": {"contract"}, "_nrt": False}
"""Products and what they are added to are rounded once, not twice, where the processor can. And nobody counts who uses
an array, which takes longer than what is done with a row of one: such loops make no arrays, but are given them."""


def inlined(loop: Loop) -> Loop:
    """A part of compiled loops, made anew into each: for what is called for every pixel."""
    return cast(Loop, numba.njit(forceinline=True, **SETTINGS)(loop))


def fused_part(loop: Loop) -> Loop:
    """A part of `fused` loops."""
    return cast(Loop, numba.njit(forceinline=True, **FUSED)(loop))


def fused(loop: Loop) -> Loop:
    """As `compiled`, for loops that need not round as numpy does."""
    return compiled(loop, FUSED)


def compiled(loop: Loop, settings: dict[str, Any] = SETTINGS) -> Loop:
    """The loop in machine code: it releases the lock, checks no index and divides as IEEE 754 says.

    Where neither the package's folder nor the user's cache can be written to, it is compiled in every process.
    """
    config = cast(Any, numba.config)
    given, config.CACHE_DIR = config.CACHE_DIR, config.CACHE_DIR or str(_kept())
    try:
        found = numba.njit(cache=True, **settings)(loop)
    except RuntimeError:  # numba: no place for the cache
        found = numba.njit(**settings)(loop)
    finally:
        config.CACHE_DIR = given
    return cast(Loop, found)


def folder() -> Path:
    """Where machine code is kept, if it can be."""
    return Path(cast(Any, numba.config).CACHE_DIR or _kept())


def _kept() -> Path:
    """A folder for the machine code of these very sources: numba compiles anew when a loop's own file changes, but not
    when a part of it does that another file holds."""
    here = Path(__file__).parent
    sources = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(here.glob("*.py"))))
    return here / "__pycache__" / sources.hexdigest()[:16]
