"""A capture being calibrated: files in a folder become frames, frames a solution, the solution a proposal.

What is known is a function of what lies in the folder: a file that is deleted takes its frame out of the solution, one
that is replaced is searched again. Corners are kept by content, so that a restart need not search again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from rainstereo import Chamber, imagefile
from rainstereo.apps.arrivals import PATIENCE_S, Arrivals, Stamp, Trouble
from rainstereo.apps.watch_state import Last, Phase, State, state_of
from rainstereo.calib import guidance
from rainstereo.calib.board import Board
from rainstereo.calib.board_search import Agreed, agree, find
from rainstereo.calib.corner_cache import Found
from rainstereo.calib.guidance import Proposal
from rainstereo.calib.incremental import Incremental, View
from rainstereo.imagefile import UnreadableImageError
from rainstereo.pairs import Pair
from rainstereo.rig import ROLES

LEAST_USED = 6
"""Frames in the solution before its own word on its uncertainty counts."""
UNKNOWN_SIZE = (1280, 960)
PICTURE_WIDTH = 960

Publish = Callable[[State, bytes | None], None]


class Session:
    """One capture. `step` looks at the folder once and does what there is to do."""

    def __init__(self, folder: Path, board: Board, lensmodel: str, chamber: Chamber | None, target: float,
                 cache: Path | None, publish: Publish, event: Callable[[State], None]) -> None:  # fmt: skip
        self.board, self.lensmodel, self.chamber, self.target, self.cache = board, lensmodel, chamber, target, cache
        self.running: Incremental | None = None
        self.proposal: Proposal | None = None
        self.phase: Phase = "waiting"
        self.files: dict[str, Pair] = {}
        self.updates: list[tuple[int, float]] = []
        self.proposed_in: list[float] = []
        self._arrivals = Arrivals(folder)
        self._found: dict[Path, tuple[Stamp, Found]] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._publish, self._event = publish, event
        self._last: Last | None = None
        self._notes: tuple[Trouble, ...] = ()
        self._pending = self._pictures = 0
        self._shown: tuple[object, ...] = ()
        self._stale_proposal = False
        self.started = time.perf_counter()

    @property
    def met(self) -> bool:
        """Whether the target is met by what has been solved, and nothing waits to be solved."""
        running = self.running
        return (
            running is not None
            and running.known is not None
            and self._pending == 0
            and len(running.names("used")) >= LEAST_USED
            and running.known.worst <= self.target
        )

    @property
    def solved_with(self) -> str:
        """mrcal's name of the present solution's lens model; empty without one."""
        solution = None if self.running is None else self.running.solution
        return "" if solution is None else solution.lensmodel

    def step(self) -> bool:
        """Look once; whether anything was done."""
        look = self._arrivals.look()
        self._found = {path: kept for path, kept in self._found.items() if look.stamps.get(path) == kept[0]}
        fresh = [pair for pair in look.pairs if not all(pair.path(role) in self._found for role in ROLES)]
        waiting = list(look.waiting)
        searched: Pair | None = None
        left = list(fresh)
        while left and searched is None:
            pair = left.pop(0)
            late = self._search(pair, look.stamps)
            if late is None:
                searched = pair
            else:
                waiting.append(late)
        self._pending = len(left)
        there = [pair for pair in look.pairs if all(pair.path(role) in self._found for role in ROLES)]
        changed = self._reconcile(there, searched, more=bool(left))
        self._notes = (*look.ignored, *waiting)
        self._stale_proposal |= changed
        if self._stale_proposal and not left:
            self._propose()
        picture = self._picture(searched) if searched is not None and not left else None
        self._show(picture, event=changed and searched is not None)
        return changed

    def use_lensmodel(self, lensmodel: str) -> None:
        """Go on with another lens model, from nothing."""
        self.lensmodel, running = lensmodel, self.running
        if running is not None:
            self.running = None
            self._restart(tuple(running.sizes), [(name, running.views.get(name), running.judged[name].reason)
                                                 for name in running.judged])  # fmt: skip
            self._propose()

    def enter(self, phase: Phase, trouble: str = "") -> None:
        """Show that another part of the work has begun."""
        self.phase = phase
        self._show(None, event=False, trouble=trouble)

    # -- within ----------------------------------------------------------------------------------------------------

    def _search(self, pair: Pair, stamps: dict[Path, Stamp]) -> Trouble | None:
        """Find the board in both images; what to wait for, if an image cannot be read yet."""
        paths = [pair.path(role) for role in ROLES]
        with ThreadPoolExecutor(len(paths)) as pool:
            found = list(pool.map(lambda path: find(path, self.board, self.cache), paths))
        for path, one in zip(paths, found, strict=True):
            if one.size is None and self._arrivals.age(path) < PATIENCE_S:
                return Trouble(path.name, f"cannot be read yet ({one.detection.reason})")
        self._found |= {path: (stamps[path], one) for path, one in zip(paths, found, strict=True)}
        return None

    def _reconcile(self, pairs: list[Pair], searched: Pair | None, more: bool) -> bool:
        """Make the running calibration one of these pairs; whether it changed."""
        sizes, agreed = agree(pairs, {path: kept[1] for path, kept in self._found.items()}, self.board)
        wanted = {each.pair.name: each for each in agreed}
        self.files = {each.pair.name: each.pair for each in agreed}
        before = time.perf_counter()
        running = self.running
        if running is None or (bool(wanted) and dict(zip(ROLES, running.sizes, strict=True)) != sizes):
            if not all(sizes[role][0] for role in ROLES) or not wanted:
                self.running = None
                return self._first_words(wanted, searched)
            self.running = running = None
            self._restart(
                (sizes["dry"], sizes["wet"]), [(name, _view(each), each.reason) for name, each in wanted.items()]
            )
            return self._note(searched, before)
        gone = [name for name in running.judged if name not in wanted or not _same(running, wanted[name])]
        for name in gone:
            running.remove(name)
        new = [name for name in wanted if name not in running.judged]
        for name in new:
            if wanted[name].reason:
                running.refuse(name, wanted[name].reason)
            else:
                running.add(_view(wanted[name]), solve_now=False)
        solved = not more and running.catch_up()
        return self._note(searched, before) if gone or new or solved else False

    def _restart(self, sizes: tuple[tuple[int, int], ...], frames: list[tuple[str, View | None, str]]) -> None:
        running = Incremental(self.board, (sizes[0], sizes[1]), self.lensmodel, self.chamber)
        for name, view, reason in frames:
            if view is None or (reason and not np.isfinite(view.corners).any((1, 2, 3)).all()):
                running.refuse(name, reason)
            else:
                running.add(view, solve_now=False)
        running.catch_up()
        self.running = running

    def _note(self, searched: Pair | None, before: float) -> bool:
        running = self.running
        if running is None:
            return False
        if running.solution is not None:
            self.updates.append((len(running.solution.names), time.perf_counter() - before))
        self.phase = "learning" if running.known is None else "met" if self.met else "capturing"
        if searched is not None and searched.name in running.judged:
            judged = running.judged[searched.name]
            self._last = Last(searched.name, judged.fate, judged.reason)
        return True

    def _first_words(self, wanted: dict[str, Agreed], searched: Pair | None) -> bool:
        self.phase = "waiting"
        if searched is not None and searched.name in wanted:
            self._last = Last(searched.name, "rejected", wanted[searched.name].reason)
        return searched is not None

    def _propose(self) -> None:
        running, self._stale_proposal = self.running, False
        started = time.perf_counter()
        if running is not None and running.solution is not None and running.known is not None:
            self.proposal = guidance.propose(
                running.solution, self.board, self.chamber, known=running.known, last=running.distance_of_last()
            )
            self.proposed_in.append(time.perf_counter() - started)
            return
        size = UNKNOWN_SIZE if running is None else running.sizes[0]
        count = 0 if running is None else len(running.names("waiting"))
        self.proposal = guidance.first_proposal(self.board, size, self.chamber, count)

    def _picture(self, pair: Pair) -> bytes | None:
        """The dry image, small, as JPEG."""
        try:
            image = imagefile.read(pair.dry)
        except UnreadableImageError:
            return None
        if image.dtype == np.uint16:
            image = (image >> 8).astype(np.uint8)
        height, width = image.shape[:2]
        if width > PICTURE_WIDTH:
            image = np.asarray(
                cv2.resize(image, (PICTURE_WIDTH, round(height * PICTURE_WIDTH / width)), interpolation=cv2.INTER_AREA)
            )
        self._pictures += 1
        return imagefile.encode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 70))

    def _show(self, picture: bytes | None, *, event: bool, trouble: str = "") -> None:
        if self.proposal is None and self.running is None:
            self._propose()
        key = (self.phase, self._last, self._notes, self._pending, self._pictures, len(self.updates), trouble)
        if key == self._shown and picture is None:
            return
        self._shown = key
        state = state_of(
            self.running,
            self.proposal,
            phase=self.phase,
            target=self.target,
            last=self._last,
            pending=self._pending,
            notes=self._notes,
            update_seconds=self.updates[-1][1] if self.updates else None,
            picture=self._pictures,
            trouble=trouble,
        )
        self._publish(state, picture)
        if event:
            self._event(state)


def _view(agreed: Agreed) -> View:
    return View(agreed.pair.name, agreed.corners)


def _same(running: Incremental, agreed: Agreed) -> bool:
    view = running.views.get(agreed.pair.name)
    if view is None:
        return running.judged[agreed.pair.name].reason == agreed.reason
    return not agreed.reason and np.array_equal(view.corners, agreed.corners, equal_nan=True)
