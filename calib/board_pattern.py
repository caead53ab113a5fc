"""What is printed black on a board, as rectangles: exact at any scale, for drawing."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo.calib.board import TAG_BORDER, TAGS, Board, aruco_dictionary
from rainstereo.types import Array, Mask


def black_rectangles(board: Board) -> Array:
    """Everything black on the board, (N, 4): x, y of the upper left corner, width, height; metres in the board frame.

    Rectangles may touch and never overlap.
    """
    if board.kind == "aprilgrid":
        return _aprilgrid(board)
    return _squares(board) if board.kind == "chessboard" else np.concatenate([_squares(board), _markers(board)])


def _aprilgrid(board: Board) -> Array:
    """Tags as AprilTag draws them, and the squares in the gaps that make each tag's corner a chessboard's."""
    (width, height), dictionary = board.shape, aruco_dictionary(TAGS)
    modules = int(dictionary.markerSize) + 2 * TAG_BORDER
    gap = board.margin
    found = []
    for row in range(height):
        for column in range(width):
            identity = width * (height - 1 - row) + column
            turned = cv2.aruco.generateImageMarker(dictionary, identity, modules, borderBits=TAG_BORDER) == 0
            corner = board.points[2 * row, 2 * column, :2]
            found.append(placed(np.rot90(turned, 2), corner, board.square / modules))
    pitch = board.square + gap
    down, across = np.divmod(np.arange((width + 1) * (height + 1)), width + 1)
    side = np.full(len(down), gap)
    return np.concatenate([*found, np.column_stack([across * pitch - gap, down * pitch - gap, side, side])])


def picture(board: Board, pixels_per_square: int, edge: int, largest: int) -> tuple[npt.NDArray[np.uint8], Array]:
    """`Board.texture` from the rectangles: every texel has its exact share of black. edge: white border in texels."""
    inside = np.ceil(np.array(board.size) / board.square * pixels_per_square - 1e-9).astype(int)
    width, height = (int(n) for n in inside + 2 * edge)
    if width * height > largest:
        raise ValueError(f"{pixels_per_square} texels a tag make a picture above {largest} texels; give fewer")
    scaled = black_rectangles(board) / board.square * pixels_per_square
    origin = edge + board.margin / board.square * pixels_per_square
    ink = np.zeros((height, width), dtype=np.float32)
    for x, y, w, h in scaled:
        left, across = _shares(origin + x, w)
        top, down = _shares(origin + y, h)
        ink[top : top + len(down), left : left + len(across)] += np.outer(down, across)
    return np.round(255 * (1 - np.minimum(ink, 1))).astype(np.uint8), np.full(2, origin - 0.5)


def _shares(start: float, length: float) -> tuple[int, Array]:
    """The first texel that an interval touches, and the share of each texel that it covers."""
    first = int(np.floor(start + 1e-9))
    texel = np.arange(first, int(np.ceil(start + length - 1e-9)))
    return first, np.clip(np.minimum(texel + 1, start + length) - np.maximum(texel, start), 0, 1)


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
