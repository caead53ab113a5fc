"""What was found of a board in one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo.calib.board import Board
from rainstereo.types import Array


@dataclass(frozen=True, eq=False)
class Detection:
    """Corners of a board in one image; false if there are none, and then ``reason`` says why.

    Attributes
    ----------
    xy
        (rows, columns, 2) float64 pixels, NaN where unseen. Right-handed (columns to rows turns clockwise in the
        image) and, where the board's colours decide it, starting at the corner that follows a black square.
    reason
        Why nothing is returned; empty if the board was found.
    seen
        What the image shows instead, if that is known, such as ``a chessboard of 9x6 inner corners``.
    legacy
        A ChArUco board laid out as OpenCV did before 4.6 (only differs for an even number of rows of squares).
    other
        The same corners numbered as in the other layout, if that is possible too. A view without the board's left
        and right rim fits both, shifted by one column: one image cannot tell, all images of a set together can.
    """

    xy: Array
    reason: str = ""
    seen: str = ""
    legacy: bool = False
    other: Detection | None = None

    def __bool__(self) -> bool:
        return not self.reason


def nothing(board: Board, reason: str, seen: str = "") -> Detection:
    """The detection that found no corner, and why."""
    return Detection(np.full((board.rows, board.columns, 2), np.nan), reason, seen)
