"""What a capture lacks, in words for the person who holds the board: leans, distances and parts of the images.

Plain counting, which also helps where there is no covariance to speak of. `guidance` computes which single pose would
help most.
"""

from __future__ import annotations

import numpy as np

from rainstereo import pose
from rainstereo.calib.solve import Solution
from rainstereo.rig import ROLES
from rainstereo.types import Array, Mask

LEANING = np.deg2rad(20.0)
NEAR_ENOUGH = 1.6
"""Times the distance at which the board fills the image."""
SPREAD = 2.0
"""The farthest board should be so many times as far as the nearest."""
CELLS = (15, 12)
PLACES = (("top left corner", "top edge", "top right corner"), ("left edge", "middle", "right edge"),
          ("bottom left corner", "bottom edge", "bottom right corner"))  # fmt: skip
SIDES = ("right", "left", "bottom", "top")


def missing(solution: Solution) -> tuple[str, ...]:
    """One sentence for each thing that the frames used lack, with the pose to take; empty where nothing is missing."""
    return (*leans(solution), *distances(solution), *places(solution))


def leans(solution: Solution) -> list[str]:
    """Sides of the board that were never turned towards the cameras by LEANING or more."""
    normals = pose.rotation_matrix(solution.rt_ref_board[:, :3])[..., 2]
    x, y = np.arctan2(normals[:, 0], normals[:, 2]), np.arctan2(normals[:, 1], normals[:, 2])
    turned = dict(zip(SIDES, (x, -x, y, -y), strict=True))
    found = [side for side, angle in turned.items() if not (angle >= LEANING).any()]
    if not found:
        return []
    largest = max(np.degrees(max(turned[side].max(), 0.0)) for side in found)
    return [
        f"no board has its {_listed(found)} side nearer by {np.degrees(LEANING):.0f} degrees or more (at most "
        f"{largest:.0f}): hold one for each so, leaning by 30 to 45 degrees"
    ]


def distances(solution: Solution) -> list[str]:
    """Whether boards stood near enough, and at different distances."""
    centre, extent = _centres(solution)
    far = np.linalg.norm(centre, axis=-1)
    camera = solution.rig.dry
    filling = float(
        max(extent[0] * camera.intrinsics[0] / camera.width, extent[1] * camera.intrinsics[1] / camera.height)
    )
    found = []
    if far.min() > NEAR_ENOUGH * filling:
        found.append(
            f"the nearest board was {far.min():.2f} m away: hold some at about {1.15 * filling:.2f} m, where it nearly "
            "fills the image"
        )
    if far.max() < SPREAD * far.min():
        found.append(
            f"all boards were {far.min():.2f} to {far.max():.2f} m away: hold some at {SPREAD * 1.25 * far.min():.2f} m"
        )
    return found


def places(solution: Solution) -> list[str]:
    """Parts of the images of which less than half was covered by corners."""
    found = []
    for camera, role in enumerate(ROLES):
        seen = covered(solution, camera)
        parts = [
            PLACES[i][j]
            for i, band in enumerate(np.array_split(seen, 3))
            for j, part in enumerate(np.array_split(band, 3, axis=1))
            if part.mean() < 0.5
        ]
        if len(parts) == 9:
            found.append(f"the {role} camera's image is hardly covered anywhere: hold the board all over it")
        elif parts:
            found.append(f"hardly a corner in the {_listed(parts)} of the {role} camera's image: hold the board there")
    return found


def covered(solution: Solution, camera: int) -> Mask:
    """Which cells of a camera's image, (rows, columns), hold a corner."""
    problem = solution.problem
    rows = problem.indices[:, 1] == camera
    views = problem.observations[rows]
    xy = views[views[..., 2] > 0][:, :2]
    width, height = problem.sizes[camera]
    counts, _, _ = np.histogram2d(
        xy[:, 1], xy[:, 0], bins=(CELLS[1], CELLS[0]), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    return np.asarray(counts > 0)


def _centres(solution: Solution) -> tuple[Array, Array]:
    """Middles of the boards in the dry camera's frame, (F, 3), and the board's width and height, metres."""
    problem = solution.problem
    points = problem.board().reshape(-1, 3)
    R = pose.rotation_matrix(solution.rt_ref_board[:, :3])
    return R @ points.mean(0) + solution.rt_ref_board[:, 3:], np.ptp(points, axis=0)[:2]


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
