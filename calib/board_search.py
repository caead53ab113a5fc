"""The board in all images of two cameras: worker threads, early refusal, agreement on layout and order."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.calib import corners
from rainstereo.calib.board import Board
from rainstereo.calib.corner_cache import Found, fingerprint, recall, remember
from rainstereo.calib.detection import Detection
from rainstereo.calib.rejection import NotEnoughData, Rejection, listing
from rainstereo.imagefile import UnreadableImageError
from rainstereo.pairs import Pair
from rainstereo.rig import ROLES
from rainstereo.types import Array

Progress = Callable[[int, int], None]

FEWEST_PAIRS = 3
_DIAGNOSED = 3
_PROBED = 4
_IF_YOURS = "if that is your board, describe it with --board (chessboards by their inner corners)"


class Views(NamedTuple):
    """Corners in both cameras' images, frame by frame, as `Observations` takes them."""

    names: tuple[str, ...]
    dry: Array
    wet: Array
    imagersize: dict[str, tuple[int, int]]
    rejected: tuple[Rejection, ...]
    files: tuple[tuple[str, str], ...]


class Agreed(NamedTuple):
    """One pair of images after all have agreed on image size and layout: corners (cameras, rows, columns, 2).

    reason: why the pair cannot be used, empty where both cameras see the board.
    """

    pair: Pair
    corners: Array
    reason: str


def find(path: Path, board: Board, cache: Path | None) -> Found:
    """The board in one image file, from the cache if it was searched before."""
    return _detect_file(path, board, cache)


def agree(
    pairs: Sequence[Pair], found: dict[Path, Found], board: Board
) -> tuple[dict[str, tuple[int, int]], list[Agreed]]:
    """Image sizes by role, (0, 0) where no image can be read, and each pair as the others let it stand."""
    mine = {path: found[path] for pair in pairs for path in (pair.dry, pair.wet)}
    alike = _one_layout(mine)
    sizes: dict[str, tuple[int, int]] = {}
    xy: dict[str, list[Array]] = {}
    reasons = [""] * len(pairs)
    for role in ROLES:
        paths = [pair.path(role) for pair in pairs]
        sizes[role] = _majority([alike[path].size for path in paths if alike[path].size]) or (0, 0)
        xy[role], refused = _usable(paths, alike, role, sizes[role])
        why = {rejection.name: rejection.reason for rejection in refused}
        for i, path in enumerate(paths):
            if path.name in why:
                reasons[i] += f"{'; ' if reasons[i] else ''}{role} image: {why[path.name]}"
    both = [_order_alike(dry, wet, board) for dry, wet in zip(xy["dry"], xy["wet"], strict=True)]
    return sizes, [Agreed(pair, np.stack(views), why) for pair, views, why in zip(pairs, both, reasons, strict=True)]


def collect(
    pairs: Sequence[Pair],
    unpaired: Sequence[Rejection],
    board: Board,
    progress: Progress | None,
    workers: int | None,
    cache: Path | None,
) -> Views:
    """Detect in all pairs, refuse what does not fit the rest, agree on the order of the corners.

    NotEnoughData if fewer than three pairs show the board; the message says, file by file, why.
    """
    rejected = list(unpaired)
    files = [path for pair in pairs for path in (pair.dry, pair.wet)]
    search = partial(_detect_all, board=board, workers=workers, cache=cache)
    probe = files[: 2 * _PROBED] if len(files) > 2 * _PROBED else []
    found = search(probe, progress=_offset(progress, 0, len(files)))
    if probe and not any(one.detection for one in found.values()):
        _refuse_another_board(pairs[:_PROBED], found, board, len(files))
    found |= search(files[len(probe) :], progress=_offset(progress, len(probe), len(files)))
    sizes: dict[str, tuple[int, int]] = {}
    found = _one_layout(found)
    xy: dict[str, list[Array]] = {}
    for role in ROLES:
        mine = [pair.path(role) for pair in pairs]
        sizes[role] = _majority([found[path].size for path in mine if found[path].size]) or (0, 0)
        xy[role], refused = _usable(mine, found, role, sizes[role])
        rejected += _diagnosed(refused, mine, found, board)
    both = [_order_alike(d, w, board) for d, w in zip(xy["dry"], xy["wet"], strict=True)]
    kept = [i for i, views in enumerate(both) if any(np.isfinite(view).any() for view in views)]
    usable = sum(all(np.isfinite(view).any() for view in views) for views in both)
    if usable < FEWEST_PAIRS:
        raise _too_few(usable, len(pairs), board, rejected, xy, [f.detection.seen for f in found.values()])
    return Views(
        tuple(pairs[i].name for i in kept),
        np.array([both[i][0] for i in kept]),
        np.array([both[i][1] for i in kept]),
        sizes,
        tuple(rejected),
        tuple((str(pairs[i].dry), str(pairs[i].wet)) for i in kept),
    )


def _offset(progress: Progress | None, before: int, total: int) -> Progress | None:
    return None if progress is None else lambda done, _: progress(before + done, total)


def _refuse_another_board(pairs: Sequence[Pair], found: dict[Path, Found], board: Board, total: int) -> None:
    """NotEnoughData if the first images agree on another board, before time goes into searching the rest."""
    refused = []
    for pair, role in product(pairs, ROLES):
        path = pair.path(role)
        known = found[path].detection
        if found[path].size is None:
            continue
        image = imagefile.read(path, gray=True)
        detection = known if known.seen else corners.detect(image, board, diagnose=True)
        if detection.seen:
            refused.append((detection.seen, Rejection(path.name, role, detection.reason)))
    shown, count = Counter(seen for seen, _ in refused).most_common(1)[0] if refused else ("", 0)
    if count >= max(3, len(found) // 2):
        rejected = [rejection for _, rejection in refused]
        raise NotEnoughData(
            f"none of the first {len(found)} images shows the board {board.spec}; the other {total - len(found)} were "
            f"not searched.\n{listing(rejected)}\nRemedy: {count} images show {shown}; {_IF_YOURS}.",
            rejected,
        )


def _detect_all(
    files: list[Path], board: Board, progress: Progress | None, workers: int | None, cache: Path | None
) -> dict[Path, Found]:
    count = workers or min(
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 16
    )
    threads = cv2.getNumThreads()
    pool = ThreadPoolExecutor(count)
    try:
        if count > 1:
            cv2.setNumThreads(1)  # one image a thread; OpenCV's own threads would compete with ours
        jobs = [pool.submit(_detect_file, path, board, cache) for path in files]
        for done, job in enumerate(as_completed(jobs), 1):
            job.result()
            if progress is not None:
                progress(done, len(files))
        return {path: job.result() for path, job in zip(files, jobs, strict=True)}
    finally:
        pool.shutdown(wait=True, cancel_futures=True)  # on an interrupt, wait for the images in hand only
        cv2.setNumThreads(threads)


def _detect_file(path: Path, board: Board, cache: Path | None) -> Found:
    blank = np.full((board.rows, board.columns, 2), np.nan)
    try:
        data = imagefile.read_bytes(path)
    except UnreadableImageError as error:
        return Found(None, Detection(blank, str(error)))
    kept = None if cache is None else cache / f"{fingerprint(data, board)}.npz"
    if kept is not None and kept.is_file():
        remembered = recall(kept)
        if remembered is not None and remembered.detection.xy.shape == blank.shape:
            return remembered
    try:
        image = imagefile.decode(data, gray=True)
    except UnreadableImageError as error:
        return Found(None, Detection(blank, str(error)))
    found = Found((image.shape[1], image.shape[0]), corners.detect(image, board))
    if kept is not None:
        remember(kept, found)
    return found


def _one_layout(found: dict[Path, Found]) -> dict[Path, Found]:
    """The same with all ChArUco corners numbered in the one layout that more corners of all images fit."""
    corners_in = Counter[bool]()
    for one in found.values():
        for detection in (one.detection, one.detection.other):
            if detection:
                corners_in[detection.legacy] += int(np.isfinite(detection.xy[..., 0]).sum())
    legacy = corners_in[True] > corners_in[False]
    return {path: Found(one.size, _in_layout(one.detection, legacy)) for path, one in found.items()}


def _in_layout(detection: Detection, legacy: bool) -> Detection:
    if not detection or detection.legacy == legacy:
        return detection
    if detection.other is not None:
        return detection.other
    reason = "its markers are laid out as by another release of OpenCV than in the other images"
    return Detection(np.full_like(detection.xy, np.nan), reason)


def _usable(
    paths: list[Path], found: dict[Path, Found], role: str, size: tuple[int, int]
) -> tuple[list[Array], list[Rejection]]:
    """Corners of each image of a camera, all NaN where refused, and the refusals."""
    xy, refused = [], []
    for path in paths:
        detection = found[path].detection
        reason = detection.reason
        if not reason and found[path].size != size:
            width, height = found[path].size or (0, 0)
            reason = f"is {width}x{height} where most {role} images are {size[0]}x{size[1]}"
        if reason:
            refused.append(Rejection(path.name, role, reason))
        xy.append(np.full_like(detection.xy, np.nan) if reason else detection.xy)
    return xy, refused


def _diagnosed(refused: list[Rejection], paths: list[Path], found: dict[Path, Found], board: Board) -> list[Rejection]:
    """The same refusals, the first few of "not found" with what the image does show (looking costs time)."""
    by_name = {path.name: path for path in paths}
    left = _DIAGNOSED
    result = []
    for rejection in refused:
        path = by_name[rejection.name]
        if left and found[path].size and not found[path].detection and not found[path].detection.seen:
            left -= 1
            again = corners.detect(imagefile.read(path, gray=True), board, diagnose=True)
            found[path] = Found(found[path].size, again)
            result.append(Rejection(rejection.name, rejection.role, again.reason or rejection.reason))
            continue
        result.append(rejection)
    return result


def _order_alike(dry: Array, wet: Array, board: Board) -> tuple[Array, Array]:
    """Where the print looks the same turned around, number the wet corners in the direction of the dry ones.

    The rule holds for cameras rolled by less than 90 degrees to each other (45 on a square board).
    """
    if not (np.isfinite(dry).any() and np.isfinite(wet).any()):
        return dry, wet

    def direction(xy: Array) -> Array:
        along = np.nanmean(np.diff(xy, axis=1), axis=(0, 1))
        return np.asarray(along / np.linalg.norm(along))

    target = direction(dry)
    return dry, max(corners.indistinguishable(wet, board), key=lambda order: float(direction(order) @ target))


def _majority(values: Sequence[Any]) -> Any:
    return Counter(values).most_common(1)[0][0] if values else None


def _too_few(
    usable: int,
    pairs: int,
    board: Board,
    rejected: list[Rejection],
    xy: dict[str, list[Array]],
    seen: list[str],
) -> NotEnoughData:
    blind = [role for role in ROLES if not any(np.isfinite(view).any() for view in xy[role])]
    if blind:
        head = f"no {' and no '.join(blind)} image shows the board {board.spec}"
    else:
        head = f"only {usable} of {pairs} pairs show the board {board.spec} to both cameras"
    shown = Counter(words for words in seen if words)
    remedy = "check the board's description, and that it is sharp, well lit and in view of both cameras"
    if shown:
        words, count = shown.most_common(1)[0]
        remedy = f"{count} images show {words}; {_IF_YOURS}"
    return NotEnoughData(
        f"{head}; {FEWEST_PAIRS} pairs at least are needed, 20 are good.\n{listing(rejected)}\nRemedy: {remedy}.",
        rejected,
    )
