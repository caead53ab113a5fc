"""The one module that talks to mrcal: names, layout, silence, and what model files carry."""

import builtins
import os
import sys

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo.calib import adjust, mrcal_versions
from rainstereo.calib.mrcal_versions import Free, Problem

from . import synthetic


@pytest.fixture(scope="module")
def problem() -> Problem:
    """A finished OPENCV5 problem without noise: what synthetic's rig saw, at the true state."""
    true, rt = synthetic.rig(), synthetic.poses(6, 2)
    seen = synthetic.observe(true, rt, warp=(3e-4, -2e-4))
    made = adjust.assemble(np.stack([seen.dry, seen.wet]), [synthetic.SIZE] * 2, seen.board.square)
    return made.copy(
        lensmodel="LENSMODEL_OPENCV5",
        intrinsics=np.stack([true.dry.intrinsics, true.wet.intrinsics]),
        rt_cam_ref=true.rt_wet_dry[None].copy(),
        rt_ref_board=rt,
        warp=np.array([3e-4, -2e-4]),
        free=Free(core=True, distortions=True, warp=True),
    )


def test_mrcal_and_the_core_agree_on_every_convention(problem: Problem) -> None:
    assert np.nanmax(np.abs(mrcal_versions.residuals(problem))) < 1e-9


def test_the_state_reaches_mrcal_under_its_own_names(problem: Problem) -> None:
    # 2.5 accepts the old names and ignores them: every part of the state must therefore be seen to matter
    for name in ("intrinsics", "rt_cam_ref", "rt_ref_board", "warp"):
        moved = problem.copy()
        getattr(moved, name)[...] += 1e-4
        assert np.nanmax(np.abs(mrcal_versions.residuals(moved))) > 1e-5, name


@pytest.mark.parametrize("part", ["intrinsics", "extrinsics", "frames", "warp"])
def test_layout_names_the_columns_that_move_that_part(problem: Problem, part: str) -> None:
    layout, at = mrcal_versions.layout(problem), mrcal_versions.linearize(problem)
    span = layout.intrinsics[1] if part == "intrinsics" else getattr(layout, part)
    step = np.zeros(layout.size)
    step[span] = 1e-7
    moved = problem.copy()
    mrcal_versions.ingest(moved, at.packed + step)
    expected = {
        "intrinsics": moved.intrinsics[1] - problem.intrinsics[1],
        "extrinsics": (moved.rt_cam_ref - problem.rt_cam_ref).ravel(),
        "frames": (moved.rt_ref_board - problem.rt_ref_board).ravel(),
        "warp": moved.warp - problem.warp,
    }
    np.testing.assert_allclose(expected[part], (step * at.scale)[span], rtol=1e-4, atol=1e-15)
    untouched = {key: value for key, value in expected.items() if key != part}
    assert all(np.abs(value).max() == 0 for value in untouched.values())


def test_jacobian_is_the_derivative_of_the_residuals(problem: Problem) -> None:
    at = mrcal_versions.linearize(problem)
    step = np.random.default_rng(3).normal(size=len(at.packed)) * 1e-6
    moved = problem.copy()
    mrcal_versions.ingest(moved, at.packed + step)
    change = mrcal_versions.linearize(moved).residuals - at.residuals
    np.testing.assert_allclose(change, at.jacobian @ step, atol=2e-3 * np.abs(change).max())


def test_weights_scale_residuals_in_mrcal_but_not_ours(problem: Problem) -> None:
    moved = problem.copy()
    moved.intrinsics[:, 2] += 0.5
    plain = mrcal_versions.residuals(moved)
    moved.observations[..., 2] *= 0.25
    np.testing.assert_allclose(mrcal_versions.residuals(moved), plain, rtol=1e-12)
    moved.observations[0, 0, 0, 2] = -1
    assert np.isnan(mrcal_versions.residuals(moved)[0, 0, 0]).all()


def test_optimize_brings_a_disturbed_state_back(problem: Problem) -> None:
    moved = problem.copy(regularization=False)
    moved.rt_ref_board[:, :3] += 0.01
    moved.intrinsics[:, 0] += 5
    mrcal_versions.optimize(moved)
    np.testing.assert_allclose(moved.intrinsics, problem.intrinsics, atol=1e-4)
    np.testing.assert_allclose(moved.rt_cam_ref, problem.rt_cam_ref, atol=1e-8)


def test_copies_share_nothing(problem: Problem) -> None:
    copy = problem.copy()
    for name in ("intrinsics", "rt_cam_ref", "rt_ref_board", "observations", "indices", "sizes", "warp"):
        assert not np.shares_memory(getattr(copy, name), getattr(problem, name)), name


def test_gradients_of_the_projection_match_differences(problem: Problem) -> None:
    points = np.random.default_rng(0).uniform([-0.4, -0.3, 1], [0.4, 0.3, 2], (7, 3))
    lens = problem.lensmodel, problem.intrinsics[0]
    pixels, by_point, by_lens = mrcal_versions.project_gradients(points, *lens)
    np.testing.assert_allclose(pixels, mrcal_versions.project(points, *lens))
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-7
        difference = (
            mrcal_versions.project(points + step, *lens) - mrcal_versions.project(points - step, *lens)
        ) / 2e-7
        np.testing.assert_allclose(by_point[..., axis], difference, atol=1e-4)
    for k in range(9):
        step = np.eye(9)[k] * 1e-6
        up, down = (mrcal_versions.project(points, lens[0], lens[1] + s) for s in (step, -step))
        np.testing.assert_allclose(by_lens[..., k], (up - down) / 2e-6, atol=1e-5)
    np.testing.assert_allclose(
        mrcal_versions.unproject(pixels, *lens), points / np.linalg.norm(points, axis=1)[:, None], atol=1e-9
    )


def test_board_points_follow_the_board_and_its_warp() -> None:
    board = synthetic.BOARD
    warp = (3e-4, -1e-4)
    points = mrcal_versions.board_points(board.rows, board.columns, board.square, np.array(warp))
    np.testing.assert_allclose(points, synthetic.bent(board, warp), atol=1e-15)


def test_what_c_code_prints_is_kept_off_the_terminal(capfd: pytest.CaptureFixture[str]) -> None:
    with mrcal_versions.quiet() as captured:
        os.write(2, b"printed by C")
        print("printed by Python", file=sys.stderr)
    assert "printed by C" in captured.text
    assert "printed by C" not in capfd.readouterr().err
    os.write(2, b"heard again")
    assert capfd.readouterr().err == "heard again"


def test_descriptor_is_restored_after_an_error(capfd: pytest.CaptureFixture[str]) -> None:
    def fail() -> None:
        with mrcal_versions.quiet():
            os.write(2, b"hidden")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    os.write(2, b"seen")
    assert capfd.readouterr().err == "seen"


def test_a_failing_solve_says_what_mrcal_said(problem: Problem) -> None:
    with pytest.raises(mrcal_versions.SolveError, match=r"mrcal's optimisation"):
        mrcal_versions.optimize(problem.copy(lensmodel="LENSMODEL_OPENCV8"))


def test_unknown_lens_model_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"LENSMODEL_OPENCV8"):
        mrcal_versions.parameters("LENSMODEL_FISHBOWL")
    assert mrcal_versions.parameters("LENSMODEL_OPENCV8") == 12


def test_missing_mrcal_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_mrcal(name: str, *args: object, **kwargs: object) -> object:
        if name == "mrcal":
            raise ImportError("No module named 'mrcal'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_mrcal)
    mrcal_versions.load.cache_clear()
    try:
        with pytest.raises(ImportError, match=r"apt-get install python3-mrcal.*pip install --no-deps mrcal"):
            mrcal_versions.load()
    finally:
        mrcal_versions.load.cache_clear()


def test_version_is_a_release() -> None:
    assert mrcal_versions.version().lstrip(">=")[:2] == "2."


def test_carried_inputs_are_plain_arrays_in_the_names_all_releases_read(problem: Problem) -> None:
    import base64
    import io

    carried = mrcal_versions.carried(problem)[1]
    stored = np.load(io.BytesIO(base64.b85decode(carried["optimization_inputs"])), allow_pickle=False)
    assert carried["icam_intrinsics"] == 1
    assert {"extrinsics_rt_fromref", "frames_rt_toref"} <= set(stored)
    np.testing.assert_array_equal(stored["frames_rt_toref"], problem.rt_ref_board)
