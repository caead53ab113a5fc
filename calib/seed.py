"""A first guess of lenses and poses from the corners alone, robust enough to start the optimiser from.

For each camera a scan over focal lengths, under a pinhole and under a stereographic lens (wide lenses lie close to the
latter), with a closed-form planar pose per board (IPPE: Collins & Bartoli, "Infinitesimal plane-based pose
estimation", IJCV 2014). IPPE returns both poses that a nearly fronto-parallel board may have; which one is meant is
decided by the pose of the cameras relative to each other, on which all frames must agree.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rainstereo import pose
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.types import Array, Mask

FOCALS = np.geomspace(0.27, 5.0, 11)
"""Focal lengths tried, as a fraction of the image width: about 130 down to 11 degrees across."""
SCAN_BOARDS = 7
MIN_CORNERS = 8
ROUNDS, STANDS_OUT = 3, 5.0
VOTERS = 16
AGREE = 0.35
"""Views of one board that contradict the cameras' relative pose by more than this (radians plus relative distance) do
not belong together; views that do, through a lens known only roughly, stay below 0.15."""
CLOSE = 1.5
"""A lens that fits this many times worse than the other is not tried."""
NEARLY = 1.1
"""Equal focal lengths that fit this many times worse than different ones are tried, too."""
LENSES = ("LENSMODEL_PINHOLE", "LENSMODEL_STEREOGRAPHIC")


@dataclass(frozen=True)
class Seed:
    """lens: one of LENSES. focals: (cameras,) pixels. rt_wet_dry: (6,) or None with one camera.

    rt_ref_board: (frames, 6), NaN for a frame without an answer. flipped: (frames,), where the second camera's
    corners stand in reversed order. apart: (frames,), by how much the cameras' two views contradict rt_wet_dry, as
    `disagreement` measures it; 0 where only one camera saw the board.
    """

    lens: str
    focals: Array
    rt_wet_dry: Array | None
    rt_ref_board: Array
    flipped: Mask
    apart: Array


class StereoError(SolveError):
    """Each camera sees boards, but no relative pose of the cameras explains both."""


@dataclass(frozen=True)
class Candidate:
    """One possible pose of a board in a camera's frame and how well it fits, RMS pixels."""

    rt_cam_board: Array
    error: float
    flipped: bool = False


def usable(corners: Array) -> bool:
    """Whether a board view, (rows, columns, 2), can give a pose: enough corners, not all on one line."""
    seen = np.isfinite(corners[..., 0])
    return int(seen.sum()) >= MIN_CORNERS and min(seen.any(0).sum(), seen.any(1).sum()) >= 2


def rays(pixels: Array, lens: str, focal: float, size: tuple[int, int]) -> Array:
    """x/z, y/z, (N, 2), that pixels have under a lens centred on the image; NaN at 90 degrees and beyond."""
    u = (pixels - (np.asarray(size) - 1) / 2) / focal
    if lens == LENSES[0]:
        return np.asarray(u)
    shrink = 1 - np.sum(u * u, -1, keepdims=True) / 4
    return np.asarray(np.where(shrink > 0, u / np.where(shrink > 0, shrink, 1), np.nan))


def board_poses(points: Array, corners: Array, lens: str, focal: float, size: tuple[int, int]) -> list[Candidate]:
    """Up to two poses, best first, of a board, (rows, columns, 3), seen at corners, (rows, columns, 2)."""
    seen = np.isfinite(corners[..., 0])
    xy = rays(corners[seen], lens, focal, size)
    if not np.isfinite(xy).all():
        return []
    return poses_from_rays(points[seen], xy, np.array([focal, focal]))


def poses_from_rays(points: Array, xy: Array, focal: Array) -> list[Candidate]:
    """Up to two poses, best first, of plane points, (N, 3), seen along rays with x/z, y/z = xy, (N, 2).

    focal: (2,), turns what is left over into pixels, corrected for how a lens compresses the angle off the axis.
    Corners that stand out after a first fit do not take part in the second.
    """
    per_tangent = focal / (1 + np.sum(xy * xy, -1, keepdims=True))  # pixels per unit of x/z: an angle's worth
    for _ in range(ROUNDS):
        found = _ippe(points, xy, per_tangent)
        if not found:
            return []
        square = found[0][1]
        kept = square <= STANDS_OUT**2 * np.median(square)
        if kept.all() or kept.sum() < MIN_CORNERS:
            break
        points, xy, per_tangent = points[kept], xy[kept], per_tangent[kept]
    return [candidate for candidate, _ in found]


def _ippe(points: Array, xy: Array, per_tangent: Array) -> list[tuple[Candidate, Array]]:
    """Poses, best first, and by how many squared pixels each corner is off, (N,)."""
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points[:, None], xy[:, None], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return []
    found = []
    for r, t in zip(rotations, translations, strict=True):
        rt = np.concatenate([r.ravel(), t.ravel()]).astype(np.float64)
        placed = points @ cv2.Rodrigues(rt[:3])[0].T + rt[3:]  # thousands of these: scipy's checks would take most time
        if np.isfinite(rt).all() and (placed[:, 2] > 0).all():
            off = (placed[:, :2] / placed[:, 2:] - xy) * per_tangent
            square = np.einsum("ij,ij->i", off, off)
            found.append((Candidate(rt, float(np.sqrt(square.sum() / (2 * len(square))))), square))
    return sorted(found, key=lambda pair: pair[0].error)


def seed(points: Array, corners: Array, sizes: list[tuple[int, int]], *, reversible: bool) -> Iterator[Seed]:
    """Guesses, best first, from corners, (cameras, frames, rows, columns, 2), NaN where unseen.

    reversible: a chessboard, whose corners may come in reversed order in one camera.
    ValueError if no view of some camera can be used.
    """
    scans = [scan(points, views, size) for views, size in zip(corners, sizes, strict=True)]
    best = {
        lens: [min(s for s in options if s[1] == lens) for options in scans if any(s[1] == lens for s in options)]
        for lens in LENSES
    }
    complete = [lens for lens in LENSES if len(best[lens]) == len(scans)]
    if not complete:
        raise ValueError(
            "no focal length makes sense of the boards seen; the images were perhaps scaled or cropped, or "
            "the board's shape is not the one given"
        )
    total = {lens: sum(s[0] for s in best[lens]) for lens in complete}
    refused: StereoError | None = None
    given = 0
    for lens in sorted(
        (name for name in complete if total[name] <= CLOSE * min(total.values())), key=total.__getitem__
    ):
        separate = np.array([s[2] for s in best[lens]])
        shared = _alike(scans, lens, sizes)
        guesses = [separate] if shared is None or np.allclose(shared, separate) else [separate, shared]
        for focals in guesses:
            try:
                guess = _joined(points, corners, sizes, lens, focals, reversible)
            except StereoError as error:
                refused = refused or error
                continue
            given += 1
            yield guess
    if not given and refused is not None:
        raise refused


def _alike(scans: list[list[tuple[float, str, float]]], lens: str, sizes: list[tuple[int, int]]) -> Array | None:
    """The focal lengths, (cameras,), of the best guess in which all cameras see as wide; None where that fits worse.

    Noise of a pixel leaves the focal length of a single camera open, and two that differ by mistake tell two stories.
    """
    widths = [size[0] for size in sizes]
    found = [
        {round(focal / width, 9): error for error, name, focal in options if name == lens}
        for options, width in zip(scans, widths, strict=True)
    ]
    common = {wide: sum(each[wide] for each in found) for wide in found[0] if all(wide in each for each in found)}
    if not common:
        return None
    wide = min(common, key=common.__getitem__)
    if common[wide] > NEARLY * sum(min(each.values()) for each in found):
        return None
    return wide * np.array(widths, dtype=np.float64)


def scan(points: Array, views: Array, size: tuple[int, int]) -> list[tuple[float, str, float]]:
    """(median error in pixels, lens, focal length in pixels) of every lens and focal length that can be."""
    chosen = [view for view in views if usable(view)]
    if not chosen:
        raise ValueError(f"no view of the board has the {MIN_CORNERS} corners that a pose needs")
    chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, SCAN_BOARDS).astype(int))]
    scores = []
    for lens in LENSES:
        for focal in FOCALS * size[0]:
            found = [board_poses(points, view, lens, focal, size) for view in chosen]
            if all(found):
                scores.append((float(np.median([candidates[0].error for candidates in found])), lens, float(focal)))
    return scores


def _joined(
    points: Array, corners: Array, sizes: list[tuple[int, int]], lens: str, focals: Array, reversible: bool
) -> Seed:
    cameras, frames = corners.shape[:2]
    found = [
        [
            board_poses(points, view, lens, focals[camera], sizes[camera]) if usable(view) else []
            for view in corners[camera]
        ]
        for camera in range(cameras)
    ]
    placed = np.full((frames, 6), np.nan)
    flipped = np.zeros(frames, bool)
    if cameras == 1:
        for frame, candidates in enumerate(found[0]):
            if candidates:
                placed[frame] = candidates[0].rt_cam_board
        return Seed(lens, focals, None, placed, flipped, np.zeros(frames))
    if reversible:
        half_turn, every = _half_turn(points), [c.rt_cam_board for candidates in found[1] for c in candidates]
        turned = pose.compose(np.array(every).reshape(-1, 6), half_turn)
        ends = np.cumsum([len(candidates) for candidates in found[1]])[:-1]
        found[1] = [
            candidates + [Candidate(rt, c.error, True) for c, rt in zip(candidates, rts, strict=True)]
            for candidates, rts in zip(found[1], np.split(turned, ends), strict=True)
        ]
    relative, apart = consensus(*found), np.zeros(frames)
    for frame, (dry, wet) in enumerate(zip(*found, strict=True)):
        if dry and wet:
            pairs = disagreement(relative[None], _stacked([dry]), _stacked([wet]))[0, 0]
            a, b = np.unravel_index(np.argmin(pairs), pairs.shape)
            placed[frame], flipped[frame], apart[frame] = dry[a].rt_cam_board, wet[b].flipped, pairs[a, b]
        elif dry:
            placed[frame] = dry[0].rt_cam_board
        elif wet:
            placed[frame] = pose.compose(pose.invert(relative), wet[0].rt_cam_board)
    both = np.array([bool(dry and wet) for dry, wet in zip(*found, strict=True)])
    agree = int((both & (apart < AGREE)).sum())
    if both.sum() > 2 and agree <= both.sum() / 2:
        raise StereoError(
            f"only {agree} of {int(both.sum())} pairs agree on how the cameras stand to each other, although each "
            "image shows the board: the images of a pair were not taken at the same moment, do not belong together, or "
            "one camera's images are all of one board that did not move; take pairs with synchronised cameras and "
            "check that equal names belong together"
        )
    return Seed(lens, focals, relative, placed, flipped, apart)


def consensus(dry: list[list[Candidate]], wet: list[list[Candidate]]) -> Array:
    """`rt_wet_dry`, (6,), on which most frames agree. ValueError if no frame was seen by both cameras."""
    pairs = [(a, b) for a, b in zip(dry, wet, strict=True) if a and b][:VOTERS]
    if not pairs:
        raise ValueError(
            "no frame shows the board to both cameras, so their relative pose is unknown; "
            "take pairs in which both see the board"
        )
    first, second = _stacked([a for a, _ in pairs]), _stacked([b for _, b in pairs])
    Rd, Rw = (pose.rotation_matrix(np.nan_to_num(rt[..., :3])) for rt in (first, second))
    R = np.einsum("fbij,fakj->fabik", Rw, Rd)
    t = second[:, None, :, 3:] - np.einsum("fabij,faj->fabi", R, first[..., 3:])
    exists = np.isfinite(t).all(-1)
    options = np.concatenate([pose.rotation_vector(R[exists]), t[exists]], -1)
    penalty = np.array(
        [[[1e-3 * (a.error + b.error) + 0.1 * b.flipped for b in bs] for a in as_] for as_, bs in _padded(pairs)]
    )[exists]
    apart = disagreement(options, first, second)
    agreement = np.minimum(apart.min((2, 3)), 1).sum(1)  # a frame that disagrees counts once, however much
    return np.asarray(options[np.argmin(agreement + penalty)])


def disagreement(rt_wet_dry: Array, dry: Array, wet: Array) -> Array:
    """How far apart two poses of one board are: radians of rotation plus distance relative to the board's.

    rt_wet_dry: (K, 6). dry: (F, a, 6) and wet: (F, b, 6), poses of F boards, NaN where there is none. Returns
    (K, F, a, b), inf where a pose is missing.
    """
    R, t = pose.rotation_matrix(rt_wet_dry[:, :3]), rt_wet_dry[:, 3:]
    Rd, Rw = (pose.rotation_matrix(np.nan_to_num(rt[..., :3])) for rt in (dry, wet))
    predicted = np.einsum("kij,fajl->kfail", R, Rd)
    moved = np.einsum("kij,faj->kfai", R, dry[..., 3:]) + t[:, None, None]
    trace = np.einsum("kfail,fbil->kfab", predicted, Rw)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    step = np.linalg.norm(moved[..., None, :] - wet[None, :, None, :, 3:], axis=-1)
    apart = angle + step / np.linalg.norm(moved, axis=-1)[..., None]
    return np.asarray(np.where(np.isfinite(apart), apart, np.inf))


def _stacked(found: list[list[Candidate]]) -> Array:
    """Poses of candidates, (boards, most, 6), padded with NaN."""
    stack = np.full((len(found), max(map(len, found)), 6), np.nan)
    for row, candidates in zip(stack, found, strict=True):
        row[: len(candidates)] = [c.rt_cam_board for c in candidates]
    return stack


def _padded(pairs: list[tuple[list[Candidate], list[Candidate]]]) -> list[tuple[list[Candidate], list[Candidate]]]:
    """Each list of candidates repeated to the longest one's length, as `_stacked` pads."""
    most = [max(len(pair[side]) for pair in pairs) for side in (0, 1)]
    return [((a * most[0])[: most[0]], (b * most[1])[: most[1]]) for a, b in pairs]


def _half_turn(points: Array) -> Array:
    """Board to board: the half turn about the board's centre that reverses the order of its corners."""
    centre = points[0, 0] + points[-1, -1]
    return np.array([0, 0, np.pi, centre[0], centre[1], 0])
