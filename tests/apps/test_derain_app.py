"""`rainstereo derain`: images, big images, videos, cameras, streams; what goes wrong is said, and the rest is done."""

import gc
import io
import json
import shutil
import struct
import subprocess
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from rainstereo import imagefile
from rainstereo.apps import big_images, derain
from rainstereo.apps.cli import main
from rainstereo.apps.derain_files import Folder
from rainstereo.apps.derain_video import Reader
from rainstereo.apps.matroska import PictureVideo
from rainstereo.model.restore import Restorer
from rainstereo.types import Image
from tests.model.small_restorer import picture, saved

FAST = ("--no-skip", "--no-sheet")


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(tmp_path_factory.mktemp("weights") / "own")


@pytest.fixture(scope="session")
def own(weights: Path) -> Restorer:
    return Restorer(weights, precision="float32", skip=False)


def run(weights: Path, images: object, out: Path, *more: str) -> int:
    """In float32, since bf16, where the processor multiplies it, differs by levels from one tile to another."""
    at = ["--checkpoint", str(weights), "--precision", "float32"]
    return main(["derain", str(images), "--out", str(out), *at, *more])


def report(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    return found


def put(path: Path, image: Image) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(path, image)
    return path


# -- images ------------------------------------------------------------------------------------------------------------


def test_a_folder_is_restored_and_not_made_again(weights: Path, own: Restorer, tmp_path: Path) -> None:
    images = {"a": picture(1), "b": picture(2, (50, 70))[..., 0], "c": picture(3).astype(np.uint16) * 200}
    for name, image in images.items():
        put(tmp_path / f"in/{name}.png", image)
    assert run(weights, tmp_path / "in", tmp_path / "out", "--no-skip", "--batch", "2") == 0
    for name, image in images.items():
        found = imagefile.read(tmp_path / f"out/{name}.png")
        assert (found.dtype, found.shape) == (image.dtype, image.shape)
        assert np.abs(found.astype(int) - own(image)).max() <= (1 if image.dtype == np.uint8 else 3)
    assert report(tmp_path / "out")["made"] == 3
    assert b"restored" in (tmp_path / "out/report.html").read_bytes()
    (tmp_path / "out/b.png").unlink()
    put(tmp_path / "in/c.png", images["c"][:40])
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST) == 0
    assert report(tmp_path / "out")["made"] == 2
    assert imagefile.read(tmp_path / "out/c.png").shape[0] == 40


def test_other_settings_do_not_mix(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put(tmp_path / "in/a.png", picture())
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST) == 0
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST, "--format", "jpg") == 2
    assert "holds what other settings" in " ".join(capsys.readouterr().err.split())
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST, "--format", "jpg", "--overwrite") == 0
    assert (tmp_path / "out/a.jpg").is_file()


def test_a_bad_image_is_named_and_the_rest_is_done(weights: Path, tmp_path: Path) -> None:
    for name in "abc":
        put(tmp_path / f"in/{name}.png", picture(ord(name)))
    whole = (tmp_path / "in/b.png").read_bytes()
    (tmp_path / "in/b.png").write_bytes(whole[: len(whole) // 2])
    assert run(weights, tmp_path / "in", tmp_path / "out", "--no-skip") == 1
    found = report(tmp_path / "out")
    assert (found["status"], found["done"]) == ("incomplete", 2)
    assert "truncated" in found["trouble"][0]["reason"]
    assert not (tmp_path / "out/b.png").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--batch", "0"), "--batch 0 was given"),
        (("--workers", "99"), "--workers 99 was given"),
        (("--frames", "0"), "--frames 0 was given"),
        (("--raw", "4x4x3"), "raw frames need both"),
        (("--tile", "3"), "a tile of at least"),
        (("--detect-every", "0"), "expected 1 or more frames"),
        (("--device", "abacus"), "is unknown"),
    ],
)
def test_options_without_sense_are_refused(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], words: str
) -> None:
    put(tmp_path / "in/a.png", picture())
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST, *more) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_inputs_and_checkpoints_without_sense_are_refused(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    put(tmp_path / "in/a.png", picture())
    other = saved(tmp_path / "gray", input={"channels": 1})
    for checkpoint, images, out, words in (
        (weights, tmp_path / "none", "out", "does not exist"),
        (weights, tmp_path / "in", "in/out", "lie in one another"),
        (weights, "camera:front", "out", "expected a camera's number"),
        (other, tmp_path / "in", "out", "channels 1; expected channels 3"),
    ):
        assert run(checkpoint, images, tmp_path / out, *FAST) == 2
        assert words in " ".join(capsys.readouterr().err.split())


# -- images that are read and written strip by strip -------------------------------------------------------------------


@pytest.fixture
def everything_is_big(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(big_images, "BIG", 1000)


@pytest.mark.usefixtures("everything_is_big")
@pytest.mark.parametrize("kind", ["tif", "gray.tif", "deep.tif", "packed.tif", "ppm", "pgm", "png", "deep.png"])
def test_big_images_equal_small_ones(weights: Path, own: Restorer, tmp_path: Path, kind: str) -> None:
    image = picture(4, (150, 200))
    if kind.startswith("gray") or kind == "pgm":
        image = image[..., 0]
    if kind.startswith("deep"):
        image = image.astype(np.uint16) * 251
    path = tmp_path / f"in/a.{kind.split('.')[-1]}"
    path.parent.mkdir()
    if path.suffix == ".tif":
        packed = {"compression": "zlib"} if kind.startswith("packed") else {}
        tifffile.imwrite(path, image if image.ndim == 2 else image[..., ::-1], **packed)
    else:
        put(path, image)
    assert big_images.is_big(path)
    with big_images.reading(path) as big:
        assert (big.file is None) == (kind in ("packed.tif", "png", "deep.png"))
        assert np.array_equal(big.read(3, 77), image[3:77])
    form = "png" if path.suffix == ".png" else "tif"
    more = (*FAST, "--format", form, "--tile", "64", "--max-megapixels", "0.0625")
    assert run(weights, path, tmp_path / "out", *more) == 0
    found = imagefile.read(tmp_path / f"out/a.{form}")
    assert (found.dtype, found.shape) == (image.dtype, image.shape)
    assert np.abs(found.astype(int) - own(image)).max() <= (1 if image.dtype == np.uint8 else 300)
    assert report(tmp_path / "out")["images"][0]["streamed"]


@pytest.mark.usefixtures("everything_is_big")
def test_memory_does_not_grow_with_the_height(weights: Path, tmp_path: Path) -> None:
    """Of all that numpy and Python hold; torch has one tile at a time."""
    peaks = []
    for height in (300, 600, 2400):
        path = tmp_path / f"in/{height}.ppm"
        put(path, np.tile(picture(1, (300, 64)), (height // 300, 1, 1)))
        out = tmp_path / f"out{height}"
        gc.collect()  # so that the collector comes at the same moments in each
        tracemalloc.start()
        try:
            assert run(weights, path, out, *FAST, "--format", "tif", "--tile", "64", "--max-megapixels", "0.0625") == 0
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
        assert len(imagefile.read(out / f"{height}.tif")) == height
    assert abs(peaks[2] - peaks[1]) < 0.05 * peaks[1] + 30_000  # a whole image more would be 350 kB more


@pytest.mark.usefixtures("everything_is_big")
def test_big_images_that_are_damaged_are_reported(weights: Path, tmp_path: Path) -> None:
    path = put(tmp_path / "in/a.ppm", picture(4, (150, 200)))
    path.write_bytes(path.read_bytes()[:-5])
    head = struct.pack(">IIBBBBB", 1 << 20, 1 << 20, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head))
    (tmp_path / "in/bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"IEND")
    put(tmp_path / "in/good.png", picture(4, (150, 200)))
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST) == 1
    found = report(tmp_path / "out")
    assert [Path(row["path"]).name for row in found["trouble"]] == ["a.ppm", "bomb.png"]
    assert "truncated" in found["trouble"][0]["reason"]
    assert "expected at most" in found["trouble"][1]["reason"]
    assert sorted(p.name for p in (tmp_path / "out").iterdir() if not p.name.startswith(".")) == [
        "good.png",
        "report.json",
    ]


# -- videos ------------------------------------------------------------------------------------------------------------

TIMES = [0.0, 0.04, 0.08, 0.2, 0.25, 0.29, 0.33, 0.5]


def video(path: Path, times: list[float] = TIMES, size: tuple[int, int] = (64, 48)) -> list[Image]:
    frames = [picture(i, size[::-1]) for i in range(len(times))]
    path.parent.mkdir(parents=True, exist_ok=True)
    with PictureVideo(path, size, 25, lossless=True) as writer:
        for frame, seconds in zip(frames, times, strict=True):
            writer.write(frame, seconds)
    return frames


def frames_of(path: Path) -> tuple[list[float], list[Image]]:
    found = list(Reader(path).frames())
    return [round(frame.seconds, 4) for frame in found], [frame.image for frame in found]


@pytest.mark.parametrize("lossless", [True, False])
def test_matroska_files_keep_frames_and_times(tmp_path: Path, lossless: bool) -> None:
    path = tmp_path / "a.mkv"
    made = video(path)
    if not lossless:
        with PictureVideo(path, (64, 48), 25) as writer:
            for frame, seconds in zip(made, TIMES, strict=True):
                writer.write(frame, seconds)
    times, found = frames_of(path)
    assert times == TIMES
    assert max(np.abs(a.astype(int) - b).max() for a, b in zip(found, made, strict=True)) <= (0 if lossless else 20)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 0.9, 1.0])
def test_matroska_files_that_were_cut_off_are_gone_on_with(tmp_path: Path, share: float) -> None:
    made = video(tmp_path / "a.mkv")
    whole = (tmp_path / "a.mkv").read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole[: max(600, int(share * len(whole)))])
    writer = PictureVideo(cut, (64, 48), 25, lossless=True, resume=True)
    assert writer.times == pytest.approx(TIMES[: len(writer.times)])
    for frame, seconds in list(zip(made, TIMES, strict=True))[len(writer.times) :]:
        writer.write(frame, seconds)
    writer.close()
    assert cut.read_bytes() == whole
    with pytest.raises(ValueError, match="could be gone on with"):
        PictureVideo(cut, (80, 48), 25, lossless=True, resume=True)
    with pytest.raises(ValueError, match="the video has"), PictureVideo(tmp_path / "b.mkv", (64, 48), 25) as writer:
        writer.write(picture(), 0)


def test_a_video_keeps_its_frame_times(weights: Path, own: Restorer, tmp_path: Path) -> None:
    given = video(tmp_path / "in/drive.mkv")
    assert run(weights, tmp_path / "in/drive.mkv", tmp_path / "out", "--no-skip", "--lossless") == 0
    times, found = frames_of(tmp_path / "out/drive.mkv")
    assert times == TIMES
    for before, after in zip(given, found, strict=True):
        assert np.abs(after.astype(int) - own(before)).max() <= 1
    assert report(tmp_path / "out")["images"][0]["frames"] == len(TIMES)
    assert run(weights, tmp_path / "in/drive.mkv", tmp_path / "out", "--no-skip", "--lossless") == 0
    assert report(tmp_path / "out")["made"] == 0


def test_a_killed_video_goes_on_at_its_frame(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video(tmp_path / "in/drive.mkv")
    assert run(weights, tmp_path / "in", tmp_path / "whole", *FAST, "--lossless") == 0
    calls: list[int] = []
    whole = Restorer.with_cells

    def dying(self: Restorer, *arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return whole(self, *arguments)

    monkeypatch.setattr(Restorer, "with_cells", dying)
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST, "--lossless") == 130
    assert not (tmp_path / "out/drive.mkv").exists()
    calls[:] = [1] * 10
    assert run(weights, tmp_path / "in", tmp_path / "out", *FAST, "--lossless") == 0
    assert len(calls) == 10 + len(TIMES) - 3
    for a, b in zip(frames_of(tmp_path / "out/drive.mkv"), frames_of(tmp_path / "whole/drive.mkv"), strict=True):
        assert np.array_equal(a, b)
    assert not list((tmp_path / "out").glob(".*partial*"))


def test_a_truncated_video_is_reported_and_what_there_is_plays(weights: Path, tmp_path: Path) -> None:
    times = [i / 25 for i in range(12)]
    video(tmp_path / "in/drive.mkv", times)
    whole = (tmp_path / "in/drive.mkv").read_bytes()
    (tmp_path / "in/drive.mkv").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "in/junk.mp4").write_bytes(b"no video at all")
    put(tmp_path / "in/photo.png", picture())
    assert run(weights, tmp_path / "in", tmp_path / "out", "--no-skip", "--lossless") == 1
    reasons = {Path(row["path"]).name: row["reason"] for row in report(tmp_path / "out")["trouble"]}
    assert reasons.keys() == {"drive.mkv", "junk.mp4"}
    assert "the file is cut off" in reasons["drive.mkv"]
    assert "not a video" in reasons["junk.mp4"]
    assert (tmp_path / "out/photo.png").is_file()
    found, _ = frames_of(tmp_path / "out/drive.mkv")
    assert 3 <= len(found) < 12
    assert found == pytest.approx(times[: len(found)])


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_the_sound_comes_along(weights: Path, tmp_path: Path) -> None:
    video(tmp_path / "silent.mkv")
    sound = ["-f", "lavfi", "-i", "sine=440:duration=0.5", "-c:v", "copy", "-c:a", "pcm_s16le"]
    join = ["ffmpeg", "-v", "error", "-i", str(tmp_path / "silent.mkv"), *sound, str(tmp_path / "drive.mkv")]
    assert subprocess.run(join, check=False).returncode == 0
    assert run(weights, tmp_path / "drive.mkv", tmp_path / "out", *FAST) == 0
    assert run(weights, tmp_path / "drive.mkv", tmp_path / "mp4", *FAST, "--video-format", "mp4") in (0, 1)
    ask = ["ffprobe", "-v", "error", "-show_entries", "stream=codec_type,codec_name", "-of", "csv=p=0"]
    told = subprocess.run([*ask, str(tmp_path / "out/drive.mkv")], capture_output=True, text=True, check=False).stdout
    assert told.split() == ["mjpeg,video", "pcm_s16le,audio"]
    assert frames_of(tmp_path / "out/drive.mkv")[0] == pytest.approx(TIMES, abs=0.001)


def test_without_ffmpeg_it_says_that_the_sound_is_lost(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rainstereo.apps.derain_video.shutil.which", lambda name: None)
    video(tmp_path / "drive.mkv")
    assert run(weights, tmp_path / "drive.mkv", tmp_path / "out", *FAST) == 0
    assert "a sound track, if there is one, was not kept" in " ".join(capsys.readouterr().err.split())
    assert run(weights, tmp_path / "drive.mkv", tmp_path / "mp4", *FAST, "--video-format", "mp4") == 1
    assert "mp4 needs ffmpeg" in report(tmp_path / "mp4")["trouble"][0]["reason"]


# -- cameras and streams -----------------------------------------------------------------------------------------------


class Camera:
    """In place of OpenCV's: gives some frames and is gone."""

    frames = 5

    def __init__(self, number: int) -> None:
        self.left = self.frames if number == 0 else 0
        self.opened = number == 0

    def isOpened(self) -> bool:
        return self.opened

    def read(self) -> tuple[bool, Image | None]:
        self.left -= 1
        return (True, picture(self.left, (48, 64))) if self.left >= 0 else (False, None)

    def release(self) -> None:
        self.opened = False


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> None:
    real = cv2.VideoCapture
    monkeypatch.setattr(cv2, "VideoCapture", lambda what: Camera(what) if isinstance(what, int) else real(what))


@pytest.mark.usefixtures("camera")
def test_a_camera_is_recorded_until_it_is_gone(weights: Path, tmp_path: Path) -> None:
    assert run(weights, "camera:0", tmp_path / "out", "--no-skip", "--frames", "3") == 0
    assert len(frames_of(tmp_path / "out/camera-0.mkv")[0]) == 3
    assert run(weights, "camera:0", tmp_path / "out", "--no-skip") == 1
    assert "no more frames after 5" in report(tmp_path / "out")["trouble"][0]["reason"]
    assert len(frames_of(tmp_path / "out/camera-0-2.mkv")[0]) == 5
    assert run(weights, "camera:7", tmp_path / "out", "--no-skip") == 1
    assert "cannot be opened" in report(tmp_path / "out")["trouble"][0]["reason"]


@pytest.mark.parametrize("rest", [0, 7])
def test_raw_frames_go_through(weights: Path, own: Restorer, tmp_path: Path, rest: int) -> None:
    frames = [picture(i, (48, 64)) for i in range(3)]
    data = b"".join(frame.tobytes() for frame in frames) + bytes(rest)
    sink = io.BytesIO()
    options = derain.Options(("-",), tmp_path / "out", weights, precision="float32", skip=False, raw="64x48x3")
    assert derain.run(options, io.BytesIO(data), sink) == (1 if rest else 0)
    found = np.frombuffer(sink.getvalue(), np.uint8).reshape(3, 48, 64, 3)
    for before, after in zip(frames, found, strict=True):
        assert np.array_equal(after, own(before))
    status = report(tmp_path / "out")["images"][0]
    assert status["frames"] == 3
    assert ("7 bytes into a frame" in status.get("reason", "")) == bool(rest)


def test_senseless_raw_sizes_are_refused(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for raw in ("64x48", "0x48x3", "999999x999999x3", "4x4x4"):
        assert run(weights, "-", tmp_path / "out", "--raw", raw) == 2
        assert "expected WIDTHxHEIGHTx3" in " ".join(capsys.readouterr().err.split())


def test_a_glob_means_the_files_that_fit_it(weights: Path, tmp_path: Path) -> None:
    for name in ("a.png", "b.png", "c.bmp"):
        put(tmp_path / "in" / name, picture(4))
    assert run(weights, tmp_path / "in" / "*.png", tmp_path / "out", *FAST) == 0
    assert report(tmp_path / "out")["made"] == 2
    assert not list((tmp_path / "out").rglob("c.*"))


def test_a_folder_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    folder = Folder(tmp_path, "key")
    folder.claim(overwrite=False)
    folder.claim(overwrite=False)
    (tmp_path / ".derain/settings.json").write_text("{")
    with pytest.raises(ValueError, match="other settings"):
        folder.claim(overwrite=False)
    folder.claim(overwrite=True)
