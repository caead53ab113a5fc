"""`rainstereo rain --surround`: rain on the inside of images, which look at what is around it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, Rig, imagefile
from rainstereo.apps.cli import main
from rainstereo.rain.render import Renderer, Surround
from rainstereo.types import Image

SIDES = (32, 20, 16, 12)
INSIDE = (slice(20, 92), slice(32, 128))
OPTIONS = ("--preset", "large", "--seed", "5", "--f-number", "inf", "--surround", *map(str, SIDES))


def picture(seed: int, size: tuple[int, int] = (144, 104)) -> Image:
    """Smooth blotches."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).random((size[1], size[0], 3)).astype(np.float32), (0, 0), 5)
    return np.rint(255 * (noise - noise.min()) / np.ptp(noise)).astype(np.uint8)


@pytest.fixture
def wide(tmp_path: Path) -> Path:
    """Two images, and their labels."""
    for i in range(2):
        for name in ("wide", "labels"):
            (tmp_path / name).mkdir(exist_ok=True)
        imagefile.write(tmp_path / f"wide/{i}.png", picture(i))
        imagefile.write(tmp_path / f"labels/{i}.png", np.random.default_rng(i).integers(0, 9, (104, 144), np.uint8))
    return tmp_path / "wide"


def rain(source: Path, out: Path, *more: str) -> int:
    return main(["rain", str(source), "--out", str(out), *more])


def test_drops_look_at_what_is_around(wide: Path, tmp_path: Path) -> None:
    """The inside under the rain that its drop list tells, seen by the whole image's camera; the rest untouched."""
    out = tmp_path / "out"
    assert rain(wide, out, *OPTIONS, "--masks", "--psnr", "20") == 0
    report = json.loads((out / "report.json").read_text())
    for i in range(2):
        image, rainy = imagefile.read(wide / f"{i}.png"), imagefile.read(out / f"{i}.png")
        renderer, drops = Renderer.from_json((out / f"drops/{i}.json").read_text())
        assert renderer.border == Surround(*SIDES)
        whole = Camera.pinhole(0.9 * 144, 0.9 * 144, 71.5, 51.5, 144, 104)
        assert renderer.camera.size == (96, 72)
        np.testing.assert_allclose(renderer.camera.intrinsics - whole.intrinsics, [0, 0, -32, -20])
        np.testing.assert_array_equal(rainy, renderer.plan(drops).apply(image))
        unknown, _, drop = np.moveaxis(imagefile.read(out / f"masks/{i}.png"), -1, 0)
        np.testing.assert_array_equal(rainy[drop == 0], image[INSIDE][drop == 0])
        alone = Renderer(renderer.camera, renderer.chamber, lens=None).plan(drops).unknown
        assert 0 < np.count_nonzero(unknown) < 0.8 * np.count_nonzero(alone)
        error = np.mean((rainy.astype(float) - image[INSIDE]) ** 2)
        assert report["images"][i]["psnr"] == pytest.approx(10 * np.log10(255**2 / error), abs=1e-3)
        assert report["images"][i]["psnr"] == pytest.approx(20, abs=0.5)
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg") == 2 * 2 + 2
    assert "32 px left, 20 above, 16 right, 12 below" in page
    assert rain(wide, tmp_path / "again", "--drops", str(out / "drops/0.json")) == 0
    assert (tmp_path / "again/0.png").read_bytes() == (out / "0.png").read_bytes()


@pytest.mark.parametrize("unknown", ["copied", "marked"])
def test_labels_are_cut_alike(unknown: str, wide: Path, tmp_path: Path) -> None:
    options = ("--labels", str(tmp_path / "labels"), "--unknown-labels", unknown, "--masks")
    assert rain(wide, tmp_path / "out", *OPTIONS, *options) == 0
    for i in range(2):
        expected = imagefile.read(tmp_path / f"labels/{i}.png")[INSIDE]
        found = imagefile.read(tmp_path / f"out/labels/{i}.png")
        _, opacity, _ = np.moveaxis(imagefile.read(tmp_path / f"out/masks/{i}.png"), -1, 0)
        assert found.shape == expected.shape
        if unknown == "marked":
            assert (found[opacity > 130] == 255).all()
        np.testing.assert_array_equal(found[found < 255], expected[found < 255])
        assert (found < 255).mean() > (0.1 if unknown == "marked" else 0.999)


def test_a_rig_s_camera_is_that_of_whole_images(wide: Path, tmp_path: Path) -> None:
    camera = Camera("LENSMODEL_OPENCV5", [130, 130, 70, 50, -0.1, 0.02, 1e-3, 1e-3, 0], 144, 104)
    Rig(camera, camera, Chamber((0, 0, 1), 0.04, (Panel(0.004, 1.49),))).save(tmp_path / "rig")
    assert rain(wide, tmp_path / "out", *OPTIONS, "--rig", str(tmp_path / "rig")) == 0
    renderer, _ = Renderer.from_json((tmp_path / "out/drops/0.json").read_text())
    assert renderer.camera.size == (96, 72)
    np.testing.assert_allclose(renderer.camera.intrinsics, [130, 130, 38, 30, -0.1, 0.02, 1e-3, 1e-3, 0])


def test_sequences_and_videos(wide: Path, tmp_path: Path) -> None:
    assert rain(wide, tmp_path / "frames", *OPTIONS, "--sequence", "--psnr", "20") == 0
    assert imagefile.read(tmp_path / "frames/1.png").shape == (72, 96, 3)
    writer = cv2.VideoWriter(str(tmp_path / "drive.mkv"), cv2.VideoWriter.fourcc(*"FFV1"), 10, (144, 104))
    for _ in range(2):
        writer.write(picture(3))
    writer.release()
    assert rain(tmp_path / "drive.mkv", tmp_path / "video", *OPTIONS, "--video-format", "mkv", "--masks") == 0
    reader = cv2.VideoCapture(str(tmp_path / "video/drive.mkv"))
    shown = reader.read()[1]
    drop = imagefile.read(tmp_path / "video/masks/drive/000000.png")[..., 2]
    np.testing.assert_array_equal(shown[drop == 0], picture(3)[INSIDE][drop == 0])
    reader.release()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--surround", "0", "0", "0", "0"), "expected pixels LEFT TOP RIGHT BOTTOM"),
        (("--surround", "-1", "0", "0", "0"), "--surround -1 0 0 0: a border of -1 pixels"),
        (("--surround", "9", "9", "9", "9", "--border", "edge"), "leave out one"),
        (("--surround", "9", "9", "9", "9", "--drops", "no.json"), "leave out --surround"),
    ],
)
def test_a_surround_without_sense_is_refused(
    more: tuple[str, ...], words: str, wide: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rain(wide, tmp_path / "out", *more) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_images_that_a_surround_leaves_nothing_of_are_named(
    wide: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rain(wide, tmp_path / "out", "--surround", "72", "0", "72", "0") == 1
    assert "leaves nothing of it" in " ".join(capsys.readouterr().err.split())
    imagefile.write(tmp_path / "labels/0.png", np.zeros((72, 96), np.uint8))
    assert rain(wide, tmp_path / "other", *OPTIONS, "--labels", str(tmp_path / "labels")) == 1
    assert "has 96 x 72 pixels, its image 144 x 104" in " ".join(capsys.readouterr().err.split())
