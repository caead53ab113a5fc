"""What the panels' uncertainty does to a calibration: against solving again with other panels, and Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, Panel, Rig, pose, refraction
from rainstereo.calib import (
    consistency,
    contributions,
    point_uncertainty,
    range_uncertainty,
    through_acrylic,
    uncertainty,
)
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.observations import Observations
from rainstereo.calib.prior import Prior
from rainstereo.calib.problem_rig import rig_of
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution, solve
from rainstereo.calib.sought import Sought
from rainstereo.chamber import ChamberUncertainty
from rainstereo.rig import ROLES
from rainstereo.triangulation import triangulate
from rainstereo.types import Array

from . import synthetic

SD = ChamberUncertainty((4e-5, 6e-5), np.deg2rad(1.0), (0.004, 0.004))
INSIDE = replace(synthetic.chamber(25), uncertainty=SD)
MODEL = "LENSMODEL_OPENCV5"


@pytest.fixture(scope="module")
def through() -> Solution:
    seen = synthetic.observe(synthetic.rig(INSIDE), synthetic.poses(12, 1), noise=0.1, seed=0)
    return solve(seen, MODEL, INSIDE)


@pytest.fixture(scope="module")
def found(through: Solution) -> contributions.Contributions:
    return contributions.contributions(through)


def test_parts_add_up(through: Solution, found: contributions.Contributions) -> None:
    assert list(found.parts) == ["corner noise", "tilt", "thickness", "index"]
    np.testing.assert_allclose(sum(p.matrix for p in found.parts.values()), found.total.matrix, rtol=1e-9)
    assert found.slab is not None
    assert not found.assumed
    sd = np.sqrt(np.diag(found.total.matrix)[found.total.layout.slab])
    np.testing.assert_allclose(sd, [SD.tilt, SD.tilt, np.hypot(4e-5, 6e-5), 0.004], rtol=1e-9)
    bare = uncertainty.covariance(through)
    assert found.total.sigma == pytest.approx(bare.sigma, rel=1e-3)
    # bare cameras that see the same would have nearly the same Jacobian
    own = slice(0, bare.layout.size)
    ratio = np.sqrt(np.diag(found.parts["corner noise"].matrix[own, own]) / np.diag(bare.matrix))
    np.testing.assert_allclose(ratio, 1, atol=0.1)


def test_solving_with_other_panels_moves_the_state_as_predicted(through: Solution) -> None:
    """The same corners solved again with a chamber that differs in one parameter."""
    slab = Slab(INSIDE, ("tilt", "thickness", "index"))
    noise, moved = contributions._response(through, slab)
    problem, layout = through.problem, versions.layout(through.problem)
    seen = problem.observations[..., :2] + through_acrylic.shift(problem, INSIDE)
    right = settled(problem, seen, INSIDE)
    for step in np.diag([2e-3, 2e-3, 5e-5, 2e-3]):
        change = settled(problem, seen, slab.moved(step).chamber) - right
        for part in (*layout.intrinsics, layout.extrinsics, layout.frames):
            predicted = (moved @ step)[part]
            little = 2e-3 * np.sqrt(np.diag(noise.matrix)[part])
            assert (np.abs(change[part] - predicted) < 0.03 * np.abs(predicted).max() + little).all()


def settled(problem: versions.Problem, seen: Array, chamber: Chamber) -> Array:
    trial = problem.copy()
    through_acrylic.refine(trial, seen, chamber, tolerance_px=1e-6)
    at = versions.linearize(trial)
    return np.asarray(at.packed * at.scale)


def test_prior_of_several_materials() -> None:
    sd = ChamberUncertainty((3e-5, 4e-5, 0.0), 0.01, (0.001, 0.002, 0.003))
    tank = Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49), Panel(0.004, 1.49), Panel(np.inf, 1.333)), (0.02, 0.0), sd)
    slab = Slab(tank, contributions.uncertain(tank))
    assert slab.names == ("pitch", "yaw", "thickness 0", "index 0", "index 1")
    np.testing.assert_allclose(Prior(tank).sigmas(slab), [0.01, 0.01, 5e-5, 0.002, 0.003])


def test_what_is_exact_adds_nothing(through: Solution) -> None:
    exact = replace(INSIDE, uncertainty=ChamberUncertainty((0.0, 0.0), 0.0, (0.0, 0.0)))
    known = contributions.contributions(replace(through, rig=replace(through.rig, chamber=exact)))
    assert list(known.parts) == ["corner noise"]
    silent = replace(INSIDE, uncertainty=None)
    usual = contributions.contributions(replace(through, rig=replace(through.rig, chamber=silent)))
    assert usual.assumed
    assert list(usual.parts) == ["corner noise", "tilt", "thickness", "index"]
    without = contributions.contributions(replace(through, rig=replace(through.rig, chamber=None)))
    assert without.slab is None
    assert list(without.parts) == ["corner noise"]


def test_a_tilt_matters_far_away_only_by_what_the_calibration_believed(
    through: Solution, found: contributions.Contributions
) -> None:
    """At infinity panels bend nothing; a wrong tilt is wrong there because the lenses made up for it."""
    part = found.parts["tilt"]
    far = range_uncertainty.stereo_uncertainty(through, cov=part, slab=found.slab)
    assert far.expected_rms > 1e-3
    own = slice(0, part.layout.slab.start)  # of mrcal's state
    severed = np.array(part.matrix)
    severed[own, :] = severed[:, own] = 0
    nothing = range_uncertainty.stereo_uncertainty(through, cov=replace(part, matrix=severed), slab=found.slab)
    assert nothing.expected_rms < 1e-12
    near = range_uncertainty.stereo_uncertainty(through, 0.5, cov=replace(part, matrix=severed), slab=found.slab)
    assert near.expected_rms > 1e-3


def drawn(slab: Slab, rng: np.random.Generator) -> Chamber:
    """A chamber that a person would have described as `slab` does."""
    return slab.moved(Prior(slab.chamber).sigmas(slab) * rng.standard_normal(len(slab.names))).chamber


def again(start: Solution, seen: Observations, known: Chamber) -> Solution:
    """The calibration of other corners of the same boards, from a calibration that is nearly theirs."""
    problem = start.problem.copy()
    frame, camera = problem.indices[:, 0], problem.indices[:, 1]
    corners = np.stack([seen.xy(role) for role in ROLES])[camera, frame]
    problem.observations[..., 2] = np.isfinite(corners[..., 0])
    through_acrylic.refine(problem, np.nan_to_num(corners), known)
    return replace(start, problem=problem, rig=rig_of(problem, known))


def pair(rig: Rig, depth: float) -> Array:
    """Pixels of both cameras, (4,), that see what the middle of the dry image shows at a depth."""
    middle = np.array([639.5, 479.5])
    ray = refraction.backproject(middle, rig.dry, rig.chamber)
    point = ray.origins + (depth - ray.origins[2]) / ray.directions[2] * ray.directions
    wet, _ = refraction.project(pose.transform(rig.rt_wet_dry, point), rig.wet, rig.chamber_in("wet"))
    return np.concatenate([middle, wet])


def test_parts_of_panels_that_were_estimated() -> None:
    """With a description that says little the corners speak; the parts still add up to the joint covariance."""
    vague = ChamberUncertainty((1e-3, 1e-3), np.deg2rad(3.0), (0.004, 0.004))
    chamber = replace(INSIDE, uncertainty=vague)
    seen = synthetic.observe(synthetic.rig(INSIDE), synthetic.poses(12, 1), noise=0.1, seed=0)
    found = solve(seen, MODEL, Sought(chamber, ("tilt", "thickness"), Prior(chamber)))
    spread = contributions.contributions(found)
    assert list(spread.parts) == ["corner noise", "tilt", "thickness"]
    np.testing.assert_allclose(sum(p.matrix for p in spread.parts.values()), spread.total.matrix)
    for part in spread.parts.values():  # each is a covariance
        deviation = np.sqrt(np.maximum(np.diag(part.matrix), 1e-300))
        assert np.linalg.eigvalsh(part.matrix / np.outer(deviation, deviation)).min() > -1e-6
    prior, slab = np.diag(spread.total.matrix)[spread.total.layout.slab], spread.slab
    assert slab is not None
    assert (np.sqrt(prior) <= Prior(chamber).sigmas(slab) * (1 + 1e-6)).all()
    pitch = spread.total.layout.slab.start
    told = [part.matrix[pitch, pitch] for part in spread.parts.values()]
    assert told[0] > told[1]  # three degrees are less than what the corners know


@pytest.mark.slow
@pytest.mark.parametrize("tilt_deg", [15, 45])
def test_monte_carlo(tilt_deg: int) -> None:
    """Panels and corners err as stated: empirical over predicted between 0.8 and 1.25 for every figure reported."""
    known = replace(synthetic.chamber(tilt_deg), uncertainty=SD)
    slab, rt = Slab(known, contributions.uncertain(known)), synthetic.poses(9, 1)
    rng, distances, depths = np.random.default_rng(tilt_deg), (np.inf, 2.0, 0.5), (0.5, 2.0)
    start = solve(synthetic.observe(synthetic.rig(known), rt, noise=0.1, seed=1), MODEL, known)
    grid = uncertainty.image_grid(np.array(synthetic.SIZE), (6, 4))
    errors: dict[str, list[Array]] = {}
    for trial in range(150):
        true = synthetic.rig(drawn(slab, rng))
        found = again(start, synthetic.observe(true, rt, noise=0.1, seed=trial), known)
        for d in distances:
            off = consistency.wet_pixels(found.rig, grid, d) - consistency.wet_pixels(true, grid, d)
            errors.setdefault(f"wet against dry at {d} m", []).append(off)
        errors.setdefault("baseline", []).append(np.array(found.rig.baseline - true.baseline))
        pairs = np.array([pair(true, z) for z in depths])
        at = triangulate(found.rig, pairs[:, :2], pairs[:, 2:])
        for z, point in zip(depths, at.points, strict=True):
            errors.setdefault(f"depth at {z} m", []).append(point[2] - z)
    spread = contributions.contributions(found)
    predicted = {
        f"wet against dry at {d} m": range_uncertainty.stereo_uncertainty(
            found, d, (6, 4), cov=spread.total, slab=spread.slab
        ).expected_rms / np.sqrt(2)
        for d in distances
    }  # fmt: skip
    predicted["baseline"] = uncertainty.baseline_sigma(found, spread.total)
    depth = point_uncertainty.at_depths(
        found, np.array(depths), pixel_sigma=0.0, cov=spread.total, slab=spread.slab
    ).depth_sigma
    predicted |= {f"depth at {z} m": float(sigma) for z, sigma in zip(depths, depth, strict=True)}
    ratios = {name: float(np.sqrt(np.mean(np.square(each))) / predicted[name]) for name, each in errors.items()}
    print(tilt_deg, {name: round(ratio, 2) for name, ratio in ratios.items()})
    assert all(0.8 < ratio < 1.25 for ratio in ratios.values()), ratios
