"""Numbers, matrices and rotations out of a parsed file; what is wrong is told with the place, and how to mend it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rainstereo.pose import rotation_vector
from rainstereo.types import Array

Table = Mapping[str, Any]
NOT_A_ROTATION = 1e-3
LONGEST = 64


def first_of(table: Table, names: Sequence[str]) -> str | None:
    """The first of the names that the table has."""
    return next((name for name in names if name in table), None)


def need(table: Table, key: str, where: str, example: str = "") -> Any:
    """An entry that must be there."""
    if key not in table:
        has = ", ".join(list(map(str, table))[:12]) or "nothing"
        raise ValueError(f"{where} lacks {key}{f', such as {example}' if example else ''}; it has {has}")
    return table[key]


def numbers(value: Any, what: str) -> Array:
    """A row of finite numbers: a list of them, nested or not, or {rows, cols, data}."""
    if isinstance(value, Mapping):
        value = need(value, "data", what, "[0, 0, 0, 0]")
    flat: list[float] = []
    _flatten(value, what, flat)
    bad = [v for v in flat if not math.isfinite(v)]
    if bad:
        raise ValueError(f"{what} holds {bad[0]}; expected finite numbers (a calibration that failed?)")
    return np.array(flat, np.float64)


def matrix(value: Any, rows: int, columns: int, what: str) -> Array:
    """A matrix of finite numbers: {rows, cols, data}, a list of rows, or all numbers in one list, row by row."""
    flat = numbers(value, what)
    given = None
    if isinstance(value, Mapping):
        sides = tuple(_integer(need(value, side, what, "3"), f"{side} of {what}") for side in ("rows", "cols"))
        given = (sides[0], sides[1])
    elif isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        given = (len(value), len(value[0]))
    if given is not None and given != (rows, columns) and not (1 in given and 1 in (rows, columns)):
        raise ValueError(f"{what} has {given[0]} rows and {given[1]} columns; expected {rows} and {columns}")
    if len(flat) != rows * columns:
        raise ValueError(f"{what} holds {len(flat)} numbers; expected {rows} x {columns}")
    return flat.reshape(rows, columns)


def core(value: Any, what: str) -> Array:
    """fx, fy, cx, cy of a camera matrix."""
    K = matrix(value, 3, 3, what)
    if np.abs(K[2, :2]).max() > 1e-6 * abs(K[0, 0]) >= 1e-6 * abs(K[0, 2]):
        raise ValueError(
            f"{what} has {K[2, 0]:g}, {K[2, 1]:g} in its last row, where 0, 0, 1 was expected: it seems to be "
            "transposed; give it row by row, as fx 0 cx, 0 fy cy, 0 0 1"
        )
    if not np.allclose(K[2], [0, 0, 1], atol=1e-9) or abs(K[1, 0]) > 1e-9:
        raise ValueError(f"{what} is {K.tolist()}; expected fx 0 cx, 0 fy cy, 0 0 1")
    if abs(K[0, 1]) > 1e-9:
        raise ValueError(f"{what} has the skew {K[0, 1]:g}, which no lens model here has; calibrate with skew 0")
    if min(K[0, 0], K[1, 1]) <= 0:
        raise ValueError(f"{what} has the focal lengths {K[0, 0]:g}, {K[1, 1]:g}; expected pixels, above 0")
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])


def rotation(value: Array, what: str) -> Array:
    """Rodrigues vector of a rotation matrix, (3, 3)."""
    off = float(np.abs(value @ value.T - np.eye(3)).max())
    if off > NOT_A_ROTATION or np.linalg.det(value) < 0:
        raise ValueError(
            f"{what} is no rotation (R R' differs from 1 by {off:.2g}, determinant {np.linalg.det(value):.3g}); "
            "expected a 3 x 3 rotation matrix, row by row"
        )
    U, _, Vt = np.linalg.svd(value)  # a file with few digits is a rotation but for those
    return rotation_vector(U @ Vt) if off > 1e-12 else rotation_vector(value)


def homogeneous(value: Any, what: str) -> Array:
    """`rt`, (6,), of a 4 x 4 transformation."""
    T = matrix(value, 4, 4, what)
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        turned = np.allclose(T[:, 3], [0, 0, 0, 1], atol=1e-9)
        raise ValueError(
            f"{what} ends in the row {T[3].tolist()}; expected 0 0 0 1"
            + (": it seems to be transposed; its translation belongs into the last column" if turned else "")
        )
    return np.concatenate([rotation(T[:3, :3], f"the rotation of {what}"), T[:3, 3]])


def size(width: Any, height: Any, where: str) -> tuple[int, int]:
    """Width and height in pixels."""
    return _integer(width, f"the image width of {where}"), _integer(height, f"the image height of {where}")


def words(value: Any, what: str) -> str:
    """A short text."""
    if not isinstance(value, str):
        raise ValueError(f"{what} is {str(value)[:60]!r}; expected a word")
    return value


def _integer(value: Any, what: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value != int(value):
        raise ValueError(f"{what} is {str(value)[:60]!r}; expected a whole number")
    return int(value)


def _flatten(value: Any, what: str, into: list[float]) -> None:
    if isinstance(value, list):
        for part in value:
            _flatten(part, what, into)
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{what} holds {str(value)[:60]!r}; expected numbers")
    else:
        try:
            into.append(float(value))
        except OverflowError as error:
            raise ValueError(f"{what} holds a number too large for any camera; expected finite numbers") from error
    if len(into) > LONGEST:
        raise ValueError(f"{what} holds more than {LONGEST} numbers; expected a small matrix")
