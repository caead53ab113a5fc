"""Inner loops as machine code, made by numba where it is installed (`pip install rainstereo[fast]`).

Everything here has a counterpart in numpy or scipy that is used without numba and that the tests hold it to. Only this
folder imports numba; others ask `available()` first, then import the loop that they need.
"""

from __future__ import annotations

import sys
from functools import cache
from importlib import import_module

MANY = 64
"""Numbers from which on a loop is worth loading numba."""


@cache
def available() -> bool:
    """Whether loops can be compiled here: numba is installed, and suits this Python and numpy."""
    try:
        import_module("numba")
    except ImportError:
        return False
    return True


def pays(count: int) -> bool:
    """Whether to take a loop for so many numbers that numpy has in a moment: for few, only if numba is loaded, which
    takes half a second."""
    return (count >= MANY or "numba" in sys.modules) and available()
