"""Boards that could stand the other way round: turned where the corners tell, named where they do not."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import pose
from rainstereo.calib import adjust, checks, outliers, pose_flips, sought, through_acrylic
from rainstereo.calib.adjust import Adjustment
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.refracted import Panels
from rainstereo.calib.solve import solve
from rainstereo.calib.sought import Sought
from rainstereo.types import Array

from . import synthetic
from .test_stress import BOARD, CASES, KINDS, Kind, capture, described, through, within_sigmas


def leans(rt_ref_board: Array) -> Array:
    """Normals of boards, (F, 3)."""
    return pose.rotation_matrix(rt_ref_board[:, :3])[..., 2]


def apart(one: Array, other: Array) -> Array:
    """Degrees between the normals of boards in two states, (F,)."""
    return np.rad2deg(np.arccos(np.clip(np.sum(leans(one) * leans(other), -1), -1, 1)))


def at_the_truth(rt: Array) -> Problem:
    true = synthetic.rig()
    seen = synthetic.observe(true, rt, BOARD)
    return adjust.assemble(np.stack([seen.dry, seen.wet]), [synthetic.SIZE] * 2, BOARD.square).copy(
        lensmodel="LENSMODEL_OPENCV5",
        intrinsics=np.stack([true.dry.intrinsics, true.wet.intrinsics]),
        rt_cam_ref=true.rt_wet_dry[None].copy(),
        rt_ref_board=rt.copy(),
        regularization=False,
    )


def test_a_mirrored_board_looks_the_same_from_far() -> None:
    rt = synthetic.poses(5, 2, BOARD, near=1.0, far=1.01)
    left = []
    for scale in (1.0, 8.0):
        problem = at_the_truth(rt * [1, 1, 1, scale, scale, scale])
        problem.rt_ref_board = pose_flips.mirrored(problem)
        left.append(adjust.frame_rms(problem))
    assert (left[1] < left[0] / 40).all()  # falls with the square of the distance
    problem = at_the_truth(rt)
    twin = problem.copy(rt_ref_board=pose_flips.mirrored(problem))
    np.testing.assert_allclose(pose_flips.mirrored(twin), rt, atol=1e-12)  # an involution
    # a second formulation: the normal keeps its angle to the line of sight and changes sides
    middle, eye = BOARD.points.reshape(-1, 3).mean(0), pose.invert(synthetic.rig().rt_wet_dry)[3:] / 2
    for one, other in zip(rt, twin.rt_ref_board, strict=True):
        line = pose.transform(one, middle) - eye
        line /= np.linalg.norm(line)
        normals = leans(np.stack([one, other]))
        along = normals @ line
        assert along[0] == pytest.approx(along[1], abs=1e-12)
        np.testing.assert_allclose(normals[0] - along[0] * line, along[1] * line - normals[1], atol=1e-12)
        np.testing.assert_allclose(pose.transform(other, middle), pose.transform(one, middle), atol=1e-12)


@pytest.mark.parametrize("kind", ["known", *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[1:])])
def test_a_solve_from_corners_turns_what_its_first_guess_had_wrong(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    turned, undo = [], pose_flips.undo
    monkeypatch.setattr(pose_flips, "undo", lambda *given: turned.append(undo(*given)) or turned[-1])
    seen, true, rt, _ = capture(kind, CASES["pose flips"], seed=1)
    found = solve(seen, "LENSMODEL_OPENCV5", through(kind, described(kind, CASES["pose flips"].chamber), len(rt)))
    assert sum(turned) > 0
    assert apart(found.rt_ref_board, np.concatenate([rt] * (len(found.names) // len(rt)))).max() < 3
    within_sigmas(found, true)
    monkeypatch.setattr(pose_flips, "undo", lambda *_given: 0)
    left = solve(seen, "LENSMODEL_OPENCV5", through(kind, described(kind, CASES["pose flips"].chamber), len(rt)))
    assert apart(left.rt_ref_board, found.rt_ref_board).max() > 10  # else nothing was shown


@pytest.mark.parametrize("kind", ["paired", *(pytest.param(kind, marks=pytest.mark.slow) for kind in KINDS[::2])])
def test_wrong_starts_of_the_solve_through_panels_are_mended(kind: Kind) -> None:
    """The three last boards of each capture are handed over mirrored, to the joint solve of what is sought."""
    case = CASES["pose flips"]
    seen, true, rt, _ = capture(kind, case)
    boards, panels = len(rt), through(kind, described(kind, case.chamber), len(rt))
    right = solve(seen, "LENSMODEL_OPENCV5", panels)
    problem = right.problem.copy()
    start = Adjustment(problem, np.stack([seen.dry, seen.wet]), seen.names, right.frames)
    wrong = np.arange(len(right.names)) % boards >= boards - 3
    problem.rt_ref_board[wrong] = pose_flips.mirrored(problem)[wrong]
    assert apart(problem.rt_ref_board, right.rt_ref_board)[wrong].min() > 10
    stuck, before = problem.copy(), right.panels or Panels.of(case.chamber)
    through_acrylic.refine(stuck, start.seen(), Panels(before.slab, before.frames, before.ties, before.prior, 0.3))
    assert apart(stuck.rt_ref_board, right.rt_ref_board)[wrong].max() > 5  # by itself not all find back
    if isinstance(panels, Sought):
        sought.find(start, panels, 0.3)
    else:
        outliers.reject(start, lambda trial: through_acrylic.refine(trial.problem, trial.seen(), panels) and None)
    np.testing.assert_allclose(start.problem.rt_ref_board, right.rt_ref_board, atol=2e-3)
    np.testing.assert_allclose(start.problem.intrinsics, right.problem.intrinsics, rtol=2e-4, atol=1e-2)
    assert abs(np.linalg.norm(start.problem.rt_cam_ref[0, 3:]) - true.baseline) < 1e-4


def test_what_no_corner_tells_is_named() -> None:
    near, flat = synthetic.poses(8, 3, BOARD, near=0.3), synthetic.poses(3, 5, BOARD, near=3.0, far=4.0, tilt_deg=12)
    seen = synthetic.observe(synthetic.rig(), np.concatenate([near, flat]), BOARD, noise=0.5)
    (finding,) = checks.ways_round(solve(seen, "LENSMODEL_OPENCV5"))
    assert finding.severity == "note"
    assert "could lean the other way" in finding.text
    assert finding.frames
    assert set(finding.frames) <= set(seen.names[8:])
    plain = solve(synthetic.observe(synthetic.rig(), near, BOARD, noise=0.5), "LENSMODEL_OPENCV5")
    assert checks.ways_round(plain) == []
