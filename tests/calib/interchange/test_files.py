"""Round trips through each format, against cv2.FileStorage and hand-written files; and files that mean harm."""

import contextlib
import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Rig
from rainstereo.calib.interchange import bounded, source, target
from rainstereo.pose import compose, invert, rotation_matrix, transform
from rainstereo.rig import ROLES
from rainstereo.types import Array
from tests.calib import synthetic

FORMATS = {"opencv": ("rig.yml", "rig.xml", "rig.json"), "ros": ("rig",), "kalibr": ("rig.yaml",)}
PLACES = [(f, name) for f, names in FORMATS.items() for name in names]
RADTAN = (-0.18, 0.11, 4e-4, -3e-4)


def written(rig: Rig | Camera, format_name: str, out: Path) -> list[Path]:
    files = target.write(rig, format_name, out).files
    for path, data in files.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
    return list(files)


def assert_same(found: Rig, expected: Rig, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(found.rt_wet_dry, expected.rt_wet_dry, rtol=0, atol=atol)
    for role in ROLES:
        ours, theirs = found.camera(role), expected.camera(role)
        assert ours.size == theirs.size
        np.testing.assert_array_equal(ours.intrinsics[:4], theirs.intrinsics[:4])
        k, d = np.zeros(12), np.zeros(12)
        k[: len(ours.distortion)], d[: len(theirs.distortion)] = ours.distortion, theirs.distortion
        np.testing.assert_array_equal(k, d)


@pytest.mark.parametrize(("format_name", "name"), PLACES)
def test_a_rig_comes_back_as_it_was(format_name: str, name: str, tmp_path: Path) -> None:
    rig = synthetic.rig(None, RADTAN)
    written(rig, format_name, tmp_path / name)
    read = source.read([tmp_path / name])
    assert read.format == format_name
    assert not read.losses
    assert isinstance(read.content, Rig)
    assert_same(read.content, rig)


@pytest.mark.parametrize(("format_name", "name"), PLACES)
def test_a_camera_comes_back_as_it_was(format_name: str, name: str, tmp_path: Path) -> None:
    camera = synthetic.rig(None, RADTAN).wet
    (path,) = written(
        camera, format_name, (tmp_path / name).with_suffix(".yaml" if name == "rig" else Path(name).suffix)
    )
    found = source.read([path]).content
    assert isinstance(found, Camera)
    np.testing.assert_array_equal(found.intrinsics[:8], camera.intrinsics)
    assert found.size == camera.size


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.floats(-1e-3, 1e-3), min_size=4, max_size=4),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-0.5, 0.5)] * 3).filter(lambda t: np.linalg.norm(t) > 1e-3),
    st.sampled_from(["opencv", "kalibr"]),
)
def test_any_pose_and_any_number_survive(
    tmp_path: Path, k: list[float], r: tuple[float, ...], t: tuple[float, ...], format_name: str
) -> None:
    core = np.array([700.0 + k[0], 701, 320, 240])
    dry = Camera("LENSMODEL_OPENCV4", np.concatenate([core, k]), 640, 480)
    pose = np.array([*r, *t])
    rig = Rig(dry, dry.with_pose(pose))
    (path,) = written(rig, format_name, tmp_path / "any.yaml")
    found = source.read([path]).content
    assert isinstance(found, Rig)
    np.testing.assert_allclose(rotation_matrix(found.rt_wet_dry[:3]), rotation_matrix(pose[:3]), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found.rt_wet_dry[3:], pose[3:])
    np.testing.assert_array_equal(found.dry.intrinsics[:4], core)


def test_cv2_reads_what_we_write_and_sees_the_same(tmp_path: Path, rng: np.random.Generator) -> None:
    rig = synthetic.rig(None)
    (path,) = written(rig, "opencv", tmp_path / "rig.yml")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    K1, D1, K2, D2, R, T = (storage.getNode(name).mat() for name in ("K1", "D1", "K2", "D2", "R", "T"))
    P = rng.uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 3], (50, 3))
    dry = cv2.projectPoints(P, np.zeros(3), np.zeros(3), K1, D1)[0].reshape(-1, 2)
    wet = cv2.projectPoints(P, cv2.Rodrigues(R)[0], T, K2, D2)[0].reshape(-1, 2)
    np.testing.assert_allclose(dry, rig.dry.project(P), atol=1e-9)
    np.testing.assert_allclose(wet, rig.wet.project(transform(rig.rt_wet_dry, P)), atol=1e-9)


def test_what_cv2_writes_under_the_samples_names_is_read(tmp_path: Path) -> None:
    """intrinsics.yml and extrinsics.yml of OpenCV's stereo_calib, in millimetres, without an image size."""
    rig = synthetic.rig(None)
    for name, nodes in (("intrinsics.yml", ("M1", "D1", "M2", "D2")), ("extrinsics.yml", ("R", "T", "R1", "P1"))):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        values = {
            "M1": _matrix(rig.dry), "M2": _matrix(rig.wet),
            "D1": rig.dry.distortion[None], "D2": rig.wet.distortion[None],
            "R": rotation_matrix(rig.rt_wet_dry[:3]), "T": 1000 * rig.rt_wet_dry[3:, None],
            "R1": np.eye(3), "P1": np.eye(3, 4),
        }  # fmt: skip
        for node in nodes:
            storage.write(node, values[node])
        storage.release()
    paths = [tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"]
    found = source.read(paths, size=synthetic.SIZE, metres=0.001).content
    assert isinstance(found, Rig)
    assert_same(found, rig)
    with pytest.raises(ValueError, match="give --unit mm"):
        source.read(paths, size=synthetic.SIZE)
    with pytest.raises(ValueError, match="give --size"):
        source.read(paths)
    with pytest.raises(ValueError, match="lacks R, such as"):
        source.read(paths[:1], size=synthetic.SIZE)
    with pytest.raises(ValueError, match=r"both have D1, D2, M1, M2"):
        source.read([paths[0], paths[0]], size=synthetic.SIZE)


def _matrix(camera: Camera) -> Array:
    fx, fy, cx, cy = camera.intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@pytest.mark.parametrize("across", [(0.03, 0.001, -0.002), (-0.03, 0, 0.001), (0.002, 0.04, 0), (0.001, -0.04, 0.003)])
def test_ros_files_mean_what_image_geometry_makes_of_them(across: tuple[float, ...], tmp_path: Path) -> None:
    """Points of the rectified frame of the camera on the left (or above) through P; and R X through P[:, :3]."""
    rig = synthetic.rig(None)
    rig = Rig(rig.dry, rig.wet.with_pose(np.array([0.01, -0.02, 0.03, *across])))
    paths = written(rig, "ros", tmp_path / "ros")
    tables = [bounded.yaml_of(path.read_text(), path) for path in paths]
    X = np.array([[0.1, -0.1, 1.0], [-0.3, 0.2, 4.0], [0.0, 0.05, 0.5]])
    P = [np.reshape(table["projection_matrix"]["data"], (3, 4)) for table in tables]
    R = [np.reshape(table["rectification_matrix"]["data"], (3, 3)) for table in tables]
    own = [X @ R[0].T, transform(rig.rt_wet_dry, X) @ R[1].T]
    first = int(np.abs(P[0][:, 3]).max() > 0)
    assert not P[first][:, 3].any()
    axis = 0 if abs(across[0]) > abs(across[1]) else 1
    f = P[0][axis, axis]
    assert P[1 - first][axis, 3] == pytest.approx(-f * rig.baseline)
    pixels = [np.column_stack([own[first], np.ones(3)]) @ P[i].T for i in (0, 1)]
    direct = [own[i] @ P[i][:, :3].T for i in (0, 1)]
    for by_left, by_own in zip(pixels, direct, strict=True):
        np.testing.assert_allclose(by_left[:, :2] / by_left[:, 2:], by_own[:, :2] / by_own[:, 2:], atol=1e-8)
    disparity = pixels[first][:, axis] / pixels[first][:, 2] - pixels[1 - first][:, axis] / pixels[1 - first][:, 2]
    np.testing.assert_allclose(disparity, f * rig.baseline / own[first][:, 2], rtol=1e-9)
    found = source.read([tmp_path / "ros"]).content
    assert isinstance(found, Rig)
    assert_same(found, rig)


HAND_WRITTEN = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.2, 1e-2, 0.0003, -0.0002]
  distortion_model: radtan
  intrinsics: [461.6, 460.3, 363.0, 248.1]
  resolution: [752, 480]
  rostopic: /{first}/image_raw
  timeshift_cam_imu: 0.01
cam1:
  T_cn_cnm1:
  - [0.0, -1.0, 0.0, -0.11]
  - [1.0, 0.0, 0.0, 0.02]
  - [0.0, 0.0, 1.0, 0.03]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [460, 461, 360, 250]
  resolution: [752, 480]
  rostopic: /{second}/image_raw
"""


def test_a_camchain_means_what_kalibr_means(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(HAND_WRITTEN.format(first="cam0", second="cam1"))
    read = source.read([path])
    rig = read.content
    assert isinstance(rig, Rig)
    assert rig.dry.distortion.tolist() == [-0.2, 0.01, 0.0003, -0.0002]
    assert rig.wet.model == "LENSMODEL_PINHOLE"
    np.testing.assert_allclose(transform(rig.rt_wet_dry, np.array([1.0, 2, 3])), [-2.11, 1.02, 3.03])
    assert any("timeshift_cam_imu" in note for note in read.notes)
    turned = source.read([path], first="wet").content
    assert isinstance(turned, Rig)
    np.testing.assert_allclose(compose(turned.rt_wet_dry, rig.rt_wet_dry), np.zeros(6), atol=1e-12)
    path.write_text(HAND_WRITTEN.format(first="wet", second="dry"))
    named = source.read([path])
    assert isinstance(named.content, Rig)
    np.testing.assert_allclose(named.content.rt_wet_dry, invert(rig.rt_wet_dry))
    assert "by the cameras' names" in named.notes[0]


def test_without_the_panels_it_says_what_is_lost() -> None:
    rig = synthetic.rig(synthetic.chamber(15))
    losses = target.chamber_losses(rig)
    assert [one.range_m for one in losses] == list(target.RANGES)
    assert all(a.max_px > b.max_px > b.median_px for a, b in itertools.pairwise(losses))
    # by hand, on the axis: the slab shifts a point by 8 mm (1 - 1/n) along its normal, seen across at 10 m
    shift = 0.008 * (1 - 1 / 1.49)
    assert 0.9 < losses[3].median_px / (shift * np.sin(np.deg2rad(15)) * 1200 / 10) < 2.5
    assert "up to" in target.without_refraction(losses)
    assert target.chamber_losses(synthetic.rig(None)) == ()


HOSTILE = {
    "empty": ("", "holds nothing"),
    "a list": ("- 1\n- 2\n", "holds a list"),
    "no YAML": ("a: [1, 2\n", "is no YAML"),
    "code": ("!!python/object/apply:os.system ['true']\n", "is no YAML"),
    "aliases": ("a: &a [1]\ncam0: *a\n", "repeats a part by an alias"),
    "deep lists": ("cam0: " + "[" * 5000, "nested more than"),
    "deep OpenCV": ("%YAML:1.0\n---\nK1: " + "[" * 100000, "nested more than"),
    "deep hyphens": ("%YAML:1.0\n---\nK1:\n   " + "- " * 100000, "nested more than"),
    "deep XML": ("<?xml version='1.0'?><opencv_storage>" + "<a>" * 100000, "nested more than"),
    "deep JSON": ('{"K1":' + "[" * 100000, "nested more than"),
    "no camera": ("%YAML:1.0\n---\nK3: 1\n", "describes no camera: it has K3"),
    "damaged": ("%YAML:1.0\n---\nK1: !!opencv-matrix\n  rows: [\n", "is no FileStorage file"),
    "a matrix of 10^12": (
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 1000000\n   cols: 1000000\n   dt: d\n"
        "   data: [ 1. ]\ndistortion_coefficients: [0]\nimage_width: 9\nimage_height: 9\n",
        "has 1000000 rows and 1000000 columns",
    ),
    "other": ("foo: 1\nbar: 2\n", "no format that is known here; it has foo, bar"),
    "three cameras": ("cam0: {}\ncam1: {}\ncam2: {}\n", "expected cam0, or cam0 and cam1"),
    "omni": ("cam0: {camera_model: omni}\n", "camera model omni, which neither"),
    "no resolution": (
        "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [1, 1, 1, 1]}\n", "lacks resolution",
    ),
    "words for numbers": (
        "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [a, b, c, d], resolution: [9, 9]}\n",
        "holds 'a'; expected numbers",
    ),
    "NaN": (
        "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [.nan, 1, 1, 1], resolution: [9, 9]}\n",
        "holds nan; expected finite",
    ),
    "a huge integer": (
        f"cam0: {{camera_model: pinhole, distortion_model: none, intrinsics: [1{'0' * 400}, 1, 1, 1], "
        "resolution: [9, 9]}\n", "too large for any camera",
    ),
    "half a pixel": (
        "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: [1, 1, 1, 1], resolution: [9.5, 9]}\n",
        "expected a whole number",
    ),
    "wrong count": (
        "cam0: {camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [0], intrinsics: [1, 1, 1, 1], "
        "resolution: [9, 9]}\n", "has 1 distortion_coeffs; radtan takes 4",
    ),
    "ROS model": (
        "camera_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}\ndistortion_model: fov\n", "model fov",
    ),
    "ROS matrix": (
        "camera_matrix: {rows: 3, cols: 3, data: [9, 0, 0, 0, 9, 0, 4, 5, 1]}\ndistortion_model: plumb_bob\n",
        "seems to be transposed",
    ),
    "skew": (
        "camera_matrix: {rows: 3, cols: 3, data: [9, 1, 4, 0, 9, 4, 0, 0, 1]}\ndistortion_model: plumb_bob\n",
        "has the skew 1",
    ),
    "short matrix": (
        "camera_matrix: {rows: 3, cols: 3, data: [9, 0, 4]}\ndistortion_model: plumb_bob\n", "holds 3 numbers",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_file_is_refused_in_words(kind: str, tmp_path: Path) -> None:
    text, words = HOSTILE[kind]
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words) as raised:
        source.read([path])
    assert str(path) in str(raised.value) or "of cam0" in str(raised.value)
    assert len(str(raised.value)) < 1000


def test_files_that_are_no_text_or_too_large_or_missing(tmp_path: Path) -> None:
    path = tmp_path / "f.yaml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="is no text"):
        source.read([path])
    path.write_bytes(b"a: 1\0")
    with pytest.raises(ValueError, match="zero bytes"):
        source.read([path])
    with path.open("wb") as file:
        file.truncate(bounded.MAX_BYTES + 1)
    with pytest.raises(ValueError, match="at most"):
        source.read([path])
    with pytest.raises(FileNotFoundError, match="does not exist"):
        source.read([tmp_path / "nothing.yaml"])
    with pytest.raises(ValueError, match="is no rig folder"):
        source.read([tmp_path])
    with pytest.raises(ValueError, match="0 files were given"):
        source.read([])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("  - [0.0, 0.0, 0.0, 1.0]", "  - [-0.11, 0.02, 0.03, 1.0]", "expected 0 0 0 1"),
        ("  - [0.0, 0.0, 1.0, 0.03]", "  - [0.0, 0.0, -1.0, 0.03]", "is no rotation"),
        ("  - [0.0, 0.0, 1.0, 0.03]\n", "", "has 3 rows and 4 columns"),
        ("-0.11", "-110", "give --unit mm"),
        ("  T_cn_cnm1:", "  T_other:", "lacks T_cn_cnm1"),
    ],
)
def test_a_pose_that_cannot_be_is_explained(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    path.write_text(HAND_WRITTEN.format(first="a", second="b").replace(old, new))
    with pytest.raises(ValueError, match=words):
        source.read([path])


def test_a_transposed_pose_is_recognised(tmp_path: Path) -> None:
    T = np.array([[0, -1, 0, -0.11], [1, 0, 0, 0.02], [0, 0, 1, 0.03], [0, 0, 0, 1.0]])
    path = tmp_path / "chain.yaml"
    head, _, tail = HAND_WRITTEN.format(first="a", second="b").partition("  T_cn_cnm1:\n")
    path.write_text(head + f"  T_cn_cnm1: {T.T.tolist()}\n" + tail.split("1.0]\n", 1)[1])
    with pytest.raises(ValueError, match="it seems to be transposed"):
        source.read([path])


def test_two_ros_cameras_in_one_place_are_no_rig(tmp_path: Path) -> None:
    for role in ROLES:
        (path,) = written(synthetic.rig(None).camera(role), "ros", tmp_path / f"{role}.yaml")
    with pytest.raises(ValueError, match="the cameras would stand in one place"):
        source.read([tmp_path / "dry.yaml", path])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_never_do_worse_than_a_value_error(data: st.DataObject, tmp_path: Path) -> None:
    rig = synthetic.rig(None, RADTAN)
    format_name, name = data.draw(st.sampled_from([p for p in PLACES if p[0] != "ros"]))
    (path,) = written(rig, format_name, tmp_path / name)
    text = path.read_text()
    at = data.draw(st.integers(0, len(text)))
    cut = data.draw(st.integers(0, 40))
    put = data.draw(st.text("0123456789.eE-+[]{}:,<>/ \n\"'!&*abc", max_size=12))
    path.write_text(text[:at] + put + text[at + cut :])
    with contextlib.suppress(ValueError):
        source.read([path])
