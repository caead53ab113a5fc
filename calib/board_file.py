"""A board's description as a TOML file: what `rainstereo board` writes beside its drawing and `--board` accepts.

The lengths are there to be corrected by whoever measures the print.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from rainstereo.calib.board import Board, words_of_length

LARGEST = 1 << 16
SHAPE = {"chessboard": "inner_corners", "charuco": "squares", "aprilgrid": "tags"}
LENGTHS = {"chessboard": ("square_mm",), "charuco": ("square_mm", "marker_mm"), "aprilgrid": ("tag_mm",)}
OTHER = {"chessboard": (), "charuco": ("dictionary",), "aprilgrid": ("spacing",)}


def description(board: Board) -> str:
    """The text of the file; `read` gives the same board again."""
    shape = board.shape
    lines = [
        f"# {board.spec}",
        "# Measure the print over as long a way as possible and correct the lengths here.",
        f'kind = "{board.kind}"',
        f"{SHAPE[board.kind]} = [{shape[0]}, {shape[1]}]",
        f"{LENGTHS[board.kind][0]} = {_millimetres(board.square)}",
    ]
    if board.spacing is not None:
        lines.append(f"spacing = {board.spacing!r}  # gap in sides of a tag")
    if board.marker is not None:
        lines += [f"marker_mm = {_millimetres(board.marker)}", f'dictionary = "{board.dictionary}"']
    return "\n".join(lines) + "\n"


def read(path: Path) -> Board:
    """The board that a file describes. ValueError says what is wrong with it, FileNotFoundError if there is none."""
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path} is larger than {LARGEST} bytes, so no board's description")
    try:
        table = tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    kind = table.pop("kind", None)
    if not isinstance(kind, str) or kind not in SHAPE:
        raise ValueError(f"{path}: kind is {kind!r}; expected one of {', '.join(SHAPE)}")
    needed = {SHAPE[kind], *LENGTHS[kind], *OTHER[kind]}
    missing, unknown = needed - set(table), set(table) - needed
    if missing or unknown:
        told = [f"lacks {', '.join(sorted(missing))}"] * bool(missing)
        told += [f"has {', '.join(sorted(unknown))}, which a {kind} has not"] * bool(unknown)
        raise ValueError(f"{path} {' and '.join(told)}; expected kind, {', '.join(sorted(needed))}")
    shape = table[SHAPE[kind]]
    if not (isinstance(shape, list) and len(shape) == 2 and all(type(n) is int for n in shape)):
        raise ValueError(f"{path}: {SHAPE[kind]} is {shape!r}; expected two whole numbers such as [9, 6]")
    square = _metres(path, table, LENGTHS[kind][0])
    try:
        if kind == "aprilgrid":
            return Board("aprilgrid", 2 * shape[0], 2 * shape[1], square, spacing=_number(path, table, "spacing"))
        if kind == "chessboard":
            return Board("chessboard", shape[0], shape[1], square)
        marker = _metres(path, table, "marker_mm")
        return Board("charuco", shape[0] - 1, shape[1] - 1, square, marker, str(table["dictionary"]).upper())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _millimetres(metres: float) -> str:
    words = words_of_length(metres)
    return words.removesuffix("mm") if words.endswith("mm") else repr(1000 * metres)


def _metres(path: Path, table: dict[str, Any], key: str) -> float:
    return _number(path, table, key) / 1000


def _number(path: Path, table: dict[str, Any], key: str) -> float:
    value = table[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        unit = " of millimetres, such as 25.0" if key.endswith("_mm") else ", such as 0.3"
        raise ValueError(f"{path}: {key} is {value!r}; expected a number{unit}")
    return float(value)
