"""A twisted board is told from a flat one, with and without a chamber, and the columns are the derivatives."""

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, pose, refraction
from rainstereo.calib import board_shape, checks
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.board_shape import SHAPES
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import solve
from rainstereo.rig import ROLES
from rainstereo.types import Array

from . import synthetic

MODEL = "LENSMODEL_OPENCV5"


def twisted(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    """Boards of the synthetic rig are twisted on top of their bending; own formula: a bilinear patch."""
    flat = synthetic.bent

    def bent(board: synthetic.Board, warp: tuple[float, float]) -> Array:
        points = flat(board, warp)
        s, t = np.linspace(0, 1, board.columns), np.linspace(0, 1, board.rows)[:, None]
        points[..., 2] += size * ((1 - s) * (1 - t) + s * t - s * (1 - t) - (1 - s) * t)  # corners + - + -
        return points

    monkeypatch.setattr(synthetic, "bent", bent)


def observed(inside: Chamber | None, seed: int) -> Observations:
    rt = synthetic.poses(30, seed)
    return synthetic.observe(synthetic.rig(inside), rt, noise=0.1, seed=seed, warp=(1e-4, -2e-4))


@pytest.mark.parametrize("tilt", [None, 15.0])
def test_a_twist_of_a_fifth_of_a_millimetre_is_found(tilt: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = None if tilt is None else synthetic.chamber(tilt)
    twisted(monkeypatch, 2e-4)
    seen = observed(inside, 0)
    solution = solve(seen, MODEL, inside)
    found = board_shape.examine(solution)
    assert found is not None
    assert found.twist_sigmas > 20
    assert found.twist == pytest.approx(2e-4, abs=5 * found.twist_sigma)
    assert found.twist_sigma < 4e-6
    assert found.ripple_sigmas < 5
    assert found.corner_sigma == pytest.approx(0.1, rel=0.03)
    verdict = checks.judge(seen, solution, shape=found)
    assert verdict.status == "doubtful"
    assert [f.text for f in verdict.findings if "twisted: its corners stand 0.20 +- 0.00 mm" in f.text]


@pytest.mark.parametrize("tilt", [None, pytest.param(15.0, marks=pytest.mark.slow)])
def test_a_flat_board_is_not_called_twisted(tilt: float | None) -> None:
    inside = None if tilt is None else synthetic.chamber(tilt)
    found = board_shape.examine(solve(observed(inside, 1), MODEL, inside))
    assert found is not None
    assert max(found.twist_sigmas, found.ripple_sigmas) < 4
    assert not checks.board(found)


@pytest.mark.slow
def test_amplitudes_scatter_as_predicted() -> None:
    """Six seeds, bare: the twist's pull is that of a normal variable."""
    pulls = []
    for seed in range(20, 26):
        found = board_shape.examine(solve(observed(None, seed), MODEL))
        assert found is not None
        assert found.ripple_sigmas < 5
        pulls.append(found.twist / found.twist_sigma)
    assert max(map(abs, pulls)) < 4
    assert 0.05 < np.mean(np.square(pulls)) < 3.8  # chi-squared, 6 degrees of freedom: one in a thousand


def exact_problem() -> tuple[Problem, Array]:
    """A small problem at the truth, and its corners seen through the chamber."""
    inside = synthetic.chamber(25)
    true, rt = synthetic.rig(inside), synthetic.poses(3, 5, near=0.3, far=0.5)
    board = synthetic.BOARD
    frame, camera = np.divmod(np.arange(6), 2)
    shape = (6, board.rows, board.columns)
    problem = Problem(
        lensmodel=MODEL,
        intrinsics=np.array([true.dry.intrinsics, true.wet.intrinsics]),
        rt_cam_ref=np.array([true.rt_wet_dry]),
        rt_ref_board=rt,
        observations=np.concatenate([np.zeros((*shape, 2)), np.ones((*shape, 1))], -1),
        indices=np.column_stack([frame, camera, camera - 1]).astype(np.int32),
        sizes=np.array([synthetic.SIZE] * 2, dtype=np.int32),
        spacing=board.square,
        warp=np.zeros(2),
        free=Free(core=True, distortions=True, warp=True),
    )
    return problem, drawn(problem, inside, np.zeros(shape[1:]))


def drawn(problem: Problem, inside: Chamber | None, heights: Array) -> Array:
    """Pixels of the corners, (M, rows, columns, 2), of a board with these heights: the core's own projection."""
    true = synthetic.rig(inside)
    found = []
    for frame, camera, _ in problem.indices:
        points = np.array(synthetic.BOARD.points)
        points[..., 2] = heights
        role = ROLES[camera]
        at = pose.transform(pose.compose(true.camera(role).rt_cam_ref, problem.rt_ref_board[frame]), points)
        pixels, _ = refraction.project(at.reshape(-1, 3), true.camera(role), true.chamber_in(role))
        found.append(pixels.reshape(*points.shape[:2], 2))
    return np.array(found)


@pytest.mark.parametrize("through", [False, True])
def test_columns_are_the_derivatives_by_finite_differences(through: bool) -> None:
    problem, seen = exact_problem()
    inside = synthetic.chamber(25) if through else None
    problem.observations[..., :2] = seen if through else drawn(problem, None, np.zeros(seen.shape[1:3]))
    linear = board_shape._through(problem, seen, inside) if inside else board_shape._bare(problem)
    order = np.argsort(problem.indices[:, 1], kind="stable") if inside else np.arange(6)
    x, y = np.linspace(-1, 1, synthetic.BOARD.columns), np.linspace(-1, 1, synthetic.BOARD.rows)[:, None]
    heights = (x * y, x**3 - x + 0 * y, y**3 - y + 0 * x, (x**2 - 1) * y, x * (y**2 - 1))
    for k, height in enumerate(heights):
        h = 1e-5
        by_difference = (drawn(problem, inside, h * height) - drawn(problem, inside, -h * height)) / (2 * h)
        column = linear.columns[:, k].reshape(by_difference.shape)
        assert np.abs(column - by_difference[order]).max() < 1e-5 * np.abs(by_difference).max(), SHAPES[k]


def test_a_linear_step_is_what_solving_with_the_shape_taken_off_gives() -> None:
    """Independent of the algebra: corners of a slightly twisted board; the twist taken off them, solved again."""
    problem, _ = exact_problem()
    problem = problem.copy(rt_ref_board=synthetic.poses(14, 2, near=0.25, far=0.5))
    frame, camera = np.divmod(np.arange(28), 2)
    shape = (28, synthetic.BOARD.rows, synthetic.BOARD.columns)
    problem.indices = np.column_stack([frame, camera, camera - 1]).astype(np.int32)
    problem.observations = np.concatenate([np.zeros((*shape, 2)), np.ones((*shape, 1))], -1)
    problem.regularization = False
    twist = 3e-5 * board_shape.shapes(problem)[0]
    problem.observations[..., :2] = drawn(problem, None, twist)
    versions.optimize(problem)
    found = board_shape.shape_of(problem)
    assert found is not None
    assert found.twist == pytest.approx(3e-5, rel=0.01)
    assert found.ripple < 1e-6
