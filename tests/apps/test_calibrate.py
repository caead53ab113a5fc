"""`rainstereo calibrate` end to end: real sets, the digital rig against its truth, and captures that deserve no rig."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo import Rig
from rainstereo.apps.cli import main
from rainstereo.calib.uncertainty import infinity_error

pytest.importorskip("mrcal")

BOARD = "chessboard:9x6:25mm"
FAR = "wet against dry"


def calibrate(dry: object, wet: object, out: Path, *more: str, board: str = BOARD) -> int:
    return main(["calibrate", "--dry", str(dry), "--wet", str(wet), "--board", board, "--out", str(out), *more])


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def words(capsys: pytest.CaptureFixture[str]) -> str:
    told = capsys.readouterr()
    return " ".join((told.out + told.err).split())


# -- real images -------------------------------------------------------------------------------------------------


def test_thirteen_real_pairs(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "calib" / "opencv_chess_640x480"
    assert calibrate(folder / "left*.jpg", folder / "right*.jpg", tmp_path / "rig") == 0
    told = report(tmp_path / "rig")
    assert told["status"] == "good"
    assert told["frames_used"] == 13
    assert told["rms_px"] <= 0.15
    assert told["baseline_m"] / 0.025 == pytest.approx(3.33, abs=0.01)
    assert told["outliers"] < 15
    rig = Rig.load(tmp_path / "rig")
    assert rig.baseline == told["baseline_m"]
    page = (tmp_path / "rig" / "report.html").read_text()
    assert page.count("<svg") >= 8
    assert "http://" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
def test_wide_lenses_with_flipped_boards(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "calib" / "stereopi_wide_640x480"
    assert calibrate(folder / "left*.png", folder / "right*.png", tmp_path / "rig") == 0
    told = report(tmp_path / "rig")
    assert told["rms_px"] <= 0.15
    assert told["frames_used"] == 25
    assert any("23" in entry["name"] for entry in told["rejected"])  # it has one file only
    assert not any("reversed" in finding["text"] for finding in told["findings"])


@pytest.mark.slow
def test_a_charuco_board_through_a_wide_lens(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "calib" / "charuco_wide_1280x800"
    board = "charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000"
    assert calibrate(folder / "left*.png", folder / "right*.png", tmp_path / "rig", board=board) == 0
    told = report(tmp_path / "rig")
    assert told["rms_px"] <= 0.32
    five = next(row for row in told["lens_models"] if row["lensmodel"] == "LENSMODEL_OPENCV5")
    assert five["fit_px"] > 1  # five coefficients do not fit, and were not chosen
    assert told["frames_used"] == 9


# -- the digital rig -----------------------------------------------------------------------------------------------


def test_rendered_images_give_the_truth_within_two_sigmas(recording: Path, tmp_path: Path) -> None:
    boards = recording / "chessboard" / "chamber"
    chamber = str(recording / "truth" / "chamber.toml")
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig", "--chamber", chamber) == 0
    told, rig, true = report(tmp_path / "rig"), Rig.load(tmp_path / "rig"), Rig.load(recording / "truth")
    assert told["status"] == "good"
    assert abs(rig.baseline - true.baseline) < 2 * told["baseline_sigma_m"]
    error = infinity_error(rig, true)
    for name, difference in (("dry", error.dry), ("wet", error.wet), (FAR, error.stereo)):
        assert difference.rms < 2 * told["infinity_expected_rms_px"][name]
    assert rig.chamber is not None
    assert rig.chamber.panels == true.chamber.panels  # type: ignore[union-attr]


def test_ignoring_the_acrylic_shows_at_infinity_and_not_in_the_rms(recording: Path, tmp_path: Path) -> None:
    boards = recording / "chessboard" / "chamber"
    chamber = str(recording / "truth" / "chamber.toml")
    model = "LENSMODEL_OPENCV5"
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "a", "--chamber", chamber, "--lensmodel", model) == 0
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "b", "--lensmodel", model) == 0
    true = Rig.load(recording / "truth")
    modelled, ignored = (infinity_error(Rig.load(tmp_path / name), true).dry.rms for name in "ab")
    assert ignored > 4 * modelled
    assert report(tmp_path / "b")["rms_px"] < 1.3 * report(tmp_path / "a")["rms_px"]
    assert not (tmp_path / "b" / "chamber.toml").exists()


# -- captures that deserve no rig ----------------------------------------------------------------------------------


@pytest.fixture
def boards(recording: Path, tmp_path: Path) -> Path:
    """A copy of the board images that a test may spoil."""
    folder = tmp_path / "boards"
    shutil.copytree(recording / "chessboard" / "chamber", folder)
    return folder


def refused(out: Path) -> bool:
    return not (out / "dry.cameramodel").exists() and not (out / "wet.cameramodel").exists()


def test_unsynchronised_pairs_are_refused_with_the_reason(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each camera alone is fine, together they are not: wet images renamed by one."""
    files = sorted((boards / "wet").iterdir())
    for path in files:
        path.rename(path.with_suffix(".moved"))
    for i, path in enumerate(files):
        files[i - 1].with_suffix(".moved").rename(path)
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig") == 1
    assert refused(tmp_path / "rig")
    assert report(tmp_path / "rig")["status"] == "refused"
    assert "each camera fits alone" in words(capsys)
    assert "not usable" in (tmp_path / "rig" / "report.html").read_text().lower()


def test_a_board_that_never_moves_before_one_camera_is_refused(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A board fixed to a wall: the wet camera shows one view throughout, whatever the dry one sees."""
    for path in sorted((boards / "wet").iterdir())[1:]:
        shutil.copy(boards / "wet" / "000.png", path)
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig") == 1
    assert refused(tmp_path / "rig")
    assert "one board that did not move" in words(capsys)


@pytest.mark.slow
def test_near_identical_views_are_refused(boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    for role in ("dry", "wet"):
        first = cv2.imread(str(boards / role / "000.png"), cv2.IMREAD_GRAYSCALE)
        for path in (boards / role).iterdir():
            noise = rng.normal(size=first.shape)
            cv2.imwrite(str(path), np.clip(first + noise, 0, 255).astype(np.uint8))
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig") == 1
    assert refused(tmp_path / "rig")
    told = words(capsys)
    assert "distinct view" in told or "parallel" in told
    assert "tilt" in told  # the remedy


@pytest.mark.slow
def test_a_refused_capture_leaves_an_earlier_rig_alone(recording: Path, boards: Path, tmp_path: Path) -> None:
    out = tmp_path / "rig"
    assert calibrate(boards / "dry", boards / "wet", out, "--lensmodel", "LENSMODEL_OPENCV5") == 0
    kept = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    for role in ("dry", "wet"):
        for path in sorted((boards / role).iterdir())[1:]:
            shutil.copy(boards / role / "000.png", path)
    assert calibrate(boards / "dry", boards / "wet", out) == 1
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == kept
    assert report(out / "refused")["status"] == "refused"


@pytest.mark.slow
def test_damaged_files_are_named_and_the_rest_suffices(boards: Path, tmp_path: Path) -> None:
    (boards / "dry" / "001.png").write_bytes(b"")
    data = (boards / "wet" / "002.png").read_bytes()
    (boards / "wet" / "002.png").write_bytes(data[: len(data) // 2])
    (boards / "wet" / "003.png").unlink()
    cv2.imwrite(str(boards / "dry" / "004.png"), np.full((480, 640), 90, np.uint8))
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig", "--lensmodel", "LENSMODEL_OPENCV5") == 0
    told = {entry["name"]: entry["reason"] for entry in report(tmp_path / "rig")["rejected"]}
    assert "zero bytes" in told["001.png"]
    assert "truncated" in told["002.png"]
    assert "has no partner" in told["003.png"]
    assert "the 9x6 chessboard is not found" in told["004.png"]


def test_a_wrong_board_is_told_from_the_printed_one(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig", board="chessboard:6x5:25mm") == 2
    assert "9x6" in words(capsys)
    assert not (tmp_path / "rig").exists()


def test_swapped_folders_are_named(boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert calibrate(boards / "wet", boards / "dry", tmp_path / "rig") == 2
    assert "the cameras look swapped" in words(capsys)
    assert not (tmp_path / "rig").exists()


def test_an_interrupt_leaves_no_half_rig(boards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("rainstereo.camera.cameramodel.text", interrupt)
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig", "--lensmodel", "LENSMODEL_OPENCV5") == 130
    assert not (tmp_path / "rig").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["boards"]


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("--board", "chessboard:9x6", "chessboard:9x6:25mm"),
        ("--chamber", "absent.toml", "absent.toml"),
        ("--dry", "nowhere", "nowhere"),
    ],
)
def test_bad_usage_is_explained(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, told: str
) -> None:
    options = {"--dry": f"{boards}/dry", "--wet": f"{boards}/wet", "--board": BOARD, "--out": str(tmp_path / "rig")}
    options[option] = value
    assert main(["calibrate", *(word for pair in options.items() for word in pair)]) == 2
    assert told in words(capsys)
    assert not (tmp_path / "rig").exists()


def test_without_mrcal_it_says_so_before_it_searches(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing() -> None:
        raise ImportError("calibration needs mrcal: sudo apt-get install python3-mrcal")

    monkeypatch.setattr("rainstereo.calib.mrcal_versions.load", missing)
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig") == 1
    told = words(capsys)
    assert "apt-get install python3-mrcal" in told
    assert "pairs show the board" not in told
    assert "report it" not in told


PANELS = """normal = [0.0, 0.2588, 0.9659]
distance_mm = 40.0
gaps_mm = [20.0]
[[panel]]
thickness_mm = 4.0
index = 1.49
[[panel]]
thickness_mm = 4.0
index = 1.49
"""


@pytest.mark.parametrize(
    ("right", "wrong", "told"),
    [
        ("thickness_mm = 4.0", "thickness_mm = 4000", "a panel 4.0 m thick was given; expected metres"),
        ("index = 1.49", "index = 149", "a refractive index of 149 was given; expected 1 to 4.5 (acrylic 1.49"),
        ("distance_mm", "tilt_deg = 15\ndistance_mm", "has tilt_deg, which means nothing here"),
        ("distance_mm", "tilt_sd_deg = 57\ndistance_mm", "standard deviation of the tilt of 0.994838 rad was given"),
    ],
)
def test_panels_that_cannot_be_are_refused_before_any_search(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], right: str, wrong: str, told: str
) -> None:
    (tmp_path / "chamber.toml").write_text(PANELS.replace(right, wrong, 1))
    out = tmp_path / "rig"
    assert calibrate(boards / "dry", boards / "wet", out, "--chamber", str(tmp_path / "chamber.toml")) == 2
    assert told in words(capsys)
    assert not out.exists()


def test_panels_that_are_hardly_meant_are_questioned_and_held_against_the_corners(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A first panel in metres, a tilt in radians, and a normal that is 20 degrees off."""
    described = PANELS.replace("thickness_mm = 4.0", "thickness_mm = 0.004", 1).replace("0.2588", "-0.09")
    (tmp_path / "chamber.toml").write_text(described.replace("distance_mm", "tilt_sd_deg = 0.0087\ndistance_mm"))
    more = ("--chamber", str(tmp_path / "chamber.toml"), "--slab", "estimated", "--lensmodel", "LENSMODEL_OPENCV5",
            "--no-cross-validate")  # fmt: skip
    calibrate(boards / "dry", boards / "wet", tmp_path / "rig", *more)
    told = words(capsys)
    assert "doubtful: panel 1 is described as 0.004 mm thick -> thickness_mm is in millimetres" in told
    assert "doubtful: the tilt is described as known to 0.0087 degrees -> tilt_sd_deg is in degrees, not rad" in told
    assert re.search(
        r"the corners contradict the description of the panels: pitch is pulled by [+-]\d+\.\d sigmas", told
    )
    assert report(tmp_path / "rig")["status"] != "good"
    assert "is pulled by" in (tmp_path / "rig" / "report.html").read_text()


@pytest.mark.parametrize("slab", ["known", "estimated"])
def test_a_solve_that_does_not_converge_writes_no_rig(
    boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, slab: str
) -> None:
    monkeypatch.setattr("rainstereo.calib.through_acrylic.MAX_PASSES", 1)
    (tmp_path / "chamber.toml").write_text(PANELS)
    more = ("--chamber", str(tmp_path / "chamber.toml"), "--slab", slab, "--lensmodel", "LENSMODEL_OPENCV5")
    assert calibrate(boards / "dry", boards / "wet", tmp_path / "rig", *more) == 1
    assert refused(tmp_path / "rig")
    assert "did not settle: after 1 passes" in words(capsys)
    assert report(tmp_path / "rig")["status"] == "refused"


@pytest.mark.slow
def test_frames_of_another_focus_are_told_apart(
    recording: Path, boards: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The dry camera's focal length is a hundredth longer in four of twelve pairs."""
    changed = ["001", "004", "006", "009"]
    for name in changed:
        image = cv2.imread(str(boards / "dry" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
        centre = Rig.load(recording / "truth").dry.intrinsics[2:4]
        zoom = np.column_stack([1.01 * np.eye(2), -0.01 * centre])
        zoomed = cv2.warpAffine(image, zoom, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(boards / "dry" / f"{name}.png"), zoomed)
    more = ("--chamber", str(recording / "truth" / "chamber.toml"), "--lensmodel", "LENSMODEL_OPENCV5",
            "--no-cross-validate")  # fmt: skip
    calibrate(boards / "dry", boards / "wet", tmp_path / "rig", *more)
    told, mixed = words(capsys), report(tmp_path / "rig")["mixed_captures"]
    assert mixed["way"] == "dry focus"
    assert sorted(mixed["frames"]) == changed
    assert mixed["focal"][0] == pytest.approx(0.01, abs=max(4 * mixed["focal_sd"][0], 1e-3))
    assert "doubtful: the 4 frames named were taken with another focus than the other 8" in told
    assert "taken with another focus" in (tmp_path / "rig" / "report.html").read_text()
