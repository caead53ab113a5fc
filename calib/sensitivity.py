"""How what a camera sees through the panels depends on everything that was calibrated, the panels included.

A camera at C, turned by R, sees a point P of the reference frame at f(R a(P - C)), as in `refracted`: a() is what the
panels do, f the lens. Derivatives are taken by the state as mrcal lays it out and by the slab's parameters behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo import pose, refraction
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import slab as slabs
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.calib.rotation import rotated_by
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.camera import Camera
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array, Mask


@dataclass(frozen=True, eq=False)
class View:
    """Points as a camera sees them; NaN where it does not.

    rays: (N, 3) unit vectors in the camera's frame, before the panels, and by_ray, (N, 2, 3), the pixel by the ray.
    by_point: (N, 2, 3) by the point in the reference frame. by_state: (N, 2, S) by the calibration, that point held.
    """

    rays: Array
    by_ray: Array
    by_point: Array
    by_state: Array


def panels(solution: Solution) -> Slab | None:
    """The solution's panels, with those parameters that it estimated; None where there are no panels."""
    if solution.rig.chamber is None:
        return None
    if solution.estimate is not None:
        return solution.estimate.slab
    return Slab(solution.rig.chamber)


def view(problem: Problem, layout: Layout, slab: Slab | None, role: Role, points: Array) -> View:
    """One camera's view of points of the reference frame, (N, 3) metres."""
    index = ROLES.index(role)
    rt = np.zeros(6) if index == 0 else problem.rt_cam_ref[index - 1]
    R, intrinsics = pose.rotation_matrix(rt[:3]), problem.intrinsics[index]
    u = points + R.T @ rt[3:]
    by_state = np.zeros((len(points), 2, layout.size))
    bent = None if slab is None else slabs.view(slab, u, -R.T @ rt[3:])
    apparent = (u if bent is None else bent.seen) @ R.T
    _, by_apparent, by_lens = versions.project_gradients(apparent, problem.lensmodel, intrinsics)
    by_point = by_apparent @ R if bent is None else by_apparent @ R @ bent.point
    by_state[..., layout.intrinsics[index]] = by_lens[..., layout.intrinsics_columns]
    if index and layout.extrinsics.stop:
        start = layout.extrinsics.start + 6 * (index - 1)
        around = by_apparent @ rotated_by(rt[:3], apparent @ R) - by_point @ rotated_by(-rt[:3], rt[3:])
        by_state[..., start : start + 3] = around
        by_state[..., start + 3 : start + 6] = by_point @ R.T
    if bent is not None:
        by_state[..., layout.slab] = by_apparent @ R @ bent.parameters
    length = np.linalg.norm(apparent, axis=-1)
    return View(apparent / length[:, None], by_apparent * length[:, None, None], by_point, by_state)


def along(problem: Problem, slab: Slab | None, role: Role, pixels: Array, distance: float) -> tuple[Array, Mask]:
    """Points that pixels, (N, 2), of a camera show at a distance from that camera's centre.

    Returns those for which there is an answer, (M, 3) metres in the reference frame, and which these are, (N,).
    """
    index = ROLES.index(role)
    rt = np.zeros(6) if index == 0 else problem.rt_cam_ref[index - 1]
    camera = Camera(problem.lensmodel, problem.intrinsics[index], *problem.sizes[index].tolist())
    inside = None if slab is None else slab.chamber.transformed(rt)
    rays = refraction.backproject(pixels, camera, inside)
    points = rays.at(distance)
    again, _ = refraction.project(points, camera, inside)  # no answer within the chamber, nor where the lens folds
    with np.errstate(invalid="ignore"):
        seen = np.linalg.norm(again - pixels, axis=-1) < 1e-2
    return pose.transform(pose.invert(rt), points[seen]), seen


def by_boards(problem: Problem, layout: Layout, points: Array) -> Array:
    """How points of the reference frame, (N, 3), move with the state, (N, 3, S), if the boards, on average, hold them.

    The mean over all boards, as in mrcal's `projection_uncertainty`.
    """
    moved = np.zeros((len(points), 3, layout.size))
    if not layout.frames.stop:
        return moved
    count = len(problem.rt_ref_board)
    for frame, rt in enumerate(problem.rt_ref_board):
        start = layout.frames.start + 6 * frame
        on_board = (points - rt[3:]) @ pose.rotation_matrix(rt[:3])
        moved[..., start : start + 3] = rotated_by(rt[:3], on_board) / count
        moved[..., start + 3 : start + 6] = np.eye(3) / count
    return moved


def by_camera(problem: Problem, layout: Layout, role: Role, points: Array) -> Array:
    """How points of the reference frame, (N, 3), move with the state, (N, 3, S), if a camera holds them."""
    moved, index = np.zeros((len(points), 3, layout.size)), ROLES.index(role)
    if index and layout.extrinsics.stop:  # P = R'(p - t) with p held
        rt, start = problem.rt_cam_ref[index - 1], layout.extrinsics.start + 6 * (index - 1)
        back = pose.rotation_matrix(rt[:3]).T
        in_camera = pose.transform(rt, points)
        moved[..., start : start + 3] = -rotated_by(-rt[:3], in_camera - rt[3:])
        moved[..., start + 3 : start + 6] = -back
    return moved


def by_dry_pixel(seen: View, points: Array) -> Array:
    """How the points that fixed dry pixels show at a fixed distance move with the state, (N, 3, S).

    seen: the dry camera's view of these points, (N, 3). The pixel fixes two directions, the distance the third.
    """
    held = np.concatenate([seen.by_point, (points / np.linalg.norm(points, axis=-1, keepdims=True))[:, None]], 1)
    shift = np.concatenate([seen.by_state, np.zeros((len(points), 1, seen.by_state.shape[-1]))], 1)
    return np.asarray(-np.linalg.solve(held, shift))
