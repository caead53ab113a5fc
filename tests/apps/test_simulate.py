"""The digital rig: its truth, what it renders, and the recording it writes."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Rig
from rainstereo.apps import simulate
from rainstereo.apps.board_poses import board_poses
from rainstereo.apps.board_views import board_drawing, render_board
from rainstereo.apps.digital_rig import RigOptions, digital_rig, exact_observations, rt_cam_board
from rainstereo.apps.photographs import NAMES, photograph
from rainstereo.apps.simulate import Options, simulation
from rainstereo.apps.simulation_images import write_images
from rainstereo.apps.street import CAMERA_HEIGHT, drive, street
from rainstereo.calib.board import Board
from rainstereo.pose import compose, rotation_matrix, transform
from rainstereo.refraction import backproject
from rainstereo.rig import ROLES
from rainstereo.sensor import Sensor
from rainstereo.types import Array
from rainstereo.view import View

CHESS = Board.parse("chessboard:9x6:25mm")
CHARUCO = Board.parse("charuco:11x8:25mm:19mm:DICT_4X4_250")
SMALL = RigOptions(width=640, height=480)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return digital_rig(SMALL)


# -- the rig -----------------------------------------------------------------------------------------------------------


def test_default_rig_is_the_papers() -> None:
    rig = digital_rig()
    assert rig.dry.size == rig.wet.size == (1280, 960)
    assert rig.baseline == pytest.approx(0.029, abs=1e-15)
    centre = -rotation_matrix(rig.rt_wet_dry[:3]).T @ rig.rt_wet_dry[3:]
    assert centre[0] < -0.0289  # the wet camera stands on the left
    assert 0 < np.degrees(np.linalg.norm(rig.rt_wet_dry[:3])) < 0.7
    assert abs(rig.dry.intrinsics[0] - 1200) < 5
    assert rig.chamber is not None
    assert np.degrees(rig.chamber.tilt) == pytest.approx(15)
    assert [(p.thickness, p.index) for p in rig.chamber.panels] == [(0.004, 1.49)] * 2
    assert (rig.chamber.distance, rig.chamber.gaps) == (0.04, (0.02,))


def test_seed_makes_the_rig() -> None:
    first, again, other = digital_rig(SMALL, 1), digital_rig(SMALL, 1), digital_rig(SMALL, 2)
    assert np.array_equal(first.wet.intrinsics, again.wet.intrinsics)
    assert np.array_equal(first.rt_wet_dry, again.rt_wet_dry)
    assert not np.array_equal(first.wet.intrinsics, other.wet.intrinsics)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    fx=st.floats(0.5, 4),
    lens=st.sampled_from(["LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8"]),
)
def test_every_pixel_of_every_digital_lens_has_a_ray(seed: int, fx: float, lens: str) -> None:
    rig = digital_rig(RigOptions(640, 480, fx=fx * 640, lens=lens), seed)  # type: ignore[arg-type]
    edge = np.array([(x, y) for x in np.linspace(-0.5, 639.5, 9) for y in (-0.5, 240, 479.5)])
    for camera in (rig.dry, rig.wet):
        assert np.abs(camera.project(camera.unproject(edge)) - edge).max() < 1e-8


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tilt_deg": 81}, "--tilt-deg 81"),
        ({"tilt_deg": 75}, "runs along the edge"),
        ({"baseline_mm": 0}, "--baseline-mm"),
        ({"index": 0.9}, "--index"),
        ({"thickness_mm": float("nan")}, "--thickness-mm"),
        ({"width": 10}, "--width"),
        ({"fx": 1.0}, "--fx"),
        ({"yaw_deg": 50, "distance_mm": 10, "fx": 4000}, "inside the chamber"),
    ],
)
def test_impossible_rigs_are_refused(change: dict[str, float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        digital_rig(replace(RigOptions(), **change))  # type: ignore[arg-type]


def test_exact_corners_without_chamber_are_opencvs(rig: Rig) -> None:
    poses = board_poses(rig, CHESS, 4, 0, through=False)
    for role, seen in zip(ROLES, exact_observations(rig, CHESS, poses, through=False), strict=True):
        camera = rig.camera(role)
        matrix = np.array([[camera.intrinsics[0], 0, camera.intrinsics[2]], [0, *camera.intrinsics[[1, 3]]], [0, 0, 1]])
        for pose, pixels in zip(poses, seen, strict=True):
            rt = compose(camera.rt_cam_ref, pose)
            theirs, _ = cv2.projectPoints(CHESS.points.reshape(-1, 3), rt[:3], rt[3:], matrix, camera.distortion)
            assert np.abs(theirs.reshape(pixels.shape) - pixels).max() < 1e-9


def test_rays_of_exact_corners_pass_through_the_corners(rig: Rig) -> None:
    poses = board_poses(rig, CHESS, 5, 3)
    for role, seen in zip(ROLES, exact_observations(rig, CHESS, poses), strict=True):
        for pose, pixels in zip(poses, seen, strict=True):
            points = transform(rt_cam_board(rig, role, pose), CHESS.points)
            origins, directions = backproject(pixels, rig.camera(role), rig.chamber_in(role))
            assert np.linalg.norm(np.cross(points - origins, directions), axis=-1).max() < 1e-12


def test_corners_beyond_the_frame_are_nan(rig: Rig) -> None:
    pose = np.array([0, 0, 0, 0.1, -0.05, 0.5])
    dry, wet = exact_observations(rig, CHESS, pose)
    assert dry.shape == wet.shape == (1, 6, 9, 2)
    for seen in (dry, wet):
        lost = np.isnan(seen[..., 0])
        assert 0 < lost.sum() < 54
        assert np.nanmax(seen[..., 0]) <= 639.5


# -- poses of boards ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("board", [CHESS, CHARUCO], ids=["chessboard", "charuco"])
@pytest.mark.parametrize("through", [True, False])
def test_boards_are_seen_by_both_and_reach_the_corners(rig: Rig, board: Board, through: bool) -> None:
    poses = board_poses(rig, board, 20, 0, through=through)
    assert rig.chamber is not None
    seen = exact_observations(rig, board, poses, through)
    shares = np.stack([np.isfinite(s[..., 0]).mean((1, 2)) for s in seen])
    assert shares.min() >= (1.0 if board.kind == "chessboard" else 1 / 3)
    if board.kind == "charuco":
        assert (shares < 1).any()  # partly beyond the frame
    points = np.stack([transform(pose, board.points) for pose in poses])
    assert (points @ np.array(rig.chamber.normal)).min() > rig.chamber.depth
    for pixels in seen:
        low, high = np.nanmin(pixels, (0, 1, 2)), np.nanmax(pixels, (0, 1, 2))
        assert (low < [0.1 * 640, 0.1 * 480]).all()
        assert (high > [0.9 * 640, 0.9 * 480]).all()
    tilts = np.degrees(np.arccos(rotation_matrix(poses[:, :3])[:, 2, 2]))
    assert (tilts > 30).sum() >= 8
    assert tilts.max() <= 45.01
    distances = points.mean((1, 2))[:, 2]
    assert distances.min() < 0.45
    assert distances.max() > 0.7


def test_poses_are_seeded_and_impossible_ones_refused(rig: Rig) -> None:
    assert np.array_equal(board_poses(rig, CHESS, 5, 1), board_poses(rig, CHESS, 5, 1))
    assert not np.array_equal(board_poses(rig, CHESS, 5, 1), board_poses(rig, CHESS, 5, 2))
    with pytest.raises(ValueError, match="another distance"):
        board_poses(rig, CHESS, 5, 1, near=0.05, far=0.1)
    with pytest.raises(ValueError, match="near < far"):
        board_poses(rig, CHESS, 5, 1, near=2, far=1)


# -- pictures of boards ------------------------------------------------------------------------------------------------


def refined(image: Array, exact: Array) -> Array:
    """OpenCV's corners, started within a pixel or so of where they must be."""
    start = np.round(exact).astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    return cv2.cornerSubPix(image, start, (4, 4), (-1, -1), criteria).reshape(exact.shape)  # type: ignore[return-value]


@pytest.mark.parametrize("through", [True, False])
def test_corners_in_images_are_where_projection_says(rig: Rig, through: bool) -> None:
    poses = board_poses(rig, CHESS, 6, 5, through=through)
    errors = []
    for role, seen in zip(ROLES, exact_observations(rig, CHESS, poses, through), strict=True):
        view = View.trace(rig.camera(role), rig.chamber_in(role) if through else None)
        drawing = board_drawing(CHESS, 4 * 600 / 0.3)
        for pose, exact in zip(poses, seen, strict=True):
            rng = np.random.default_rng(0)
            image = render_board(view, drawing, rt_cam_board(rig, role, pose), Sensor(0.7, 2, 0), rng)
            errors.append((refined(image, exact) - exact).reshape(-1, 2))
    error = np.concatenate(errors)
    assert len(error) == 2 * 6 * 54
    assert np.abs(error.mean(0)).max() < 0.005  # bias of all
    assert np.median(np.abs(error)) < 0.025  # mostly the detector's own
    assert np.sqrt((error**2).mean()) < 0.06


def test_detector_finds_rendered_boards_by_itself(rig: Rig) -> None:
    view = View.trace(rig.dry, rig.chamber)
    poses = board_poses(rig, CHESS, 4, 7)
    exact, _ = exact_observations(rig, CHESS, poses)
    for pose, corners in zip(poses, exact, strict=True):
        image = render_board(view, board_drawing(CHESS, 8000), pose, Sensor(), np.random.default_rng(1))
        found, pixels = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_EXHAUSTIVE)
        assert found
        straight = pixels.reshape(corners.shape)
        flipped = straight[::-1, ::-1]
        assert min(np.abs(straight - corners).max(), np.abs(flipped - corners).max()) < 0.6


def test_charuco_markers_are_read_with_their_numbers(rig: Rig) -> None:
    view = View.trace(rig.dry, rig.chamber)
    pose = board_poses(rig, CHARUCO, 1, 2, far=0.5)[0]
    image = render_board(view, board_drawing(CHARUCO, 8000), pose, Sensor(), np.random.default_rng(1))
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(CHARUCO.charuco()).detectBoard(image)
    exact = exact_observations(rig, CHARUCO, pose)[0][0].reshape(-1, 2)
    assert len(numbers) > 30
    error = corners.reshape(-1, 2) - 0.5 - exact[numbers.reshape(-1)]  # this detector's pixel centres are half-integers
    assert np.abs(error).max() < 0.2
    assert np.abs(error.mean(0)).max() < 0.03


def test_chamber_moves_corners_as_predicted(rig: Rig) -> None:
    pose = np.array([0.5, 0.1, 0.05, -0.11, -0.06, 0.32])
    images, exact = [], []
    for through in (False, True):
        view = View.trace(rig.dry, rig.chamber if through else None)
        exact.append(exact_observations(rig, CHESS, pose, through)[0][0])
        image = render_board(view, board_drawing(CHESS, 8000), pose, Sensor(0.7, 2, 0), np.random.default_rng(0))
        images.append(refined(image, exact[-1]))
    predicted = exact[1] - exact[0]
    assert np.linalg.norm(predicted, axis=-1).max() > 1.0
    error = images[1] - images[0] - predicted
    assert np.abs(error.mean((0, 1))).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.06


# -- the street --------------------------------------------------------------------------------------------------------


def test_photographs_come_with_scikit_image() -> None:
    for name in NAMES:
        image = photograph(name)
        assert image.dtype == np.uint8
        assert image.shape[2] == 3
        assert min(image.shape[:2]) >= 300
    with pytest.raises(ValueError, match="expected one of"):
        photograph("lena")


def test_things_stand_on_the_street_at_5_to_60_m() -> None:
    scene = street(0)
    assert scene.planes[0].name == "road"
    upright = [p for p in scene.planes if p.name not in ("road", "kerb", "land")]
    depth = np.array([transform(p.rt_scene_plane, np.array([*p.size, 0]) / 2)[2] for p in upright])
    assert ((depth > 5) & (depth < 60)).sum() > 30
    for plane in upright:
        bottom = transform(plane.rt_scene_plane, np.array([[0.0, plane.size[1], 0], [*plane.size, 0]]))[:, 1]
        assert (bottom < 1e-9).all()  # y points down
        assert rotation_matrix(plane.rt_scene_plane[:3])[1, 1] == pytest.approx(1)


def test_drive_goes_ahead_at_camera_height() -> None:
    poses = drive(5, 0)
    centres = np.stack([-rotation_matrix(p[:3]).T @ p[3:] for p in poses])
    assert np.diff(centres[:, 2]) == pytest.approx([0.8] * 4)
    assert centres[:, 1] == pytest.approx([-CAMERA_HEIGHT] * 5)


# -- the recording -----------------------------------------------------------------------------------------------------

TINY = RigOptions(width=320, height=240)
BOARDS = ("chessboard:5x4:30mm", "charuco:6x5:30mm:22mm:DICT_4X4_50")


def options(out: Path, **change: object) -> Options:
    made = Options(out, BOARDS, frames=2, bare_frames=1, drive_frames=2, supersampling=3, rig=TINY, workers=1)
    return replace(made, **change)  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith("report.")
    }


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("recording") / "new" / "folder"
    assert simulate.run(options(out)) == 0
    return out


def test_recording_has_its_layout(recording: Path) -> None:
    files = set(contents(recording))
    expected = {f"truth/{name}" for name in ("dry.cameramodel", "wet.cameramodel", "chamber.toml", "poses.json")}
    for board in ("chessboard", "charuco"):
        expected |= {f"truth/{board}-bare.npz", f"truth/{board}-chamber.npz"}
        expected |= {f"{board}/bare/{role}/000.png" for role in ROLES}
        expected |= {f"{board}/chamber/{role}/{i:03d}.png" for role in ROLES for i in range(2)}
    expected |= {f"drive/{role}/{i:03d}.png" for role in ROLES for i in range(2)}
    expected |= {f"drive/depth/{i:03d}.npz" for i in range(2)}
    assert files == expected
    report = json.loads((recording / "report.json").read_text())
    assert report["status"] == "ok"
    assert report["images_made"] == 16
    assert report["seed"] == 0
    assert report["options"]["rig"]["width"] == 320
    assert "<html" in (recording / "report.html").read_text()
    for path in recording.rglob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image.shape == ((240, 320, 3) if "drive" in path.parts else (240, 320))
        assert image.dtype == np.uint8
        assert image.std() > 10


def test_truth_is_the_rig_and_its_exact_corners(recording: Path) -> None:
    rig, truth = Rig.load(recording / "truth"), digital_rig(TINY, 0)
    for role in ROLES:
        assert np.array_equal(rig.camera(role).intrinsics, truth.camera(role).intrinsics)
        assert np.array_equal(rig.camera(role).rt_cam_ref, truth.camera(role).rt_cam_ref)
    assert rig.chamber is not None
    assert truth.chamber is not None
    assert rig.chamber.normal == pytest.approx(truth.chamber.normal, abs=1e-15)
    poses = json.loads((recording / "truth" / "poses.json").read_text())
    for capture in poses["captures"]:
        board = Board.parse(capture["board"])
        rt = np.array([image["rt_ref_board"] for image in capture["images"]])
        dry, wet = exact_observations(rig, board, rt, capture["through_chamber"])
        with np.load(recording / "truth" / f"{capture['folder'].replace('/', '-')}.npz") as file:
            assert np.allclose(file["dry"], dry, rtol=0, atol=1e-9, equal_nan=True)
            assert np.allclose(file["wet"], wet, rtol=0, atol=1e-9, equal_nan=True)


def test_depth_of_the_road_is_its_closed_form(recording: Path) -> None:
    rig = Rig.load(recording / "truth")
    poses = json.loads((recording / "truth" / "poses.json").read_text())
    for image in poses["drive"]["images"]:
        rt_ref_scene = np.array(image["rt_ref_scene"])
        with np.load(recording / "drive" / "depth" / f"{image['name']}.npz") as file:
            depth = file["depth"]
        assert depth.dtype == np.float32
        pixels = np.array([[160.0, 230.0], [150.0, 200.0], [180.0, 160.0]])
        origins, directions = backproject(pixels, rig.dry, rig.chamber)
        normal, point = rotation_matrix(rt_ref_scene[:3])[:, 1], rt_ref_scene[3:]
        on_road = origins + ((point - origins) @ normal / (directions @ normal))[:, None] * directions
        measured = depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        assert np.abs(measured / on_road[:, 2] - 1).max() < 1e-6
        assert np.isnan(depth[0, 150])  # sky
        assert np.nanmin(depth) > 2


def test_same_seed_same_bytes_for_any_number_of_workers(recording: Path, tmp_path: Path) -> None:
    assert write_images(simulation(options(tmp_path)), tmp_path, workers=3) == (16, 0)
    found = contents(tmp_path)
    reference = {name: data for name, data in contents(recording).items() if not name.startswith("truth")}
    assert found == reference


def test_another_seed_other_bytes(recording: Path, tmp_path: Path) -> None:
    write_images(simulation(options(tmp_path, seed=1, drive_frames=0)), tmp_path, workers=2)
    reference = contents(recording)
    assert all(data != reference[name] for name, data in contents(tmp_path).items())


def test_a_run_goes_on_where_it_stopped(tmp_path: Path, recording: Path) -> None:
    out = tmp_path / "r"
    simulate.run(options(out))
    stays, goes = out / "chessboard/bare/dry/000.png", out / "drive/depth/001.npz"
    os.utime(stays, ns=(1, 1))
    goes.unlink()
    (out / "charuco/chamber/wet/001.png").unlink()
    simulate.run(options(out))
    report = json.loads((out / "report.json").read_text())
    assert (report["images_made"], report["images_kept"]) == (2, 14)
    assert stays.stat().st_mtime_ns == 1
    assert contents(out) == contents(recording)


def test_other_recordings_are_kept_unless_told_otherwise(tmp_path: Path) -> None:
    out = tmp_path / "r"
    quick = options(out, boards=BOARDS[:1], frames=2, bare_frames=0, drive_frames=0)
    simulate.run(quick)
    with pytest.raises(ValueError, match="--overwrite"):
        simulate.run(replace(quick, seed=5))
    (out / "notes.txt").write_text("mine")
    simulate.run(replace(quick, seed=5, frames=1, overwrite=True))
    assert sorted(path.name for path in (out / "chessboard").rglob("*.png")) == ["000.png", "000.png"]
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("overwrite", [False, True])
def test_folders_of_other_origin_are_never_touched(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "mine.txt").write_text("mine")
    with pytest.raises(ValueError, match="not written by simulate"):
        simulate.run(options(tmp_path, overwrite=overwrite))
    assert [path.name for path in tmp_path.rglob("*")] == ["drive", "mine.txt"]


def test_noise_in_the_files_is_what_was_asked_for(tmp_path: Path) -> None:
    for name, noise in (("quiet", 0.0), ("noisy", 2.0)):
        plan = simulation(options(tmp_path / name, boards=BOARDS[:1], bare_frames=0, drive_frames=0, noise=noise))
        write_images(plan, tmp_path / name)
    quiet, noisy = (cv2.imread(str(tmp_path / n / "chessboard/chamber/dry/000.png"), 0) for n in ("quiet", "noisy"))
    difference = noisy.astype(float) - quiet
    assert difference.std() == pytest.approx(np.sqrt(4 + 2 / 12), rel=0.03)
    assert abs(difference.mean()) < 0.05


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"boards": ("chessboard:9x6",)}, "chessboard:9x6"),
        ({"boards": (BOARDS[0], BOARDS[0])}, "twice"),
        ({"boards": (), "drive_frames": 0}, "nothing to see"),
        ({"rig": replace(TINY, tilt_deg=85)}, "tilt-deg 85"),
        ({"seed": -1}, "seed -1"),
        ({"noise": -1.0}, "noise"),
        ({"supersampling": 0}, "supersampling"),
        ({"frames": 5000}, "5000 frames"),
        ({"drive_frames": -1}, "drive of -1"),
        ({"workers": -2}, "workers -2"),
        ({"near_m": 0.01, "far_m": 0.05}, "another distance"),
        ({"board_tilt_deg": 80.0}, "80 degrees"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(
    tmp_path: Path, change: dict[str, object], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        simulate.run(options(tmp_path / "out", **change))
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ValueError, match="cannot be written"):
            simulate.run(options(out))


def test_interrupting_keeps_whole_images_only(tmp_path: Path) -> None:
    plan = simulation(options(tmp_path, drive_frames=0))

    def stop(_: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_images(plan, tmp_path, workers=2, progress=stop)
    left = list(tmp_path.rglob("*.*"))
    assert 1 <= len(left) < 12
    assert all(cv2.imread(str(path), 0) is not None for path in left)
    made, kept = write_images(plan, tmp_path, workers=2)
    assert (made + kept, kept) == (12, len(left))


def test_core_of_the_simulation_needs_neither_mrcal_nor_scikit_image() -> None:
    code = (
        "import sys; import rainstereo.scene, rainstereo.drawing, rainstereo.sensor;"
        "assert not {'mrcal', 'skimage', 'torch'} & set(sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
