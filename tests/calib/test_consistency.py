"""Parts of a capture against each other: noise differs as noise should, ignored panels by more."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo.calib import consistency, uncertainty
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution, solve

from . import synthetic

INSIDE = synthetic.chamber(25)
MODEL = "LENSMODEL_OPENCV5"


@pytest.fixture(scope="module")
def through() -> Solution:
    seen = synthetic.observe(synthetic.rig(INSIDE), synthetic.poses(24, 1), noise=0.05, seed=0)
    return solve(seen, MODEL, INSIDE)


def test_noise_alone_differs_as_expected(through: Solution) -> None:
    compared = consistency.compare(through, grid=(8, 6))
    assert [each.frames for each in compared] == [(12, 12), (16, 24), (16, 24), (16, 24)]
    for each in compared:
        assert not each.failure
        assert [d.distance for d in each.differences] == [np.inf, 2.0, 0.5]
        for d in each.differences:
            assert 0.4 < d.ratio < 1.7, (each.name, d.distance)  # few degrees of freedom
            assert d.found < 3 * d.expected
            assert d.max >= d.found
    assert consistency.doubts(compared) == []
    assert compared[0].at(2.0) is compared[0].differences[1]
    assert compared[0].at(7.0) is None


def test_ignored_panels_show_although_the_residuals_hide_them(through: Solution) -> None:
    """Boards at different distances ask for different lenses: the nearest third is the telltale."""
    seen = synthetic.observe(synthetic.rig(INSIDE), synthetic.poses(24, 1), noise=0.05, seed=0)
    blind = solve(seen, MODEL)
    assert blind.rms_px < 0.1  # which looks like a good calibration
    compared = consistency.compare(blind, grid=(8, 6))
    nearest = compared[1]
    assert "nearest" in nearest.name
    assert max(d.ratio for d in nearest.differences) > 2
    (doubt, *_) = consistency.doubts(compared)
    assert "times what noise of the corners explains" in doubt.text
    assert "panels" in doubt.remedy


def test_what_is_small_is_noted_and_what_is_large_is_doubted() -> None:
    pixels, expected = np.zeros((2, 2, 2)), np.full((2, 2), 1e-4)
    severities = []
    for length in (0.005, 0.1, 1.0):
        difference = consistency.Difference(np.inf, pixels, np.full((2, 2, 2), length / np.sqrt(2)), expected)
        assert difference.found == pytest.approx(length)
        assert difference.ratio == pytest.approx(length / 0.01)
        severities.append(
            [f.severity for f in consistency.doubts([consistency.Comparison("x", (4, 4), (difference,))])]
        )
    assert severities == [[], ["note"], ["doubtful"]]


def test_a_part_is_what_solving_it_alone_gives(through: Solution) -> None:
    kept = np.arange(24) % 2 == 0
    warm = consistency.part(through, kept)
    seen = synthetic.observe(synthetic.rig(INSIDE), synthetic.poses(24, 1), noise=0.05, seed=0)
    alone = solve(replace(seen, names=seen.names[::2], dry=seen.dry[::2], wet=seen.wet[::2]), MODEL, INSIDE)
    assert warm.problem.observations.shape[0] == kept[through.problem.indices[:, 0]].sum()
    difference = uncertainty.infinity_error(warm.rig, alone.rig)
    assert max(difference.dry.rms, difference.stereo.rms) < 0.02  # outliers were chosen from all frames
    assert through.problem.observations.shape[0] == len(through.problem.indices)


def test_frames_whose_board_stood_still_keep_their_partner() -> None:
    ties = np.array([0, 1, 2, 0, 1, 2])
    panels = Panels(Slab(INSIDE), ties=ties)
    kept = np.array([True, False, True, True, True, False])
    assert consistency._ties(panels, kept).tolist() == [0, 1, 0, 3]  # type: ignore[union-attr]
    assert consistency._ties(Panels(Slab(INSIDE)), kept) is None


def test_too_few_frames_are_said_to_be() -> None:
    found = solve(synthetic.observe(synthetic.rig(), synthetic.poses(5, 2), noise=0.05), "LENSMODEL_OPENCV4")
    compared = consistency.compare(found)
    assert all(not each.differences for each in compared[:3])  # without the farthest one four are left
    assert "too few" in compared[0].failure
    assert "too few" in compared[1].failure


def test_wet_pixels_at_infinity_are_the_limit() -> None:
    rig = synthetic.rig(INSIDE)
    dry = uncertainty.image_grid(np.array(synthetic.SIZE), (4, 3))
    far, infinite = (consistency.wet_pixels(rig, dry, d) for d in (1e6, np.inf))
    np.testing.assert_allclose(far, infinite, atol=1e-3)
    assert np.isnan(consistency.wet_pixels(rig, dry, 0.01)).all()
