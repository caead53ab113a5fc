"""A calibration that grows frame by frame has the solution of one that has all frames from the start."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from rainstereo.calib import guidance
from rainstereo.calib.incremental import REDUNDANT, Incremental, View
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import Solution, solve

from . import synthetic

pytest.importorskip("mrcal")

MODEL = "LENSMODEL_OPENCV5"
TRUE = synthetic.rig(synthetic.chamber(15))


def seen(count: int = 12, *, noise: float = 0.1, seed: int = 3, poses: np.ndarray | None = None) -> Observations:
    held = synthetic.poses(count, seed, near=0.3) if poses is None else poses
    return synthetic.observe(TRUE, held, noise=noise, seed=seed)


def running(redundant: float = 0.0, lensmodel: str = MODEL) -> Incremental:
    return Incremental(synthetic.BOARD, (synthetic.SIZE, synthetic.SIZE), lensmodel, TRUE.chamber, redundant=redundant)


def views(observations: Observations) -> list[View]:
    return [View(name, np.stack([observations.dry[i], observations.wet[i]]))
            for i, name in enumerate(observations.names)]  # fmt: skip


def fed(now: Incremental, frames: Iterable[View], *, at_once: bool = False) -> Incremental:
    for view in frames:
        now.add(view, solve_now=not at_once)
    now.catch_up()
    return now


def sigmas_apart(one: Solution, other: Solution) -> float:
    """How far two solutions' lenses and relative poses are from each other, in standard deviations, at most."""
    known = guidance.certainty(one.problem, TRUE.chamber)
    sigma = known.noise * np.sqrt(np.diag(known.covariance)) * known.information.scale
    layout = known.information.layout
    parts = [(s.problem.intrinsics.ravel(), s.problem.rt_cam_ref.ravel()) for s in (one, other)]
    spans = sigma[layout.intrinsics[0].start : layout.intrinsics[1].stop], sigma[layout.extrinsics]
    return max(float(np.abs((a - b) / span).max()) for a, b, span in zip(*parts, spans, strict=True))


def test_frame_by_frame_equals_all_at_once() -> None:
    observations = seen()
    now = fed(running(), views(observations))
    assert now.spent.count["solved on"] >= 4  # not from nothing each time
    assert now.names("used") == observations.names
    assert now.solution is not None
    assert sigmas_apart(now.solution, solve(observations, MODEL, TRUE.chamber)) < 1e-3


def test_many_at_once_equal_one_by_one() -> None:
    observations = seen()
    now = fed(running(), views(observations), at_once=True)
    assert now.spent.count["placed"] > 0
    assert now.spent.count.get("solved on", 0) + now.spent.count["solved afresh"] < 6
    assert now.solution is not None
    assert sigmas_apart(now.solution, solve(observations, MODEL, TRUE.chamber)) < 1e-3


def test_bare_cameras_too() -> None:
    true = synthetic.rig()
    observations = synthetic.observe(true, synthetic.poses(8, 3, near=0.3), noise=0.1, seed=1)
    now = fed(
        Incremental(synthetic.BOARD, (synthetic.SIZE, synthetic.SIZE), MODEL, None, redundant=0), views(observations)
    )
    assert now.solution is not None
    assert sigmas_apart(now.solution, solve(observations, MODEL)) < 0.02  # mrcal's own stopping rule is looser


def test_leaving_redundant_frames_out_changes_less_than_it_says() -> None:
    few = synthetic.poses(10, 5, near=0.3)
    rng = np.random.default_rng(6)
    nearly = np.concatenate([few, *(few[:6] + rng.normal(0, 0.004, (6, 6)) for _ in range(3))])
    observations = seen(poses=nearly)
    everything = solve(observations, MODEL, TRUE.chamber)
    share = 0.1
    now = fed(running(share), views(observations))
    left_out = now.names("redundant")
    assert len(left_out) >= 2
    assert set(left_out) | set(now.names("used")) == set(observations.names)
    assert now.solution is not None
    assert now.known is not None
    assert now.seconds_saved > 0
    full = guidance.certainty(everything.problem, TRUE.chamber)
    # at the same noise no sigma of the full solution is less than the share promised below ours
    ours, all_of_them = now.known.sigmas / now.known.noise, full.sigmas / full.noise
    assert (all_of_them > (1 - share - 0.01) * ours).all()
    assert sigmas_apart(now.solution, everything) < 3 * np.sqrt(2 * share)  # three sigmas of what is to be expected


def test_a_board_that_has_not_moved_is_redundant() -> None:
    held = synthetic.poses(8, 3, near=0.3)
    now = fed(running(REDUNDANT), views(seen(poses=np.concatenate([held, held[-1:], held[-1:]]))))
    assert now.judged["008.png"].fate == now.judged["009.png"].fate == "redundant"
    assert "has not moved since 007" in now.judged["009.png"].reason
    now.remove("007.png")
    now.catch_up()
    assert now.judged["008.png"].fate == "used"  # in its place
    assert "has not moved since 008" in now.judged["009.png"].reason


def test_a_frame_that_is_taken_away_leaves_no_trace() -> None:
    observations = seen(9)
    now = fed(running(), views(observations))
    now.remove("004.png")
    assert now.catch_up()
    others = observations.select([i for i in range(9) if i != 4])
    assert now.names("used") == others.names
    assert now.solution is not None
    assert sigmas_apart(now.solution, solve(others, MODEL, TRUE.chamber)) < 1e-3
    assert not now.catch_up()


def test_images_of_different_moments_are_rejected() -> None:
    observations = seen(9)
    frames = views(observations)
    mixed = View("mixed", np.stack([frames[1].corners[0], frames[5].corners[1]]))
    now = fed(running(), [*frames[:7], mixed, *frames[7:]])
    assert now.judged["mixed"].fate == "rejected"
    assert "moment" in now.judged["mixed"].reason
    assert now.names("used") == observations.names


def test_a_mismatch_among_the_first_is_found_once_there_are_more() -> None:
    observations = seen(12)
    frames = views(observations)
    mixed = View("mixed", np.stack([frames[1].corners[0], frames[5].corners[1]]))
    now = fed(running(), [mixed, *frames])
    assert now.judged["mixed"].fate == "rejected"
    assert now.solution is not None
    assert sigmas_apart(now.solution, solve(observations, MODEL, TRUE.chamber)) < 1e-3


def test_outliers_and_reversed_corners() -> None:
    observations = seen(10)
    frames = views(observations)
    rng = np.random.default_rng(7)
    spoiled = frames[8].corners.copy()
    which = rng.uniform(size=spoiled.shape[:-1]) < 0.1
    spoiled[which] += rng.choice([-8.0, 8.0], size=(int(which.sum()), 2))
    frames[8] = replace(frames[8], corners=spoiled)
    turned = frames[9].corners.copy()
    turned[1] = turned[1][::-1, ::-1]
    frames[9] = replace(frames[9], corners=turned)
    now = fed(running(), frames)
    assert now.names("used") == observations.names
    assert now.solution is not None
    assert 0.9 * which.sum() <= now.solution.outlier_count <= 1.3 * which.sum() + 3
    assert now.solution.rms_px < 0.12
    cold = solve(now.observations(observations.names), MODEL, TRUE.chamber)
    assert sigmas_apart(now.solution, cold) < 1e-3


def test_too_little_says_so() -> None:
    frames = views(seen(4))
    now = running()
    now.add(frames[0])
    assert "needs" in now.trouble
    empty = View("empty", np.full_like(frames[0].corners, np.nan))
    assert now.add(empty).fate == "rejected"
    assert now.refuse("dark", "no board found").reason == "no board found"
    fed(now, frames[1:])
    assert now.names("used") == tuple(frame.name for frame in frames)
    with pytest.raises(ValueError, match="here already"):
        now.add(frames[0])
    for frame in frames[:2]:
        now.remove(frame.name)
    now.catch_up()
    assert now.solution is None
    assert now.known is None


def test_the_lens_model_is_the_plain_one_unless_the_rich_one_pays() -> None:
    now = fed(running(lensmodel="auto"), views(seen(8)), at_once=True)
    assert now.solution is not None
    assert now.solution.lensmodel == "LENSMODEL_OPENCV5"  # which the true lens is
    rich = synthetic.rig(TRUE.chamber, (0.0, 0, 4e-4, -3e-4, 0, 0.8, 0.8, 0.0))
    observations = synthetic.observe(rich, synthetic.poses(10, 3, near=0.3), noise=0.001, seed=3)
    now = fed(running(lensmodel="auto"), views(observations), at_once=True)
    assert now.solution is not None
    assert now.solution.lensmodel == "LENSMODEL_OPENCV8"


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="redundant"):
        running(1.5)
    with pytest.raises(ValueError, match="unknown to mrcal"):
        running(lensmodel="LENSMODEL_FANCY")
