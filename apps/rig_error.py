"""How far a rig that was found is from the true one, in pixels far away."""

from __future__ import annotations

import numpy as np

from rainstereo import Camera, Rig
from rainstereo.pose import rotation_matrix
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array


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


def far_rays(rig: Rig) -> Array:
    """Unit rays, (N, 3), of a grid of pixels of the dry image, then of the wet one, in the frame of the dry camera."""
    return np.concatenate([_directions(rig, role) for role in ROLES])


def matching_error(found: Rig, truth: Rig) -> float:
    """By how many pixels the found rig mistakes which pixels of its two cameras see the same far point: RMS over a
    grid of the dry image. What both cameras get wrong alike does not show."""
    pixels = _grid(truth.dry)

    def match(rig: Rig) -> Array:
        rays = rig.dry.unproject(pixels) @ rotation_matrix(rig.wet.rt_cam_ref[:3]).T
        matched: Array = rig.wet.project(rays)
        return matched

    difference = match(found) - match(truth)
    return float(np.sqrt(np.nanmean((difference**2).sum(-1))))


def _directions(rig: Rig, role: Role) -> Array:
    """Unit rays (N, 3) of a grid of pixels, in the frame of the dry camera."""
    camera = rig.camera(role)
    directions: Array = camera.unproject(_grid(camera)) @ rotation_matrix(camera.rt_cam_ref[:3])
    return directions


def _grid(camera: Camera) -> Array:
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 25))
    return np.asarray(np.stack([x, y], -1).reshape(-1, 2), np.float64)
