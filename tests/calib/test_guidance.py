"""What frames say, what a hypothetical one would say, and where the board should be held next."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import pose
from rainstereo.calib import board_candidates, guidance, information, uncertainty
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.board import Board
from rainstereo.calib.far_directions import GRID
from rainstereo.calib.solve import Solution, solve
from rainstereo.rig import ROLES, Rig

from . import synthetic

pytest.importorskip("mrcal")

MODEL = "LENSMODEL_OPENCV5"
NOISE = 0.1


@cache
def solved(through: bool = True, frames: int = 10) -> tuple[Rig, Solution]:
    true = synthetic.rig(synthetic.chamber(15) if through else None)
    seen = synthetic.observe(true, synthetic.poses(frames, 3, near=0.3), noise=NOISE, seed=4)
    return true, solve(seen, MODEL, true.chamber)


@cache
def certain() -> guidance.Certainty:
    true, solution = solved()
    return guidance.certainty(solution.problem, true.chamber)


# -- information ---------------------------------------------------------------------------------------------------


def test_eliminating_poses_leaves_the_covariance_of_the_rest() -> None:
    _, solution = solved(through=False)
    problem = solution.problem
    known = information.information(problem, None)
    at, where = versions.linearize(problem), versions.layout(problem)
    everything = np.linalg.inv((at.jacobian.T @ at.jacobian).toarray())  # mrcal's own Jacobian, nothing eliminated
    kept = np.r_[: where.frames.start, where.frames.stop : where.size]
    ours, theirs = information.inverse(known.total), everything[np.ix_(kept, kept)]
    sigma = np.sqrt(np.diag(theirs))
    np.testing.assert_allclose(ours / np.outer(sigma, sigma), theirs / np.outer(sigma, sigma), atol=2e-6)


@pytest.mark.parametrize("through", [False, True])
def test_a_frame_that_is_there_says_what_it_would_say(through: bool) -> None:
    true, solution = solved(through)
    problem = solution.problem
    known = information.information(problem, true.chamber)
    weight = np.zeros((2, len(solution.names), *problem.observations.shape[1:3]))
    weight[problem.indices[:, 1], problem.indices[:, 0]] = np.maximum(problem.observations[..., 2], 0)
    told = information.of_poses(problem, true.chamber, problem.rt_ref_board, weight, problem.spacing)
    np.testing.assert_allclose(told, known.frames, rtol=1e-7, atol=1e-7 * np.abs(known.frames).max())


def test_a_board_that_nobody_sees_says_nothing() -> None:
    true, solution = solved()
    unseen = np.zeros((2, 1, 7, 10))
    told = information.of_poses(solution.problem, true.chamber, solution.rt_ref_board[:1], unseen, 0.022)
    assert np.abs(told).max() == 0


def test_the_figure_is_that_of_the_full_covariance() -> None:
    _, solution = solved(through=False)
    known = guidance.certainty(solution.problem, None)
    cov = uncertainty.covariance(solution)
    assert known.noise == pytest.approx(cov.sigma, rel=1e-3)
    maps = [uncertainty.infinity_uncertainty(solution, role, GRID, gauge="image", cov=cov).sigma for role in ROLES]
    maps.append(uncertainty.stereo_infinity_uncertainty(solution, GRID, cov=cov).sigma)
    np.testing.assert_allclose(known.maps, maps, rtol=0.03)  # ours counts the regularization as noise, too
    assert (known.maps > 0.99 * np.array(maps)).all()
    number, pixel = known.worst_place
    assert known.worst == known.maps[number].max()
    assert (pixel >= 0).all()


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10**6), size=st.floats(1e-6, 1e6), rank=st.integers(1, 12))
def test_no_frame_makes_anything_less_certain(seed: int, size: float, rank: int) -> None:
    known = certain()
    rows = np.random.default_rng(seed).normal(size=(rank, known.information.layout.size)) * size
    after = known.with_frames((rows.T @ rows)[None])[0]
    assert (after <= known.sigmas * (1 + 1e-6)).all()
    assert 0 <= known.gain(rows.T @ rows) + 1e-6 <= 1 + 1e-5


def test_covariances_of_what_is_not_determined_are_large_and_finite() -> None:
    total = np.diag([4.0, 1.0, 0.0])
    for found in (information.inverse(total), information.inverse(total[None])[0]):
        assert np.isfinite(found).all()
        np.testing.assert_allclose(np.diag(found)[:2], [0.25, 1.0], rtol=1e-9)
        assert found[2, 2] > 1e6


# -- candidates ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("board", ["chessboard:10x7:22mm", "charuco:11x8:25mm:19mm:DICT_4X4_250"])
def test_candidates_can_be_held_and_found(board: str) -> None:
    true, print_ = synthetic.rig(synthetic.chamber(15)), Board.parse(board)
    possible = board_candidates.candidates(true, print_)
    assert len(possible.poses) > 100
    assert len(np.unique(possible.place, axis=0)) == 9
    seen, whole = board_candidates.views(true, print_, possible.poses)
    np.testing.assert_array_equal(seen, possible.seen)
    if print_.kind == "chessboard":
        assert whole.all()
    for rt, distance in zip(possible.poses, possible.distance, strict=True):
        corners = pose.transform(rt, print_.points)
        assert (corners @ np.array(true.chamber.normal)).min() > true.chamber.depth  # type: ignore[union-attr]
        assert guidance.distance_of(print_, rt) == pytest.approx(distance)


def test_words_say_what_the_pose_is() -> None:
    true, board = synthetic.rig(), synthetic.BOARD
    possible = board_candidates.candidates(true, board)
    pixels = board_candidates.drawn(true, possible.poses, board_candidates.outline(board))
    middle, size = pixels.mean((0, 2)), np.array(synthetic.SIZE)
    for i, rt in enumerate(possible.poses):
        side = guidance.SIDES[guidance._key(possible.place[i])]
        for word, there in (("left", middle[i, 0] < size[0] / 2), ("right", middle[i, 0] > size[0] / 2),
                            ("top", middle[i, 1] < size[1] / 2), ("bottom", middle[i, 1] > size[1] / 2)):  # fmt: skip
            assert word not in side or there
        corners = pose.transform(rt, board.points)[..., 2]
        lean = guidance._lean(guidance._key(possible.away[i]))
        far = corners.mean()
        for word, part in (("left", corners[:, 0]), ("right", corners[:, -1]), ("top", corners[0]),
                           ("bottom", corners[-1])):  # fmt: skip
            assert word not in lean or part.mean() > far + 0.01


def test_nothing_is_proposed_where_nothing_fits() -> None:
    _, solution = solved(through=False)
    deep = replace(synthetic.chamber(0), distance=3.0)
    assert guidance.propose(solution, synthetic.BOARD, deep) is None
    assert guidance.first_proposal(synthetic.BOARD, synthetic.SIZE, deep, 0) is None


def test_first_proposals_differ() -> None:
    told = {guidance.first_proposal(synthetic.BOARD, (640, 480), None, count).words for count in range(6)}  # type: ignore[union-attr]
    assert len(told) == 6


@given(rows=st.integers(2, 60), columns=st.integers(2, 60))
def test_thinned_boards_keep_their_extent(rows: int, columns: int) -> None:
    step = guidance.stride(rows, columns)
    assert step >= 1
    if step > 1:
        for n in (rows, columns):
            assert step * ((n - 1) // step) >= guidance.REACH * (n - 1)
        assert len(range(0, rows, step)) * len(range(0, columns, step)) >= guidance.LEAST_POINTS


# -- proposals -----------------------------------------------------------------------------------------------------


def test_a_proposal_keeps_its_promise() -> None:
    true, solution = solved()
    proposal = guidance.propose(solution, synthetic.BOARD, last=0.6)
    assert proposal is not None
    assert proposal.considered > 100
    assert proposal.predicted < 0.9 * proposal.now
    now = certain()
    assert proposal.now == now.worst
    poses = np.concatenate([synthetic.poses(10, 3, near=0.3), proposal.pose[None]])
    again = solve(synthetic.observe(true, poses, noise=NOISE, seed=5), MODEL, true.chamber)
    actual = guidance.certainty(again.problem, true.chamber)
    # the noise itself is estimated anew: compare what the geometry makes of a pixel of it
    assert actual.worst / actual.noise == pytest.approx(proposal.predicted / now.noise, rel=0.05)
    for role in ROLES:
        assert (proposal.outlines[role] >= -0.5).all()
        assert (proposal.outlines[role] <= np.array(synthetic.SIZE) - 0.5).all()
    assert "cm away" in proposal.words


def test_the_proposal_is_better_than_nearly_all_other_poses() -> None:
    true, solution = solved()
    known = certain()
    possible = board_candidates.candidates(guidance.rig_of(solution.problem, true.chamber), synthetic.BOARD)
    told = guidance.offers(solution.problem, true.chamber, synthetic.BOARD, possible)
    every = information.of_poses(solution.problem, true.chamber, possible.poses, possible.seen.astype(float), 0.022)
    worst, thinned = known.with_frames(every).max(-1), known.with_frames(told).max(-1)
    np.testing.assert_allclose(thinned, worst, rtol=0.2)  # a part of the corners stands for all
    assert worst[guidance.best(known, told)] <= np.quantile(worst, 0.1)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_guided_pairs_reach_the_target_with_fewer_than_half_of_random_ones(seed: int) -> None:
    true, solution = solved()
    known = certain()
    possible = board_candidates.candidates(guidance.rig_of(solution.problem, true.chamber), synthetic.BOARD)
    told = guidance.offers(solution.problem, true.chamber, synthetic.BOARD, possible)
    rng, needed = np.random.default_rng(seed), []
    for guided in (True, False):
        now, count = known, 0
        while now.sigmas.max() > 0.4 * known.sigmas.max():
            chosen = guidance.best(now, told) if guided else int(rng.integers(len(told)))
            more = replace(now.information, held=now.information.held + told[chosen])
            now = replace(now, information=more, sigmas=now.with_frames(told[chosen]))
            now = replace(now, covariance=information.inverse(more.total))
            count += 1
        needed.append(count)
    assert needed[0] <= 0.5 * needed[1], needed
