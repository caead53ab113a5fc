"""Exact residuals and normal equations through panels: against the core's refraction, and against differences."""

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, Panel
from rainstereo.calib import adjust, mrcal_versions, refracted
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Slab
from rainstereo.rig import ROLES

from . import synthetic

WARP = (3e-4, -2e-4)


def problem_at_truth(chamber: Chamber, **changes: object) -> tuple[Problem, np.ndarray]:
    """A problem whose state is the true one, and the corners seen through the chamber."""
    true, rt = synthetic.rig(chamber), synthetic.poses(5, 2)
    seen = synthetic.observe(true, rt, warp=WARP)
    made = adjust.assemble(np.stack([seen.dry, seen.wet]), [synthetic.SIZE] * 2, seen.board.square).copy(
        lensmodel="LENSMODEL_OPENCV5",
        intrinsics=np.stack([true.dry.intrinsics, true.wet.intrinsics]),
        rt_cam_ref=true.rt_wet_dry[None].copy(),
        rt_ref_board=rt,
        warp=np.array(WARP),
        free=Free(core=True, distortions=True, warp=True),
        regularization=False,
    )
    return made.copy(**changes), made.observations[..., :2].copy()


@pytest.mark.parametrize("tilt_deg", [0, 20, 50])
def test_pixels_are_those_of_the_core(tilt_deg: float) -> None:
    chamber = synthetic.chamber(tilt_deg)
    problem, observed = problem_at_truth(chamber)
    taking_part = problem.observations[..., 2] > 0
    off = refracted.pixels(problem, chamber) - observed
    assert np.abs(off[taking_part]).max() < 1e-9
    assert refracted.cost(problem, observed, chamber) < 1e-15


def test_frames_before_no_panels_are_those_of_mrcal() -> None:
    """A camera may have seen no frame through the panels; the equations then are the bare ones, which mrcal knows."""
    chamber = synthetic.chamber(20)
    problem, observed = problem_at_truth(chamber, regularization=True)
    problem.observations[..., :2] += np.random.default_rng(2).normal(size=observed.shape)
    nowhere = np.zeros(len(problem.rt_ref_board), dtype=np.bool_)
    normal = refracted.normal_equations(
        problem, problem.observations[..., :2], Panels(Slab(chamber, ("tilt",)), nowhere)
    )
    at = mrcal_versions.linearize(problem)
    own = slice(0, len(at.packed))
    expected = (at.jacobian.T @ at.jacobian).toarray()
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        normal.matrix[own, own] / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-9
    )
    np.testing.assert_allclose(normal.gradient[own] / scale, at.jacobian.T @ at.residuals / scale, atol=1e-7)
    assert normal.cost == pytest.approx(float(at.residuals @ at.residuals), rel=1e-9)
    np.testing.assert_array_equal(normal.matrix[normal.layout.slab], 0)


FREEDOMS = (
    Free(core=True, distortions=True, warp=True),
    Free(core=False, distortions=True),
    Free(core=True),
    Free(extrinsics=False),
)


@pytest.mark.parametrize("free", FREEDOMS)
@pytest.mark.parametrize("tilt_deg", [0, 35])
def test_gradient_and_moves_match_differences_for_every_state(free: Free, tilt_deg: float) -> None:
    chamber = synthetic.chamber(tilt_deg)
    problem, observed = problem_at_truth(chamber, free=free)
    observed += np.random.default_rng(1).normal(size=observed.shape)
    normal = refracted.normal_equations(problem, observed, chamber)
    assert normal.cost == pytest.approx(refracted.cost(problem, observed, chamber), rel=1e-12)
    for k in range(len(normal.packed)):
        ends, moved = [], []
        for sign in (1, -1):
            trial = problem.copy()
            mrcal_versions.ingest(trial, normal.packed + sign * 1e-5 * np.eye(len(normal.packed))[k])
            ends.append(refracted.cost(trial, observed, chamber))
            moved.append(refracted.pixels(trial, chamber))
        slope = (ends[0] - ends[1]) / 2e-5
        scale = np.sqrt(normal.matrix[k, k] * normal.cost)
        assert 2 * normal.gradient[k] == pytest.approx(slope, abs=1e-5 * scale)
        taking_part = problem.observations[..., 2] > 0
        square = np.sum(((moved[0] - moved[1])[taking_part] / 2e-5) ** 2)
        assert normal.matrix[k, k] == pytest.approx(square, rel=1e-5)


def test_without_refraction_they_are_those_of_mrcal() -> None:
    air = Chamber((0, 0.3, 1), 0.04, (Panel(0.004, 1.0),))
    problem, observed = problem_at_truth(air)
    problem.regularization = True
    problem.observations[0, :2, :3, 2] = -1
    problem.observations[..., 2] *= 0.5
    problem.intrinsics[:, 2] += 0.3
    normal, at = refracted.normal_equations(problem, observed, air), mrcal_versions.linearize(problem)
    expected = (at.jacobian.T @ at.jacobian).toarray()
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((normal.matrix - expected) / size).max() < 1e-8
    np.testing.assert_allclose(
        normal.gradient, at.jacobian.T @ at.residuals, rtol=1e-6, atol=1e-6 * np.sqrt(normal.cost)
    )
    assert normal.cost == pytest.approx(float(np.sum(at.residuals**2)), rel=1e-9)


def test_outliers_and_unseen_corners_carry_nothing() -> None:
    chamber = synthetic.chamber(20)
    problem, observed = problem_at_truth(chamber)
    problem.observations[2, 1:3, 1:4, 2] *= -1
    spoiled = observed.copy()
    spoiled[problem.observations[..., 2] <= 0] += 50
    before, after = (refracted.normal_equations(problem, corners, chamber) for corners in (observed, spoiled))
    np.testing.assert_array_equal(before.matrix, after.matrix)
    np.testing.assert_array_equal(before.gradient, after.gradient)


def test_roles_stand_in_the_order_of_the_problem() -> None:
    assert ROLES == ("dry", "wet")
