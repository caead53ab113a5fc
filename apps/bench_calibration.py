"""Benchmark stage `calibration`: from noisy corners to a rig, and how far that rig is from the true one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo import Camera, Rig
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.digital_rig import digital_rig, exact_observations, noisy_observations
from rainstereo.calib import mrcal_versions
from rainstereo.calib.board import Board
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import solve
from rainstereo.pose import rotation_matrix
from rainstereo.rig import ROLES, Role

Float = npt.NDArray[np.float64]
BOARD = Board.parse("chessboard:10x7:22mm")
NOISE_PX = 0.1
MODEL = "LENSMODEL_OPENCV8"


def build(seed: int, quick: bool) -> Stage:
    """The stage with 13 and 60 pairs; with 8 if `quick`."""
    if quick:
        works: tuple[Work, ...] = (_work("through", 8, True, seed, 1, 1),)
    else:
        works = (
            _work("bare", 13, False, seed, 5, 3),
            _work("through", 13, True, seed, 5, 3),
            _work("sixty", 60, True, seed, 1, 8),
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
            "The panels are known exactly here. What a mistake about them costs is another question.",
        ),
    )


def infinity_error(found: Rig, truth: Rig) -> float:
    """By how many pixels the found rig mistakes where its pixels look, RMS over a grid of both images.

    Parallel panels do not turn rays, so far away the true directions are those of the bare cameras. One rotation of the
    whole rig is free: nothing that a calibration sees ties the rig to the world.
    """
    ours, true = far_rays(found), far_rays(truth)
    known = np.isfinite(ours).all(-1)
    U, _, Vt = np.linalg.svd(true[known].T @ ours[known])  # Kabsch: the rotation from ours to the truth
    turned = ours[known] @ (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
    focal = float(truth.dry.intrinsics[0])
    return focal * float(np.sqrt(((turned - true[known]) ** 2).sum(-1).mean()))


def far_rays(rig: Rig) -> Float:
    """Unit rays, (N, 3), of a grid of pixels of the dry image, then of the wet one, in the frame of the dry camera."""
    return np.concatenate([_directions(rig, role) for role in ROLES])


def matching_error(found: Rig, truth: Rig) -> float:
    """By how many pixels the found rig mistakes which pixels of its two cameras see the same far point: RMS over a
    grid of the dry image. What both cameras get wrong alike does not show."""
    pixels = _grid(truth.dry)

    def match(rig: Rig) -> Float:
        rays = rig.dry.unproject(pixels) @ rotation_matrix(rig.wet.rt_cam_ref[:3]).T
        matched: Float = rig.wet.project(rays)
        return matched

    difference = match(found) - match(truth)
    return float(np.sqrt(np.nanmean((difference**2).sum(-1))))


def _directions(rig: Rig, role: Role) -> Float:
    """Unit rays (N, 3) of a grid of pixels, in the frame of the dry camera."""
    camera = rig.camera(role)
    directions: Float = camera.unproject(_grid(camera)) @ rotation_matrix(camera.rt_cam_ref[:3])
    return directions


def _grid(camera: Camera) -> Float:
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    return np.asarray(np.stack([x, y], -1).reshape(-1, 2), np.float64)


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

    def variant(
        title: str, rig_of: Callable[[Observations], Rig], note: str, every: int = 1, ours: bool = False
    ) -> Variant:
        def error(first: Rig) -> float:
            others = [rig_of(observations) for observations in noisy[1:]]
            return float(np.sqrt(np.mean([infinity_error(rig, truth) ** 2 for rig in (first, *others)])))

        def also(rig: Rig) -> Mapping[str, float]:
            return {
                "match, px": matching_error(rig, truth),
                "baseline, mm": 1e3 * (rig.baseline - truth.baseline),
            }

        return Variant(title, lambda: rig_of(noisy[0]), error, ours, note, every, also)

    variants = [variant("solve, bare", lambda seen: solve(seen, MODEL).rig, "no chamber in the model", ours=True)]
    if through:
        known = variant("solve, known panels", lambda seen: solve(seen, MODEL, truth.chamber).rig, "", ours=True)
        variants.insert(0, known)
    variants += [
        variant("mrcal", mrcal_recipe, "the bare solver"),
        variant("cv2.stereoCalibrate", opencv, "rational model", every=slow),
    ]
    where = "through two panels" if through else "nothing in front of the cameras"
    return Work(
        name,
        f"{pairs} pairs, {where}",
        f"{pairs} boards seen by both cameras, {where}; {NOISE_PX} px of noise.",
        tuple(variants),
        variants[0].name,
        "px",
        f"of directions at infinity, RMS over both images{f' and {draws} draws of the noise' if draws > 1 else ''}; "
        "match: error of wet pixels matched to dry ones at infinity, like the baseline's of the draw that was timed",
        targets=(Target(variants[0].name, None, 0.5),) if pairs == 13 and not through else (),
    )


def _camera(K: Any, k: Any, size: tuple[int, int], pose: Float) -> Camera:
    intrinsics = np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], np.ravel(k)[:8]])
    return Camera(MODEL, intrinsics, *size, pose)
