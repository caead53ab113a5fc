"""The cavity set: four real cameras that look through plexiglass into water. And the folders that are not it."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rainstereo.apps import bench_cavity, cavity_set
from rainstereo.apps.cavity_trial import MODELS, Trial, rms
from rainstereo.calib import known_points


@pytest.fixture(scope="module")
def cavity(shared_data: Path) -> Path:
    folder = shared_data / "through_glass" / "openptv_cavity"
    if not folder.is_dir():
        pytest.skip("the cavity set is not beside this checkout")
    return folder


@pytest.mark.slow
def test_refraction_beats_the_central_camera_on_every_count(cavity: Path) -> None:
    views = cavity_set.load(cavity)
    assert [len(view.ids) for view in views] == [40, 42, 69, 69]
    for view in views:  # each dot once, each where OpenPTV's files say it is, but for one common shift
        assert len(set(view.ids.tolist())) == len(view.ids)
        off = known_points.seen(view.points, view.openptv, view.window) - view.pixels
        assert np.abs(off - np.median(off, axis=0)).max() < 9
    with_wall, central = Trial(MODELS[0], views), Trial(MODELS[1], views)
    for ours, theirs in zip(with_wall.residuals, central.residuals, strict=True):
        assert rms(ours) < 0.48
        assert rms(ours) < 0.75 * rms(theirs)
    assert rms(with_wall.residuals) < 0.52 * rms(central.residuals)
    assert rms(with_wall.halves) < 0.55 * rms(central.halves)
    depth, flat = rms(with_wall.in_space()[:, 2]), rms(central.in_space()[:, 2])
    assert depth < 0.17e-3
    assert depth < 0.45 * flat
    found = with_wall.cameras
    for camera in found:  # a 70 mm lens focused at half a metre: 5833 px at infinity, up to a fifth more here
        assert 5000 < camera.intrinsics[0] < 6600
    peer = bench_cavity.PEER_MODEL.fit(views[2])
    assert peer.intrinsics[0] == pytest.approx(central.cameras[2].intrinsics[0], rel=1e-4)


def test_a_folder_that_is_not_the_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="give --cavity FOLDER"):
        bench_cavity.build(0, True)
    with pytest.raises(FileNotFoundError, match="expected a folder with OpenPTV's cavity set"):
        cavity_set.load(tmp_path)
    (tmp_path / "target_on_a_side.txt").write_text("1 -40 -25 eight\n")
    with pytest.raises(ValueError, match="something besides numbers"):
        cavity_set.target(tmp_path / "target_on_a_side.txt")
    (tmp_path / "a.ori").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="holds 3 numbers; expected the 21"):
        cavity_set.orientation(tmp_path / "a.ori")


def test_images_without_the_pattern_are_refused(cavity: Path, tmp_path: Path) -> None:
    for name in ("target_on_a_side.txt", "cam1.tif.ori", "cam2.tif.ori"):
        shutil.copy(cavity / name, tmp_path / name)
    from rainstereo import imagefile

    imagefile.write(tmp_path / "cam1.png", np.full((1024, 1280), 30, np.uint8))
    with pytest.raises(ValueError, match="pattern is not among the dots found"):
        cavity_set.load(tmp_path)
    imagefile.write(tmp_path / "cam1.png", np.full((512, 640), 30, np.uint8))
    with pytest.raises(ValueError, match="is 640 x 512; expected 1280 x 1024"):
        cavity_set.load(tmp_path)
