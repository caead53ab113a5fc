"""Corners of a board seen by both cameras: one table, and every image that is missing from it named."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rainstereo.calib.board import Board
from rainstereo.calib.board_search import Progress, collect
from rainstereo.calib.corner_cache import read_npz, write_npz
from rainstereo.calib.rejection import NotEnoughData, Rejection, listing
from rainstereo.pairs import Source, match
from rainstereo.rig import ROLES
from rainstereo.types import Array, Mask

_FORMAT = 1


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

    def select(self, indices: Sequence[int] | np.ndarray[Any, Any]) -> Observations:
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
        write_npz(path, dry=self.dry, wet=self.wet, words=np.array(json.dumps(words)))

    @classmethod
    def load(cls, path: str | Path) -> Observations:
        """Read what `save` wrote; ValueError if the file is something else."""
        try:
            arrays = read_npz(Path(path))
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
    ) -> Observations:
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
        pairing = match(dry, wet)
        rejected = [Rejection(file.path.name, file.role, file.reason) for file in pairing.unpaired]
        if not pairing.pairs:
            raise _unpaired(rejected)
        return cls(board, *collect(pairing.pairs, rejected, board, progress, workers, cache))


def _unpaired(rejected: list[Rejection]) -> NotEnoughData:
    examples = ", ".join(next(f"{role} {r.name}" for r in rejected if r.role == role) for role in ROLES)
    return NotEnoughData(
        f"no dry image has a wet partner of the same name ({examples}).\n{listing(rejected)}\n"
        "Remedy: name the two images of a pair alike, or alike but for left/right, dry/wet or cam0/cam1.",
        rejected,
    )
