"""Sub-pixel corners of a calibration board in one image."""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.calib.aprilgrid import find_aprilgrid
from rainstereo.calib.board import Board
from rainstereo.calib.charuco import find_charuco, find_markers
from rainstereo.calib.chessboard import checkered, chessboard_of, extent, find_chessboard, refined_chessboard
from rainstereo.calib.detection import Detection, nothing
from rainstereo.calib.saddles import orderings
from rainstereo.types import Array, Image

VERSION = 1
"""Raised whenever the same image may give other corners than before: cached corners of another version are stale."""


def detect(image: Image, board: Board, *, legacy: bool | None = None, diagnose: bool = False) -> Detection:
    """Find ``board`` in an image.

    Parameters
    ----------
    image
        (height, width) or (height, width, 3 or 4: BGR) uint8 or uint16; not changed.
    legacy
        Layout of a ChArUco board with an even number of rows of squares; None takes the one that more corners fit.
    diagnose
        Where the board is not found, look for another one to name in the reason (slower).
    """
    gray = _gray(image)
    search = _eight_bits(gray)
    fine = gray.astype(np.float32)
    cv2.setRNGSeed(0)  # OpenCV's sector-based search draws random numbers; the same image gives the same corners
    if board.kind == "aprilgrid":
        found = find_aprilgrid(search, fine, board)
    elif board.kind == "charuco":
        found = find_charuco(search, fine, board, legacy)
    else:
        found = find_chessboard(search, fine, board)
    if diagnose and not found and not found.seen:
        seen = _what_is_there(search, fine, board)
        found = nothing(board, f"{found.reason}; this image shows {seen or 'no other board either'}", seen)
    return found


def decided_by_colour(board: Board) -> bool:
    """Whether the print tells corner [0, 0] from its opposite: always with markers, else if columns + rows is odd."""
    return board.kind != "chessboard" or (board.columns + board.rows) % 2 == 1


def indistinguishable(xy: Array, board: Board) -> list[Array]:
    """All right-handed orders of (rows, columns, 2) corners that the print of ``board`` cannot tell apart.

    One where the colours decide, else two (turned by 180 degrees), or four for a square board that also looks the
    same turned by 90 degrees. The given order comes first if it is right-handed.
    """
    orders = orderings(xy)
    if decided_by_colour(board):
        return orders[:1]
    return orders[::2] if board.columns == board.rows and board.columns % 2 == 1 else orders


def _gray(image: Image) -> Image:
    if image.ndim not in (2, 3) or image.dtype not in (np.uint8, np.uint16) or min(image.shape[:2]) < 2:
        raise ValueError(
            f"an image of shape {image.shape} and type {image.dtype} was given; expected (height, width) or "
            "(height, width, 3 or 4), uint8 or uint16"
        )
    if image.ndim == 2:
        return image
    codes = {1: None, 3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
    if image.shape[2] not in codes:
        raise ValueError(f"the image has {image.shape[2]} channels; expected 1, 3 (BGR) or 4 (BGRA)")
    code = codes[image.shape[2]]
    return np.asarray(image[..., 0] if code is None else cv2.cvtColor(image, code))


def _eight_bits(gray: Image) -> Image:
    """Contiguous uint8; sixteen bits are stretched between their 0.5 % and 99.5 % quantiles."""
    if gray.dtype == np.uint8:
        return np.ascontiguousarray(gray)
    low, high = (float(level) for level in np.percentile(gray, (0.5, 99.5)))
    stretched: Image = np.clip((gray - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    return stretched


def _what_is_there(search: Image, fine: Image, board: Board) -> str:
    """Name another board that the image shows, by its markers' dictionary or its shape; empty if there is none."""
    for dictionary in ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_APRILTAG_36H11"):
        identities, _ = find_markers(search, board, dictionary)
        if len(identities) >= 6 and dictionary != board.dictionary:
            return f"markers of {dictionary}"
    for flags in (0, cv2.CALIB_CB_ACCURACY):
        ok, corners, meta = cv2.findChessboardCornersSBWithMeta(search, (3, 3), cv2.CALIB_CB_LARGER | flags)
        if not ok:
            continue
        xy = refined_chessboard(fine, np.asarray(corners, dtype=float).reshape(*meta.shape[:2], 2))
        if np.isfinite(xy[..., 0]).mean() < 0.9 or not checkered(fine, xy):
            continue
        shape = extent(fine, xy)
        if board.kind != "chessboard" or set(shape) != {board.columns, board.rows}:
            return chessboard_of(shape, board)
    return ""
