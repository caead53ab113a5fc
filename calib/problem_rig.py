"""The rig that the state of a calibration problem stands for."""

from __future__ import annotations

import numpy as np

from rainstereo.calib.mrcal_versions import Problem
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.rig import Rig


def rig_of(problem: Problem, chamber: Chamber | None = None) -> Rig:
    """Both cameras as they stand, behind a chamber given in the dry camera's frame."""
    poses = np.zeros(6), problem.rt_cam_ref[0]
    dry, wet = (
        Camera(problem.lensmodel, problem.intrinsics[i], int(width), int(height), poses[i])
        for i, (width, height) in enumerate(problem.sizes)
    )
    return Rig(dry, wet, chamber)
