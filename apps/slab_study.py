"""Monte Carlo of calibrations through panels: many captures of one digital rig that differ by noise only.

Each run draws the corners' noise and, where a description has standard deviations, what caliper, protractor and data
sheet said. What came out is held against the truth, and its scatter against the sigma that each run predicted. A few
runs are repeated with all errors' signs turned: what is linear in them leaves the mean of the two, and a bias shows
that would otherwise hide in the scatter of hundreds of runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context

import numpy as np

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import RigOptions, digital_rig, exact_observations, noisy_observations, seen_by
from rainstereo.apps.rig_error import far_rays, infinity_error
from rainstereo.calib import contributions, point_uncertainty, uncertainty
from rainstereo.calib.board import Board
from rainstereo.calib.observations import Observations
from rainstereo.calib.prior import Prior
from rainstereo.calib.slab import across
from rainstereo.calib.solve import Solution, solve
from rainstereo.calib.sought import Sought
from rainstereo.calib.state_covariance import Covariance
from rainstereo.chamber import ChamberUncertainty
from rainstereo.rig import ROLES
from rainstereo.triangulation import triangulate
from rainstereo.types import Array

BOARD = Board.parse("chessboard:14x10:17mm")
COARSE = Board.parse("chessboard:10x7:22mm")
"""As large, with half as many corners."""
NOISE_PX = 0.1
MODEL = "LENSMODEL_OPENCV8"
SD = ChamberUncertainty((2e-5, 2e-5), np.deg2rad(0.5), (0.002, 0.002))
DEPTH_M = 2.0
MIRRORED = 10
LITTLE = 1e-3
"""Of a standard deviation: a step over which directions change linearly."""
MODES = ("known", "estimated", "exact", "ignored", "paired")


@dataclass(frozen=True, eq=False)
class Setting:
    """A rig, poses of a board, and how they are calibrated.

    mode: "exact" panels known exactly, "known" as described with SD, "estimated" improved by the corners, "ignored";
    "paired" with as many bare frames of the same poses. frames: poses.
    """

    mode: str
    tilt_deg: float
    frames: int
    near: float | None = None
    far: float | None = None
    board: Board = BOARD


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Of all runs, by quantity: error (found minus true, in the unit named) and the sigma predicted, (runs,) each.

    mirrored: errors of the first runs again, with the signs of all that was drawn turned, (pairs,).
    infinity_px: (runs,), RMS over both images after one rotation of the rig. bound_px: what the first run predicts of
    it by the covariance of its solution, which for corners with normal noise is the bound of Cramer and Rao.
    wedges: in how many runs one was found.
    """

    errors: dict[str, Array]
    sigmas: dict[str, Array]
    mirrored: dict[str, Array]
    infinity_px: Array
    bound_px: float
    wedges: int

    def bias(self, name: str) -> float:
        """Mean error of the runs that have a mirror image, and of those; NaN if there are none."""
        middles = self._middles(name)
        return float(middles.mean()) if len(middles) else float("nan")

    def bias_sigma(self, name: str) -> float:
        """Standard deviation of `bias`."""
        middles = self._middles(name)
        return float(middles.std(ddof=1) / np.sqrt(len(middles))) if len(middles) > 1 else float("nan")

    def _middles(self, name: str) -> Array:
        turned = self.mirrored[name]
        return np.asarray((self.errors[name][: len(turned)] + turned) / 2)

    def scatter(self, name: str) -> float:
        """RMS error."""
        return float(np.sqrt(np.mean(self.errors[name] ** 2)))

    def ratio(self, name: str) -> float:
        """RMS error over predicted sigma; 1 where predictions are right."""
        return float(np.sqrt(np.mean((self.errors[name] / self.sigmas[name]) ** 2)))


@dataclass(frozen=True, eq=False)
class Capture:
    """A setting with its rig, the board's poses, (frames, 6), and where the corners are without noise: dry and wet,
    (N, rows, columns, 2), of paired captures those without the chamber first.
    """  # fmt: skip

    setting: Setting
    truth: Rig
    poses: Array
    exact: tuple[Array, Array]

    @classmethod
    def of(cls, setting: Setting, seed: int) -> Capture:
        """The capture that a seed stands for. ValueError for an unknown mode."""
        if setting.mode not in MODES:
            raise ValueError(f"mode {setting.mode!r} was given; expected one of {', '.join(MODES)}")
        truth = digital_rig(RigOptions(tilt_deg=setting.tilt_deg), seed)
        board = setting.board
        poses = board_poses(truth, board, setting.frames, seed, near=setting.near, far=setting.far)
        exact = exact_observations(truth, board, poses)
        if setting.mode == "paired":
            bare = exact_observations(truth, board, poses, through=False)
            exact = (np.concatenate([bare[0], exact[0]]), np.concatenate([bare[1], exact[1]]))
        return cls(setting, truth, poses, exact)

    def calibrated(self, seed: int, run: int, sign: float = 1.0) -> Solution:
        """One draw of all errors, calibrated. sign: -1 turns them round."""
        return solve(self.drawn(seed, run, sign), MODEL, self.sought(seed, run, sign))

    def drawn(self, seed: int, run: int, sign: float = 1.0) -> Observations:
        """The corners of a run."""
        rng = np.random.default_rng([seed, run, 0x51AB])
        seen = noisy_observations(self.truth, self.setting.board, self.exact, NOISE_PX, rng)
        if sign > 0:
            return seen
        dry, wet = (2 * exact - noisy for exact, noisy in zip(self.exact, (seen.dry, seen.wet), strict=True))
        return replace(seen, dry=dry, wet=wet)

    def sought(self, seed: int, run: int, sign: float = 1.0) -> Chamber | Sought | None:
        """What a run is told about the panels, and is to find out."""
        rng = np.random.default_rng([seed, run, 0x51AC])
        chamber, mode, count = self.truth.chamber, self.setting.mode, self.setting.frames
        if chamber is None or mode == "ignored":
            return None
        if mode == "exact":
            return replace(chamber, uncertainty=ChamberUncertainty((0.0, 0.0), 0.0, (0.0, 0.0)))
        if mode == "paired":
            thin = tuple(Panel(panel.thickness - 2e-4, panel.index) for panel in chamber.panels)
            rough = replace(described(chamber, rng, 4.0 * sign), panels=thin)
            through, ties = np.arange(2 * count) >= count, np.arange(2 * count) % count
            return Sought(rough, ("tilt", "thickness"), None, through, ties, wedge=True)
        known = described(chamber, rng, sign)
        return known if mode == "known" else Sought(known, ("tilt", "thickness", "index"), Prior(known))


@dataclass(frozen=True, eq=False)
class Run:
    """One run: error and sigma by quantity, error at infinity, its bound (the first run's only), whether a wedge
    was found."""

    told: dict[str, tuple[float, float]]
    infinity_px: float
    bound_px: float
    wedged: bool


def outcomes(capture: Capture, runs: int, seed: int, workers: int = 1) -> Outcomes:
    """Calibrate `runs` draws of a capture, in so many processes; their number changes nothing."""
    jobs = [(run, 1.0) for run in range(runs)] + [(run, -1.0) for run in range(min(runs, MIRRORED))]
    if workers == 1:
        found = [one(capture, seed, *job) for job in jobs]
    else:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            found = list(pool.map(partial(one, capture, seed), *zip(*jobs, strict=True), chunksize=4))
    return gathered(found[:runs], found[runs:])


def gathered(runs: Sequence[Run], mirrored: Sequence[Run] = ()) -> Outcomes:
    """What many runs, and the first of them with all errors turned, have in common."""
    names = list(runs[0].told)
    return Outcomes(
        {name: np.array([run.told[name][0] for run in runs]) for name in names},
        {name: np.array([run.told[name][1] for run in runs]) for name in names},
        {name: np.array([run.told[name][0] for run in mirrored]) for name in names},
        np.array([run.infinity_px for run in runs]),
        runs[0].bound_px,
        sum(run.wedged for run in runs),
    )


def one(capture: Capture, seed: int, run: int, sign: float = 1.0) -> Run:
    """One run of a study."""
    return judged(capture.calibrated(seed, run, sign), capture.truth, bound=run == 0 and sign > 0)


def judged(solution: Solution, truth: Rig, *, bound: bool) -> Run:
    """A calibration held against the truth; with the bound of its error at infinity, which takes a while, or NaN."""
    spread = contributions.contributions(solution)
    return Run(
        quantities(solution, truth, spread),
        infinity_error(solution.rig, truth),
        infinity_bound(solution, spread.total) if bound else float("nan"),
        solution.estimate is not None and "wedge" in solution.estimate.slab.free,
    )


def infinity_bound(solution: Solution, cov: Covariance) -> float:
    """What `rig_error.infinity_error` is in the root of the mean square, by a solution's covariance, pixels.

    Directions of both images move by J db; the rotation of the whole rig that fits best, whose derivatives are the
    columns of T, is taken off them.
    """
    rig, layout = solution.rig, cov.layout
    state = np.concatenate([rig.dry.intrinsics, rig.wet.intrinsics, rig.wet.rt_cam_ref])
    which = np.concatenate([np.arange(layout.size)[span] for span in (*layout.intrinsics, layout.extrinsics)])
    k = len(rig.dry.intrinsics)

    def directions(at: Array) -> Array:
        dry = Camera(rig.dry.model, at[:k], *rig.dry.size)
        wet = Camera(rig.wet.model, at[k : 2 * k], *rig.wet.size, at[2 * k :])
        return far_rays(Rig(dry, wet, None)).ravel()

    here = directions(state)
    sd = np.sqrt(np.diag(cov.matrix))[which]
    J = np.stack([(directions(state + step) - here) / step[i] for i, step in enumerate(np.diag(LITTLE * sd))], -1)
    T = np.stack([np.cross(axis, here.reshape(-1, 3)).ravel() for axis in np.eye(3)], -1)
    answered = np.isfinite(J).all(-1)
    J, T = J[answered], T[answered]
    J = J - T @ np.linalg.lstsq(T, J, rcond=None)[0]
    square = float(np.sum((J @ cov.matrix[np.ix_(which, which)]) * J)) / (len(J) / 3)
    return float(rig.dry.intrinsics[0]) * float(np.sqrt(square))


def described(chamber: Chamber, rng: np.random.Generator, times: float = 1.0) -> Chamber:
    """The chamber as somebody measured it: off by `times` SD; the index of all panels alike."""
    normal = np.asarray(chamber.normal) + across(chamber.normal) @ (times * SD.tilt * rng.standard_normal(2))
    index = times * float(rng.normal(0, SD.index[0]))
    panels = tuple(
        Panel(panel.thickness + times * float(rng.normal(0, sd)), panel.index + index)
        for panel, sd in zip(chamber.panels, SD.thickness, strict=True)
    )
    x, y, z = normal.tolist()
    return replace(chamber, normal=(x, y, z), panels=panels, uncertainty=SD)


def quantities(solution: Solution, truth: Rig, spread: contributions.Contributions) -> dict[str, tuple[float, float]]:
    """Error and predicted sigma of what a calibration is asked for: mm, degrees, pixels."""
    cov, rig = spread.total, solution.rig
    told: dict[str, tuple[float, float]] = {}
    sd = np.sqrt(np.diag(cov.matrix))
    for index, role in enumerate(ROLES):
        for k, name in enumerate(("fx", "fy", "cx", "cy")):
            column = cov.layout.intrinsics[index].start + k
            off = rig.camera(role).intrinsics[k] - truth.camera(role).intrinsics[k]
            told[f"{role} {name}, px"] = float(off), float(sd[column])
    told["baseline, mm"] = 1e3 * (rig.baseline - truth.baseline), 1e3 * uncertainty.baseline_sigma(solution, cov)
    told["depth at 2 m, mm"] = _depth(solution, truth, spread=spread)
    if solution.estimate is not None and rig.chamber is not None and truth.chamber is not None:
        off = np.degrees(across(truth.chamber.normal).T @ np.asarray(rig.chamber.normal))
        sigmas = solution.estimate.sigmas
        told["pitch, deg"] = float(off[0]), float(np.degrees(sigmas["pitch"]))
        told["yaw, deg"] = float(off[1]), float(np.degrees(sigmas["yaw"]))
        count = len(truth.chamber.panels)
        thick = sum(p.thickness for p in rig.chamber.panels) - sum(p.thickness for p in truth.chamber.panels)
        told["thickness a panel, mm"] = 1e3 * thick / count, 1e3 * sigmas["thickness 0"] / count
    return told


def _depth(solution: Solution, truth: Rig, spread: contributions.Contributions) -> tuple[float, float]:
    """Error of the depth of a point 2 m ahead, matched exactly, and its sigma from the calibration, millimetres."""
    point = np.array([[0.0, 0.0, DEPTH_M]])
    dry, wet = (seen_by(truth, role, point) for role in ROLES)
    found = triangulate(solution.rig, dry, wet)
    points = point_uncertainty.triangulate_with_covariance(
        solution, dry, wet, pixel_sigma=0.0, cov=spread.total, slab=spread.slab
    )
    depth = float(np.asarray(found.points)[0, 2])
    return 1e3 * (depth - DEPTH_M), 1e3 * float(np.sqrt(points.from_calibration[0, 2, 2]))
