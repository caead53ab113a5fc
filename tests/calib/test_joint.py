"""Panels found together with the rig: exact corners give them back, noisy ones within their sigmas, and stress."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, Panel, pose, refraction
from rainstereo.calib import adjust, joint, mrcal_versions, refracted
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.calib.prior import Prior
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Kind, Slab, across
from rainstereo.chamber import ChamberUncertainty
from rainstereo.rig import ROLES
from rainstereo.types import Array

from . import synthetic

POSES = 10
BOTH: tuple[Kind, ...] = ("tilt", "thickness")


def paired(chamber: Chamber, noise: float = 0.0, *, poses: int = POSES, near: float = 0.25, far: float = 0.6,
           seed: int = 0) -> tuple[Problem, Array]:  # fmt: skip
    """A problem at the truth: every board first without, then with the chamber, at the same place; corners seen."""
    true, rt = synthetic.rig(chamber), synthetic.poses(poses, 3, near=near, far=far)
    bare = synthetic.observe(replace(true, chamber=None), rt, noise=noise, seed=2 * seed)
    through = synthetic.observe(true, rt, noise=noise, seed=2 * seed + 1)
    corners = np.stack([np.concatenate([getattr(bare, role), getattr(through, role)]) for role in ROLES])
    problem = adjust.assemble(corners, [synthetic.SIZE] * 2, bare.board.square).copy(
        lensmodel="LENSMODEL_OPENCV5",
        intrinsics=np.stack([true.dry.intrinsics, true.wet.intrinsics]),
        rt_cam_ref=true.rt_wet_dry[None].copy(),
        rt_ref_board=np.concatenate([rt, rt]),
        warp=np.zeros(2),
        free=Free(core=True, distortions=True, warp=True),
    )
    return problem, problem.observations[..., :2].copy()


def tied(described: Chamber, free: tuple[Kind, ...] = BOTH, poses: int = POSES) -> Panels:
    return Panels(Slab(described, free), np.arange(2 * poses) >= poses, np.arange(2 * poses) % poses)


def rough(chamber: Chamber) -> Chamber:
    """The same panels as somebody guessed them: 4 degrees off, 0.3 mm too thin, elsewhere."""
    normal = np.array(chamber.normal) + across(chamber.normal) @ np.deg2rad([3.0, -2.5])
    thin = tuple(Panel(panel.thickness - 3e-4, panel.index) for panel in chamber.panels)
    return Chamber(tuple(normal.tolist()), 0.05, thin, (0.015,))


def angles(found: Chamber, true: Chamber) -> Array:
    """Pitch and yaw between two normals, degrees."""
    return np.rad2deg(across(true.normal).T @ np.array(found.normal))


def thickness(chamber: Chamber) -> float:
    return sum(panel.thickness for panel in chamber.panels)


@pytest.mark.parametrize("tilt_deg", [0, 15, 60])
def test_paired_exact_corners_give_the_panels_back(tilt_deg: float) -> None:
    true = synthetic.chamber(tilt_deg)
    near, far = (0.25, 0.6) if tilt_deg < 50 else (0.6, 1.2)  # so steep, the chamber reaches far into the view
    problem, seen = paired(true, near=near, far=far)
    problem.regularization = False
    panels = tied(rough(true))
    found = joint.estimate(problem, seen, panels)
    np.testing.assert_allclose(angles(panels.slab.chamber, true), 0, atol=1e-3)
    assert thickness(panels.slab.chamber) == pytest.approx(thickness(true), abs=1e-7)
    assert found.chamber.distance == 0.05  # which no board can show
    assert found.chamber.nominal == ("distance", "gaps", "index")


def test_paired_noise_within_its_sigmas_and_as_certain_as_promised() -> None:
    true = synthetic.chamber(15)
    problem, seen = paired(true, 0.1)
    panels = tied(rough(true))
    found = joint.estimate(problem, seen, panels)
    off = {"pitch": np.deg2rad(angles(panels.slab.chamber, true)[0]),
           "yaw": np.deg2rad(angles(panels.slab.chamber, true)[1]),
           "thickness 0": thickness(panels.slab.chamber) - thickness(true)}  # fmt: skip
    for name, value in off.items():
        assert abs(value) < 4 * found.sigmas[name]
    assert found.covariance.sigma == pytest.approx(0.1, rel=0.05)
    assert np.rad2deg(found.sigmas["pitch"]) < 0.09  # 10 poses; 30 of them: 0.05 and 0.012 mm a panel
    assert found.sigmas["thickness 0"] / 2 < 2.1e-5


@pytest.mark.parametrize(
    ("noise", "poses", "near", "far", "half"),
    [(1.0, POSES, 0.25, 0.6, False), (0.1, 5, 0.25, 0.6, False), (0.1, POSES, 0.25, 0.6, True),
     (0.1, POSES, 0.15, 0.2, False), (0.1, POSES, 1.5, 2.5, False)],
    ids=["1 px of noise", "5 poses", "wet camera missing in half", "boards at 0.15 m", "boards far away"],
)  # fmt: skip
def test_stress_stays_within_its_sigmas(noise: float, poses: int, near: float, far: float, half: bool) -> None:
    true = synthetic.chamber(15)
    problem, seen = paired(true, noise, poses=poses, near=near, far=far)
    if half:
        problem.observations[(problem.indices[:, 1] == 1) & (problem.indices[:, 0] % 2 == 1), ..., 2] = 0
    panels = tied(rough(true), poses=poses)
    found = joint.estimate(problem, seen, panels)
    pitch, yaw = np.deg2rad(angles(panels.slab.chamber, true))
    assert abs(pitch) < 4 * found.sigmas["pitch"]
    assert abs(yaw) < 4 * found.sigmas["yaw"]
    assert abs(thickness(panels.slab.chamber) - thickness(true)) < 4 * found.sigmas["thickness 0"]
    assert found.covariance.sigma == pytest.approx(noise, rel=0.1)


def test_sigmas_are_those_of_the_scatter_over_tied_poses() -> None:
    """The covariance against its definition: linear response of the solution to noise, by solving again and again."""
    true = synthetic.chamber(20)
    problem, clean = paired(true)
    start = joint.estimate(problem, clean, tied(true))
    rng, runs, names = np.random.default_rng(0), 24, start.slab.names
    off = np.zeros((runs, len(names)))
    for run in range(runs):
        panels, trial = tied(true), problem.copy()
        found = joint.estimate(trial, clean + rng.normal(0, 0.1, clean.shape), panels)
        off[run, :2] = np.deg2rad(angles(panels.slab.chamber, true))
        off[run, 2] = thickness(panels.slab.chamber) - thickness(true)
    ratio = np.sqrt(np.mean(off**2, axis=0)) / np.array([found.sigmas[name] for name in names])
    assert (ratio > 0.6).all()  # 24 runs: one sigma of the ratio is 0.14
    assert (ratio < 1.5).all()


def test_gradient_with_a_wedge_a_prior_and_shared_poses_matches_differences() -> None:
    true = synthetic.chamber(25)
    problem, seen = paired(true)
    seen = seen + np.random.default_rng(1).normal(size=seen.shape)
    slab = Slab(true, ("tilt", "thickness", "index", "wedge")).moved(np.array([0.01, -0.02, 1e-4, 1e-3, 2e-3, -1e-3]))
    panels = Panels(slab, np.arange(20) >= 10, np.arange(20) % 10, Prior(true), 0.7)
    normal = refracted.normal_equations(problem, seen, panels)
    assert normal.cost == pytest.approx(refracted.cost(problem, seen, panels), rel=1e-12)
    extrinsics, frames = normal.layout.extrinsics.start, normal.layout.frames.start
    for k in (0, 9, *range(extrinsics, extrinsics + 6), frames, frames + 4, frames + 11, *range(-6, 0)):
        step = np.zeros(len(normal.gradient))
        step[k] = 1e-6
        ends = []
        for sign in (1, -1):
            trial, moved = problem.copy(), panels.spread(normal.layout, sign * step)
            mrcal_versions.ingest(trial, normal.packed + moved[: len(normal.packed)])
            there = replace(panels, slab=slab.moved(moved[normal.layout.slab]))
            ends.append(refracted.cost(trial, seen, there))
        scale = np.sqrt(normal.matrix[k, k] * normal.cost)
        assert 2 * normal.gradient[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=2e-5 * scale)


def test_a_wedge_of_a_fiftieth_of_a_degree_is_found() -> None:
    true, size = synthetic.chamber(15), np.deg2rad(0.02)
    problem, _ = paired(true)
    W = across(true.normal) @ np.array([0.6, -0.8]) * size
    wedged = Panels(Slab(true, wedge=tuple(W.tolist())), np.arange(20) >= 10)
    seen = refracted.pixels(problem, wedged) + np.random.default_rng(3).normal(
        0, 0.1, problem.observations[..., :2].shape
    )
    without = joint.estimate(problem.copy(), seen, tied(rough(true)))
    panels = tied(rough(true), (*BOTH, "wedge"))
    found = joint.estimate(problem, seen, panels)
    off = across(panels.slab.chamber.normal).T @ (np.array(panels.slab.wedge) - W)
    assert (np.abs(off) < 4 * np.array([found.sigmas["wedge pitch"], found.sigmas["wedge yaw"]])).all()
    assert found.sigmas["wedge yaw"] < size / 8
    assert without.covariance.sigma > 1.02 * found.covariance.sigma


@pytest.mark.parametrize(("size", "index"), [(1e-6, 1.49), (0.004, 1.0005)])
def test_panels_that_hardly_refract_leave_the_rest_alone(size: float, index: float) -> None:
    """Thickness towards 0, index towards 1: the tilt cannot be found, and says so; the lenses are those without."""
    true = replace(synthetic.chamber(15), panels=(Panel(size, index),) * 2)
    problem, seen = paired(true, 0.1)
    before = problem.copy()
    panels = tied(true)
    found = joint.estimate(problem, seen, panels)
    refined = tied(true, ())
    joint.estimate(before, seen, refined)
    assert found.sigmas["pitch"] > np.deg2rad(3)
    off = (problem.intrinsics - before.intrinsics)[:, :2]
    sigma = np.sqrt(np.diag(found.covariance.matrix))[found.covariance.layout.intrinsics[0]][:2]
    assert (np.abs(off) < 3 * sigma).all()
    assert thickness(panels.slab.chamber) >= 0


def test_a_strong_prior_is_kept_and_a_weak_one_yields() -> None:
    true = synthetic.chamber(15)
    problem, seen = paired(true, 0.1)
    off = replace(true, panels=(Panel(0.0042, 1.49),) * 2, normal=rough(true).normal)
    strong = replace(off, uncertainty=ChamberUncertainty((1e-8, 1e-8), 1e-6, (0.0, 0.0)))
    weak = replace(off, uncertainty=ChamberUncertainty((5e-3, 5e-3), 0.5, (0.0, 0.0)))
    kept, yielded = tied(strong), tied(weak)
    kept.prior, yielded.prior = Prior(strong), Prior(weak)
    first = joint.estimate(problem.copy(), seen, kept)
    second = joint.estimate(problem.copy(), seen, yielded)
    assert thickness(kept.slab.chamber) == pytest.approx(thickness(strong), abs=1e-6)
    assert thickness(yielded.slab.chamber) == pytest.approx(thickness(true), abs=8e-5)
    assert max(second.gain.values()) < 0.05
    assert abs(first.pulls["pitch"]) > 20  # the corners contradict it


def test_chamber_in_only_the_prior_decides_and_the_gain_says_so() -> None:
    true, rt = synthetic.chamber(15), synthetic.poses(14, 1, near=0.3)
    seen_by = synthetic.observe(synthetic.rig(true), rt, noise=0.1)
    corners = np.stack([seen_by.dry, seen_by.wet])
    problem = adjust.assemble(corners, [synthetic.SIZE] * 2, seen_by.board.square).copy(
        lensmodel="LENSMODEL_OPENCV5",
        intrinsics=np.stack([synthetic.rig().dry.intrinsics, synthetic.rig().wet.intrinsics]),
        rt_cam_ref=synthetic.rig().rt_wet_dry[None].copy(),
        rt_ref_board=rt,
        warp=np.zeros(2),
        free=Free(core=True, distortions=True, warp=True),
    )
    seen = problem.observations[..., :2].copy()
    known = true.with_uncertainty()
    panels = Panels(Slab(known, ("tilt", "thickness", "index")), None, None, Prior(known))
    found = joint.estimate(problem, seen, panels)
    assert 0.95 < found.gain["thickness 0"] <= 1.0001  # boards do not improve on a caliper
    assert found.gain["index 0"] > 0.99
    assert found.gain["yaw"] < 0.98
    assert all(abs(pull) < 4 for pull in found.pulls.values())
    sd = found.chamber.uncertainty
    assert sd is not None
    np.testing.assert_allclose(sd.thickness, 2e-5, rtol=0.02)


def test_the_solution_is_a_stationary_point_of_an_independent_sum_of_squares() -> None:
    """The core's own projection through the found panels: no change of tilt or thickness makes it smaller."""
    true = synthetic.chamber(15)
    problem, seen = paired(true, 0.1)
    problem.regularization = False
    panels = tied(rough(true))
    joint.estimate(problem, seen, panels)
    found, taking = panels.slab, problem.observations[..., 2] > 0

    def square(slab: Slab) -> float:
        total = 0.0
        points = mrcal_versions.board_points(*seen.shape[1:3], problem.spacing, problem.warp)
        for row, (frame, camera, _) in enumerate(problem.indices):
            rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[0]
            lens = replace(synthetic.rig().dry, intrinsics=problem.intrinsics[camera])
            placed = pose.transform(pose.compose(rt, problem.rt_ref_board[frame]), points)
            inside = slab.chamber.transformed(rt) if frame >= POSES else None
            pixels, _ = refraction.project(placed.reshape(-1, 3), lens, inside)
            off = pixels.reshape(*seen.shape[1:3], 2) - seen[row]
            total += float(np.sum(off[taking[row]] ** 2))
        return total

    best = square(found)
    for step in np.concatenate([np.diag([1e-3, 1e-3, 2e-5]), -np.diag([1e-3, 1e-3, 2e-5])]):
        assert square(found.moved(step)) > best
