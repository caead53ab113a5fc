"""`rainstereo align` on the street of the digital rig, and on files that are not what they should be."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo import Rig, imagefile
from rainstereo.apps.cli import main
from rainstereo.pose import transform
from rainstereo.refine import turned
from rainstereo.refraction import project


def align(recording: Path, out: Path, *more: str, drive: Path | None = None, rig: Path | None = None) -> int:
    drive = drive or recording / "drive"
    folders = ["--dry", f"{drive}/dry", "--wet", f"{drive}/wet", "--rig", str(rig or recording / "truth")]
    return main(["align", *folders, "--out", str(out), *more])


def test_a_recording_becomes_aligned_pairs(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert align(recording, tmp_path) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["status"], report["pairs"], report["skipped"]) == ("ok", 3, [])
    size = report["view"]["width"], report["view"]["height"]
    for name in ("000", "001", "002"):
        images = [imagefile.read(tmp_path / role / f"{name}.png") for role in ("dry", "wet")]
        assert all(image.shape[1::-1] == size for image in images)
    x, y = report["remaining_shift_px"]["median_xy"]
    assert abs(y) < 0.05  # no depth moves things across the baseline
    assert 0.2 < x < 3.5  # all of the street is nearer than infinity
    assert (tmp_path / "report.html").read_text().count("data:image") >= 4
    assert "3 aligned pairs" in capsys.readouterr().out


def test_the_parallax_that_remains_is_that_of_the_true_depth(recording: Path, tmp_path: Path) -> None:
    """Where the true depth map puts a point, the aligned pair has f b / Z of disparity."""
    assert align(recording, tmp_path) == 0
    view = json.loads((tmp_path / "report.json").read_text())["view"]
    rig = Rig.load(recording / "truth")
    depth = np.load(recording / "drive" / "depth" / "000.npz")["depth"]
    dry, wet = (imagefile.read(tmp_path / role / "000.png", gray=True).astype(np.float32) for role in ("dry", "wet"))
    focal, centre = view["focal_px"], np.array(view["centre_px"])
    errors = []
    for u in range(60, view["width"] - 60, 15):
        for v in range(view["height"] // 2 - 60, view["height"] - 40, 9):
            ray = np.array([(u - centre[0]) / focal, (v - centre[1]) / focal, 1.0])
            raw = rig.dry.project(ray).round().astype(int)
            near = depth[raw[1] - 3 : raw[1] + 4, raw[0] - 16 : raw[0] + 36]
            if near.shape != (7, 52) or not np.isfinite(near).all() or np.ptp(near) > 0.1 * near.mean():
                continue
            patch = dry[v - 2 : v + 3, u - 15 : u + 16]
            search = wet[v - 2 : v + 3, u - 15 : u + 36]
            scores = cv2.matchTemplate(search, patch, cv2.TM_CCOEFF_NORMED)[0]
            best = int(scores.argmax())
            if scores[best] < 0.9 or not 0 < best < len(scores) - 1:
                continue
            left, middle, right = scores[best - 1 : best + 2]
            disparity = best + 0.5 * (left - right) / (left - 2 * middle + right)
            P = ray * depth[raw[1], raw[0]]
            expected = rig.baseline * focal / float(P[2])
            errors.append(disparity - expected)
    assert len(errors) > 30
    assert np.median(np.abs(errors)) < 0.15
    assert abs(np.median(errors)) < 0.08


def test_the_road_plane_takes_the_road_s_parallax_away(recording: Path, tmp_path: Path) -> None:
    assert align(recording, tmp_path / "far") == 0
    assert align(recording, tmp_path / "road", "--plane", "road:1.5m") == 0

    def off_on_the_road(folder: Path) -> float:
        dry, wet = (imagefile.read(folder / role / "000.png", gray=True).astype(float) for role in ("dry", "wet"))
        height, width = dry.shape
        road = np.s_[int(0.75 * height) : height - 10, width // 4 : width // 2]
        shift, _ = cv2.phaseCorrelate(dry[road] - dry[road].mean(), wet[road] - wet[road].mean())
        return float(np.hypot(*shift))

    assert off_on_the_road(tmp_path / "far") > 2
    assert off_on_the_road(tmp_path / "road") < 0.4


def test_bad_files_are_skipped_by_name_and_the_rest_is_aligned(recording: Path, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    shutil.copytree(recording / "drive", drive)
    (drive / "wet" / "001.png").write_bytes((drive / "wet" / "001.png").read_bytes()[:2000])
    (drive / "dry" / "900.png").write_bytes(b"")
    cv2.imwrite(str(drive / "wet" / "900.png"), np.zeros((480, 640), np.uint8))
    cv2.imwrite(str(drive / "dry" / "901.png"), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(drive / "wet" / "901.png"), np.zeros((480, 640), np.uint8))
    (drive / "dry" / "902.png").touch()
    assert align(recording, tmp_path / "out", drive=drive) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    reasons = {Path(entry["file"]).name: entry["reason"] for entry in report["skipped"]}
    assert reasons["001.png"].startswith("truncated")
    assert reasons["900.png"] == "zero bytes"
    assert reasons["901.png"] == "64 x 48 pixels; the rig was calibrated at 640 x 480"
    assert reasons["902.png"] == "has no partner among the 5 wet images"
    for role in ("dry", "wet"):
        assert sorted(p.name for p in (tmp_path / "out" / role).iterdir()) == ["000.png", "002.png"]


def test_nothing_to_align_is_a_failure(recording: Path, tmp_path: Path) -> None:
    for role in ("dry", "wet"):
        (tmp_path / role).mkdir()
        (tmp_path / role / "0.png").write_bytes(b"x")
    assert align(recording, tmp_path / "out", drive=tmp_path) == 1
    assert json.loads((tmp_path / "out" / "report.json").read_text())["status"] == "failed"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--plane", "5 feet"], "expected infinity, a depth like 5m"),
        (["--interpolation", "best"], "interpolation 'best' is unknown"),
        (["--rig", "absent"], "absent is no folder; expected a rig folder"),
        (["--dry", "absent"], "absent, given for the dry images, does not exist"),
    ],
)
def test_bad_usage_is_explained(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: list[str], words: str
) -> None:
    options = {"--dry": f"{recording}/drive/dry", "--wet": f"{recording}/drive/wet", "--rig": f"{recording}/truth"}
    options |= {"--out": str(tmp_path / "out"), change[0]: change[1]}
    assert main(["align", *(word for pair in options.items() for word in pair)]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not list((tmp_path / "out").glob("*/*.png"))


def test_pixels_of_the_view_show_what_the_truth_says(recording: Path, tmp_path: Path) -> None:
    """A point far away: its pixel in both aligned images is the view's own projection of it."""
    from rainstereo.align import plan

    rig = Rig.load(recording / "truth")
    alignment = plan(rig)
    P = np.array([[1e5, 4e4, 1e6], [-2e5, 1e5, 1e6]])
    q = alignment.view.project(P)
    for role, warp in (("dry", alignment.dry), ("wet", alignment.wet)):
        camera = rig.camera(role)  # type: ignore[arg-type]
        seen, _ = project(transform(camera.rt_cam_ref, P), camera, rig.chamber_in(role))  # type: ignore[arg-type]
        u, v = q.round().astype(int).T
        slope = np.gradient(warp.map_xy, axis=(1, 0))
        predicted = (
            warp.map_xy[v, u] + slope[0][v, u] * (q[:, :1] - u[:, None]) + slope[1][v, u] * (q[:, 1:] - v[:, None])
        )
        np.testing.assert_allclose(predicted, seen, atol=2e-3)


@pytest.mark.slow
def test_a_lens_that_was_knocked_is_corrected_from_the_recording(recording: Path, tmp_path: Path) -> None:
    """The rig as calibrated, its wet camera turned since by 3 arc minutes."""
    truth = Rig.load(recording / "truth")
    since = np.array([4e-4, -6e-4, 5e-4])
    turned(truth, -since).save(tmp_path / "rig")
    assert align(recording, tmp_path / "out", rig=tmp_path / "rig", drive=None) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    found = report["model"]["refine"]
    assert found["applied"]
    error = np.abs(np.array(found["rotation"]) - since)
    assert (error[[0, 2]] < 4 * np.array(found["sigma"])[[0, 2]]).all()
    assert (
        error[[0, 2]] * 600 < 0.03
    ).all()  # pixels; three pairs may be too few to tell yaw, which is then left alone
    assert abs(report["remaining_shift_px"]["median_xy"][1]) < 0.05
    assert found["across_px"]["after"] < 0.5 * found["across_px"]["before"]
    assert "arc minutes" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_auto_takes_the_disparity_away_that_infinity_leaves(recording: Path, tmp_path: Path) -> None:
    assert align(recording, tmp_path / "auto", "--plane", "auto", "--refine", "off", "--valid") == 0
    report = json.loads((tmp_path / "auto" / "report.json").read_text())
    fit = report["model"]["plane"]["fit"]
    assert fit["mean_px"]["at_plane"] < 0.6 * fit["mean_px"]["at_infinity"]
    assert report["plane"]["normal"][1] > 0.9  # most of the street's texture is its ground
    assert set(report["disparity_px"]) == {"at_3m", "at_5m", "at_10m", "at_20m", "at_60m"}
    assert report["homography_px"]["share_above"] == 0
    mask = imagefile.read(tmp_path / "auto" / "valid" / "001.png")
    assert set(np.unique(mask)) <= {0, 64, 128, 255}
    assert 0.5 < (mask == 255).mean() < 1
