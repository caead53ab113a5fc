"""A ChArUco board in an image: markers, then local homographies, then corners grown over the grid."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rainstereo.calib.board import TAG_BORDER, TAGS, Board, aruco_dictionary
from rainstereo.calib.detection import Detection, nothing
from rainstereo.calib.saddles import checker, contrast_of, refine, spacing_of, steps
from rainstereo.types import Array, Image, Mask

_CONTRAST = 0.4  # a corner is one if its contrast is at least this share of the board's median
_FEWEST = 6


def find_markers(search: Image, board: Board, dictionary: str | None = None) -> tuple[Array, Array]:
    """Identities (M,) and image corners (M, 4, 2) of all markers of the board's dictionary."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = 5  # two windows find as many markers as six, in a third of the time
    parameters.adaptiveThreshWinSizeMax = 21
    parameters.adaptiveThreshWinSizeStep = 16
    parameters.minMarkerPerimeterRate = 0.01
    parameters.minMarkerDistanceRate = 0.01
    parameters.perspectiveRemovePixelPerCell = 8
    if board.kind == "aprilgrid" and dictionary is None:
        dictionary, parameters.markerBorderBits = TAGS, TAG_BORDER
    name = dictionary or board.dictionary or ""
    quads, identities, _ = cv2.aruco.ArucoDetector(aruco_dictionary(name), parameters).detectMarkers(search)
    if identities is None or len(identities) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    return np.ravel(identities).astype(int), np.reshape(quads, (-1, 4, 2)).astype(float)


def find_charuco(search: Image, fine: Image, board: Board, legacy: bool | None) -> Detection:
    """The board in an image; `search`: uint8, `fine`: the same in float32; `legacy`: its layout, None: either."""
    identities, quads = find_markers(search, board)
    layouts = (False, True) if legacy is None and board.squares[1] % 2 == 0 else (bool(legacy),)
    found = [_charuco_layout(fine, board, identities, quads, layout) for layout in layouts]
    best = max(found, key=lambda detection: np.isfinite(detection.xy).sum())
    others = [detection for detection in found if detection and detection is not best]
    return replace(best, other=others[0]) if others else best


def _charuco_layout(fine: Image, board: Board, identities: Array, quads: Array, legacy: bool) -> Detection:
    layout = np.array(board.charuco(legacy).getObjPoints(), dtype=float)[..., :2] / board.square - 1.0
    known = identities < len(layout)
    if not known.any():
        return nothing(board, f"none of the board's {len(layout)} markers of {board.dictionary} is seen")
    on_board = layout[np.where(known, identities, 0)]  # in squares, corner [0, 0] at the origin
    agree = consistent(on_board, quads, known)
    if agree.sum() < max(2, 0.4 * len(identities)):
        reason = f"only {agree.sum()} of {len(identities)} markers of {board.dictionary} are where the board has them"
        return nothing(board, f"{reason}: another board, or its squares were counted wrongly")
    guess = from_markers(board, on_board[agree], quads[agree])
    white_first = legacy and board.squares[1] % 2 == 0
    expected = checker(board.rows, board.columns) * (-1.0 if white_first else 1.0)
    xy = _complete(fine, guess, expected, gap=0.5 * (1.0 - (board.marker or 0.0) / board.square))
    lattice = np.argwhere(np.isfinite(xy[..., 0]))
    if len(lattice) < _FEWEST or np.ptp(lattice[:, 0]) == 0 or np.ptp(lattice[:, 1]) == 0:
        return nothing(board, f"only {len(lattice)} corners are seen, or all in one row")
    return Detection(xy, legacy=legacy)


def consistent(on_board: Array, quads: Array, candidates: Mask) -> Mask:
    """Markers that lie where at least half of the neighbours within two squares expect them."""
    keep = candidates.copy()
    centre_board, centre_image = on_board.mean(axis=1), quads.mean(axis=1)
    # affine map of each marker's own neighbourhood: image = centre + A (board - centre), least squares on 4 corners
    b, q = on_board - centre_board[:, None], quads - centre_image[:, None]
    A = np.swapaxes(np.linalg.solve(np.swapaxes(b, 1, 2) @ b, np.swapaxes(b, 1, 2) @ q), 1, 2)
    offset = centre_board[None] - centre_board[:, None]
    miss = np.linalg.norm(centre_image[:, None] + np.einsum("iab,ijb->ija", A, offset) - centre_image[None], axis=-1)
    size = np.sqrt(np.abs(np.linalg.det(A)))
    expected = (miss < 0.5 * size[:, None]) & (np.linalg.det(A) > 0)[:, None]
    expected |= expected.T
    near = (np.linalg.norm(offset, axis=-1) < 2.3) & ~np.eye(len(keep), dtype=bool)
    for _ in range(3):
        neighbours = near & keep[None]
        votes = (neighbours & expected).sum(axis=1)
        keep &= (votes >= 1) & (votes >= 0.5 * neighbours.sum(axis=1))
    return keep


def from_markers(board: Board, on_board: Array, quads: Array) -> Array:
    """First guess of the corners, (rows, columns, 2): homography of the markers around each; NaN beside none.

    Linear least squares on the corners of up to six markers within 1.7 squares. A faint pull of the two perspective
    terms to zero leaves an affine map where a single marker says nothing about them.
    """
    lattice = np.stack(np.meshgrid(np.arange(board.columns), np.arange(board.rows)), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(on_board.mean(axis=1)[None] - lattice[:, None], axis=-1)
    beside = distance.min(axis=1) < 0.8
    nearest = np.argsort(distance[beside], axis=1)[:, :6]
    weight = np.repeat(np.take_along_axis(distance[beside], nearest, axis=1) < 1.7, 4, axis=1).astype(float)
    x, y = np.moveaxis((on_board[nearest] - lattice[beside][:, None, None]).reshape(len(nearest), -1, 2), -1, 0)
    target = quads[nearest].reshape(len(nearest), -1, 2)
    centre = target[:, :4].mean(axis=1, keepdims=True)
    size = np.linalg.norm(target[:, 0] - target[:, 2], axis=-1)[:, None]
    u, v = np.moveaxis(target - centre, -1, 0) / size
    one, zero = np.ones_like(x), np.zeros_like(x)
    equations = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1),
        ],
        axis=1,
    )
    weighted = np.swapaxes(equations * np.tile(weight, 2)[..., None], 1, 2)
    normal = weighted @ equations + 1e-2 * np.diag([0, 0, 0, 0, 0, 0, 1, 1])
    solution = np.linalg.solve(normal, weighted @ np.concatenate([u, v], axis=1)[..., None])[..., 0]
    guess = np.full((len(lattice), 2), np.nan)
    guess[beside] = centre[:, 0] + size * solution[:, [2, 5]]
    return guess.reshape(board.rows, board.columns, 2)


def _complete(fine: Image, guess: Array, expected: Array, gap: float) -> Array:
    """Refine the guesses, then grow the grid over corners without a readable marker as long as they look right.

    ``expected`` is the sign of each corner's contrast, ``gap`` the width in squares of the white rim around a
    marker: the refinement must not see the marker itself.
    """
    shares = (0.7 * gap, gap)
    xy = np.full_like(guess, np.nan)
    reference = np.nan
    for _ in range(max(guess.shape)):
        fresh = np.isfinite(guess[..., 0]) & np.isnan(xy[..., 0])
        if not fresh.any():
            break
        both = np.where(fresh[..., None], guess, xy)
        du, dv = steps(both)
        spacing = np.where(fresh, spacing_of(du, dv), np.nan)
        refined = refine(fine, guess, gap * spacing, np.maximum(0.15 * spacing, 1.0))
        contrast = contrast_of(fine, refined, du, dv, shares) * expected
        if np.isnan(reference):
            if not np.isfinite(contrast).any():
                break
            reference = float(np.nanmedian(contrast))
        good = fresh & (contrast > _CONTRAST * reference)
        if not good.any():
            break
        xy[good] = refined[good]
        guess = _grown(xy)
    return xy


def _grown(xy: Array) -> Array:
    """Guesses for unseen corners with three seen in line beside them, averaged over the directions."""
    total, count = np.zeros_like(xy), np.zeros(xy.shape[:2])
    for turn in range(4):
        turned = np.rot90(xy, turn)
        ahead = np.full_like(turned, np.nan)
        ahead[3:] = 3 * turned[2:-1] - 3 * turned[1:-2] + turned[:-3]
        ahead = np.rot90(ahead, -turn)
        there = np.isfinite(ahead[..., 0])
        total[there] += ahead[there]
        count += there
    guess = np.where((count > 0)[..., None], total / np.maximum(count, 1)[..., None], np.nan)
    guess[np.isfinite(xy[..., 0])] = np.nan
    return guess
