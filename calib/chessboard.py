"""A chessboard in an image: found by three searches, refined, and followed beyond its rim.

OpenCV's sector-based search comes first, then the same on an enlarged image, then the classic search. Whatever they
return is kept only if every corner looks like the one that the board has there, the cells between are plain and
alternate, and the pattern ends where the board asked for ends: a part of a larger board is refused, however
convincing it may be.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.calib.board import Board
from rainstereo.calib.detection import Detection, nothing
from rainstereo.calib.saddles import (
    SQUARE_SHARES,
    checker,
    contrast_of,
    inside_image,
    orderings,
    refine,
    sample,
    spacing_of,
    steps,
)  # fmt: skip
from rainstereo.types import Array, Image

CONTRAST = 0.3
"""A corner is one if its contrast is at least this share of the board's median."""
_SEARCH_SIDE = 1600  # larger images are searched shrunk to this; refinement always sees every pixel
_WINDOW = 0.3  # half window of the refinement in local spacings; measured best on real boards between 0.2 and 0.45


def find_chessboard(search: Image, fine: Image, board: Board) -> Detection:
    """The board in an image; `search`: uint8, `fine`: the same in float32."""
    shape = (board.columns, board.rows)
    weak = False
    for finder in (_sectors, _sectors_enlarged, _classic):
        found = finder(search, shape)
        if found is None:
            continue
        xy = refined_chessboard(fine, found)
        if np.isfinite(xy[..., 0]).mean() < 0.9 or not checkered(fine, xy):
            weak = True
            continue
        seen = extent(fine, xy)
        if sorted(seen) != sorted(shape):
            shown = chessboard_of(seen, board)
            return nothing(board, f"wrong board shape: this image shows {shown}, not {shape[0]}x{shape[1]}", shown)
        return Detection(_ordered_by_colour(fine, xy))
    name = f"the {shape[0]}x{shape[1]} chessboard"
    if weak:
        return nothing(board, f"{name} is not clearly there: blurred, partly hidden or another board")
    return nothing(board, f"{name} is not found")


def _sectors(search: Image, shape: tuple[int, int], flags: int = 0) -> Array | None:
    """Sector-based search (Duda and Frese 2018), on a shrunk image first where the image is large."""
    shrink = _SEARCH_SIDE / max(search.shape)
    if shrink < 0.8:
        small = cv2.resize(search, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        found = _sectors(small, shape, flags)
        if found is not None:
            ratio = np.array(search.shape[::-1]) / small.shape[::-1]
            return (found + 0.5) * ratio - 0.5
    ok, corners = cv2.findChessboardCornersSB(search, shape, flags=flags)
    return np.asarray(corners, dtype=float).reshape(shape[1], shape[0], 2) if ok else None


def _sectors_enlarged(search: Image, shape: tuple[int, int]) -> Array | None:
    return _sectors(search, shape, cv2.CALIB_CB_ACCURACY)


def _classic(search: Image, shape: tuple[int, int]) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    ok, corners = cv2.findChessboardCorners(search, shape, flags=flags)
    return np.asarray(corners, dtype=float).reshape(shape[1], shape[0], 2) if ok else None


def refined_chessboard(fine: Image, found: Array) -> Array:
    """Refined corners, NaN where the image does not look like a corner of alternating squares."""
    du, dv = steps(found)
    spacing = spacing_of(du, dv)
    xy = refine(fine, found, _WINDOW * spacing, 0.3 * spacing)
    contrast = contrast_of(fine, xy, du, dv, SQUARE_SHARES) * checker(*xy.shape[:2])
    seen = np.isfinite(contrast)
    if not seen.any():
        return np.full_like(xy, np.nan)
    median = np.median(contrast[seen])
    xy[~(contrast * np.sign(median) > CONTRAST * abs(median))] = np.nan
    return xy


def checkered(fine: Image, xy: Array) -> bool:
    """Whether the cells between the corners are plain and alternate: a search may step over rows or go askew."""
    share = np.linspace(0.25, 0.75, 4)[:, None, None, None]
    top = xy[:-1, :-1] + share * (xy[:-1, 1:] - xy[:-1, :-1])
    bottom = xy[1:, :-1] + share * (xy[1:, 1:] - xy[1:, :-1])
    gray = sample(fine, top + share[:, None] * (bottom - top)).reshape(16, xy.shape[0] - 1, xy.shape[1] - 1)
    whole = np.isfinite(gray).all(axis=0)
    dark = (checker(*whole.shape) < 0) & whole
    light = (checker(*whole.shape) > 0) & whole
    if not (dark.any() and light.any()):
        return False
    mean, spread = gray.mean(axis=0), np.ptp(gray, axis=0)
    levels = float(np.median(mean[light])), float(np.median(mean[dark]))
    plain = spread < 0.5 * abs(levels[0] - levels[1])
    right = np.sign(levels[0] - levels[1]) * (mean - np.mean(levels)) * checker(*whole.shape) > 0
    return bool((plain & right)[whole].mean() >= 0.9)


def _ordered_by_colour(fine: Image, xy: Array) -> Array:
    """Right-handed; among those orders one that starts after a black square, then the most upright one."""

    def rank(order: Array) -> tuple[bool, float]:
        du, dv = steps(order)
        contrast = contrast_of(fine, order, du, dv, SQUARE_SHARES) * checker(*order.shape[:2])
        black_first = float(np.nanmedian(contrast)) > 0
        return black_first, float(np.nanmean(du[..., 0]) / np.linalg.norm(np.nanmean(du, axis=(0, 1))))

    return max(orderings(xy), key=rank)


def extent(fine: Image, xy: Array) -> tuple[int, int]:
    """Follow the pattern beyond the found grid and count the (columns, rows) of corners that are really there."""
    rows, columns = xy.shape[:2]
    for _ in range(4 * max(rows, columns) + 100):
        for turn in range(4):
            turned = np.rot90(xy, turn)
            beyond = _next_row(fine, turned)
            if beyond is not None:
                xy = np.rot90(np.concatenate([turned, beyond[None]]), -turn)
                break
        else:
            break
    return xy.shape[1], xy.shape[0]


def _next_row(fine: Image, xy: Array) -> Array | None:
    """Row of corners that follows the last one, or None unless half of those in view, three at least, are there."""
    ahead = 3 * xy[-1] - 3 * xy[-2] + xy[-3]  # the perspective of equal steps, to second order
    du, dv = steps(np.stack([xy[-1], ahead]))
    spacing = spacing_of(du[1], dv[1])
    refined = refine(fine, ahead, 0.25 * spacing, 0.3 * spacing)
    before = contrast_of(fine, xy[-1], du[0], dv[0], SQUARE_SHARES)
    after = contrast_of(fine, refined, du[1], dv[1], SQUARE_SHARES)
    reference = np.nanmedian(np.abs(before)) if np.isfinite(before).any() else np.nan
    in_view = inside_image(fine, ahead) & np.isfinite(ahead).all(axis=-1)
    for side in (-0.3, 0.3):
        in_view &= inside_image(fine, ahead + side * dv[1], 0.0) & inside_image(fine, ahead + side * du[1], 0.0)
    alternates = (-np.sign(before) * after > CONTRAST * reference) & in_view
    if alternates.sum() < 3 or alternates.sum() < 0.5 * in_view.sum():
        return None
    return np.where(np.isfinite(refined), refined, ahead)


def chessboard_of(shape: tuple[int, int], board: Board) -> str:
    """Words for a chessboard of (columns, rows), the longer side put where the board asked for has it."""
    long, short = max(shape), min(shape)
    columns, rows = (long, short) if board.columns >= board.rows else (short, long)
    return f"a chessboard of {columns}x{rows} inner corners"
