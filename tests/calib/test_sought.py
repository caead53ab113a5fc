"""solve() with panels that are sought: ties of poses, hypotheses, and what a user is told."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo import Chamber, Panel, Rig
from rainstereo.calib import board_shape, hypotheses, panel_checks, uncertainty
from rainstereo.calib.observations import Observations
from rainstereo.calib.prior import Prior
from rainstereo.calib.slab import across
from rainstereo.calib.solve import Solution, solve
from rainstereo.calib.sought import Sought
from rainstereo.chamber import ChamberUncertainty

from . import synthetic

COUNT = 9
TRUE = synthetic.chamber(15)
ACRYLIC = Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49),))


def described(true: Chamber) -> Chamber:
    normal = np.array(true.normal) + across(true.normal) @ np.deg2rad([2.0, -1.0])
    return replace(true, normal=tuple(normal.tolist()), panels=(Panel(0.0038, 1.49),) * 2, distance=0.05)


def captures(moved: int | None = None) -> tuple[Observations, Rig]:
    """Each board without, then with the chamber; one of them pushed by 0.3 mm in between."""
    true, rt = synthetic.rig(TRUE), synthetic.poses(COUNT, 3, near=0.25, far=0.6)
    after = rt.copy()
    if moved is not None:
        after[moved, 3] += 3e-4
    bare = synthetic.observe(replace(true, chamber=None), rt, noise=0.1, seed=1)
    through = synthetic.observe(true, after, noise=0.1, seed=2)
    dry, wet = (np.concatenate([getattr(bare, role), getattr(through, role)]) for role in ("dry", "wet"))
    names = tuple(f"bare/{i}" for i in range(COUNT)) + tuple(f"chamber/{i}" for i in range(COUNT))
    return Observations(bare.board, names, dry, wet, dict(bare.imagersize)), true


@pytest.fixture(scope="module")
def found() -> tuple[Solution, Rig]:
    seen, true = captures(moved=4)
    index = np.arange(2 * COUNT)
    sought = Sought(described(TRUE), ("tilt", "thickness"), None, index >= COUNT, index % COUNT, wedge=True)
    return solve(seen, "LENSMODEL_OPENCV5", sought), true


def test_a_flat_board_is_not_called_twisted_where_panels_are_free(found: tuple[Solution, Rig]) -> None:
    shape = board_shape.examine(found[0])
    assert shape is not None
    assert max(shape.twist_sigmas, shape.ripple_sigmas) < 4
    assert shape.corner_sigma == pytest.approx(0.1, rel=0.05)


def test_paired_captures_find_the_panels_and_the_board_that_moved(found: tuple[Solution, Rig]) -> None:
    solution, _ = found
    estimate, chamber = solution.estimate, solution.rig.chamber
    assert estimate is not None
    assert chamber is not None
    off = across(TRUE.normal).T @ np.array(chamber.normal)
    assert abs(off[0]) < 4 * estimate.sigmas["pitch"] < np.deg2rad(0.4)
    assert abs(off[1]) < 4 * estimate.sigmas["yaw"]
    assert sum(panel.thickness for panel in chamber.panels) == pytest.approx(0.008, abs=1e-4)
    assert chamber.distance == 0.05
    assert chamber.nominal == ("distance", "gaps", "index")
    assert solution.moved == ("chamber/4",)
    assert len(solution.names) == 2 * COUNT


def test_its_covariance_is_that_of_the_joint_solve(found: tuple[Solution, Rig]) -> None:
    solution, true = found
    cov = uncertainty.covariance(solution)
    assert cov.layout.slab.stop == cov.layout.size == len(cov.matrix)
    np.testing.assert_array_equal(
        cov.matrix[cov.layout.frames, cov.layout.frames][:6, :6],
        cov.matrix[cov.layout.frames, cov.layout.frames][6 * COUNT : 6 * COUNT + 6, 6 * COUNT : 6 * COUNT + 6],
    )  # board 0 has one pose
    assert abs(solution.rig.baseline - true.baseline) < 4 * uncertainty.baseline_sigma(solution)


def test_hypotheses_and_words(found: tuple[Solution, Rig]) -> None:
    solution, _ = found
    table = hypotheses.compare(solution, described(TRUE))
    rows = {row.name: row for row in table}
    assert [row.problem for row in table] == [""] * 4
    assert rows[hypotheses.KNOWN].gain > 100
    assert rows[hypotheses.ESTIMATED].rejects  # the description, that is, by 2 degrees
    assert not rows[hypotheses.WEDGE].rejects
    assert max(row.rms_px for row in table[2:]) < 0.11
    told = [finding.text for finding in panel_checks.panels(solution, described(TRUE), table)]
    assert any("moved while" in text for text in told)
    assert any("kept from the description" in text and "distance, gaps, index" in text for text in told)
    assert not any("not parallel" in text for text in told)


def test_names_that_agree_by_chance_tie_nothing() -> None:
    true = synthetic.rig(TRUE)
    bare = synthetic.observe(replace(true, chamber=None), synthetic.poses(7, 3, near=0.25), noise=0.1, seed=1)
    through = synthetic.observe(true, synthetic.poses(7, 8, near=0.25), noise=0.1, seed=2)
    dry, wet = (np.concatenate([getattr(bare, role), getattr(through, role)]) for role in ("dry", "wet"))
    seen = Observations(bare.board, tuple(map(str, range(14))), dry, wet, dict(bare.imagersize))
    index = np.arange(14)
    solution = solve(seen, "LENSMODEL_OPENCV5", Sought(TRUE, ("tilt", "thickness"), None, index >= 7, index % 7))
    assert solution.moved == tuple(map(str, range(7, 14)))
    assert solution.estimate is not None
    assert solution.estimate.sigmas["thickness 0"] > 1e-4  # independent poses know much less


def test_a_description_that_corners_contradict_is_reported_with_its_pull() -> None:
    seen = synthetic.observe(synthetic.rig(TRUE), synthetic.poses(14, 1, near=0.25), noise=0.05)
    wrong = replace(TRUE, normal=(-0.3, TRUE.normal[1], 1.0)).with_uncertainty()
    solution = solve(seen, "LENSMODEL_OPENCV5", Sought(wrong, ("tilt", "thickness"), Prior(wrong)))
    assert solution.estimate is not None
    assert abs(solution.estimate.pulls["yaw"]) > panel_checks.CONTRADICTION
    told = panel_checks.panels(solution, wrong)
    assert any("yaw is pulled by" in finding.text and finding.severity == "doubtful" for finding in told)


@pytest.mark.parametrize(
    ("chamber", "words"),
    [
        (Chamber((0, 0, 1), 0.04, (Panel(0.4, 1.49),)), "400 mm thick"),
        (Chamber((0, 0, 1), 0.04, (Panel(4e-6, 1.49),)), "0.004 mm thick"),
        (Chamber((0, 0, 1), 0.04, (Panel(0.004, 4.0),)), "index of 4"),
        (Chamber((0, 0, 1), 40.0, (Panel(0.004, 1.49),)), "40000 mm away"),
        (Chamber((0, 1, 0.1), 0.04, (Panel(0.004, 1.49),)), "tilted by 84 degrees"),
        (replace(ACRYLIC, uncertainty=ChamberUncertainty((2e-5,), np.deg2rad(0.0087), (0.0,))), "known to 0.0087 deg"),
        (
            replace(ACRYLIC, uncertainty=ChamberUncertainty((2e-8,), 0.01, (0.0,))),
            "panel 1 is described as known to 2e",
        ),
    ],
)
def test_units_that_are_hardly_meant_are_questioned(chamber: Chamber, words: str) -> None:
    assert any(words in finding.text for finding in panel_checks.questions(chamber))
    assert not panel_checks.questions(TRUE)
    assert not panel_checks.questions(TRUE.with_uncertainty())
    assert not panel_checks.questions(replace(ACRYLIC, uncertainty=ChamberUncertainty((0.0,), 0.0, (0.0,))))
