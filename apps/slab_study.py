"""Monte Carlo of calibrations through panels: many captures of one digital rig that differ by noise only.

Each run draws the corners' noise and, where a description has standard deviations, what caliper, protractor and data
sheet said. What came out is held against the truth, and its scatter against the sigma that each run predicted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rainstereo import Chamber, Panel, Rig
from rainstereo.apps.bench_calibration import infinity_error
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import RigOptions, digital_rig, exact_observations, noisy_observations, seen_by
from rainstereo.calib import contributions, point_uncertainty, uncertainty
from rainstereo.calib.board import Board
from rainstereo.calib.prior import Prior
from rainstereo.calib.slab import across
from rainstereo.calib.solve import Solution, solve
from rainstereo.calib.sought import Sought
from rainstereo.chamber import ChamberUncertainty
from rainstereo.rig import ROLES
from rainstereo.triangulation import triangulate
from rainstereo.types import Array

BOARD = Board.parse("chessboard:10x7:22mm")
NOISE_PX = 0.1
MODEL = "LENSMODEL_OPENCV8"
SD = ChamberUncertainty((2e-5, 2e-5), np.deg2rad(0.5), (0.002, 0.002))
DEPTH_M = 2.0
MODES = ("known", "estimated", "exact", "ignored", "paired")


@dataclass(frozen=True, eq=False)
class Setting:
    """A rig, boards, and how they are calibrated.

    mode: "exact" panels known exactly, "known" as described with SD, "estimated" improved by the corners, "ignored";
    "paired" with as many bare frames of the same poses. frames: poses.
    """

    mode: str
    tilt_deg: float
    frames: int
    near: float | None = None
    far: float | None = None
    wedge: float = 0.0


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Of all runs, by quantity: error (found minus true, in the unit named) and the sigma predicted, (runs,) each.

    infinity_px: (runs,), RMS over both images after one rotation of the rig. seconds: (runs,). wedges: found.
    """

    errors: dict[str, Array]
    sigmas: dict[str, Array]
    infinity_px: Array
    seconds: Array
    wedges: int

    def bias(self, name: str) -> float:
        """Mean error."""
        return float(self.errors[name].mean())

    def scatter(self, name: str) -> float:
        """RMS error."""
        return float(np.sqrt(np.mean(self.errors[name] ** 2)))

    def ratio(self, name: str) -> float:
        """RMS error over predicted sigma; 1 where predictions are right."""
        return float(np.sqrt(np.mean((self.errors[name] / self.sigmas[name]) ** 2)))


@dataclass(frozen=True, eq=False)
class Capture:
    """A setting with its rig and where the corners are without noise: dry and wet, (N, rows, columns, 2)."""

    setting: Setting
    truth: Rig
    exact: tuple[Array, Array]

    @classmethod
    def of(cls, setting: Setting, seed: int) -> Capture:
        """The capture that a seed stands for. ValueError for an unknown mode."""
        if setting.mode not in MODES:
            raise ValueError(f"mode {setting.mode!r} was given; expected one of {', '.join(MODES)}")
        truth = digital_rig(RigOptions(tilt_deg=setting.tilt_deg), seed)
        poses = board_poses(truth, BOARD, setting.frames, seed, near=setting.near, far=setting.far)
        exact = exact_observations(truth, BOARD, poses)
        if setting.mode == "paired":
            bare = exact_observations(truth, BOARD, poses, through=False)
            exact = (np.concatenate([bare[0], exact[0]]), np.concatenate([bare[1], exact[1]]))
        return cls(setting, truth, exact)

    def calibrated(self, rng: np.random.Generator) -> Solution:
        """One draw of the noise, calibrated."""
        seen = noisy_observations(self.truth, BOARD, self.exact, NOISE_PX, rng)
        return solve(seen, MODEL, self._sought(rng))

    def _sought(self, rng: np.random.Generator) -> Chamber | Sought | None:
        chamber, mode, count = self.truth.chamber, self.setting.mode, self.setting.frames
        if chamber is None or mode == "ignored":
            return None
        if mode == "exact":
            return chamber
        if mode == "paired":
            rough = replace(described(chamber, rng, 4.0), panels=tuple(Panel(0.0038, p.index) for p in chamber.panels))
            through, ties = np.arange(2 * count) >= count, np.arange(2 * count) % count
            return Sought(rough, ("tilt", "thickness"), None, through, ties, wedge=True)
        known = described(chamber, rng)
        return known if mode == "known" else Sought(known, ("tilt", "thickness", "index"), Prior(known))


def outcomes(capture: Capture, runs: int, seed: int) -> Outcomes:
    """Calibrate `runs` draws of a capture."""
    rows: list[tuple[dict[str, tuple[float, float]], float, float, int]] = []
    for run in range(runs):
        solution = capture.calibrated(np.random.default_rng([seed, run, 0x51AB]))
        told, far = quantities(solution, capture.truth), infinity_error(solution.rig, capture.truth)
        rows.append((told, far, solution.solve_seconds, _wedged(solution)))
    names = list(rows[0][0])
    return Outcomes(
        {name: np.array([row[0][name][0] for row in rows]) for name in names},
        {name: np.array([row[0][name][1] for row in rows]) for name in names},
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        sum(row[3] for row in rows),
    )


def described(chamber: Chamber, rng: np.random.Generator, times: float = 1.0) -> Chamber:
    """The chamber as somebody measured it: off by SD, `times` as much in tilt; the index of all panels alike."""
    normal = np.asarray(chamber.normal) + across(chamber.normal) @ (times * SD.tilt * rng.standard_normal(2))
    index = float(rng.normal(0, SD.index[0])) if times == 1.0 else 0.0
    panels = tuple(
        Panel(panel.thickness + float(rng.normal(0, sd)), panel.index + index)
        for panel, sd in zip(chamber.panels, SD.thickness, strict=True)
    )
    x, y, z = normal.tolist()
    return replace(chamber, normal=(x, y, z), panels=panels, uncertainty=SD)


def quantities(solution: Solution, truth: Rig) -> dict[str, tuple[float, float]]:
    """Error and predicted sigma of what a calibration is asked for: mm, degrees, pixels."""
    spread = contributions.contributions(solution)
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


def _wedged(solution: Solution) -> int:
    return int(solution.estimate is not None and "wedge" in solution.estimate.slab.free)
