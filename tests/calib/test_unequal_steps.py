"""Boards with unequal steps: the same least squares as mrcal's on a finer regular lattice, and the truth in the end."""

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo.calib import adjust, board_shape, information, uncertainty, unequal_steps
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.board import Board
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.solve import solve

from . import synthetic

GRID = Board.parse("aprilgrid:4x3:24mm:0.5")
MODEL = "LENSMODEL_OPENCV5"


def problem_of(board: Board, frames: int, noise: float = 0.3) -> Problem:
    """Boards seen by the synthetic rig, the state beside the truth."""
    true, rt = synthetic.rig(), synthetic.poses(frames, 3, board, near=0.2, far=0.4)
    seen = synthetic.observe(true, rt, board, noise=noise)
    problem = adjust.assemble(
        np.stack([seen.dry, seen.wet]),
        [synthetic.SIZE] * 2,
        board.square,
        adjust.lattice_of(board.points, board.square),
    )
    return problem.copy(
        lensmodel=MODEL,
        intrinsics=np.array([true.dry.intrinsics, true.wet.intrinsics]) * 1.001,
        rt_cam_ref=np.array([true.rt_wet_dry]) + 1e-4,
        rt_ref_board=rt + 1e-4,
        warp=np.array([1e-4, -2e-4]),
        free=Free(core=True, distortions=True, warp=True),
    )


def test_rows_are_those_of_mrcal_on_a_finer_lattice() -> None:
    """mrcal itself, given the corners as seen nodes of a lattice of gap's width, is the second formulation."""
    problem = problem_of(GRID, 3)
    problem.observations[1, 2, 3, 2] = -1  # an outlier
    assert problem.lattice is not None
    fine = unequal_steps.as_regular(problem)
    assert fine is not None
    assert fine.observations.shape[1:3] == (3 * 3, 4 * 3)  # a gap is a step, a tag two
    assert fine.spacing == pytest.approx(0.012)
    ours, theirs = versions.linearize(problem), versions.linearize(fine)
    y, x = (np.round(along / fine.spacing).astype(int) for along in reversed(problem.lattice))
    nodes = np.arange(theirs.boards).reshape(*fine.observations.shape[:3], 2)[:, y[:, None], x].ravel()
    assert np.abs(ours.residuals[: ours.boards] - theirs.residuals[nodes]).max() < 1e-9
    difference = ours.jacobian[: ours.boards].toarray() - theirs.jacobian[nodes].toarray()
    assert np.abs(difference).max() < 1e-8 * np.abs(theirs.jacobian[nodes].toarray()).max()
    off = versions.residuals(problem)
    assert np.isnan(off[1, 2, 3]).all()
    assert np.nanmax(np.abs(off - versions.residuals(fine)[:, y[:, None], x])) < 1e-9


def test_the_minimum_is_that_of_mrcal() -> None:
    problem = problem_of(GRID, 8)
    problem.regularization = False  # mrcal weighs it by the number of nodes, seen or not
    fine = unequal_steps.as_regular(problem)
    assert fine is not None
    versions.optimize(problem)
    versions.optimize(fine)
    assert np.abs(problem.intrinsics[:, :4] - fine.intrinsics[:, :4]).max() < 1e-2
    assert np.abs(problem.rt_cam_ref - fine.rt_cam_ref).max() < 1e-6
    assert adjust.fit(problem) == pytest.approx(adjust.fit(fine), rel=1e-6)


@pytest.mark.parametrize("tilt", [None, 15.0])
def test_a_few_views_of_an_aprilgrid_lead_to_the_truth(tilt: float | None) -> None:
    inside = None if tilt is None else synthetic.chamber(tilt)
    true = synthetic.rig(inside)
    seen = synthetic.observe(true, synthetic.poses(8, 1, GRID), GRID)
    assert np.isnan(seen.dry).any()  # partial views
    solution = solve(seen, MODEL, inside)
    assert len(solution.names) == 8
    assert solution.rig.baseline == pytest.approx(synthetic.BASELINE, abs=1e-8)
    assert uncertainty.infinity_error(solution.rig, true).stereo.max < 1e-3
    shape = board_shape.examine(solution)
    assert shape is not None
    assert abs(shape.twist) < 1e-9


def test_noise_ends_where_it_was_predicted_to() -> None:
    true = synthetic.rig()
    seen = synthetic.observe(true, synthetic.poses(16, 2, GRID), GRID, noise=0.1, seed=4)
    solution = solve(seen, MODEL)
    assert solution.rms_px == pytest.approx(0.1, rel=0.05)
    sigma = uncertainty.baseline_sigma(solution)
    assert abs(solution.rig.baseline - synthetic.BASELINE) < 4 * sigma
    expected = uncertainty.stereo_infinity_uncertainty(solution)
    assert uncertainty.infinity_error(solution.rig, true).stereo.rms < expected.rms_limit(3.5)
    assert solution.rig.dry.carried


def test_thinned_boards_tell_as_much_as_the_regular_boards_that_they_are() -> None:
    """Guidance asks what every second corner of a board would say; for an AprilGrid these stand at equal steps."""
    problem = problem_of(GRID, 3)
    assert problem.lattice is not None
    poses, weight = synthetic.poses(2, 9, GRID, near=0.2, far=0.4), np.ones((2, 2, 3, 4))
    ours = information.of_poses(problem, None, poses, weight, 2 * problem.spacing)
    regular = problem.copy(spacing=GRID.square * 1.5, observations=problem.observations[:, ::2, ::2], lattice=None)
    theirs = information.of_poses(regular, None, poses, weight, regular.spacing)
    # the bending is counted from the rim of the corners that there are, in both
    assert np.abs(ours - theirs).max() < 1e-9 * np.abs(theirs).max()


def test_a_lattice_too_fine_for_mrcal_is_left_out_of_the_file() -> None:
    problem = problem_of(Board.parse("aprilgrid:4x3:24mm:0.3137"), 3)
    assert unequal_steps.as_regular(problem) is None
    assert versions.carried(problem) == [{}, {}]
    with pytest.raises(ValueError, match="equal steps only"):
        versions.optimize(problem, outliers=True)
