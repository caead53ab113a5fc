"""Covariance of triangulated points: against differences, against mrcal's own, and in its limits."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import pose, refraction
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import point_uncertainty, uncertainty
from rainstereo.calib.solve import Solution
from rainstereo.rig import Rig
from rainstereo.triangulation import triangulate
from rainstereo.types import Array

from . import synthetic

INSIDE = synthetic.chamber(15)
"""What `through`, of conftest, looks through."""
POINTS = np.array([[0.05, 0.02, 0.5], [-0.3, 0.2, 2.0], [1.0, -0.6, 6.0]])


def seen(rig: Rig, points: Array) -> tuple[Array, Array]:
    dry, _ = refraction.project(points, rig.dry, rig.chamber)
    wet, _ = refraction.project(pose.transform(rig.rt_wet_dry, points), rig.wet, rig.chamber_in("wet"))
    return dry, wet


def test_points_without_panels_are_mrcals(bare: Solution, tmp_path: Path) -> None:
    mrcal = versions.load()
    bare.rig.save(tmp_path / "rig")
    models = [mrcal.cameramodel(str(tmp_path / "rig" / f"{role}.cameramodel")) for role in ("dry", "wet")]
    dry, wet = seen(bare.rig, POINTS)
    pairs = np.ascontiguousarray(np.stack([dry, wet], 1))
    cov = uncertainty.covariance(bare)
    theirs, calibration, noise, _ = mrcal.triangulate(
        pairs,
        models,
        q_calibration_stdev=cov.sigma,
        q_observation_stdev=0.1,
        q_observation_stdev_correlation=0.0,
        stabilize_coords=False,
    )
    ours = point_uncertainty.triangulate_with_covariance(bare, dry, wet, pixel_sigma=0.1, cov=cov)
    np.testing.assert_allclose(ours.points, theirs, rtol=1e-7)
    count = range(len(POINTS))
    np.testing.assert_allclose(ours.from_calibration, calibration[count, :, count], rtol=1e-2, atol=1e-11)
    np.testing.assert_allclose(
        ours.from_pixels[:, 2, 2], noise[count, 2, count, 2] if noise.ndim == 4 else noise[:, 2, 2], rtol=1e-2
    )


def test_derivative_by_the_calibration(through: Solution) -> None:
    cov = uncertainty.covariance(through)
    dry, wet = seen(through.rig, POINTS)
    found = point_uncertainty.triangulate_with_covariance(through, dry, wet, pixel_sigma=0.1, cov=cov)
    np.testing.assert_allclose(found.points, POINTS, rtol=1e-9)
    dry_lens, wet_lens, between = (span.start for span in (*cov.layout.intrinsics, cov.layout.extrinsics))
    for column in (dry_lens, wet_lens + 2, *range(between, between + 6)):
        step = 1e-3 * np.sqrt(cov.matrix[column, column])
        up, down = (triangulate(changed(through, column, s), dry, wet).points for s in (step, -step))
        scale = np.abs(found.by_calibration[..., column]).max(-1, keepdims=True)
        np.testing.assert_allclose(
            found.by_calibration[..., column] / scale, (up - down) / (2 * step) / scale, atol=1e-4
        )


def changed(solution: Solution, column: int, step: float) -> Rig:
    at = versions.linearize(solution.problem)
    packed = at.packed.copy()
    packed[column] += step / at.scale[column]
    other = solution.problem.copy()
    versions.ingest(other, packed)
    rig = solution.rig
    dry, wet = (
        type(rig.dry)(rig.dry.model, k, *rig.dry.size, pose)
        for k, pose in zip(other.intrinsics, (np.zeros(6), other.rt_cam_ref[0]), strict=True)
    )
    return Rig(dry, wet, rig.chamber)


def test_depth_sigma_grows_with_the_square_of_the_depth(through: Solution) -> None:
    """z = f b / d: a pixel's noise makes sigma_z = z^2 / (f b) sqrt(2) sigma; the calibration adds to it."""
    depths = np.array([0.5, 2.0, 20.0])
    found = point_uncertainty.at_depths(through, depths, pixel_sigma=0.1)
    np.testing.assert_allclose(found.points[:, 2], depths, rtol=1e-9)
    expected = depths**2 / (1200 * synthetic.BASELINE) * np.sqrt(2) * 0.1
    np.testing.assert_allclose(np.sqrt(found.from_pixels[:, 2, 2]), expected, rtol=0.03)
    assert (found.depth_sigma > np.sqrt(found.from_pixels[:, 2, 2])).all()
    exact = point_uncertainty.at_depths(through, depths, pixel_sigma=0.0)
    np.testing.assert_allclose(exact.covariance, found.from_calibration, rtol=1e-9)


def test_what_has_no_answer(through: Solution) -> None:
    dry, wet = seen(through.rig, POINTS)
    wet[1] = dry[1] + [-300, 0]
    found = point_uncertainty.triangulate_with_covariance(through, dry, wet, pixel_sigma=0.1)
    assert found.status[1] != 0
    assert np.isnan(found.covariance[1]).all()
    assert np.isfinite(found.covariance[[0, 2]]).all()
    with pytest.raises(ValueError, match="0 or more"):
        point_uncertainty.at_depths(through, np.array([1.0]), pixel_sigma=-1.0)
