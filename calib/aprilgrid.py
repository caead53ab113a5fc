"""An AprilGrid in an image: its tags, whichever are seen, and their corners refined as saddles.

Where the gaps cross lies a black square, so that every corner of a tag is a chessboard's. The squares touch the tags,
which hides the tags' outlines from the detector of markers: it looks at an image whose dark parts were thinned. From
the tags read, the corners grow over the board as far as they look right. The window of the refinement stays within the
tag's black frame and within the square.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.calib.board import TAG_BORDER, TAGS, Board, aruco_dictionary
from rainstereo.calib.charuco import consistent, find_markers
from rainstereo.calib.detection import Detection, nothing
from rainstereo.calib.saddles import checker, contrast_of, refine, spacing_of
from rainstereo.types import Array, Image

_CONTRAST = 0.4  # a corner is one if its contrast is at least this share of the first corners' median
_FEWEST = 6
_ENOUGH, _FEW = 0.7, 3  # share of the tags read with which no enlarged image is searched; tags, with which no third
_WINDOW = 0.85  # half window of the refinement, in what is clear about a corner
_NEAREST, _FAR = 16, 3.0  # corners that guess another one: how many, and how far they may be in sides of a tag
_SHARES = (0.45, 0.75)  # of the way to the edge of the frame or the square, where gray levels are compared
_REACH = 0.08  # sides of a tag that a corner may move in the refinement


def find_aprilgrid(search: Image, fine: Image, board: Board) -> Detection:
    """The board in an image; `search`: uint8, `fine`: the same in float32. Corners of unseen tags are NaN."""
    identities, quads = _tags(search, board)
    width, height = board.shape
    known = identities < width * height
    if not known.any():
        return nothing(board, f"none of the board's {width * height} tags of the family 36h11 is seen")
    up, column = np.divmod(np.where(known, identities, 0), width)
    row = height - 1 - up
    # OpenCV's first corner of a tag is AprilTag's lower right one; it goes on clockwise
    rows = np.stack([2 * row + 1, 2 * row + 1, 2 * row, 2 * row], -1)
    columns = np.stack([2 * column + 1, 2 * column, 2 * column, 2 * column + 1], -1)
    on_board = board.points[rows, columns, :2] / board.square
    agree = known if known.sum() == 1 else consistent(on_board, quads, known)
    if agree.sum() < max(1, 0.4 * len(identities)):
        reason = f"only {agree.sum()} of {len(identities)} tags are where the board has them"
        return nothing(board, f"{reason}: another board, or its tags were counted wrongly")
    guess = np.full((board.rows, board.columns, 2), np.nan)
    guess[rows[agree], columns[agree]] = quads[agree]
    xy = _complete(fine, guess, board)
    seen = np.isfinite(xy[..., 0])
    if seen.sum() < _FEWEST:
        return nothing(board, f"only {int(seen.sum())} corners of tags are seen clearly; {_FEWEST} are needed")
    return Detection(xy)


def _tags(search: Image, board: Board) -> tuple[Array, Array]:
    """Numbers (M,) and corners (M, 4, 2) of the tags that can be read, each once; small ones in an enlarged image."""
    found: dict[int, Array] = {}
    for scale, enough in ((1, _ENOUGH * np.prod(board.shape)), (2, _FEW), (3, 0)):
        image = search
        if scale > 1:
            image = cv2.resize(search, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        identities, quads = find_markers(cv2.dilate(image, np.ones((3, 3), np.uint8)), board)
        for identity, quad in zip(identities.tolist(), quads, strict=True):
            found.setdefault(identity, (quad - (scale - 1) / 2) / scale)
        if len(found) >= enough:
            break
    return np.array(list(found), dtype=int), np.reshape(list(found.values()), (-1, 4, 2))


def _complete(fine: Image, guess: Array, board: Board) -> Array:
    """Refine the guesses, then guess and refine their neighbours, until no further corner is found."""
    xy, reference = np.full_like(guess, np.nan), np.nan
    modules = int(aruco_dictionary(TAGS).markerSize) + 2 * TAG_BORDER
    clear = min(TAG_BORDER / modules, float(board.spacing or 0))
    expected = checker(board.rows, board.columns)
    for _ in range(board.rows + board.columns):
        fresh = np.isfinite(guess[..., 0]) & np.isnan(xy[..., 0])
        if not fresh.any():
            break
        du, dv = _edges(np.where(fresh[..., None], guess, xy))
        side = np.where(fresh, spacing_of(du, dv), np.nan)
        refined = refine(fine, guess, _WINDOW * clear * side, np.maximum(_REACH * side, 1.5))
        contrast = contrast_of(fine, refined, du, dv, tuple(share * clear for share in _SHARES)) * expected
        if np.isnan(reference) and np.isfinite(contrast).any():
            reference = float(np.nanmedian(contrast))
        good = fresh & (contrast > _CONTRAST * reference)
        if not good.any():
            break
        xy[good] = refined[good]
        guess = _grown(xy, board)
    return xy


def _edges(xy: Array) -> tuple[Array, Array]:
    """The two edges of its own tag that meet at each corner, along columns and along rows, (rows, columns, 2)."""
    du = np.repeat(xy[:, 1::2] - xy[:, 0::2], 2, axis=1)
    dv = np.repeat(xy[1::2] - xy[0::2], 2, axis=0)
    return du, dv


def _grown(xy: Array, board: Board) -> Array:
    """Guesses for unseen corners with enough seen ones about them: each by the homography of the nearest."""
    points = board.points[..., :2] / board.square
    seen = np.isfinite(xy[..., 0])
    guess = np.full_like(xy, np.nan)
    there, pixels = points[seen], xy[seen]
    for row, column in np.argwhere(~seen):
        distance = np.linalg.norm(there - points[row, column], axis=-1)
        nearest = np.argsort(distance, kind="stable")[:_NEAREST]
        nearest = nearest[distance[nearest] < _FAR]
        if len(nearest) < 4 or (np.linalg.svd(there[nearest] - there[nearest].mean(0))[1] < 0.3).any():
            continue
        H, _ = cv2.findHomography(there[nearest], pixels[nearest])
        if H is not None:
            x, y, w = H @ [*points[row, column], 1]
            guess[row, column] = (x / w, y / w) if w > 0 else np.nan
    return guess
