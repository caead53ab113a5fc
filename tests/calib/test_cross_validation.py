"""The lens model chosen: as simple as the lens allows, as rich as it demands."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mrcal", reason="mrcal is not installed")

from rainstereo.calib import cross_validation
from rainstereo.calib.cross_validation import choose_lensmodel
from rainstereo.camera import Camera
from rainstereo.rig import Rig

from . import synthetic

SIMPLE = ("LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8")
RATIONAL = np.array([0.75, 0.06, 0, 0, 0, 1.0, 0.19, 0.002])


def wide() -> Rig:
    """A wide rational lens, close to stereographic, that no polynomial of two or three terms follows."""
    true = synthetic.rig()
    cameras = [
        Camera(
            "LENSMODEL_OPENCV8",
            np.concatenate([[620, 620], camera.intrinsics[2:4], RATIONAL]),
            *camera.size,
            camera.rt_cam_ref,
        )
        for camera in (true.dry, true.wet)
    ]
    return Rig(cameras[0], cameras[1])


def test_simplest_sufficient_model_is_kept() -> None:
    true = synthetic.rig(distortion=(-0.2, 0.08, 3e-4, -2e-4))
    seen = synthetic.observe(true, synthetic.poses(14, 1), noise=0.1, seed=2)
    choice = choose_lensmodel(seen)
    assert choice.lensmodel == "LENSMODEL_OPENCV4"
    assert [row.pays for row in choice.table] == [True, False, False, False]
    for row in choice.table[:3]:
        assert row.held_out_px == pytest.approx(0.1, rel=0.15)
        assert row.held_out_px > row.fit_px


def test_rich_model_is_taken_where_the_lens_demands_it() -> None:
    rt = synthetic.poses(14, 1, near=0.1, far=0.5)
    rt[:, 3:5] *= 1.8
    seen = synthetic.observe(wide(), rt, noise=0.05, seed=2)
    choice = choose_lensmodel(seen, SIMPLE)
    assert choice.lensmodel == "LENSMODEL_OPENCV8"
    assert choice.table[0].held_out_px > 3 * choice.table[2].held_out_px
    assert choice.table[2].held_out_median_px == pytest.approx(0.05, rel=0.2)


def test_few_frames_keep_the_simplest_model_and_say_so() -> None:
    seen = synthetic.observe(synthetic.rig(), synthetic.poses(4, 1), noise=0.1)
    choice = choose_lensmodel(seen, SIMPLE)
    assert choice.lensmodel == "LENSMODEL_OPENCV4"
    assert "too few" in choice.table[1].reason


def test_copies_of_a_frame_are_no_unseen_frames() -> None:
    seen = synthetic.observe(synthetic.rig(), np.repeat(synthetic.poses(4, 1), 5, axis=0), noise=0.1)
    choice = choose_lensmodel(seen)
    assert choice.lensmodel == "LENSMODEL_OPENCV4"
    assert "4 different views are too few" in choice.table[1].reason


def test_chamber_is_taken_off_before_models_are_compared() -> None:
    true = synthetic.rig(synthetic.chamber(15), distortion=(-0.2, 0.08, 3e-4, -2e-4))
    seen = synthetic.observe(true, synthetic.poses(12, 1), noise=0.03, seed=2)
    choice = choose_lensmodel(seen, SIMPLE[:2], true.chamber)
    assert choice.lensmodel == "LENSMODEL_OPENCV4"
    assert choice.table[0].held_out_px == pytest.approx(0.03, rel=0.2)


def test_dense_boards_are_thinned_to_the_same_geometry() -> None:
    board = replace(synthetic.BOARD, rows=14, columns=20)
    dense = synthetic.observe(synthetic.rig(), synthetic.poses(12, 1, board, near=0.4), board)
    thin = cross_validation._thinned(dense)
    np.testing.assert_array_equal(thin.wet, dense.wet[:, ::2, ::2])
    np.testing.assert_allclose(thin.board.points, dense.board.points[::2, ::2])
    assert cross_validation._thinned(thin) is thin


def test_choice_is_repeatable_and_reports_progress() -> None:
    seen = synthetic.observe(synthetic.rig(), synthetic.poses(9, 1), noise=0.1)
    names: list[str] = []
    first = choose_lensmodel(seen, SIMPLE[:2], progress=names.append)
    assert names == list(SIMPLE[:2])
    assert choose_lensmodel(seen, SIMPLE[:2]) == first


def test_no_candidate_is_refused() -> None:
    seen = synthetic.observe(synthetic.rig(), synthetic.poses(4, 1))
    with pytest.raises(ValueError, match=r"no lens model to choose from"):
        choose_lensmodel(seen, ())
