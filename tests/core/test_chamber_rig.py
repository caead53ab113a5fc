"""Chamber, rig and poses: geometry, files, and what they refuse."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.chamber import INDEX_SD, THICKNESS_SD, TILT_SD, ChamberUncertainty
from rainstereo.pose import compose, invert, rotation_matrix, rotation_vector, transform
from rainstereo.refraction import project

PANELS = (Panel(0.004, 1.49), Panel(0.005, 1.52))
CHAMBER = Chamber((0, 0.3, 1.0), 0.04, PANELS, (0.02,))
POSE = np.array([0.02, -0.05, 0.01, 0.029, 0.001, -0.002])


def rig(chamber: Chamber | None = CHAMBER) -> Rig:
    dry = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
    return Rig(dry, Camera.pinhole(1210, 1205, 650, 470, 1280, 960).with_pose(POSE), chamber)


def test_faces_and_depth() -> None:
    assert CHAMBER.faces == pytest.approx([0.04, 0.064])
    assert CHAMBER.depth == pytest.approx(0.069)
    assert np.linalg.norm(CHAMBER.normal) == pytest.approx(1, abs=1e-15)
    assert CHAMBER.tilt == pytest.approx(math.atan(0.3))
    assert Chamber((0, 0, 1), 0.1, (Panel(math.inf, 1.333),)).depth == math.inf
    assert Chamber((0, 0, 1), 0.1, ()).depth == 0.1


def test_both_cameras_look_through_the_same_panels(rng: np.random.Generator) -> None:
    """A point on a face of the chamber lies on that face in either camera's frame."""
    r = rig()
    n = np.asarray(CHAMBER.normal)
    for face in CHAMBER.faces:
        P = rng.normal(size=(20, 3))
        P += (face - P @ n)[:, None] * n
        seen = r.chamber_in("wet")
        assert seen is not None
        in_wet = transform(r.rt_wet_dry, P)
        index = list(CHAMBER.faces).index(face)
        np.testing.assert_allclose(in_wet @ np.asarray(seen.normal), seen.faces[index], atol=1e-15)
    assert rig(None).chamber_in("wet") is None


def test_the_same_point_through_a_moved_frame(rng: np.random.Generator) -> None:
    """Physics does not know frames: refraction there and back gives the pixel of the untransformed problem."""
    cam = rig().dry
    P = rng.uniform([-0.2, -0.2, 0.5], [0.2, 0.2, 2.0], (50, 3))
    turn = np.array([0.0, 0.0, np.pi / 2, 0, 0, 0])
    direct, _ = project(P, cam, CHAMBER)
    turned, _ = project(transform(turn, P), cam, CHAMBER.transformed(turn))
    offset = turned - [639.5, 479.5]
    np.testing.assert_allclose(np.stack([offset[:, 1], -offset[:, 0]], -1) + [639.5, 479.5], direct, atol=1e-10)


def test_chamber_file_round_trip(tmp_path: Path) -> None:
    for chamber in (CHAMBER, Chamber((0, 0, 1), 0.1, (Panel(0.006, 1.46), Panel(math.inf, 1.333)), (0.0,))):
        chamber.save(tmp_path / "chamber.toml")
        read = Chamber.load(tmp_path / "chamber.toml")
        assert read.panels == chamber.panels
        assert read.gaps == pytest.approx(chamber.gaps)
        assert read.distance == pytest.approx(chamber.distance)
        assert read.normal == pytest.approx(chamber.normal, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("normal = [", "is no TOML"),
        ("distance_mm = 40", "'panel' is missing"),
        ("normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4}]", "'index' is missing"),
        ("normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4000, index=1.49}]", "panel 4.0 m thick"),
        ("normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4, index=149}]", "refractive index of 149"),
        ("normal=[0,0,1]\ndistance_mm=-40\npanel=[{thickness_mm=4, index=1.49}]", "first face is -0.04 m"),
        ("normal=[0,0,0]\ndistance_mm=40\npanel=[{thickness_mm=4, index=1.49}]", "is no direction"),
        ("normal=[0,0,1]\ndistance_mm=40\ngaps_mm=[3]\npanel=[{thickness_mm=4, index=1.49}]", "have 0 gaps"),
        (
            "normal=[0,0,1]\ndistance_mm=40\ntilt_sd_deg=-1\npanel=[{thickness_mm=4, index=1.49}]",
            "deviation of the tilt",
        ),
        (
            "normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4, index=1.49, thickness_sd_mm=20}]",
            "deviation of the thickness of 0.02 m was given",
        ),
        ("normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4, index=1.49, index_sd=2}]", "deviation of the index"),
        ("normal=[0,0,1]\ndistance_mm=40\nnominal=['x']\npanel=[{thickness_mm=4, index=1.49}]", "nominal names x"),
        ("normal=[0,0,1]\ndistance=40\npanel=[{thickness_mm=4, index=1.49}]", "has distance, which means nothing"),
    ],
)
def test_a_bad_chamber_file_is_explained_with_an_example(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "chamber.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        Chamber.load(path)
    assert str(path) in str(raised.value)
    assert "thickness_mm = 4.0" in str(raised.value)


def test_standard_deviations_and_what_was_not_measured_are_kept(tmp_path: Path) -> None:
    sd = ChamberUncertainty((2e-5, 5e-5), math.radians(0.3), (0.001, 0.0))
    before = Chamber((0, 0.3, 1.0), 0.04, PANELS, (0.02,), sd, ("distance", "gaps"))
    before.save(tmp_path / "chamber.toml")
    after = Chamber.load(tmp_path / "chamber.toml")
    assert after.uncertainty is not None
    assert after.uncertainty.thickness == pytest.approx(sd.thickness, rel=1e-12)
    assert after.uncertainty.tilt == pytest.approx(sd.tilt, rel=1e-12)
    assert after.uncertainty.index == sd.index
    assert after.nominal == ("distance", "gaps")
    assert after.transformed(POSE).uncertainty == after.uncertainty
    assert CHAMBER.uncertainty is None  # not stated, rather than exact
    usual = CHAMBER.with_uncertainty().uncertainty
    assert usual == ChamberUncertainty((THICKNESS_SD,) * 2, TILT_SD, (INDEX_SD,) * 2)
    assert before.with_uncertainty() is before


def test_a_file_that_states_some_standard_deviations_gets_the_usual_others(tmp_path: Path) -> None:
    path = tmp_path / "chamber.toml"
    path.write_text("normal=[0,0,1]\ndistance_mm=40\npanel=[{thickness_mm=4, index=1.49, thickness_sd_mm=0.1}]")
    assert Chamber.load(path).uncertainty == ChamberUncertainty((1e-4,), TILT_SD, (INDEX_SD,))


def test_only_the_last_panel_may_be_endless() -> None:
    with pytest.raises(ValueError, match="only the last panel"):
        Chamber((0, 0, 1), 0.1, (Panel(math.inf, 1.3), Panel(0.1, 1.5)), (0.0,))


# -- rig ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chamber", [CHAMBER, None])
def test_rig_folder_round_trip(tmp_path: Path, chamber: Chamber | None) -> None:
    before = rig(chamber)
    before.save(tmp_path / "rig")
    (tmp_path / "rig" / "report.json").write_text("kept")
    rig(CHAMBER).save(tmp_path / "rig")  # over an older one
    before.save(tmp_path / "rig")
    after = Rig.load(tmp_path / "rig")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rig"]  # nothing temporary is left
    assert (tmp_path / "rig" / "report.json").read_text() == "kept"
    np.testing.assert_array_equal(after.rt_wet_dry, POSE)
    assert after.baseline == pytest.approx(np.linalg.norm(POSE[3:]), abs=1e-16)
    assert (after.chamber is None) == (chamber is None)


def test_an_interrupted_save_leaves_the_old_rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig().save(tmp_path / "rig")
    kept = (tmp_path / "rig" / "wet.cameramodel").read_bytes()

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Chamber, "save", interrupt)
    with pytest.raises(KeyboardInterrupt):
        rig().save(tmp_path / "rig")
    with pytest.raises(KeyboardInterrupt):
        rig().save(tmp_path / "new")
    assert (tmp_path / "rig" / "wet.cameramodel").read_bytes() == kept
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rig"]


def test_a_rig_is_brought_into_the_dry_frame() -> None:
    dry_pose, wet_pose = np.array([0.1, 0.2, -0.1, 1, 2, 3.0]), np.array([0.1, 0.1, -0.1, 1.1, 2, 3.0])
    cam = rig().dry
    r = Rig(cam.with_pose(dry_pose), cam.with_pose(wet_pose))
    assert not r.dry.rt_cam_ref.any()
    P = np.array([[0.3, 0.1, 4.0]])
    through_world = transform(wet_pose, transform(invert(dry_pose), P))
    np.testing.assert_allclose(transform(r.rt_wet_dry, P), through_world, atol=1e-14)


def test_a_missing_rig_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="is no folder; expected a rig folder"):
        Rig.load(tmp_path / "absent")
    with pytest.raises(FileNotFoundError, match=r"dry\.cameramodel does not exist"):
        Rig.load(tmp_path)


# -- poses ---------------------------------------------------------------------------------------------------------

rts = hnp.arrays(np.float64, 6, elements=st.floats(-3, 3))


@given(rts, rts)
def test_poses_compose_and_invert_as_4x4_matrices(a: np.ndarray, b: np.ndarray) -> None:
    def matrix(rt: np.ndarray) -> np.ndarray:
        return np.block([[rotation_matrix(rt[:3]), rt[3:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    np.testing.assert_allclose(matrix(compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)
    np.testing.assert_allclose(matrix(invert(a)), np.linalg.inv(matrix(a)), atol=1e-11)
    P = np.array([[1.0, -2, 3]])
    np.testing.assert_allclose(transform(a, P), (matrix(a) @ [1, -2, 3, 1])[None, :3], atol=1e-13)


def test_many_poses_compose_as_each_does(rng: np.random.Generator) -> None:
    one, many = rng.normal(size=6), rng.normal(size=(4, 6))
    for together, each in (
        (compose(one, many), [compose(one, b) for b in many]),
        (compose(many, one), [compose(a, one) for a in many]),
        (compose(many, many[::-1]), [compose(a, b) for a, b in zip(many, many[::-1], strict=True)]),
    ):
        np.testing.assert_allclose(together, each, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi - 1e-12])
def test_rotations_near_their_singularities(angle: float) -> None:
    axis = np.array([2.0, -1, 2]) / 3
    R = rotation_matrix(angle * axis)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation_vector(R), angle * axis, atol=3e-15 if angle < 3 else 1e-8)
    expected = np.eye(3) + np.sin(angle) * _cross(axis) + (1 - np.cos(angle)) * _cross(axis) @ _cross(axis)
    np.testing.assert_allclose(R, expected, atol=1e-15)  # Rodrigues' formula


def _cross(a: np.ndarray) -> np.ndarray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
