"""Benchmark stage `calibration`: from noisy corners to a rig, and how far that rig is from the true one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo import Camera, Chamber, Rig
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import digital_rig, exact_observations, noisy_observations
from rainstereo.apps.rig_error import infinity_error, matching_error
from rainstereo.apps.slab_study import COARSE, Capture, Setting
from rainstereo.calib import mrcal_versions
from rainstereo.calib.board import Board
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import solve
from rainstereo.rig import ROLES

Float = npt.NDArray[np.float64]
BOARD = Board.parse("chessboard:10x7:22mm")
NOISE_PX = 0.1
MODEL = "LENSMODEL_OPENCV8"


def build(seed: int, quick: bool) -> Stage:
    """The stage with 13 and 60 pairs and with paired captures; with 8 pairs if `quick`."""
    if quick:
        works: tuple[Work, ...] = (_work("through", 8, True, seed, 1, 1),)
    else:
        works = (
            _work("bare", 13, False, seed, 5, 3),
            _work("through", 13, True, seed, 5, 3),
            _work("sixty", 60, True, seed, 3, 8),
            _paired(seed, 3, 8),
        )
    return Stage(
        "calibration",
        "from corners to a calibrated rig",
        "Corners of a chessboard held before a digital rig, exact but for noise, so that the truth is known. To ignore "
        "the acrylic costs little in residuals, and much in where the cameras are believed to look.",
        works,
        {
            "rig": "two OPENCV8 cameras of 1280x960, f about 1200 px, 29 mm apart, behind two 4 mm panels pitched "
            "by 15 degrees",
            "board": BOARD.spec,
            "noise": f"{NOISE_PX} px a coordinate",
            "seed": seed,
        },
        (
            "Corners are given: detection is not part of the time. Imports are not, either.",
            "cv2: calibrateCamera for each camera, then stereoCalibrate with everything free, rational model. mrcal: "
            "its stereographic seed, then OPENCV8 with a bent board; the solver that we use too, without our checks "
            "for flipped boards, bad frames and outliers, and without the chamber.",
            "The panels are known exactly here, but for the paired captures. What a mistake about them costs is in the "
            "stage `slab`.",
        ),
    )


def opencv(observations: Observations) -> Rig:
    """OpenCV's usual recipe. Boards must be seen whole."""
    board = np.asarray(BOARD.points.reshape(-1, 3), np.float32)
    size = observations.imagersize["dry"]
    boards = [board] * len(observations.names)
    corners = {role: [np.asarray(v.reshape(-1, 2), np.float32) for v in getattr(observations, role)] for role in ROLES}
    flags = cv2.CALIB_RATIONAL_MODEL
    (_, K_dry, k_dry, *_), (_, K_wet, k_wet, *_) = (
        cv2.calibrateCamera(boards, corners[role], size, np.eye(3), np.zeros(8), flags=flags) for role in ROLES
    )
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    _, K_dry, k_dry, K_wet, k_wet, R, t, *_ = cv2.stereoCalibrate(
        boards, corners["dry"], corners["wet"], K_dry, k_dry, K_wet, k_wet, size, flags=flags
    )
    pose = np.concatenate([cv2.Rodrigues(R)[0].ravel(), np.ravel(t)])
    return Rig(_camera(K_dry, k_dry, size, np.zeros(6)), _camera(K_wet, k_wet, size, pose), None)


def mrcal_recipe(observations: Observations) -> Rig:
    """mrcal's own recipe, as its `mrcal-calibrate-cameras` goes about it. Boards must be seen whole."""
    corners = np.stack([getattr(observations, role) for role in ROLES], 1).reshape(-1, BOARD.rows, BOARD.columns, 2)
    observed = np.concatenate([corners, np.ones_like(corners[..., :1])], -1)
    frame, camera = np.divmod(np.arange(len(observed)), 2)
    sizes = np.array([observations.imagersize[role] for role in ROLES], np.int32)
    with mrcal_versions.quiet():
        seed = mrcal_versions.load().seed_stereographic(
            sizes, 1000.0, np.column_stack([frame, camera]).astype(np.int32), observed, BOARD.square
        )
    intrinsics, rt_cam_ref, rt_ref_board = (np.array(part, float) for part in seed)
    problem = Problem(
        "LENSMODEL_STEREOGRAPHIC",
        intrinsics,
        rt_cam_ref,
        rt_ref_board,
        observed,
        np.column_stack([frame, camera, camera - 1]).astype(np.int32),
        sizes,
        BOARD.square,
        regularization=False,
    )
    mrcal_versions.optimize(problem)
    problem.free = Free(core=True)
    mrcal_versions.optimize(problem)
    problem.intrinsics = np.hstack([problem.intrinsics, 1e-6 * np.ones((2, 8))])
    problem.lensmodel, problem.regularization = MODEL, True
    problem.free = Free(core=True, distortions=True)
    mrcal_versions.optimize(problem)
    problem.warp, problem.free = np.zeros(2), Free(core=True, distortions=True, warp=True)
    mrcal_versions.optimize(problem, outliers=True)
    width, height = observations.imagersize["dry"]
    poses = np.zeros(6), problem.rt_cam_ref[0]
    dry, wet = (Camera(MODEL, problem.intrinsics[i], width, height, poses[i]) for i in range(2))
    return Rig(dry, wet, None)


def _work(name: str, pairs: int, through: bool, seed: int, draws: int, slow: int) -> Work:
    truth = digital_rig(seed=seed)
    poses = board_poses(truth, BOARD, pairs, seed)
    exact = exact_observations(truth, BOARD, poses, through)
    noisy = [
        noisy_observations(truth, BOARD, exact, NOISE_PX, np.random.default_rng([seed, pairs, draw]))
        for draw in range(draws)
    ]
    variants = [_variant("solve, bare", _bare, noisy, truth, "no chamber in the model", ours=True)]
    if through:
        known = partial(_known, chamber=truth.chamber)
        variants.insert(0, _variant("solve, known panels", known, noisy, truth, "", ours=True))
    variants += _peers(noisy, truth, slow)
    where = "through two panels" if through else "nothing in front of the cameras"
    ours = variants[0].name
    targets = {"bare": (Target(ours, None, 0.5),), "sixty": (Target(ours, "mrcal", 2.0),)}
    return Work(
        name,
        f"{pairs} pairs, {where}",
        f"{pairs} boards seen by both cameras, {where}; {NOISE_PX} px of noise.",
        tuple(variants),
        ours,
        "px",
        _errors(draws),
        targets=targets.get(name, ()),
    )


def _paired(seed: int, draws: int, slow: int) -> Work:
    """Thirty poses, each seen without and with the chamber; panels described wrongly and found."""
    poses = 30
    capture = Capture.of(Setting("paired", 15, poses, 0.25, 0.6, COARSE), seed)
    noisy = [capture.drawn(seed, draw) for draw in range(draws)]
    sought = [capture.sought(seed, draw) for draw in range(draws)]

    def ours(seen: Observations) -> Rig:
        return solve(seen, MODEL, sought[[seen is each for each in noisy].index(True)]).rig

    def first_half(seen: Observations) -> Rig:
        return opencv(replace(seen, names=seen.names[:poses], dry=seen.dry[:poses], wet=seen.wet[:poses]))

    truth = capture.truth
    return Work(
        "paired",
        f"{poses} poses without and with the chamber, everything estimated",
        f"{poses} poses of a board at 0.25 to 0.6 m, seen by both cameras without and then through two panels that are "
        f"described 2 degrees and 0.2 mm wrong; {NOISE_PX} px of noise.",
        (
            _variant("solve, paired", ours, noisy, truth, "lenses, poses, board, tilt, thickness, wedge", ours=True),
            *_peers(noisy, truth, slow),
            _variant("cv2, bare half", first_half, noisy, truth, "leaves the panels unknown", every=slow),
        ),
        "solve, paired",
        "px",
        _errors(draws),
        targets=(Target("solve, paired", None, 5.0),),
    )


def _bare(seen: Observations) -> Rig:
    return solve(seen, MODEL).rig


def _known(seen: Observations, chamber: Chamber | None) -> Rig:
    return solve(seen, MODEL, chamber).rig


def _peers(noisy: list[Observations], truth: Rig, slow: int) -> list[Variant]:
    return [
        _variant("mrcal", mrcal_recipe, noisy, truth, "the bare solver"),
        _variant("cv2.stereoCalibrate", opencv, noisy, truth, "rational model", every=slow),
    ]


def _variant(
    title: str,
    rig_of: Callable[[Observations], Rig],
    noisy: list[Observations],
    truth: Rig,
    note: str,
    every: int = 1,
    ours: bool = False,
) -> Variant:
    def error(first: Rig) -> float:
        others = [rig_of(observations) for observations in noisy[1:]]
        return float(np.sqrt(np.mean([infinity_error(rig, truth) ** 2 for rig in (first, *others)])))

    def also(rig: Rig) -> Mapping[str, float]:
        return {"match, px": matching_error(rig, truth), "baseline, mm": 1e3 * (rig.baseline - truth.baseline)}

    return Variant(title, lambda: rig_of(noisy[0]), error, ours, note, every, also)


def _errors(draws: int) -> str:
    return (
        f"of directions at infinity, RMS over both images{f' and {draws} draws of the noise' if draws > 1 else ''}; "
        "match: error of wet pixels matched to dry ones at infinity, like the baseline's of the draw that was timed"
    )


def _camera(K: Any, k: Any, size: tuple[int, int], pose: Float) -> Camera:
    intrinsics = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.ravel(k)[:8]])
    return Camera(MODEL, intrinsics, *size, pose)
