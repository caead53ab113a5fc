"""Loops compiled before a large plan, or a frame of many moving drops, needs memory, the first time by another process.

The compiler takes 100 MB and more, and never gives them back; machine code that is read from disk takes next to none.
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rainstereo import compiled
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber, Panel
from rainstereo.droplet import SphericalCap
from rainstereo.height_rays import HeightRays
from rainstereo.types import Indices

from .cells import LARGEST
from .far_caps import FarCaps
from .free_memory import give_back
from .lookups import Lookups
from .paste import Paste
from .pursuit import Pursuit
from .quadtree import Quadtree, Taps

Way = Literal["default", "lasting", "moving"]
MANY = 1 << 17  # pixels of a plan, or of moving drops, or such drops: loops are compiled before tables take memory
SIDE = 8  # pixels
SPAN = 40  # of the rays of a pixel
PATIENCE = 600.0  # seconds for another process; then this one compiles
CHILD = """
import sys
sys.path[:] = {path!r}
from rainstereo.rain import compile_ahead
compile_ahead.compile_here({way!r})
"""


@cache
def compile_ahead(way: Way) -> None:
    """Have the loops ready that plans and frames of drops need; nothing without numba."""
    if not compiled.available():
        return
    from rainstereo.compiled.compile import folder

    done = folder() / f"rain-ahead-{way}"
    if not done.exists() and Path(sys.executable or "").name.startswith("python"):  # not what else Python is built into
        told = CHILD.format(path=sys.path, way=way)
        try:
            subprocess.run([sys.executable, "-c", told], capture_output=True, timeout=PATIENCE, check=True)
            done.touch()
        except (OSError, ValueError, TypeError, subprocess.SubprocessError):
            pass  # nowhere to keep it, or no Python to start: this process compiles
    compile_here(way)


def compile_here(way: Way) -> None:
    """Trace a pixel, find the taps of one, order, pack and draw them; or draw a moving drop, and tell its pixels."""
    camera, pane = Camera.pinhole(SPAN, SPAN, 0, 0, SIDE, SIDE), Chamber((0, 0, 1), 0.05, (Panel(0.002, 1.5),))
    cap = SphericalCap((0, 0), 0.001, 0.5)
    _meet_bodies()
    if way == "moving":
        from rainstereo.compiled.cap_rivals import meet

        from .render import Renderer  # which needs this module

        meet(np.zeros((1, 3)), 0, 1, (SIDE, SIDE), np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.uint32))
        Renderer(camera, pane, moving=True).plan(cap).render(np.zeros((SIDE, SIDE, 3), dtype=np.uint8))
        give_back()
        return
    caps = FarCaps.of([cap], camera, pane, np.inf)
    if caps is not None:
        caps.look(np.zeros(1, dtype=np.intp), None, 1, np.ones(1, dtype=np.float32))
    along = np.linspace(0, SPAN, SIDE, dtype=np.float32)
    x, y = (at.reshape(-1, 1) for at in np.meshgrid(along, along))
    tree = Quadtree((SIDE * SPAN,) * 2, 17, 1.0)
    sums = Pursuit((SIDE * SPAN,) * 2, 1.0, tree) if way == "lasting" else tree
    sums.taps(x, y, np.full(x.shape, 1 / SIDE**2, dtype=np.float32))
    _draw()
    give_back()


def _meet_bodies() -> None:
    """What rays do that meet drops which merged."""
    from rainstereo.compiled.height_map import interpolate

    one: Any = np.zeros(1, dtype=np.float32)
    nodes, dry = np.zeros((6, 6)), np.zeros((3, 3), dtype=np.uint8)
    rays = HeightRays(np.float32(1), 1.0, nodes, dry, 1.0, one, one, one, one)
    interpolate(one, one, np.float32(1), 1.0, nodes, dry, np.zeros((3, 1), dtype=np.float32))
    rays.first_change(one, True, one, one)
    rays.rises_above(one, one, 1.0)
    rays.deepest(one, 0.5, 1)
    rays.meet(one, one, 1.0, 1)


def _draw() -> None:
    texels = np.append(np.arange(4), SIDE**2 + np.arange(12)).astype(
        np.int32
    )  # some pixels, and most of the next level
    one: Indices = np.zeros(1, dtype=np.intp)
    image = np.zeros((SIDE, SIDE, 3), dtype=np.uint8)
    for weight in (LARGEST, LARGEST**2):  # in a byte, and in two
        weights = np.full(len(texels), weight, dtype=np.int16)
        taps = Taps(texels, weights, one + len(texels), np.zeros(1))
        table = Lookups.of(one, one, taps, np.zeros(1), np.zeros((1, 2)), np.zeros(1, dtype=np.bool_)).ordered(SIDE)
        for some in (table, table.narrow((SIDE, SIDE))[0]):
            paste = Paste([some], (SIDE, SIDE), SIDE)
            for _ in range(2):  # the second time, otherwise than the first
                paste.paste(image, image, image.copy())
