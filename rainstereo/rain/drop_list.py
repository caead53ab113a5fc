"""Drops, and what they were rendered with, as JSON that gives back the same frame.

Numbers are written so that they are read back as the same doubles; grids as the bytes of little-endian doubles,
compressed, in base64. Reading builds only the shapes named here, from numbers: nothing in a file is executed.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import cv2
import numpy as np

from rainstereo import __version__
from rainstereo.bezier_drop import BezierDrop
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber, Panel
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.thin_lens import ThinLens
from rainstereo.young_laplace_drop import YoungLaplaceDrop

from .streak_piece import StreakPiece
from .streaks import Streak

FORMAT, VERSION = "rainstereo drops", 1
DROPS = (SphericalCap, YoungLaplaceDrop, BezierDrop, HeightMap, Streak, StreakPiece)
SHAPES: dict[str, type[Any]] = {shape.__name__: shape for shape in (*DROPS, ThinLens, Panel, Chamber, Camera)}
LEFT_OUT = {"carried"}  # what a camera carries for other programs
MOST_NUMBERS = 1 << 24  # of a grid


def to_json(drops: Sequence[Drop], **settings: Any) -> str:
    """Drops in their order, with settings: numbers, texts, cameras, chambers, lenses. ValueError for unknown shapes."""
    versions = {"rainstereo": __version__, "opencv": cv2.__version__, "numpy": np.__version__}
    shared: dict[int, int] = {}
    bodies: list[Any] = []
    for drop in drops:  # the pieces of a streak share it
        if isinstance(drop, StreakPiece) and id(drop.streak) not in shared:
            shared[id(drop.streak)] = len(bodies)
            bodies.append(_encoded(drop.streak, {}))
    head = {"format": FORMAT, "version": VERSION, "versions": versions}
    body = {name: _encoded(value, shared) for name, value in settings.items()}
    return json.dumps({**head, **body, "streaks": bodies, "drops": [_encoded(drop, shared) for drop in drops]})


def from_json(text: str) -> tuple[list[Drop], dict[str, Any]]:
    """Drops and settings. ValueError if the text is not such a list, or holds what no drop can be."""
    try:
        found = json.loads(text)
    except ValueError as error:
        raise ValueError(f"not JSON: {error}; expected a drop list as `drops_json` writes it") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT or found.get("version") != VERSION:
        raise ValueError(f"not a drop list; expected JSON with format '{FORMAT}' and version {VERSION}")
    if not isinstance(found.get("streaks"), list) or not isinstance(found.get("drops"), list):
        raise ValueError("the drop list lacks its lists 'streaks' and 'drops'")
    streaks = [_decoded(streak, []) for streak in found["streaks"]]
    drops = [_decoded(drop, streaks) for drop in found["drops"]]
    wrong = next((drop for drop in drops if not isinstance(drop, Drop)), None)
    if wrong is not None:
        raise ValueError(f"the drop list holds {wrong!r:.80}, which is no drop")
    known = {"format", "version", "versions", "streaks", "drops"}
    return drops, {name: _decoded(value, []) for name, value in found.items() if name not in known}


def _encoded(value: Any, shared: dict[int, int]) -> Any:
    if isinstance(value, np.ndarray):
        data = zlib.compress(np.ascontiguousarray(value, dtype="<f8").tobytes())
        return {"shape": list(value.shape), "float64": base64.b64encode(data).decode("ascii")}
    if isinstance(value, tuple | list):
        return [_encoded(item, shared) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"number": str(value)}
    if isinstance(value, Streak) and id(value) in shared:
        return {"streak": shared[id(value)]}
    if type(value).__name__ in SHAPES:
        given = {f.name: getattr(value, f.name) for f in fields(value) if f.init and f.name not in LEFT_OUT}
        return {"type": type(value).__name__, **{name: _encoded(item, shared) for name, item in given.items()}}
    raise ValueError(f"a {type(value).__name__} cannot be written to a drop list; expected one of {', '.join(SHAPES)}")


def _decoded(value: Any, streaks: Sequence[Any]) -> Any:
    if isinstance(value, list):
        return tuple(_decoded(item, streaks) for item in value)
    if not isinstance(value, dict):
        return value
    if "number" in value:
        return float(value["number"])
    if "streak" in value and "type" not in value:
        number = value["streak"]
        if not (isinstance(number, int) and 0 <= number < len(streaks)):
            raise ValueError(f"the drop list names streak {number!r} of {len(streaks)}")
        return streaks[number]
    if "float64" in value:
        return _grid(value)
    name = value.get("type")
    if name not in SHAPES:
        raise ValueError(f"the drop list holds a {name!r}; expected one of {', '.join(SHAPES)}")
    shape = SHAPES[name]
    names = {f.name for f in fields(shape) if f.init}
    unknown = set(value) - names - {"type"}
    if unknown:
        raise ValueError(f"a {name} of the drop list has the unknown entries {', '.join(sorted(unknown))}")
    try:
        return shape(**{key: _decoded(item, streaks) for key, item in value.items() if key != "type"})
    except TypeError as error:
        raise ValueError(f"a {name} of the drop list is incomplete: {error}") from None


def _grid(value: dict[str, Any]) -> Any:
    shape = value.get("shape")
    if not isinstance(shape, list) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError(f"a grid of the drop list has the shape {shape!r}; expected whole numbers")
    count = math.prod(shape)
    if count > MOST_NUMBERS:
        raise ValueError(f"a grid of {count} numbers; expected at most {MOST_NUMBERS}")
    try:
        data = zlib.decompressobj().decompress(base64.b64decode(value["float64"], validate=True), 8 * count + 1)
    except (binascii.Error, zlib.error, TypeError) as error:
        raise ValueError(f"a grid of the drop list is damaged: {error}") from None
    if len(data) != 8 * count:
        raise ValueError(f"a grid of shape {shape} holds {len(data)} bytes; expected {8 * count}")
    return np.frombuffer(data, dtype="<f8").astype(np.float64).reshape(shape)


__all__ = ["FORMAT", "VERSION", "from_json", "to_json"]
