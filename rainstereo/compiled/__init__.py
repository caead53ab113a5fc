"""Inner loops as machine code, made by numba where it is installed (`pip install rainstereo[fast]`).

Everything here has a counterpart in numpy or scipy that is used without numba and that the tests hold it to. Only this
folder imports numba; others ask `available()` first, then import the loop that they need.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module


@cache
def available() -> bool:
    """Whether loops can be compiled here: numba is installed, and suits this Python and numpy."""
    try:
        import_module("numba")
    except ImportError:
        return False
    return True
