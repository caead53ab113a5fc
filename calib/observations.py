"""Corners of a board seen by both cameras: from two sets of image files to one table, every refusal named."""

import hashlib
import json
import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from functools import partial
from glob import glob, has_magic
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from rainstereo.calib import corners
from rainstereo.calib.board import Board
from rainstereo.calib.corners import Detection
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array, Mask

Source = str | Path | Sequence[str | Path]
Progress = Callable[[int, int], None]

FEWEST_PAIRS = 3

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp", ".jp2"}
_FORMAT = 1
_LARGEST_FILE = 1 << 30
_NAMED = 12
_DIAGNOSED = 3
_PROBED = 4
_IF_YOURS = "if that is your board, describe it with --board (chessboards by their inner corners)"


class NotEnoughData(ValueError):  # noqa: N818 - the name says what is wrong
    """Too few usable images to calibrate; the message names them one by one and the remedy."""

    def __init__(self, message: str, rejected: Sequence["Rejection"] = ()) -> None:
        super().__init__(message)
        self.rejected = tuple(rejected)


@dataclass(frozen=True)
class Rejection:
    """An image file that gave no corners, the role it was meant for, and why."""

    name: str
    role: str
    reason: str


@dataclass(frozen=True)
class Observations:
    """Board corners seen by both cameras of a rig.

    Attributes
    ----------
    board
        The board.
    names
        (N,) name of each frame, that is of each synchronised pair of images.
    dry, wet
        (N, rows, columns, 2) float64 pixels, NaN where unseen; all NaN where that camera saw no board. Read-only.
        Corner [r, c] is the same point of the board in both.
    imagersize
        (width, height) for ``"dry"`` and ``"wet"``.
    rejected
        Images that gave nothing, with reasons.
    files
        (N,) pairs of image paths (dry, wet), or empty where the corners did not come from files.
    """

    board: Board
    names: tuple[str, ...]
    dry: Array
    wet: Array
    imagersize: dict[str, tuple[int, int]]
    rejected: tuple[Rejection, ...] = ()
    files: tuple[tuple[str, str], ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        shape = (len(self.names), self.board.rows, self.board.columns, 2)
        for role in ROLES:
            xy = np.array(getattr(self, role), dtype=float)
            if xy.shape != shape:
                raise ValueError(
                    f"{role} corners have shape {xy.shape}; {len(self.names)} names and the board need {shape}"
                )
            xy[~np.isfinite(xy).all(axis=-1)] = np.nan
            xy.flags.writeable = False
            object.__setattr__(self, role, xy)
        if set(self.imagersize) != set(ROLES):
            raise ValueError(f"imagersize is given for {sorted(self.imagersize)}; expected 'dry' and 'wet'")
        if self.files and len(self.files) != len(self.names):
            raise ValueError(f"{len(self.files)} pairs of files were given for {len(self.names)} frames")

    def __len__(self) -> int:
        return len(self.names)

    def xy(self, role: str) -> Array:
        """Corners of ``"dry"`` or ``"wet"``, (N, rows, columns, 2), NaN where unseen."""
        if role not in ROLES:
            raise ValueError(f"the role is {role!r}; expected 'dry' or 'wet'")
        return self.dry if role == "dry" else self.wet

    def counts(self, role: str) -> np.ndarray[Any, np.dtype[np.int64]]:
        """(N,) number of corners seen in each frame by this camera."""
        return np.asarray(np.count_nonzero(np.isfinite(self.xy(role)[..., 0]), axis=(1, 2)))

    @property
    def paired(self) -> Mask:
        """(N,) frames in which both cameras see the board."""
        return (self.counts("dry") > 0) & (self.counts("wet") > 0)

    def select(self, indices: Sequence[int] | np.ndarray[Any, Any]) -> "Observations":
        """The same with these frames only, in this order; a boolean (N,) mask works too."""
        chosen = np.arange(len(self))[np.asarray(indices)] if len(indices) else np.zeros(0, dtype=int)
        return Observations(
            self.board,
            tuple(self.names[i] for i in chosen),
            self.dry[chosen],
            self.wet[chosen],
            dict(self.imagersize),
            self.rejected,
            tuple(self.files[i] for i in chosen) if self.files else (),
        )

    def near_identical(self, tolerance_px: float = 2.0) -> tuple[tuple[int, ...], ...]:
        """Groups of two or more frames that show the board in practically one place.

        A frame joins the first group to whose first frame the median corner motion is below ``tolerance_px`` in
        each camera that saw the board in both. Such frames add no geometry, only averaging.
        """
        groups: list[list[int]] = []
        for frame in range(len(self)):
            for group in groups:
                if self._motion(group[0], frame) < tolerance_px:
                    group.append(frame)
                    break
            else:
                groups.append([frame])
        return tuple(tuple(group) for group in groups if len(group) > 1)

    def _motion(self, first: int, second: int) -> float:
        """Median corner motion in pixels between two frames, the larger of the two cameras'; inf if not comparable."""
        motions = []
        for role in ROLES:
            moved = np.linalg.norm(self.xy(role)[first] - self.xy(role)[second], axis=-1)
            if np.isfinite(moved).any():
                motions.append(float(np.nanmedian(moved)))
        return max(motions, default=np.inf)

    def summary(self) -> dict[str, Any]:
        """JSON-able account: board, frames, corner counts, image sizes and every rejection."""
        return {
            "board": self.board.spec,
            "frames": len(self),
            "pairs": int(self.paired.sum()),
            "corners": {role: [int(count) for count in self.counts(role)] for role in ROLES},
            "imagersize": {role: list(self.imagersize[role]) for role in ROLES},
            "names": list(self.names),
            "rejected": [asdict(rejection) for rejection in self.rejected],
        }

    def save(self, path: str | Path) -> None:
        """Write all to an ``.npz`` file (no pickle), replacing it in one step."""
        path = Path(path)
        words = self.summary() | {"format": _FORMAT, "files": [list(pair) for pair in self.files]}
        _write_npz(path, dry=self.dry, wet=self.wet, words=np.array(json.dumps(words)))

    @classmethod
    def load(cls, path: str | Path) -> "Observations":
        """Read what `save` wrote; ValueError if the file is something else."""
        try:
            arrays = _read_npz(Path(path))
            words = json.loads(str(arrays["words"]))
            if words["format"] != _FORMAT:
                raise ValueError(f"format {words['format']}, expected {_FORMAT}")
            return cls(
                Board.parse(words["board"]),
                tuple(words["names"]),
                arrays["dry"],
                arrays["wet"],
                {role: (int(words["imagersize"][role][0]), int(words["imagersize"][role][1])) for role in ROLES},
                tuple(Rejection(**rejection) for rejection in words["rejected"]),
                tuple((dry, wet) for dry, wet in words["files"]),
            )
        except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{path} does not hold observations: {error}") from error

    @classmethod
    def from_folders(
        cls,
        dry: Source,
        wet: Source,
        board: Board,
        *,
        progress: Progress | None = None,
        workers: int | None = None,
        cache: Path | None = None,
    ) -> "Observations":
        """Find the board in all images of both cameras.

        Parameters
        ----------
        dry, wet
            A folder, a glob such as ``data/left*.jpg``, or a list of files, for each camera. Images are paired by
            name: alike, or alike but for words such as left and right, dry and wet, cam0 and cam1.
        progress
            Called as ``progress(done, total)`` after each image.
        workers
            Number of images worked on at once; by default one for each processor. Threads serve here: all the time
            is spent inside OpenCV, which lets go of Python's lock.
        cache
            Folder that keeps the corners of each image by content, so that a second run need not search again.

        Raises
        ------
        NotEnoughData
            If fewer than three pairs show the board; the message says, file by file, why.
        ValueError
            If the two sources are the same or look exchanged.
        """
        _refuse_swapped(dry, wet)
        paths = {"dry": _list_images(dry, "dry"), "wet": _list_images(wet, "wet")}
        if set(paths["dry"]) & set(paths["wet"]):
            raise ValueError(
                f"the same images were given for both cameras ({dry} and {wet}); "
                "give two folders, or two globs such as 'data/left*.png' and 'data/right*.png'"
            )
        pairs, rejected = _pair(paths["dry"], paths["wet"])
        if not pairs:
            raise _unpaired(paths, rejected)
        return _collect(cls, pairs, rejected, board, progress, workers, cache)


# --- from files to corners ---------------------------------------------------------------------------------------


class _Found(NamedTuple):
    size: tuple[int, int] | None
    detection: Detection


def _collect(
    cls: type[Observations],
    pairs: list["_Pair"],
    rejected: list[Rejection],
    board: Board,
    progress: Progress | None,
    workers: int | None,
    cache: Path | None,
) -> Observations:
    """Detect in all pairs, refuse what does not fit the rest, agree on the order, and build the table."""
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
    return cls(
        board,
        tuple(pairs[i].name for i in kept),
        np.array([both[i][0] for i in kept]),
        np.array([both[i][1] for i in kept]),
        sizes,
        tuple(rejected),
        tuple((str(pairs[i].dry), str(pairs[i].wet)) for i in kept),
    )


def _offset(progress: Progress | None, before: int, total: int) -> Progress | None:
    return None if progress is None else lambda done, _: progress(before + done, total)


def _refuse_another_board(pairs: list["_Pair"], found: dict[Path, _Found], board: Board, total: int) -> None:
    """NotEnoughData if the first images agree on another board, before time goes into searching the rest."""
    refused = []
    for pair, role in product(pairs, ROLES):
        path = pair.path(role)
        image, _ = corners.read_gray(path)
        if image is None:
            continue
        known = found[path].detection
        detection = known if known.seen else corners.detect(image, board, diagnose=True)
        if detection.seen:
            refused.append((detection.seen, Rejection(path.name, role, detection.reason)))
    shown, count = Counter(seen for seen, _ in refused).most_common(1)[0] if refused else ("", 0)
    if count >= max(3, len(found) // 2):
        rejected = [rejection for _, rejection in refused]
        raise NotEnoughData(
            f"none of the first {len(found)} images shows the board {board.spec}; the other {total - len(found)} were "
            f"not searched.\n{_listing(rejected)}\nRemedy: {count} images show {shown}; {_IF_YOURS}.",
            rejected,
        )


def _detect_all(
    files: list[Path], board: Board, progress: Progress | None, workers: int | None, cache: Path | None
) -> dict[Path, _Found]:
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


def _detect_file(path: Path, board: Board, cache: Path | None) -> _Found:
    blank = np.full((board.rows, board.columns, 2), np.nan)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            return _Found(None, Detection(blank, f"larger than {_LARGEST_FILE >> 20} MiB"))
        data = path.read_bytes()
    except OSError as error:
        return _Found(None, Detection(blank, f"cannot be read ({error.strerror or error})"))
    kept = None if cache is None else cache / f"{_fingerprint(data, board)}.npz"
    if kept is not None and kept.is_file():
        remembered = _recall(kept)
        if remembered is not None and remembered.detection.xy.shape == blank.shape:
            return remembered
    image, reason = corners.decode_gray(data)
    if image is None:
        return _Found(None, Detection(blank, reason))
    found = _Found((image.shape[1], image.shape[0]), corners.detect(image, board))
    if kept is not None:
        _remember(kept, found)
    return found


def _one_layout(found: dict[Path, _Found]) -> dict[Path, _Found]:
    """The same with all ChArUco corners numbered in the one layout that more corners of all images fit."""
    corners_in = Counter[bool]()
    for one in found.values():
        for detection in (one.detection, one.detection.other):
            if detection:
                corners_in[detection.legacy] += int(np.isfinite(detection.xy[..., 0]).sum())
    legacy = corners_in[True] > corners_in[False]
    return {path: _Found(one.size, _in_layout(one.detection, legacy)) for path, one in found.items()}


def _in_layout(detection: Detection, legacy: bool) -> Detection:
    if not detection or detection.legacy == legacy:
        return detection
    if detection.other is not None:
        return detection.other
    reason = "its markers are laid out as by another release of OpenCV than in the other images"
    return Detection(np.full_like(detection.xy, np.nan), reason)


def _usable(
    paths: list[Path], found: dict[Path, _Found], role: str, size: tuple[int, int]
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


def _diagnosed(refused: list[Rejection], paths: list[Path], found: dict[Path, _Found], board: Board) -> list[Rejection]:
    """The same refusals, the first few of "not found" with what the image does show (looking costs time)."""
    by_name = {path.name: path for path in paths}
    left = _DIAGNOSED
    result = []
    for rejection in refused:
        path = by_name[rejection.name]
        if left and found[path].size and not found[path].detection and not found[path].detection.seen:
            image, _ = corners.read_gray(path)
            if image is not None:
                left -= 1
                again = corners.detect(image, board, diagnose=True)
                found[path] = _Found(found[path].size, again)
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
        f"{head}; {FEWEST_PAIRS} pairs at least are needed, 20 are good.\n{_listing(rejected)}\nRemedy: {remedy}.",
        rejected,
    )


def _listing(rejected: Sequence[Rejection]) -> str:
    lines = [f"  {rejection.role} {rejection.name}: {rejection.reason}" for rejection in rejected[:_NAMED]]
    if len(rejected) > _NAMED:
        lines.append(f"  and {len(rejected) - _NAMED} more")
    return "\n".join(lines)


# --- corners remembered by content -------------------------------------------------------------------------------


def _fingerprint(data: bytes, board: Board) -> str:
    how = f"{board.spec} {corners.VERSION} {cv2.__version__}".encode()
    return hashlib.sha256(hashlib.sha256(how).digest() + data).hexdigest()


def _remember(path: Path, found: _Found) -> None:
    one, other = found.detection, found.detection.other
    words = {"size": found.size, "reason": one.reason, "seen": one.seen, "legacy": one.legacy}
    xy = np.stack([one.xy] if other is None else [one.xy, other.xy])
    _write_npz(path, xy=xy, words=np.array(json.dumps(words)))


def _recall(path: Path) -> _Found | None:
    """What `_remember` wrote, or None if the file is damaged."""
    try:
        arrays = _read_npz(path)
        words, xy = json.loads(str(arrays["words"])), arrays["xy"].astype(float)
        width, height = words["size"]
        legacy = bool(words["legacy"])
        other = Detection(xy[1], legacy=not legacy) if len(xy) > 1 else None
        detection = Detection(xy[0], str(words["reason"]), str(words["seen"]), legacy, other)
        return _Found((int(width), int(height)), detection)
    except (OSError, KeyError, IndexError, TypeError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _write_npz(path: Path, **arrays: np.ndarray[Any, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _read_npz(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > _LARGEST_FILE:
            raise ValueError(f"it unpacks to more than {_LARGEST_FILE >> 20} MiB")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}


# --- file names --------------------------------------------------------------------------------------------------


class _Pair(NamedTuple):
    name: str
    dry: Path
    wet: Path

    def path(self, role: Role) -> Path:
        return self.dry if role == "dry" else self.wet


_SIDE_WORDS = re.compile(r"(?<![a-z])(left|right|l|r|dry|wet)(?![a-z])")
_CAMERA_WORDS = re.compile(r"(?<![a-z])(cam|camera)[ _-]?([0-9]{1,2}|[ab])(?![0-9a-z])")


def _list_images(source: Source, role: str) -> list[Path]:
    """Files of a folder with an image's suffix, of a glob, or as listed; sorted."""
    if not isinstance(source, str | Path):
        return [Path(path) for path in source]
    text = str(source)
    if Path(text).is_dir():
        paths = [path for path in Path(text).iterdir() if path.suffix.lower() in _SUFFIXES]
    elif has_magic(text):
        paths = [Path(match) for match in glob(text, recursive=True)]  # noqa: PTH207 - Path.glob refuses absolute ones
    else:
        paths = [Path(text)]
        if not paths[0].exists():
            raise NotEnoughData(f"{text}, given for the {role} images, does not exist; give a folder or a glob")
    paths = sorted(path for path in paths if not path.is_dir() and not path.name.startswith("."))
    if not paths:
        raise NotEnoughData(f"there is no {role} image at {text}; looked for {', '.join(sorted(_SUFFIXES))}")
    return paths


def _keys(path: Path) -> tuple[str, str, str, str]:
    """Names by which an image may find its partner, strictest first."""
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path.stem).casefold()
    sideless = _SIDE_WORDS.sub("_", stem)
    cameraless = _CAMERA_WORDS.sub("_", sideless)
    numbers = re.findall(r"[0-9]+", stem)
    tidy = [re.sub(r"[^a-z0-9]+", "_", key).strip("_") for key in (sideless, cameraless)]
    return path.stem, tidy[0], tidy[1], numbers[-1] if numbers else stem


def _pair(dry: list[Path], wet: list[Path]) -> tuple[list[_Pair], list[Rejection]]:
    """Pair files by the strictest rule under which most find a partner; what is left over is named."""
    best: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for level in range(4):
        sides = tuple(_by_key(paths, level) for paths in (dry, wet))
        if len(sides[0].keys() & sides[1].keys()) > len(best[0].keys() & best[1].keys()):
            best = (sides[0], sides[1])
    common = [key for key in best[0] if key in best[1]]
    pairs = [_Pair(key or best[0][key].stem, best[0][key], best[1][key]) for key in common]
    used = {path for pair in pairs for path in (pair.dry, pair.wet)}
    rejected = [
        Rejection(path.name, role, f"has no partner among the {len(others)} {other} images")
        for role, other, paths, others in (("dry", "wet", dry, wet), ("wet", "dry", wet, dry))
        for path in paths
        if path not in used
    ]
    return pairs, rejected


def _by_key(paths: list[Path], level: int) -> dict[str, Path]:
    """Files by key; a key that several files share pairs none of them."""
    keys = [_keys(path)[level] for path in paths]
    count = Counter(keys)
    return {key: path for key, path in zip(keys, paths, strict=True) if count[key] == 1}


def _unpaired(paths: dict[str, list[Path]], rejected: list[Rejection]) -> NotEnoughData:
    examples = ", ".join(f"{role} {paths[role][0].name}" for role in ROLES)
    return NotEnoughData(
        f"no dry image has a wet partner of the same name ({examples}).\n{_listing(rejected)}\n"
        "Remedy: name the two images of a pair alike, or alike but for left/right, dry/wet or cam0/cam1.",
        rejected,
    )


def _refuse_swapped(dry: Source, wet: Source) -> None:
    """ValueError if the dry images' path speaks of wet and the wet images' of dry."""
    if not (isinstance(dry, str | Path) and isinstance(wet, str | Path)):
        return
    dry_parts, wet_parts = Path(dry).parts, Path(wet).parts
    shared = next((i for i, (a, b) in enumerate(zip(dry_parts, wet_parts, strict=False)) if a != b), 0)
    words = [set(re.findall(r"[a-z]+", " ".join(parts[shared:]).casefold())) for parts in (dry_parts, wet_parts)]
    if "wet" in words[0] - words[1] and "dry" in words[1] - words[0]:
        raise ValueError(
            f"the cameras look swapped: the dry images were given as {dry} and the wet ones as {wet}; "
            "exchange --dry and --wet"
        )
