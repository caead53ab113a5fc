"""What is printed black on a board, as rectangles: exact at any scale, for drawing."""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.calib.board import Board
from rainstereo.types import Array, Mask


def black_rectangles(board: Board) -> Array:
    """Everything black on the board, (N, 4): x, y of the upper left corner, width, height; metres in the board frame.

    Rectangles may touch and never overlap.
    """
    return _squares(board) if board.kind == "chessboard" else np.concatenate([_squares(board), _markers(board)])


def _squares(board: Board) -> Array:
    width, height = board.squares
    row, column = np.nonzero(np.add.outer(np.arange(height), np.arange(width)) % 2 == 0)
    return board.square * np.column_stack([column - 1, row - 1, np.ones_like(row), np.ones_like(row)])


def _markers(board: Board) -> Array:
    charuco = board.charuco()
    dictionary = charuco.getDictionary()
    modules = int(dictionary.markerSize) + 2
    found = []
    for identity, corners in zip(np.ravel(charuco.getIds()), charuco.getObjPoints(), strict=True):
        black = cv2.aruco.generateImageMarker(dictionary, int(identity), modules) == 0
        corner = np.asarray(corners, dtype=float)[0, :2] / board.square - 1  # OpenCV has float32
        corner = np.floor(corner) + 0.5 - 0.5 * float(board.marker or 0) / board.square
        found.append(placed(black, corner * board.square, float(board.marker or 0) / modules))
    return np.concatenate(found)


def placed(black: Mask, corner: Array, module: float) -> Array:
    """The black modules of a marker as few rectangles, (N, 4). corner: of the marker, (2,); module: its side."""
    return np.asarray([*corner, 0.0, 0.0] + module * np.array(blocks(black), dtype=float).reshape(-1, 4))


def blocks(black: Mask) -> list[tuple[int, int, int, int]]:
    """Disjoint rectangles (column, row, width, height) that cover the true cells of a grid: runs, stacked if alike."""
    left = np.array(black)
    found = []
    for row, column in np.argwhere(left).tolist():
        if not left[row, column]:
            continue
        width = 1
        while column + width < left.shape[1] and left[row, column + width]:
            width += 1
        height = 1
        while row + height < left.shape[0] and left[row + height, column : column + width].all():
            height += 1
        left[row : row + height, column : column + width] = False
        found.append((column, row, width, height))
    return found
