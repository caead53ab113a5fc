"""Uncertainty at any range, through the panels: against mrcal's own, against differences, and in its limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Camera, Chamber, Panel, Rig, pose, refraction
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import range_uncertainty, sensitivity, uncertainty
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Covariance
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array

from . import synthetic

INSIDE = synthetic.chamber(15)
"""What `through`, of conftest, looks through."""


def stereo_pixels(rig: Rig, dry: Array, distance: float) -> Array:
    """Second formulation of the map from a dry pixel to the wet pixel: rays and projections of the core."""
    rays = refraction.backproject(dry, rig.dry, rig.chamber)
    ahead = (rays.origins * rays.directions).sum(-1)
    length = np.sqrt(ahead**2 - (rays.origins**2).sum(-1) + distance**2) - ahead
    points = pose.transform(rig.rt_wet_dry, rays.origins + length[:, None] * rays.directions)
    return refraction.project(points, rig.wet, rig.chamber_in("wet"))[0]


def changed(problem: versions.Problem, column: int, step: float) -> versions.Problem:
    at = versions.linearize(problem)
    packed = at.packed.copy()
    packed[column] += step / at.scale[column]
    other = problem.copy()
    versions.ingest(other, packed)
    return other


def rig_of(problem: versions.Problem, chamber: Chamber | None) -> Rig:
    dry, wet = (Camera(problem.lensmodel, k, *synthetic.SIZE) for k in problem.intrinsics)
    return Rig(dry, wet.with_pose(problem.rt_cam_ref[0]), chamber)


# -- mrcal's own ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", [0.3, 2.0, 500.0])
def test_agrees_with_mrcal_at_any_range(bare: Solution, distance: float, tmp_path: Path) -> None:
    mrcal = versions.load()
    bare.rig.save(tmp_path / "rig")
    cov = uncertainty.covariance(bare)
    for role in ROLES:
        ours = range_uncertainty.projection_uncertainty(bare, role, distance, (4, 3), cov=cov)
        model = mrcal.cameramodel(str(tmp_path / "rig" / f"{role}.cameramodel"))
        rays = mrcal.unproject(np.ascontiguousarray(ours.pixels), *model.intrinsics(), normalize=True)
        theirs = mrcal.projection_uncertainty(
            rays * distance, model, what="covariance", observed_pixel_uncertainty=cov.sigma
        )
        np.testing.assert_allclose(ours.covariance, theirs, rtol=1e-5, atol=1e-12)


# -- derivatives ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", [0.4, 3.0])
def test_stereo_derivative_against_differences(through: Solution, distance: float) -> None:
    cov = uncertainty.covariance(through)
    dry = uncertainty.image_grid(np.array(synthetic.SIZE), (3, 2)).reshape(-1, 2)
    F, shown = range_uncertainty.stereo_gradient(through, dry, distance, cov)
    assert shown.all()
    layout, problem = cov.layout, through.problem
    for span in (*layout.intrinsics, layout.extrinsics):
        for column in range(span.start, span.stop):
            step = 1e-3 * np.sqrt(cov.matrix[column, column])
            up, down = (
                stereo_pixels(rig_of(changed(problem, column, s), INSIDE), dry, distance) for s in (step, -step)
            )
            scale = np.abs(F[..., column]).max()
            np.testing.assert_allclose(F[..., column] / scale, (up - down) / (2 * step) / scale, atol=1e-5)
    assert not F[..., layout.frames].any()  # no board has a say in it


def extended(cov: Covariance, count: int) -> Covariance:
    return replace(cov, matrix=np.pad(cov.matrix, (0, count)), layout=cov.layout.with_slab(count))


def test_slab_derivatives_against_differences(through: Solution) -> None:
    slab = Slab(INSIDE, ("tilt", "thickness", "index"))
    count = len(slab.names)
    cov = extended(uncertainty.covariance(through), count)
    dry = uncertainty.image_grid(np.array(synthetic.SIZE), (3, 2)).reshape(-1, 2)
    F, _ = range_uncertainty.stereo_gradient(through, dry, 0.5, cov, slab)
    for k in range(count):
        step = 1e-6 * np.eye(count)[k]
        up, down = (stereo_pixels(rig_of(through.problem, slab.moved(s).chamber), dry, 0.5) for s in (step, -step))
        scale = np.abs(F[..., cov.layout.slab][..., k]).max()
        numeric = (up - down) / 2e-6
        np.testing.assert_allclose(F[..., cov.layout.slab][..., k] / scale, numeric / scale, atol=1e-5)


@pytest.mark.parametrize("role", ROLES)
def test_a_camera_and_its_boards_against_differences(through: Solution, role: Role) -> None:
    """Gauge "boards": points are carried by the mean of the boards while everything else changes."""
    cov, problem, index = uncertainty.covariance(through), through.problem, ROLES.index(role)
    slab = Slab(INSIDE)
    pixels = uncertainty.image_grid(np.array(synthetic.SIZE), (3, 2)).reshape(-1, 2)
    points, _ = sensitivity.along(problem, slab, role, pixels, 0.5)
    seen = sensitivity.view(problem, cov.layout, slab, role, points)
    F = seen.by_state + seen.by_point @ sensitivity.by_boards(problem, cov.layout, points)

    def image(of: versions.Problem) -> Array:
        held = [pose.transform(rt, pose.transform(pose.invert(was), points))
                for rt, was in zip(of.rt_ref_board, problem.rt_ref_board, strict=True)]  # fmt: skip
        rig = rig_of(of, INSIDE)
        camera = rig.camera(role)
        in_camera = pose.transform(camera.rt_cam_ref, np.mean(held, 0))
        return refraction.project(in_camera, camera, rig.chamber_in(role))[0]

    layout = cov.layout
    some = (layout.intrinsics[index].start, layout.extrinsics.start + 1, layout.extrinsics.start + 3,
            layout.frames.start, layout.frames.start + 4, layout.frames.start + 8)  # fmt: skip
    for column in some:
        step = 1e-3 * np.sqrt(cov.matrix[column, column])
        up, down = (image(changed(problem, column, s)) for s in (step, -step))
        scale = max(np.abs(F[..., column]).max(), 1e-9)
        np.testing.assert_allclose(F[..., column] / scale, (up - down) / (2 * step) / scale, atol=2e-5)


# -- limits --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", ["boards", "image"])
def test_far_away_is_infinity(through: Solution, gauge: uncertainty.Gauge) -> None:
    cov = uncertainty.covariance(through)
    for role in ROLES:
        far, infinite = (
            range_uncertainty.projection_uncertainty(through, role, d, (5, 4), gauge=gauge, cov=cov).covariance
            for d in (1e5, np.inf)
        )
        np.testing.assert_allclose(far, infinite, rtol=2e-3, atol=1e-9)
    far, infinite = (
        range_uncertainty.stereo_uncertainty(through, d, (5, 4), cov=cov).covariance for d in (1e5, np.inf)
    )
    np.testing.assert_allclose(far, infinite, rtol=2e-3, atol=1e-9)


def test_a_slab_of_no_thickness_is_none(bare: Solution) -> None:
    cov = uncertainty.covariance(bare)
    nothing = Slab(Chamber((0, 0.2, 1), 0.04, (Panel(0.0, 1.49),)))
    for distance in (0.3, 2.0):
        np.testing.assert_allclose(
            range_uncertainty.stereo_uncertainty(bare, distance, (4, 3), cov=cov, slab=nothing).covariance,
            range_uncertainty.stereo_uncertainty(bare, distance, (4, 3), cov=cov).covariance,
            rtol=1e-9,
        )


def test_within_the_chamber_there_is_no_answer(through: Solution) -> None:
    assert range_uncertainty.stereo_uncertainty(through, 0.05, (4, 3)).reach == 0
    with pytest.raises(ValueError, match="more than 0"):
        range_uncertainty.stereo_uncertainty(through, -1)
