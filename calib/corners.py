"""Sub-pixel corners of a calibration board in one image.

A chessboard is found by OpenCV's sector-based search, then by the same on an enlarged image, then by the classic
search; a ChArUco board through its markers and local homographies. All corners are then refined alike: gradient
orthogonality (Forstner and Gulch 1987, ``cv2.cornerSubPix``) in a window that follows the local spacing, after a
smoothing that removes most of that method's bias on sharp edges. On real images this leaves smaller residuals than
either search's own answer. A corner is kept only if it looks like the one that the board has there. The grid is
then followed beyond its rim: a board with more corners than were asked for is refused, however convincing the part
found may be.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rainstereo.calib.board import Board, aruco_dictionary
from rainstereo.types import Array, Image, Mask

VERSION = 1
"""Raised whenever the same image may give other corners than before: cached corners of another version are stale."""

_CONTRAST = 0.3  # a corner is one if its contrast is at least this share of the board's median
_MARKED_CONTRAST = 0.4
_SQUARE_SHARES = (0.2, 0.3)  # where squares are sampled to see a corner, in steps along their diagonal
_SEARCH_SIDE = 1600  # larger images are searched shrunk to this; refinement always sees every pixel
_WINDOW = 0.3  # half window of the refinement in local spacings; measured best on real boards between 0.2 and 0.45
_WINDOW_PIXELS = (2, 15)
_SMOOTHING = 0.12  # Gaussian sigma in half windows: bias on sharp drawn boards 0.04 -> 0.02 px, real residuals -5 %
_SMOOTHING_PIXELS = (0.5, 2.0)
_FEWEST = 6


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
    other: "Detection | None" = None

    def __bool__(self) -> bool:
        return not self.reason


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
    found = _chessboard(search, fine, board) if board.kind == "chessboard" else _charuco(search, fine, board, legacy)
    if diagnose and not found and not found.seen:
        seen = _what_is_there(search, fine, board)
        found = _nothing(board, f"{found.reason}; this image shows {seen or 'no other board either'}", seen)
    return found


def decided_by_colour(board: Board) -> bool:
    """Whether the print tells corner [0, 0] from its opposite: always with markers, else if columns + rows is odd."""
    return board.kind == "charuco" or (board.columns + board.rows) % 2 == 1


def indistinguishable(xy: Array, board: Board) -> list[Array]:
    """All right-handed orders of (rows, columns, 2) corners that the print of ``board`` cannot tell apart.

    One where the colours decide, else two (turned by 180 degrees), or four for a square board that also looks the
    same turned by 90 degrees. The given order comes first if it is right-handed.
    """
    orders = _orderings(xy)
    if decided_by_colour(board):
        return orders[:1]
    return orders[::2] if board.columns == board.rows and board.columns % 2 == 1 else orders


def _orderings(xy: Array) -> list[Array]:
    turns = range(4) if xy.shape[0] == xy.shape[1] else (0, 2)
    given = xy if _handedness(xy) >= 0 else xy[:, ::-1]
    return [np.ascontiguousarray(np.rot90(given, turn)) for turn in turns]


def read_gray(path: Path) -> tuple[Image | None, str]:
    """Read an image file as (height, width) uint8 or uint16 and ``""``, or return None and the reason.

    Never raises for what a file may hold. Truncated files are refused: decoders fill what is missing with gray.
    """
    try:
        if path.stat().st_size > 1 << 30:
            return None, "larger than 1 GiB"
        data = path.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror or error})"
    return decode_gray(data)


def decode_gray(data: bytes) -> tuple[Image | None, str]:
    """As `read_gray`, from the bytes of the file."""
    if not data:
        return None, "zero bytes"
    # FF DA starts a scan and cannot occur inside one; a thumbnail's scan lies before the image's
    jpeg_cut = data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < max(data.rfind(b"\xff\xda"), 1)
    if jpeg_cut or (data.startswith(b"\x89PNG") and b"IEND" not in data[-4096:]):
        return None, "truncated: the file ends before the image does"
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        return None, "not an image, or a damaged one"
    if image.dtype not in (np.uint8, np.uint16):
        return None, f"pixels are {image.dtype}; expected 8 or 16 bits"
    return image, ""


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


def _nothing(board: Board, reason: str, seen: str = "") -> Detection:
    return Detection(np.full((board.rows, board.columns, 2), np.nan), reason, seen)


# --- geometry of a grid ------------------------------------------------------------------------------------------


def _handedness(xy: Array) -> float:
    """Median cross product of the column and row steps, positive if right-handed in the image."""
    du, dv = _steps(xy)
    cross = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    return float(np.median(cross[np.isfinite(cross)])) if np.isfinite(cross).any() else 0.0


def _steps(xy: Array) -> tuple[Array, Array]:
    """Local steps (rows, columns, 2) along columns and rows: mean over the neighbours that there are, else NaN."""

    def along(axis: int) -> Array:
        nan = np.full_like(np.take(xy, [0], axis), np.nan)
        step = np.diff(xy, axis=axis)
        both = np.stack([np.concatenate([nan, step], axis), np.concatenate([step, nan], axis)])
        there = np.isfinite(both)
        count = there.sum(axis=0)
        return np.where(count > 0, np.where(there, both, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)

    return along(1), along(0)


def _spacing(du: Array, dv: Array) -> Array:
    return np.asarray(np.minimum(np.linalg.norm(du, axis=-1), np.linalg.norm(dv, axis=-1)))


def _inside(image: Image, xy: Array, margin: float = 1.0) -> Mask:
    height, width = image.shape
    x, y = xy[..., 0], xy[..., 1]
    return (x >= margin) & (y >= margin) & (x <= width - 1 - margin) & (y <= height - 1 - margin)


# --- looking at the image ----------------------------------------------------------------------------------------


def _refine(image: Image, xy: Array, half_window: Array, reach: Array) -> Array:
    """Move corners to the saddle; NaN where that is farther than ``reach`` pixels or outside the image."""
    refined = np.full_like(xy, np.nan)
    usable = _inside(image, xy) & np.isfinite(half_window)
    window = np.zeros(half_window.shape, dtype=int)
    window[usable] = np.clip(np.round(half_window[usable]), *_WINDOW_PIXELS)
    if not usable.any():
        return refined
    sigma = float(np.clip(_SMOOTHING * np.median(half_window[usable]), *_SMOOTHING_PIXELS))
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    for size in np.unique(window[usable]):
        these = usable & (window == size)
        points = np.ascontiguousarray(xy[these].reshape(-1, 1, 2), dtype=np.float32)
        moved = cv2.cornerSubPix(smooth, points, (int(size), int(size)), (-1, -1), criteria)
        refined[these] = moved.reshape(-1, 2)
    refined[~(np.linalg.norm(refined - xy, axis=-1) <= reach)] = np.nan
    return refined


def _contrast(image: Image, xy: Array, du: Array, dv: Array, shares: tuple[float, ...]) -> Array:
    """Contrast of the four squares that meet at each corner: positive if the up-left one is dark, 0 if no corner.

    It is the darker of the bright pair minus the brighter of the dark pair, each square's gray being the mean over
    samples at ``shares`` of the way along its diagonal's two steps.
    """
    quadrants = []
    for along, down in ((-1, -1), (1, 1), (1, -1), (-1, 1)):
        samples = [xy + share * (along * du + down * dv) for share in shares]
        quadrants.append(np.mean([_sample(image, sample) for sample in samples], axis=0))
    up_left, down_right, up_right, down_left = quadrants
    dark_first = np.minimum(up_right, down_left) - np.maximum(up_left, down_right)
    bright_first = np.minimum(up_left, down_right) - np.maximum(up_right, down_left)
    return np.asarray(np.maximum(dark_first, 0.0) - np.maximum(bright_first, 0.0))


def _sample(image: Image, xy: Array) -> Array:
    """Bilinear gray at (..., 2) pixels, NaN outside the image. (cv2.remap 4.x rounds to 1/32 pixel.)"""
    inside = _inside(image, xy, 0.0)
    x, y = np.moveaxis(np.where(inside[..., None], xy, 0.0), -1, 0)
    column = np.minimum(x.astype(int), image.shape[1] - 2)
    row = np.minimum(y.astype(int), image.shape[0] - 2)
    right, down = x - column, y - row
    top = image[row, column] * (1 - right) + image[row, column + 1] * right
    bottom = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return np.where(inside, top * (1 - down) + bottom * down, np.nan)


# --- chessboard --------------------------------------------------------------------------------------------------


def _chessboard(search: Image, fine: Image, board: Board) -> Detection:
    shape = (board.columns, board.rows)
    weak = False
    for finder in (_sectors, _sectors_enlarged, _classic):
        found = finder(search, shape)
        if found is None:
            continue
        xy = _refined_chessboard(fine, found)
        if np.isfinite(xy[..., 0]).mean() < 0.9 or not _checkered(fine, xy):
            weak = True
            continue
        seen = _extent(fine, xy)
        if sorted(seen) != sorted(shape):
            shown = _chessboard_of(seen, board)
            return _nothing(board, f"wrong board shape: this image shows {shown}, not {shape[0]}x{shape[1]}", shown)
        return Detection(_ordered_by_colour(fine, xy))
    name = f"the {shape[0]}x{shape[1]} chessboard"
    if weak:
        return _nothing(board, f"{name} is not clearly there: blurred, partly hidden or another board")
    return _nothing(board, f"{name} is not found")


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


def _refined_chessboard(fine: Image, found: Array) -> Array:
    """Refined corners, NaN where the image does not look like a corner of alternating squares."""
    du, dv = _steps(found)
    spacing = _spacing(du, dv)
    xy = _refine(fine, found, _WINDOW * spacing, 0.3 * spacing)
    contrast = _contrast(fine, xy, du, dv, _SQUARE_SHARES) * _checker(*xy.shape[:2])
    seen = np.isfinite(contrast)
    if not seen.any():
        return np.full_like(xy, np.nan)
    median = np.median(contrast[seen])
    xy[~(contrast * np.sign(median) > _CONTRAST * abs(median))] = np.nan
    return xy


def _checkered(fine: Image, xy: Array) -> bool:
    """Whether the cells between the corners are plain and alternate: a search may step over rows or go askew."""
    share = np.linspace(0.25, 0.75, 4)[:, None, None, None]
    top = xy[:-1, :-1] + share * (xy[:-1, 1:] - xy[:-1, :-1])
    bottom = xy[1:, :-1] + share * (xy[1:, 1:] - xy[1:, :-1])
    gray = _sample(fine, top + share[:, None] * (bottom - top)).reshape(16, xy.shape[0] - 1, xy.shape[1] - 1)
    whole = np.isfinite(gray).all(axis=0)
    dark = (_checker(*whole.shape) < 0) & whole
    light = (_checker(*whole.shape) > 0) & whole
    if not (dark.any() and light.any()):
        return False
    mean, spread = gray.mean(axis=0), np.ptp(gray, axis=0)
    levels = float(np.median(mean[light])), float(np.median(mean[dark]))
    plain = spread < 0.5 * abs(levels[0] - levels[1])
    right = np.sign(levels[0] - levels[1]) * (mean - np.mean(levels)) * _checker(*whole.shape) > 0
    return bool((plain & right)[whole].mean() >= 0.9)


def _checker(rows: int, columns: int) -> Array:
    """+1 where the up-left square is black, -1 where it is white."""
    return 1.0 - 2.0 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2)


def _ordered_by_colour(fine: Image, xy: Array) -> Array:
    """Right-handed; among those orders one that starts after a black square, then the most upright one."""

    def rank(order: Array) -> tuple[bool, float]:
        du, dv = _steps(order)
        contrast = _contrast(fine, order, du, dv, _SQUARE_SHARES) * _checker(*order.shape[:2])
        black_first = float(np.nanmedian(contrast)) > 0
        return black_first, float(np.nanmean(du[..., 0]) / np.linalg.norm(np.nanmean(du, axis=(0, 1))))

    return max(_orderings(xy), key=rank)


def _extent(fine: Image, xy: Array) -> tuple[int, int]:
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
    du, dv = _steps(np.stack([xy[-1], ahead]))
    spacing = _spacing(du[1], dv[1])
    refined = _refine(fine, ahead, 0.25 * spacing, 0.3 * spacing)
    before = _contrast(fine, xy[-1], du[0], dv[0], _SQUARE_SHARES)
    after = _contrast(fine, refined, du[1], dv[1], _SQUARE_SHARES)
    reference = np.nanmedian(np.abs(before)) if np.isfinite(before).any() else np.nan
    in_view = _inside(fine, ahead) & np.isfinite(ahead).all(axis=-1)
    for side in (-0.3, 0.3):
        in_view &= _inside(fine, ahead + side * dv[1], 0.0) & _inside(fine, ahead + side * du[1], 0.0)
    alternates = (-np.sign(before) * after > _CONTRAST * reference) & in_view
    if alternates.sum() < 3 or alternates.sum() < 0.5 * in_view.sum():
        return None
    return np.where(np.isfinite(refined), refined, ahead)


# --- ChArUco -----------------------------------------------------------------------------------------------------


def _markers(search: Image, board: Board, dictionary: str | None = None) -> tuple[Array, Array]:
    """Identities (M,) and image corners (M, 4, 2) of all markers of the board's dictionary."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = 5  # two windows find as many markers as six, in a third of the time
    parameters.adaptiveThreshWinSizeMax = 21
    parameters.adaptiveThreshWinSizeStep = 16
    parameters.minMarkerPerimeterRate = 0.01
    parameters.minMarkerDistanceRate = 0.01
    parameters.perspectiveRemovePixelPerCell = 8
    name = dictionary or board.dictionary or ""
    quads, identities, _ = cv2.aruco.ArucoDetector(aruco_dictionary(name), parameters).detectMarkers(search)
    if identities is None or len(identities) == 0:
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    return np.ravel(identities).astype(int), np.reshape(quads, (-1, 4, 2)).astype(float)


def _charuco(search: Image, fine: Image, board: Board, legacy: bool | None) -> Detection:
    identities, quads = _markers(search, board)
    layouts = (False, True) if legacy is None and board.squares[1] % 2 == 0 else (bool(legacy),)
    found = [_charuco_layout(fine, board, identities, quads, layout) for layout in layouts]
    best = max(found, key=lambda detection: np.isfinite(detection.xy).sum())
    others = [detection for detection in found if detection and detection is not best]
    return replace(best, other=others[0]) if others else best


def _charuco_layout(fine: Image, board: Board, identities: Array, quads: Array, legacy: bool) -> Detection:
    layout = np.array(board.charuco(legacy).getObjPoints(), dtype=float)[..., :2] / board.square - 1.0
    known = identities < len(layout)
    if not known.any():
        return _nothing(board, f"none of the board's {len(layout)} markers of {board.dictionary} is seen")
    on_board = layout[np.where(known, identities, 0)]  # in squares, corner [0, 0] at the origin
    agree = _consistent(on_board, quads, known)
    if agree.sum() < max(2, 0.4 * len(identities)):
        reason = f"only {agree.sum()} of {len(identities)} markers of {board.dictionary} are where the board has them"
        return _nothing(board, f"{reason}: another board, or its squares were counted wrongly")
    guess = _from_markers(board, on_board[agree], quads[agree])
    white_first = legacy and board.squares[1] % 2 == 0
    expected = _checker(board.rows, board.columns) * (-1.0 if white_first else 1.0)
    xy = _complete(fine, guess, expected, gap=0.5 * (1.0 - (board.marker or 0.0) / board.square))
    lattice = np.argwhere(np.isfinite(xy[..., 0]))
    if len(lattice) < _FEWEST or np.ptp(lattice[:, 0]) == 0 or np.ptp(lattice[:, 1]) == 0:
        return _nothing(board, f"only {len(lattice)} corners are seen, or all in one row")
    return Detection(xy, legacy=legacy)


def _consistent(on_board: Array, quads: Array, candidates: Mask) -> Mask:
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


def _from_markers(board: Board, on_board: Array, quads: Array) -> Array:
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
        du, dv = _steps(both)
        spacing = np.where(fresh, _spacing(du, dv), np.nan)
        refined = _refine(fine, guess, gap * spacing, np.maximum(0.15 * spacing, 1.0))
        contrast = _contrast(fine, refined, du, dv, shares) * expected
        if np.isnan(reference):
            if not np.isfinite(contrast).any():
                break
            reference = float(np.nanmedian(contrast))
        good = fresh & (contrast > _MARKED_CONTRAST * reference)
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


# --- what else is in the image -----------------------------------------------------------------------------------


def _chessboard_of(shape: tuple[int, int], board: Board) -> str:
    """Words for a chessboard of (columns, rows), the longer side put where the board asked for has it."""
    long, short = max(shape), min(shape)
    columns, rows = (long, short) if board.columns >= board.rows else (short, long)
    return f"a chessboard of {columns}x{rows} inner corners"


def _what_is_there(search: Image, fine: Image, board: Board) -> str:
    """Name another board that the image shows, by its markers' dictionary or its shape; empty if there is none."""
    for dictionary in ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_APRILTAG_36H11"):
        identities, _ = _markers(search, board, dictionary)
        if len(identities) >= 6 and dictionary != board.dictionary:
            return f"markers of {dictionary}"
    for flags in (0, cv2.CALIB_CB_ACCURACY):
        ok, corners, meta = cv2.findChessboardCornersSBWithMeta(search, (3, 3), cv2.CALIB_CB_LARGER | flags)
        if not ok:
            continue
        xy = _refined_chessboard(fine, np.asarray(corners, dtype=float).reshape(*meta.shape[:2], 2))
        if np.isfinite(xy[..., 0]).mean() < 0.9 or not _checkered(fine, xy):
            continue
        shape = _extent(fine, xy)
        if board.kind != "chessboard" or set(shape) != {board.columns, board.rows}:
            return _chessboard_of(shape, board)
    return ""
