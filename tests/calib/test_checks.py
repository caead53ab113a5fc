"""Verdicts: what is good is called good, what is degenerate is refused, and the frames concerned are named."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, Panel, pose
from rainstereo.calib import checks, uncertainty
from rainstereo.calib.checks import Verdict
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import solve
from rainstereo.calib.through_acrylic import ChamberError
from rainstereo.rig import Rig
from rainstereo.types import Array

from . import synthetic

MODEL = "LENSMODEL_OPENCV5"


def seen(rt: Array, true: Rig | None = None, noise: float = 0.1) -> Observations:
    return synthetic.observe(true or synthetic.rig(), rt, noise=noise, seed=1)


def judged(observations: Observations, **options: float) -> Verdict:
    try:
        found = solve(observations, MODEL)
    except (ValueError, RuntimeError) as error:
        return checks.judge_failure(observations, error, MODEL)
    return checks.judge(observations, found, **options)


def said(verdict: Verdict, severity: str) -> str:
    return " / ".join(f"{f.text} -> {f.remedy}" for f in verdict.findings if f.severity == severity)


@pytest.fixture(scope="module")
def plenty() -> Observations:
    return seen(synthetic.poses(16, 1))


def test_a_proper_calibration_is_good_and_nothing_is_said(plenty: Observations) -> None:
    verdict = judged(plenty, expected_baseline=synthetic.BASELINE)
    assert verdict.status == "good"
    assert not verdict.findings


@pytest.mark.parametrize("count", [2, 5, 12])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.2])
def test_near_identical_views_are_refused(count: int, noise: float) -> None:
    rng = np.random.default_rng(count)
    rt = synthetic.poses(1, 3) + rng.normal(size=(count, 6)) * [0.01, 0.01, 0.01, 0.002, 0.002, 0.002]
    verdict = judged(seen(rt, noise=noise))
    assert verdict.status == "refused"
    assert "distinct view" in said(verdict, "refused")
    assert "tilted" in said(verdict, "refused")


def test_a_single_pair_is_refused() -> None:
    assert judged(seen(synthetic.poses(1, 3))).status == "refused"


def test_three_good_views_are_doubtful() -> None:
    verdict = judged(seen(synthetic.poses(3, 3)))
    assert verdict.status == "doubtful"
    assert "3 distinct views" in said(verdict, "doubtful")


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_boards_that_are_all_parallel_are_refused(noise: float) -> None:
    rt = synthetic.poses(16, 3)
    rt[:, :2] = 0
    verdict = judged(seen(rt, noise=noise))
    assert verdict.status == "refused"
    assert "parallel" in said(verdict, "refused")


def test_boards_in_the_middle_only_are_doubtful() -> None:
    rt = synthetic.poses(16, 3)
    centre = (synthetic.BOARD.points[0, 0] + synthetic.BOARD.points[-1, -1]) / 2
    for row in rt:
        row[3:] = np.array([0, 0, 0.6]) - pose.rotation_matrix(row[:3]) @ centre
    verdict = judged(seen(rt))
    assert verdict.status in {"doubtful", "refused"}
    assert "cover only" in said(verdict, "doubtful")


@pytest.mark.parametrize("mishap", ["shuffled", "wall"])
def test_cameras_that_tell_different_stories_are_refused(plenty: Observations, mishap: str) -> None:
    fixed = seen(np.repeat(synthetic.poses(1, 1), 16, 0)).wet
    wet = np.roll(plenty.wet, 3, axis=0) if mishap == "shuffled" else fixed
    verdict = judged(synthetic.replaced(plenty, wet=wet))
    assert verdict.status == "refused"
    assert "same moment" in said(verdict, "refused")


def test_slight_asynchrony_is_told_apart_from_bad_corners(plenty: Observations) -> None:
    # the board moves by some 2 mm between the two exposures, another way in each pair
    rng = np.random.default_rng(4)
    late = seen(synthetic.poses(16, 1) + rng.normal(size=(16, 6)) * [0.004, 0.004, 0.004, 0.002, 0.002, 0.002])
    verdict = judged(synthetic.replaced(plenty, wet=late.wet))
    assert verdict.status in {"doubtful", "refused"}
    told = said(verdict, "refused") + said(verdict, "doubtful") + said(verdict, "note")
    assert "alone" in told


def test_exchanged_pairs_are_named(plenty: Observations) -> None:
    dry, wet = plenty.dry.copy(), plenty.wet.copy()
    dry[[2, 5]], wet[[2, 5]] = plenty.wet[[2, 5]], plenty.dry[[2, 5]]
    verdict = judged(synthetic.replaced(plenty, dry=dry, wet=wet))
    exchanged = {f.frames for f in verdict.findings if "exchanged" in f.text}
    assert exchanged == {("002.png",), ("005.png",)}
    assert verdict.status == "good"


def test_folders_exchanged_as_a_whole_are_hinted_at(plenty: Observations) -> None:
    verdict = judged(synthetic.replaced(plenty, dry=plenty.wet, wet=plenty.dry))
    assert "folders for wet and dry are exchanged" in said(verdict, "note")
    assert verdict.status == "good"


def test_wrong_square_size_is_worked_out_from_the_baseline(plenty: Observations) -> None:
    verdict = judged(plenty, expected_baseline=2 * synthetic.BASELINE)
    assert verdict.status == "doubtful"
    assert "measure 44.0" in said(verdict, "doubtful")


def test_different_focal_lengths_are_pointed_out() -> None:
    true = synthetic.rig()
    zoomed = type(true.wet)(
        true.wet.model, np.array(true.wet.intrinsics) * ([1.3, 1.3] + [1] * 7), *true.wet.size, true.wet.rt_cam_ref
    )
    verdict = judged(seen(synthetic.poses(16, 1), Rig(true.dry, zoomed)))
    assert "focal lengths differ" in said(verdict, "doubtful")


def test_many_outliers_are_doubtful_and_the_worst_frames_named(plenty: Observations) -> None:
    rng = np.random.default_rng(3)
    wet = plenty.wet.copy()
    spoiled = np.isfinite(wet[..., 0]) & (rng.random(wet.shape[:-1]) < 0.15)
    wet[spoiled] += rng.choice([-1, 1], (int(spoiled.sum()), 2)) * 5
    verdict = judged(synthetic.replaced(plenty, wet=wet))
    assert verdict.status == "doubtful"
    assert "rejected as outliers" in said(verdict, "doubtful")


def test_every_doubt_and_refusal_has_a_remedy_in_the_verdict() -> None:
    for verdict in (judged(seen(synthetic.poses(1, 3))), judged(seen(synthetic.poses(3, 3)))):
        assert all(f.remedy for f in verdict.findings if f.severity != "note")


def test_lens_model_that_cannot_follow_the_lens_is_pointed_out() -> None:
    true = synthetic.rig(distortion=(0.75, 0.06, 0, 0, 0, 1.0, 0.19, 0.002))
    rt = synthetic.poses(16, 1)
    rt[:, 3:5] *= 1.5
    observations = seen(rt, true)
    for model, status in (("LENSMODEL_PINHOLE", "doubtful"), ("LENSMODEL_OPENCV8", "good")):
        verdict = checks.judge(observations, solve(observations, model))
        assert verdict.status == status
        assert ("fixed pattern" in said(verdict, "doubtful")) == (status == "doubtful")


def test_impossible_chamber_is_blamed_on_the_chamber(plenty: Observations) -> None:
    backwards = Chamber((0, 0, -1), 0.04, (Panel(0.004, 1.49),))
    with pytest.raises(ChamberError) as caught:
        solve(plenty, MODEL, backwards)
    verdict = checks.judge_failure(plenty, caught.value, MODEL)
    assert verdict.status == "refused"
    assert "panels" in said(verdict, "refused")
    assert "alone" not in said(verdict, "refused")


def test_distinct_views_counts_turns_and_moves() -> None:
    base = np.array([0, 0, 0, 0, 0, 0.5])
    same = np.array([base, base + [0.01, 0, 0, 0, 0, 0], base + [0, 0, 0, 0.01, 0, 0]])
    assert checks.distinct_views(same, 0.1) == [0]
    turned, moved = base + [0.3, 0, 0, 0, 0, 0], base + [0, 0, 0, 0.2, 0, 0]
    assert checks.distinct_views(np.array([base, turned, moved]), 0.1) == [0, 1, 2]


def test_a_state_that_is_not_at_the_minimum_is_refused(plenty: Observations) -> None:
    solution = solve(plenty, "LENSMODEL_OPENCV5")
    cov = uncertainty.covariance(solution)
    assert checks.settled(solution, cov) == []
    away = solution.problem.copy()
    away.intrinsics[0, :2] *= 1.001
    (finding,) = checks.settled(replace(solution, problem=away), cov)
    assert finding.severity == "refused"
    assert "did not converge" in finding.text
