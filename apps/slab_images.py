"""The study of calibrations through panels from pictures: boards drawn and photographed, their corners detected."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context

import numpy as np

from rainstereo.apps.board_views import board_drawing
from rainstereo.apps.slab_study import MODEL, Capture, Run, Setting, judged
from rainstereo.calib.corners import detect
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import Solution, solve
from rainstereo.drawing import render_drawing
from rainstereo.pose import compose
from rainstereo.rig import ROLES, Role
from rainstereo.sensor import Sensor
from rainstereo.types import Array
from rainstereo.view import View

WALL = 96.0
"""Gray level of what is behind the boards."""


@dataclass(frozen=True, eq=False)
class Photographed:
    """One capture from pictures: what was detected, by how much corners are off (RMS a coordinate, pixels, and the
    share of them that was found), and what the calibration came to.
    """  # fmt: skip

    seen: Observations
    corner_px: float
    found: float
    run: Run


def photographed(
    setting: Setting, noises: Sequence[float], seeds: Sequence[int], workers: int = 1
) -> list[tuple[Photographed, ...]]:
    """For each seed, which makes the rig, the poses and all noise, a capture at each of the sensor's noises, gray
    levels.
    """  # fmt: skip
    make = partial(capture_of, setting, tuple(noises))
    if workers == 1:
        return [make(seed) for seed in seeds]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        return list(pool.map(make, seeds))


def capture_of(setting: Setting, noises: tuple[float, ...], seed: int) -> tuple[Photographed, ...]:
    """One rig's capture at each noise."""
    capture = Capture.of(setting, seed)
    dry, wet = (_corners(capture, index, noises, seed) for index in range(2))
    return tuple(_judged(capture, pair, seed) for pair in zip(dry, wet, strict=True))


def calibrated(setting: Setting, seed: int, photo: Photographed) -> Solution:
    """The calibration of what was detected."""
    return solve(photo.seen, MODEL, Capture.of(setting, seed).sought(seed, 0))


def _judged(capture: Capture, corners: tuple[Array, Array], seed: int) -> Photographed:
    dry, wet = corners
    names = tuple(f"{i:03d}" for i in range(len(dry)))
    sizes: dict[str, tuple[int, int]] = {role: capture.truth.camera(role).size for role in ROLES}
    seen = Observations(capture.setting.board, names, dry, wet, sizes)
    off = np.stack(corners) - np.stack(capture.exact)
    solution = solve(seen, MODEL, capture.sought(seed, 0))
    return Photographed(
        seen,
        float(np.sqrt(np.nanmean(off**2))),
        float(np.isfinite(off).mean()),
        judged(solution, capture.truth, bound=True),
    )


def _corners(capture: Capture, index: int, noises: tuple[float, ...], seed: int) -> list[Array]:
    """One camera's corners in all frames, (N, rows, columns, 2), at each noise."""
    role, frames = ROLES[index], capture.setting.frames
    nearest = float(np.linalg.norm(capture.poses[:, 3:], axis=-1).min())
    camera = capture.truth.camera(role)
    drawing = board_drawing(capture.setting.board, 4 * float(camera.intrinsics[0]) / nearest)
    passes = (False, True) if capture.setting.mode == "paired" else (True,)
    corners = [np.full(capture.exact[index].shape, np.nan) for _ in noises]
    for part, through in enumerate(passes):
        view = _view(capture, role, through)
        for i, pose in enumerate(capture.poses):
            behind = np.full(view.shape, WALL, dtype=np.float32)
            light = render_drawing(view, drawing, compose(camera.rt_cam_ref, pose), behind, Sensor().blur, 4)
            frame = part * frames + i
            for level, noise in enumerate(noises):
                rng = np.random.default_rng([seed, index, frame, level])
                image = Sensor(noise=noise).expose(light, view.cosine, rng)
                corners[level][frame] = _ordered(detect(image, capture.setting.board).xy, capture.exact[index][frame])
    return corners


def _view(capture: Capture, role: Role, through: bool) -> View:
    return View.trace(capture.truth.camera(role), capture.truth.chamber_in(role) if through else None)


def _ordered(found: Array, exact: Array) -> Array:
    """Corners, (rows, columns, 2), in the order in which the board was held: a print may look the same turned round."""
    turned = found[::-1, ::-1]
    near, far = (float(np.nansum((corners - exact) ** 2)) for corners in (found, turned))
    return np.asarray(found if near <= far else turned)
