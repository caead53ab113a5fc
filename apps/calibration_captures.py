"""Which images a calibration works on, what stood before the cameras in each, and what is to be found out about it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rainstereo import Chamber
from rainstereo.calib.board import Board
from rainstereo.calib.observations import Observations
from rainstereo.calib.prior import Prior
from rainstereo.calib.sought import Sought
from rainstereo.rig import ROLES

if TYPE_CHECKING:
    from rainstereo.apps.calibrate import Options

BARE, CHAMBER = "bare", "chamber"


@dataclass(frozen=True, eq=False)
class Captures:
    """Frames to calibrate from.

    described: the panels as they were described, None where there are none. sought: what is to be found out about
    them, None where they are taken as described. choice: frames and panels that a lens model is chosen with.
    """

    observations: Observations
    described: Chamber | None
    sought: Sought | None
    choice: tuple[Observations, Chamber | None]

    @property
    def through(self) -> Chamber | Sought | None:
        """What `solve` is to be told about the panels."""
        return self.described if self.sought is None else self.sought


def check(options: Options) -> Chamber | None:
    """The panels that the options describe, read before any image is. ValueError where the options contradict."""
    if options.bare is None:
        if options.panels is not None and (options.chamber is None or not options.chamber.is_dir()):
            raise ValueError("--panels goes with a folder as --chamber; without one --chamber names the chamber.toml")
        if options.chamber is None:
            if options.slab != "known":
                raise ValueError("--slab estimated needs the panels' description: --chamber chamber.toml")
            _require_both(options)
            return None
        if not options.chamber.is_dir():
            _require_both(options)
            return Chamber.load(options.chamber)
        return _described(options)
    for name, folder in (("--bare", options.bare), ("--chamber", options.chamber)):
        if folder is None or not folder.is_dir():
            raise ValueError(
                f"{name} is {folder or 'not given'}; paired captures are two folders, --bare DIR without the chamber "
                "and --chamber DIR with it, each with dry/ and wet/ in it (or say --dry 'left*.png' --wet 'right*.png')"
            )
    if options.bare == options.chamber:
        raise ValueError("--bare and --chamber name one folder; they are the captures without and with the chamber")
    return _described(options)


def gather(
    options: Options,
    board: Board,
    described: Chamber | None,
    progress: Callable[[str], AbstractContextManager[Callable[[int, int], None]]],
) -> Captures:
    """Find the board in all images that the options name."""

    def search(folder: Path | None, words: str) -> Observations:
        dry, wet = (_source(options, folder, role) for role in ROLES)
        with progress(words) as step:
            return Observations.from_folders(
                dry, wet, board, progress=step, workers=options.workers, cache=options.cache
            )

    if options.bare is None or described is None:
        folder = options.chamber if options.chamber is not None and options.chamber.is_dir() else None
        seen = search(folder, "looking for the board")
        sought = None
        if options.slab == "estimated" and described is not None:
            sought = Sought(described, ("tilt", "thickness", "index"), Prior(described))
        return Captures(seen, described, sought, (seen, described))
    bare = search(options.bare, "looking for the board without the chamber")
    through = search(options.chamber, "looking for the board behind the chamber")
    both = joined(bare, through)
    return Captures(both, described, paired(bare, through, described), (bare, None))


def joined(bare: Observations, through: Observations) -> Observations:
    """Both captures as one; names say where a frame is from."""
    for role in ROLES:
        if bare.imagersize[role] != through.imagersize[role]:
            raise ValueError(
                f"the {role} camera's images are {bare.imagersize[role]} without the chamber and "
                f"{through.imagersize[role]} with it; both captures must come from one rig, unchanged"
            )
    names = tuple(f"{BARE}/{name}" for name in bare.names) + tuple(f"{CHAMBER}/{name}" for name in through.names)
    rejected = [
        replace(each, name=f"{where}/{each.name}")
        for where, part in ((BARE, bare), (CHAMBER, through))
        for each in part.rejected
    ]
    files = bare.files + through.files if bare.files and through.files else ()
    return Observations(
        bare.board,
        names,
        np.concatenate([bare.dry, through.dry]),
        np.concatenate([bare.wet, through.wet]),
        dict(bare.imagersize),
        tuple(rejected),
        files,
    )


def paired(bare: Observations, through: Observations, described: Chamber) -> Sought:
    """What paired captures are to find: tilt and thickness, without any prior, and a wedge.

    Frames of one name show the board in one place, until the corners say otherwise.
    """
    count, behind = len(bare), len(through)
    place = {name: i for i, name in enumerate(bare.names)}
    ties = [*range(count), *(place.get(name, count + i) for i, name in enumerate(through.names))]
    return Sought(
        described,
        ("tilt", "thickness"),
        None,
        np.arange(count + behind) >= count,
        np.array(ties, dtype=np.intp),
        wedge=True,
    )


def _described(options: Options) -> Chamber:
    path = options.panels or (options.chamber or Path()) / "chamber.toml"
    if not path.exists():
        raise ValueError(
            f"{path} does not exist; it describes the panels (how many, their index, about how thick and where), from "
            "which a calibration starts and takes what boards cannot show. Write one, or name it with --panels"
        )
    return Chamber.load(path)


def _require_both(options: Options) -> None:
    if not (options.dry and options.wet):
        raise ValueError(
            "give the board images of both cameras: --dry DIR --wet DIR, or folders that hold dry/ and wet/: "
            "--chamber DIR, and for paired captures --bare DIR, too; or --watch DIR while capturing"
        )


def _source(options: Options, folder: Path | None, role: str) -> str:
    given = options.dry if role == "dry" else options.wet
    if folder is None:
        return given
    source = folder / (given or role)
    if not given and not source.is_dir():
        raise ValueError(
            f"{folder} has no folder {role}; expected dry/ and wet/ in it, or say what its images are called: "
            "--dry 'left*.png' --wet 'right*.png'"
        )
    return str(source)
