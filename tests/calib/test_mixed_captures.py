"""Frames of another focus or rig among the others are found, named and measured; where there are none, nothing is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Rig
from rainstereo.calib import mixed_captures, own_rig
from rainstereo.calib.mixed_captures import WAYS, Mixture
from rainstereo.calib.observations import Observations
from rainstereo.calib.own_rig import Own
from rainstereo.calib.solve import solve
from rainstereo.rig import ROLES
from rainstereo.types import Array

from . import synthetic
from .test_stress import BOARD, CASES, capture, described, through

COUNT = 13
CHAMBER = synthetic.chamber(15)


def zoomed(rig: Rig, dry: float = 1.0, wet: float = 1.0) -> Rig:
    """The rig with longer focal lengths."""

    def longer(role: str, factor: float) -> Array:
        intrinsics = np.array(getattr(rig, role).intrinsics)
        intrinsics[:2] *= factor
        return intrinsics

    return replace(
        rig, dry=replace(rig.dry, intrinsics=longer("dry", dry)), wet=replace(rig.wet, intrinsics=longer("wet", wet))
    )


def restood(rig: Rig, longer: float, turned_deg: float) -> Rig:
    """The rig with a longer baseline, metres, and the wet camera turned."""
    rt = rig.rt_wet_dry.copy()
    rt[3:] *= 1 + longer / np.linalg.norm(rt[3:])
    rt[1] += np.deg2rad(turned_deg)
    return replace(rig, wet=rig.wet.with_pose(rt))


def taken(
    other: Callable[[Rig], Rig] | None = None, few: int = 4, *, noise: float = 0.1, seed: int = 1,
    outliers: float = 0.0, behind: bool = False, count: int = COUNT,
) -> tuple[Observations, set[str]]:  # fmt: skip
    """A capture of which `few` frames, drawn by chance, were taken by another rig; the names of these."""
    rig, rng = synthetic.rig(CHAMBER if behind else None), np.random.default_rng(seed)
    rt = synthetic.poses(count, seed + 3, BOARD, near=0.25, far=0.7)
    seen = synthetic.observe(rig, rt, BOARD, noise=noise, seed=seed)
    which = np.zeros(count, dtype=np.bool_)
    if other is not None:
        which[rng.permutation(count)[:few]] = True
    corners = {role: getattr(seen, role).copy() for role in ROLES}
    if other is not None:
        elsewhere = synthetic.observe(other(rig), rt, BOARD, noise=noise, seed=seed + 100)
        for role in ROLES:
            corners[role][which] = getattr(elsewhere, role)[which]
    for role in ROLES:
        bad = np.isfinite(corners[role][..., 0]) & (rng.random(corners[role].shape[:-1]) < outliers)
        corners[role][bad] += rng.uniform(-20, 20, (int(bad.sum()), 2))
    return replace(seen, **corners), {name for name, there in zip(seen.names, which, strict=True) if there}


def found(seen: Observations, *, behind: bool = False) -> Mixture | None:
    return mixed_captures.examine(seen, solve(seen, "LENSMODEL_OPENCV5", CHAMBER if behind else None))


@pytest.mark.parametrize(
    ("noise", "outliers", "behind"),
    [
        (1.0, 0.0, False),
        pytest.param(0.0, 0.0, False, marks=pytest.mark.slow),
        pytest.param(0.1, 0.1, False, marks=pytest.mark.slow),
        pytest.param(0.1, 0.0, True, marks=pytest.mark.slow),
    ],
    ids=["1 px", "exact", "10 % outliers", "panels ignored"],
)
def test_one_rig_raises_no_alarm(noise: float, outliers: float, behind: bool) -> None:
    for seed in (1, 2):
        seen, _ = taken(noise=noise, outliers=outliers, seed=seed, behind=behind)
        assert found(seen) is None  # also where the panels are there and nobody knows of them
    assert mixed_captures.doubts(None) == []


@pytest.mark.parametrize(
    "mishap", ["shift", pytest.param("exchange", marks=pytest.mark.slow), pytest.param("blur", marks=pytest.mark.slow)]
)
def test_frames_that_are_dropped_for_other_reasons_are_not_another_rigs(mishap: str) -> None:
    seen, _ = taken()
    dry, wet = seen.dry.copy(), seen.wet.copy()
    if mishap == "shift":
        wet[[2, 9]] = seen.wet[[9, 2]]
    elif mishap == "exchange":
        dry[[2, 9]], wet[[2, 9]] = seen.wet[[2, 9]], seen.dry[[2, 9]]
    else:
        wet[[2, 9]] += np.random.default_rng(1).normal(size=wet[[2, 9]].shape) * 6
    spoiled = replace(seen, dry=dry, wet=wet)
    solution = solve(spoiled, "LENSMODEL_OPENCV5")
    assert {drop.name for drop in solution.dropped} == {"002.png", "009.png"}
    assert mixed_captures.examine(spoiled, solution) is None


@pytest.mark.slow
def test_paired_captures_are_one_rig() -> None:
    seen, _, rt, _ = capture("paired", CASES["20 % outliers"])
    sought = through("paired", described("paired", CHAMBER), len(rt))
    solution = solve(seen, "LENSMODEL_OPENCV5", sought)
    assert solution.dropped
    assert mixed_captures.examine(seen, solution, np.arange(2 * len(rt)) >= len(rt)) is None


def test_a_breath_of_focus_is_found_measured_and_told() -> None:
    seen, these = taken(lambda rig: zoomed(rig, 1.005))
    mixture = found(seen)
    assert mixture is not None
    assert mixture.way == "dry focus"
    assert set(mixture.frames) == these
    assert mixture.others == COUNT - len(these)
    assert abs(mixture.focal[0] - 0.005) < 4 * mixture.focal_sd[0] < 1e-3
    assert mixture.p < 1e-9
    (finding,) = mixed_captures.doubts(mixture)
    assert finding.severity == "doubtful"
    assert "taken with another focus than the other 9: the dry camera's focal length +0." in finding.text
    assert "folder of their own" in finding.remedy
    assert set(finding.frames) == these


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "outliers", "behind", "count"),
                         [(1.0, 0.0, False, 30), (0.1, 0.05, False, COUNT), (0.1, 0.0, True, COUNT)],
                         ids=["1 px", "outliers", "through panels"])  # fmt: skip
def test_focus_under_stress(noise: float, outliers: float, behind: bool, count: int) -> None:
    seen, these = taken(lambda rig: zoomed(rig, 1, 0.995), count // 3, noise=noise, outliers=outliers, behind=behind,
                        count=count)  # fmt: skip
    mixture = found(seen, behind=behind)
    assert mixture is not None
    assert len(set(mixture.frames) ^ these) <= (4 if noise == 1.0 else 0)  # of thirty
    assert abs(mixture.focal[1] - mixture.focal[0] + 0.005) < 4 * np.hypot(*mixture.focal_sd)


@pytest.mark.parametrize(
    ("longer", "turned_deg"), [(1e-3, 0.2), pytest.param(1e-3, 0.0, marks=pytest.mark.slow),
                               pytest.param(0.0, 0.2, marks=pytest.mark.slow)]
)  # fmt: skip
def test_a_camera_that_moved_half_way_through_is_found(longer: float, turned_deg: float) -> None:
    seen, these = taken(lambda rig: restood(rig, longer, turned_deg), COUNT // 2)
    mixture = found(seen)
    assert mixture is not None
    assert mixture.way == "cameras"
    assert set(mixture.frames) in (these, set(seen.names) - these)
    sign = 1 if set(mixture.frames) == these else -1
    assert abs(mixture.baseline - sign * longer) < 4 * mixture.baseline_sd < 4e-4
    assert abs(mixture.turn - np.deg2rad(turned_deg)) < 4 * mixture.turn_sd < np.deg2rad(0.05)
    (finding,) = mixed_captures.doubts(mixture)
    assert "the cameras stand differently to each other" in finding.text


@pytest.mark.parametrize("few", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_images_of_quite_another_rig_are_found(few: int) -> None:
    seen, these = taken(lambda rig: restood(zoomed(rig, 1.3, 1.3), 0.03, 3.0), few, seed=2)
    mixture = found(seen)
    assert mixture is not None
    assert mixture.way == "rig"
    assert set(mixture.frames) == these
    np.testing.assert_allclose(mixture.focal, 0.3, atol=0.02)
    assert mixture.baseline == pytest.approx(0.03, abs=0.002)
    (finding,) = mixed_captures.doubts(mixture)
    assert "taken by another rig" in finding.text


def test_own_rigs_are_those_that_took_the_frames() -> None:
    """Exact corners of a rig that differs a little: each frame alone gives the difference; also the search from far."""
    rig, rt = synthetic.rig(), synthetic.poses(4, 3, BOARD, near=0.25, far=0.5)
    known = solve(synthetic.observe(rig, synthetic.poses(14, 5, BOARD), BOARD), "LENSMODEL_OPENCV5").problem
    change = np.array([2e-4, -3e-4, 1e-4, -2e-4, 1e-4, 2e-5, -3e-5, 1e-5])
    other = zoomed(rig, *np.exp(change[:2]))
    seen = synthetic.observe(replace(other, wet=other.wet.with_pose(rig.rt_wet_dry + change[2:])), rt, BOARD)
    corners = np.stack([seen.dry, seen.wet])
    own = own_rig.own_rigs(known, (), [(seen.names, corners, None)])
    sd = np.sqrt(np.diagonal(np.linalg.inv(own.weight[-4:]), axis1=1, axis2=2))  # at a pixel of noise
    assert (np.abs(own.values[-4:] - change) < 1e-3 * sd).all()
    assert not own.used[-4:].any()


def test_weights_are_the_inverse_of_the_scatter() -> None:
    """A frame's covariance against its definition: the same board seen again and again with fresh noise."""
    rig, rt = synthetic.rig(), np.repeat(synthetic.poses(1, 8, BOARD, near=0.3, far=0.31), 150, axis=0)
    known = solve(synthetic.observe(rig, synthetic.poses(14, 5, BOARD), BOARD), "LENSMODEL_OPENCV5").problem
    seen = synthetic.observe(rig, rt, BOARD, noise=0.05, seed=3)
    problem = known.copy(
        rt_ref_board=rt,
        indices=np.array([(i, c, c - 1) for i in range(len(rt)) for c in (0, 1)], dtype=np.int32),
        observations=np.concatenate([np.stack([seen.dry, seen.wet], 1).reshape(-1, BOARD.rows, BOARD.columns, 2),
                                     np.ones((2 * len(rt), BOARD.rows, BOARD.columns, 1))], -1),
    )  # fmt: skip
    own = own_rig.own_rigs(problem, seen.names, ())
    assert own.noise == pytest.approx(0.05, rel=0.05)
    square = np.einsum("fi,fij,fj->f", own.values, own.weight, own.values) / 0.05**2
    assert np.mean(square) == pytest.approx(len(own_rig.NAMES), rel=0.15)  # chi-squared with 8: 150 tell it to 4 %


@pytest.mark.parametrize("count", [6, 12, 40])
def test_the_probability_is_a_bound_whatever_the_scatter(count: int) -> None:
    """Frames that all scatter about one value, by more than their sigmas say and with long tails: never two groups."""
    rng = np.random.default_rng(count)
    for _ in range(240 // count):
        roots = rng.normal(size=(count, 8, 8))
        weight = roots @ np.swapaxes(roots, 1, 2) * 1e4
        half = np.linalg.cholesky(np.linalg.inv(weight))
        values = 20 * np.einsum("fij,fj->fi", half, rng.standard_t(4, (count, 8)))
        own = Own(tuple(map(str, range(count))), values, weight, np.full(count, 50.0), 1.0, np.ones(count, bool))
        for columns in WAYS.values():
            assert mixed_captures._divided(own, list(columns)) is None


def test_two_groups_of_numbers_are_told_apart() -> None:
    rng, which = np.random.default_rng(1), np.arange(20) % 3 == 0
    values = np.zeros((20, 8))
    values[:, 0] = rng.normal(0, 1e-3, 20) + 0.03 * which
    values[7, 0] = -0.4  # one that belongs to neither
    own = Own(tuple(map(str, range(20))), values, np.tile(np.eye(8) * 1e6, (20, 1, 1)), np.full(20, 50.0), 1.0,
              np.ones(20, bool))  # fmt: skip
    division = mixed_captures._divided(own, [0])
    assert division is not None
    assert set(division.frames) == {str(i) for i in np.flatnonzero(which)}
    assert "7" not in division.others
    assert division.step[0] == pytest.approx(0.03, abs=2e-3)
    assert mixed_captures._divided(own, [1]) is None
