"""A calibration that keeps up with a capture: each new frame joins the solution at hand instead of starting anew.

A new frame gets its pose under the present lenses (`posing`), then everything is solved from there by the same steps
that a whole calibration ends with (`solve.settle`), so that both have the same solution; outliers and poses that were
turned the wrong way are looked for anew, from nothing, each time the frames have grown by half.

Frames that would change nothing measurable stay outside: the board has not moved since another frame, or all frames
left out together would lessen no uncertainty at infinity by more than a stated share s. As both solutions are the
best for their frames, they then differ by less than sqrt(2 s) of a sigma (the variance of the difference is the
difference of the variances: Hausman, "Specification tests in econometrics", 1978).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from rainstereo.calib import adjust, guidance, information, posing
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.adjust import Adjustment
from rainstereo.calib.board import Board
from rainstereo.calib.guidance import Certainty
from rainstereo.calib.mrcal_versions import Problem, SolveError
from rainstereo.calib.observations import Observations
from rainstereo.calib.seed import usable
from rainstereo.calib.solve import Solution, package, settle, solve
from rainstereo.chamber import Chamber
from rainstereo.rig import ROLES
from rainstereo.types import Array, Mask

AUTOMATIC, SPLINED = "auto", "splined"
PLAIN_AND_RICH = ("LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8")
PAYS, PAYS_FROM = 0.95, 6
"""The richer lens model is taken from this many frames on, where it lowers the noise to this share at least: with few
frames its rational function may have a pole in a corner of the image where no board was."""
FEWEST = 3
"""Pairs before a first solution is tried."""
AFRESH = 1.5
"""Growth of the frames after which all is solved from nothing."""
GROWN = 0.2
"""Frames that may join unsolved, as a share of those solved, while more are at hand."""
ROUNDS = 3
REDUNDANT = 0.03
SAME_PLACE_PX = 1.5
MISFIT, MISFIT_PX = 6.0, 2.0
"""A new frame that fits, with its own pose free, this many times worse than the others is not taken in."""

Fate = Literal["used", "redundant", "rejected", "waiting"]


@dataclass(frozen=True, eq=False)
class View:
    """One pair's corners, (cameras, rows, columns, 2) pixels, NaN where unseen."""

    name: str
    corners: Array


@dataclass(frozen=True)
class Judged:
    """What became of a frame, and why. gain: the largest share by which it lessens, or would, a sigma at infinity."""

    fate: Fate
    reason: str = ""
    gain: float = np.nan


@dataclass
class Spent:
    """Seconds of the work so far, by kind, and how often each was done."""

    seconds: dict[str, float] = field(default_factory=dict)
    count: dict[str, int] = field(default_factory=dict)

    def add(self, kind: str, seconds: float) -> None:
        """Note that much time for one piece of work."""
        self.seconds[kind] = self.seconds.get(kind, 0.0) + seconds
        self.count[kind] = self.count.get(kind, 0) + 1


@dataclass(frozen=True, eq=False)
class _Placed:
    """A frame outside of the solution: rt_ref_board (6,), corners in the order that fits.

    like: the name of a frame in which the board is in the same place; empty where there is none.
    """

    pose: Array
    corners: Array
    like: str = ""


class Incremental:
    """A calibration in progress. Not for several threads at once.

    judged: what became of each frame, by name, in the order in which they came. solution, known: the present solution
    and its certainty; None while there is none, and then `trouble` says why.
    """

    def __init__(
        self,
        board: Board,
        sizes: tuple[tuple[int, int], tuple[int, int]],
        lensmodel: str,
        chamber: Chamber | None,
        *,
        redundant: float = REDUNDANT,
    ) -> None:
        if not 0 <= redundant < 1:
            raise ValueError(f"frames that lessen no sigma by a share of {redundant} are redundant; expected 0 to 1")
        if lensmodel not in (AUTOMATIC, SPLINED):
            versions.parameters(lensmodel)
        self.board, self.sizes, self.chamber, self.redundant = board, sizes, chamber, redundant
        self.lensmodels = PLAIN_AND_RICH if lensmodel == AUTOMATIC else (lensmodel,)
        self.views: dict[str, View] = {}
        self.judged: dict[str, Judged] = {}
        self.solution: Solution | None = None
        self.known: Certainty | None = None
        self.trouble = f"{FEWEST} pairs at least are needed"
        self.spent = Spent()
        self._adjustment: Adjustment | None = None
        self._left_out: dict[str, _Placed] = {}
        self._solved_afresh = self._misfits = self._unsolved = 0

    # -- frames come and go ----------------------------------------------------------------------------------------

    def add(self, view: View, *, solve_now: bool = True) -> Judged:
        """Take in a pair. solve_now: False where more follow at once; `catch_up` then, after the last.

        A name that is known already is a ValueError.
        """
        if view.name in self.judged:
            raise ValueError(f"frame {view.name!r} is here already; remove it first")
        self.views[view.name] = view
        if not all(usable(corners) for corners in view.corners):
            self.judged[view.name] = Judged("rejected", adjust.TOO_LITTLE)
            return self.judged[view.name]
        self.judged[view.name] = Judged("waiting", "not solved yet")
        if self._adjustment is None:
            self._unsolved += 1
        else:
            self._admit(view)
            self._misfits += self.judged[view.name].fate == "rejected"
        if solve_now:
            self.catch_up()
        elif self._due():
            self.solve_on()
        return self.judged[view.name]

    def refuse(self, name: str, reason: str) -> Judged:
        """Note a pair that shows nothing to calibrate from, and why."""
        if name in self.judged:
            raise ValueError(f"frame {name!r} is here already; remove it first")
        self.judged[name] = Judged("rejected", reason)
        return self.judged[name]

    def catch_up(self) -> bool:
        """Renew the solution if frames came or went since; whether there was anything to do."""
        for done in range(ROUNDS):
            if not self._unsolved and not (self._misfits and self._stale()):
                return done > 0
            self.solve_on()
        return True

    def _due(self) -> bool:
        """Whether so much has come together that the solution is to be renewed although more is at hand."""
        count = 0 if self._adjustment is None else len(self._adjustment.frames)
        return self._unsolved > max(GROWN * count, FEWEST) or (self._misfits > 0 and self._stale())

    def _stale(self) -> bool:
        """Whether frames, used and refused, have grown so much that all is to be solved from nothing."""
        count = 0 if self._adjustment is None else len(self._adjustment.frames)
        return count + 2 * self._misfits >= AFRESH * self._solved_afresh

    def remove(self, name: str) -> None:
        """Forget a pair, as when its files were deleted."""
        judged = self.judged.pop(name)
        self.views.pop(name, None)
        self._left_out.pop(name, None)
        likenesses = [other for other, placed in self._left_out.items() if placed.like == name]
        if judged.fate == "used" and self._adjustment is not None:
            names = self._used_names(self._adjustment)
            which = np.array([other == name for other in names])
            if which.any() and (~which).sum() >= FEWEST:
                self._adjustment = _without(self._adjustment, which)
                self._unsolved += 1
            else:
                self._forget("too few pairs are left")
        for other in likenesses:  # one of them takes the place of the frame that is gone
            view = self.views.pop(other)
            del self.judged[other]
            self._left_out.pop(other, None)
            self.add(view, solve_now=False)

    def solve_on(self) -> None:
        """Solve from the present solution; from nothing if the frames have grown much, or that fails."""
        adjustment = self._adjustment
        if adjustment is None or self._stale():
            self.solve_afresh()
            return
        started = time.perf_counter()
        try:
            passes = settle(adjustment, self.chamber)
        except SolveError:
            self.solve_afresh()
            return
        seconds = time.perf_counter() - started
        self.spent.add("solved on", seconds)
        lost = {drop.name: drop.reason for drop in adjustment.dropped}
        self._solved(package(adjustment, self._observations(adjustment), self.chamber, passes, seconds), lost)

    def solve_afresh(self) -> None:
        """Solve from nothing: all frames but those left out; frames rejected before may come in again."""
        wanted = [name for name in self.views if self._counts(name) and name not in self._left_out]
        if len(wanted) < FEWEST:
            self._forget(f"{len(wanted)} of the {FEWEST} pairs that a first solution needs")
            return
        observations = self.observations(wanted)
        started = time.perf_counter()
        try:
            solution = self._best(observations)
        except (SolveError, ValueError) as error:
            self._forget(str(error))
            return
        self.spent.add("solved afresh", time.perf_counter() - started)
        corners = np.stack([observations.xy(role) for role in ROLES])
        turned = np.isin(np.array(observations.names), solution.reordered)
        corners[1, turned] = corners[1, turned][:, ::-1, ::-1]
        self._adjustment = Adjustment(
            solution.problem, corners, observations.names, solution.frames, [], solution.reordered
        )
        self._solved_afresh, self._misfits = len(solution.frames), 0
        self._solved(solution, {drop.name: drop.reason for drop in solution.dropped})

    def _best(self, observations: Observations) -> Solution:
        """From nothing, with the lens model given, or with the plain one unless the rich one pays."""
        plain = solve(observations, self.lensmodels[0], self.chamber)
        if len(self.lensmodels) == 1 or len(observations) < PAYS_FROM:
            return plain
        rich = solve(observations, self.lensmodels[1], self.chamber)
        noise = [guidance.certainty(found.problem, self.chamber).noise for found in (plain, rich)]
        return rich if noise[1] < PAYS * noise[0] or len(rich.frames) > len(plain.frames) else plain

    # -- what there is ---------------------------------------------------------------------------------------------

    def names(self, fate: Fate) -> tuple[str, ...]:
        """Names of the frames of that fate."""
        return tuple(name for name, judged in self.judged.items() if judged.fate == fate)

    def observations(self, names: list[str] | tuple[str, ...]) -> Observations:
        """These frames, as a calibration takes them."""
        corners = np.stack([self.views[name].corners for name in names], 1)
        return Observations(self.board, tuple(names), corners[0], corners[1], dict(zip(ROLES, self.sizes, strict=True)))

    @property
    def seconds_saved(self) -> float:
        """What leaving frames out saved in the last solution, seconds: its time is in proportion to the frames."""
        if self.solution is None or not self._left_out:
            return 0.0
        return self.solution.solve_seconds * len(self._left_out) / max(len(self.solution.names), 1)

    def distance_of_last(self) -> float | None:
        """How far away the board was in the newest frame that has a pose, metres."""
        if self.solution is None:
            return None
        poses = dict(zip(self.solution.names, self.solution.rt_ref_board, strict=True))
        poses |= {name: placed.pose for name, placed in self._left_out.items()}
        newest = next((name for name in reversed(self.judged) if name in poses), None)
        return None if newest is None else guidance.distance_of(self.board, poses[newest])

    # -- within ----------------------------------------------------------------------------------------------------

    def _admit(self, view: View) -> None:
        """Give a new frame its pose and decide whether it joins the solution."""
        adjustment, known = self._adjustment, self.known
        if adjustment is None or known is None:
            return
        started = time.perf_counter()
        problem = adjustment.problem
        placed, corners = self._placed(problem, view.corners)
        self.spent.add("placed", time.perf_counter() - started)
        if placed is None:
            self.judged[view.name] = Judged("rejected", "no pose of the board explains its corners")
            return
        misfit = _typical(placed)
        if misfit > max(MISFIT * known.noise, MISFIT_PX):
            self.judged[view.name] = Judged(
                "rejected", f"its corners are {misfit:.1f} px from where the other frames put them: taken at different "
                "moments, or wrongly detected"
            )  # fmt: skip
            return
        pose = placed.rt_ref_board[0]
        same = self._same_place(view.corners)
        self._left_out[view.name] = _Placed(pose, corners, same)
        if same:
            self.judged[view.name] = Judged("redundant", f"the board has not moved since {same}")
            return
        gain = float(known.gain(self._information([view.name])[0]))
        self.judged[view.name] = Judged("redundant", _no_news(self.redundant), gain)
        if not self._expendable():
            self._let_in(view.name, gain)

    def _let_in(self, name: str, gain: float) -> None:
        placed = self._left_out.pop(name)
        self.judged[name] = Judged("used", "", gain)
        self._append(name, placed.corners, placed.pose)
        self._unsolved += 1

    def _placed(self, problem: Problem, corners: Array) -> tuple[Problem | None, Array]:
        """The pair alone under the present cameras; a chessboard's wet corners in the order that fits."""
        orders = [corners]
        if self.board.kind == "chessboard":
            orders.append(np.stack([corners[0], corners[1][::-1, ::-1]]))
        best: tuple[float, Problem | None, Array] = (np.inf, None, corners)
        for order in orders:
            try:
                placed, there = posing.place(problem, order[:, None], self.chamber)
            except SolveError:
                continue
            if there.all():
                best = min(best, (_typical(placed), placed, order), key=lambda found: found[0])
                if best[0] < MISFIT_PX:
                    break
        return best[1], best[2]

    def _same_place(self, corners: Array) -> str:
        """A frame in which the board is where it is here, by its name; empty if there is none."""
        seen = np.isfinite(corners[..., 0]).sum()
        for name in self.names("used"):
            moved = np.linalg.norm(self.views[name].corners - corners, axis=-1)
            both = np.isfinite(moved)
            if both.sum() > 0.8 * seen and np.median(moved[both]) < SAME_PLACE_PX:
                return name
        return ""

    def _apart(self) -> list[str]:
        """Frames left out for what they say, not because the board has not moved."""
        return [name for name, placed in self._left_out.items() if not placed.like]

    def _expendable(self) -> bool:
        """Whether all frames left out together would lessen no sigma by more than the share agreed."""
        apart = self._apart()
        if not apart or self.known is None:
            return True
        return float(self.known.gain(self._information(apart).sum(0))) <= self.redundant

    def _information(self, names: list[str]) -> Array:
        """What frames left out say, (K, G, G)."""
        adjustment = self._adjustment
        if adjustment is None:
            raise ValueError("there is no solution yet; solve first")
        placed = [self._left_out[name] for name in names]
        seen = np.isfinite(np.stack([each.corners[..., 0] for each in placed], 1)).astype(np.float64)
        poses = np.stack([each.pose for each in placed])
        return information.of_poses(adjustment.problem, self.chamber, poses, seen, adjustment.problem.spacing)

    def _append(self, name: str, corners: Array, pose: Array) -> None:
        """Put a frame at the end of the problem; outliers so far stay marked."""
        old = self._adjustment
        if old is None:
            return
        everything = np.concatenate([old.corners[:, old.frames], corners[:, None]], 1)
        names = (*self._used_names(old), name)
        before = old.problem
        fresh = adjust.assemble(everything, [(int(w), int(h)) for w, h in before.sizes], before.spacing)
        fresh.observations[: len(before.observations)] = before.observations  # sorted by frame, so the new one is last
        problem = before.copy(
            observations=fresh.observations,
            indices=fresh.indices,
            rt_ref_board=np.concatenate([before.rt_ref_board, pose[None]]),
        )
        self._adjustment = Adjustment(problem, everything, names, np.arange(len(names)), [], old.reordered)

    def _solved(self, solution: Solution, lost: dict[str, str]) -> None:
        """Take over a new solution; name what it lost, and let in what can no longer be left out."""
        adjustment = self._adjustment
        if adjustment is None:
            return
        self.solution, self.trouble, self._unsolved = solution, "", 0
        started = time.perf_counter()
        self.known = guidance.certainty(solution.problem, self.chamber)
        self.spent.add("certainty", time.perf_counter() - started)
        for name in self._used_names(adjustment):
            if self.judged[name].fate != "used":
                self.judged[name] = replace(self.judged[name], fate="used", reason="")
        for name, reason in lost.items():
            self.judged[name] = Judged("rejected", reason)
        while not self._expendable():
            apart = self._apart()
            gains = self.known.gain(self._information(apart))
            self._let_in(apart[int(np.argmax(gains))], float(gains.max()))

    def _forget(self, trouble: str) -> None:
        self.solution = self.known = self._adjustment = None
        self.trouble, self._left_out, self._misfits = trouble, {}, 0
        self._solved_afresh = self._unsolved = 0
        for name in filter(self._counts, self.views):
            self.judged[name] = Judged("waiting", trouble)

    def _counts(self, name: str) -> bool:
        """Whether a frame shows enough of the board to both cameras."""
        return self.judged[name].reason != adjust.TOO_LITTLE

    def _observations(self, adjustment: Adjustment) -> Observations:
        return self.observations(adjustment.names)

    @staticmethod
    def _used_names(adjustment: Adjustment) -> tuple[str, ...]:
        return tuple(adjustment.names[i] for i in adjustment.frames)


def _typical(problem: Problem) -> float:
    """A robust standard deviation of the residuals, pixels: some corners may be wrong."""
    return 1.4826 * float(np.nanmedian(np.abs(versions.residuals(problem))))


def _without(adjustment: Adjustment, which: Mask) -> Adjustment:
    """The adjustment without some of its frames, (F,) true, which it does not know by name any longer either."""
    kept = adjustment.frames[~which]
    return Adjustment(
        adjust.without(adjustment.problem, which),
        adjustment.corners[:, kept],
        tuple(adjustment.names[i] for i in kept),
        np.arange(len(kept)),
        [],
        adjustment.reordered,
    )


def _no_news(share: float) -> str:
    return f"with all others left out it would lessen no uncertainty by {share:.0%}"
