"""The command: what it records is what the cameras gave; verify, repair and export of what it left."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo.apps import record
from rainstereo.apps.cli import main
from rainstereo.hardware.codec import available
from rainstereo.hardware.codec_choice import CodecRate, choose, disk_rate, measure
from rainstereo.hardware.recording import open_recording
from rainstereo.hardware.recording_repair import verify
from rainstereo.hardware.segment_log import segment_path
from rainstereo.imagefile import read
from rainstereo.rig import ROLES


@pytest.fixture
def folders(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Twelve pairs of mosaics, gray PNG."""
    for role in ROLES:
        (tmp_path / "in" / role).mkdir(parents=True)
        for i in range(12):
            smooth = cv2.resize(rng.integers(0, 255, (6, 8), np.uint8), (64, 48), interpolation=cv2.INTER_CUBIC)
            cv2.imwrite(str(tmp_path / "in" / role / f"{i:03d}.png"), smooth)
    return tmp_path / "in"


def take(folders: Path, out: Path, *more: str) -> int:
    words = ["record", "--dry", f"folder:{folders / 'dry'}", "--wet", f"folder:{folders / 'wet'}", "--out", str(out)]
    return main([*words, "--least-free-gb", "0", *more])


def test_folders_are_recorded_verified_and_exported(folders: Path, tmp_path: Path) -> None:
    out = tmp_path / "rec"
    assert take(folders, out, "--pixel-format", "BayerRG8", "--preview-s", "0.001") == 0
    found = open_recording(out)
    assert len(found) == 12
    for i in (0, 7, 11):
        for role in ROLES:
            assert np.array_equal(found.read(i).frame(role).image, read(folders / role / f"{i:03d}.png"))
    report = json.loads((out / "report.json").read_text())
    assert report["status"] == "ok"
    assert report["pairs"] == 12
    assert report["ended"] == "the files have no more frames"
    assert report["codec"] in available()
    assert len(report["codec_choice"]["rates"]) == len(available())
    assert "In step?" in (out / "report.html").read_text()
    preview = cv2.imread(str(out / "preview.jpg"))
    assert preview is not None
    assert preview.shape == (26 + 360, 960, 3)
    assert main(["record", "verify", str(out)]) == 0
    for layout, dry in (("robotcar", "dry/*.png"), ("kitti", "image_02/data/*.png")):
        assert main(["record", "export", str(out), "--out", str(tmp_path / layout), "--layout", layout]) == 0
        assert len(list((tmp_path / layout).glob(dry))) == 12
    stamps = (tmp_path / "robotcar" / "wet.timestamps").read_text().split("\n")[:-1]
    assert all((tmp_path / "robotcar" / "wet" / f"{line.split()[0]}.png").exists() for line in stamps)
    first = read(tmp_path / "kitti" / "image_03" / "data" / "0000000000.png")
    assert np.array_equal(first, found.read(0).wet)
    assert len((tmp_path / "kitti" / "image_02" / "timestamps.txt").read_text().split("\n")) == 13
    rows = (tmp_path / "robotcar" / "pairs.csv").read_text().split("\n")
    assert rows[0] == "name,dry,wet,timestamp_us,drive,regime,sync_us,photometric"
    assert main(["record", "export", str(out), "--out", str(tmp_path / "raw"), "--raw"]) == 0
    gray = sorted((tmp_path / "raw" / "dry").glob("*.png"))[3]
    assert np.array_equal(read(gray), read(folders / "dry" / "003.png"))


def test_damage_is_told_and_mended(folders: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "rec"
    assert take(folders, out, "--codec", "png", "--pairs", "5") == 0
    assert len(open_recording(out)) == 5
    entry = open_recording(out).entry(2)
    with segment_path(out, 0).open("rb+") as file:
        file.seek(entry.payload + entry.meta_bytes + 100)
        value = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([value ^ 0x10]))
    capsys.readouterr()
    assert main(["record", "verify", str(out)]) == 1
    assert f"bit 4 of byte {entry.payload + entry.meta_bytes + 100} is flipped" in capsys.readouterr().out
    assert main(["record", "export", str(out), "--out", str(tmp_path / "x")]) == 1
    assert "record 3" in capsys.readouterr().out
    assert main(["record", "repair", str(out)]) == 0
    assert main(["record", "verify", str(out)]) == 0


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["record"], "needs --dry, --wet and --out"),
        (["record", "verify"], "needs the folder of a recording"),
        (["record", "export", "here"], "needs --out"),
        (["record", "verify", "nowhere"], "no segments"),
        (["record", "--dry", "usb:1", "--wet", "usb:2", "--out", "x"], "expected folder:PATH"),
        (["record", "--dry", "folder:a", "--wet", "folder:b", "--out", "x", "--pump", "p"], "a pump needs a schedule"),
    ],
)
def test_bad_usage(words: list[str], complaint: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    os.chdir(tmp_path)
    assert main(words) == 2
    assert complaint in " ".join(capsys.readouterr().err.split())


def test_too_little_room_ends_a_recording_as_a_failure(folders: Path, tmp_path: Path) -> None:
    out = tmp_path / "rec"
    assert take(folders, out, "--least-free-gb", "1e9", "--codec", "raw") == 1
    assert json.loads((out / "report.json").read_text())["status"] == "failed"
    assert verify(out).sound


def test_a_codec_is_chosen_by_rate_and_size() -> None:
    rates = [CodecRate("raw", 300, 1.0), CodecRate("zstd", 120, 0.8), CodecRate("jxl", 50, 0.55)]
    frame = 1280 * 960
    assert choose(rates, 1e9, frame, 32, 2).codec == "jxl"  # 100 a second are enough for twice 32
    assert choose(rates, 1e9, frame, 60, 2).codec == "zstd"
    assert choose(rates, 1e9, frame, 200, 2).codec == "raw"
    slow = choose(rates, 40e6, frame, 32, 2)  # 50 MB/s of jxl would be needed
    assert (slow.codec, slow.enough) == ("jxl", False)


def test_rates_are_measured(tmp_path: Path, rng: np.random.Generator) -> None:
    frames = [(rng.integers(0, 255, (48, 64), np.uint8), "BayerRG8")]
    found = {rate.name: rate for rate in measure(frames, 0.01)}
    assert set(found) == set(available())
    assert found["raw"].ratio == 1
    assert all(rate.fps > 0 for rate in found.values())
    assert disk_rate(tmp_path, 1 << 20) > 0
    assert not list(tmp_path.iterdir())


def test_interrupted_recordings_are_closed(folders: Path, tmp_path: Path) -> None:
    """Ctrl-C while a camera is silent: everything is written and closed."""
    script = """
        import sys, time
        from pathlib import Path
        from rainstereo.apps import record
        from rainstereo.hardware.capture import CameraPair
        from rainstereo.hardware.file_cameras import folder_pair
        class Endless:
            def __init__(self, camera): self.camera = camera
            def __getattr__(self, name): return getattr(self.camera, name)
            def read(self, timeout):
                try:
                    return self.camera.read(timeout)
                except EOFError:
                    sys.stdout.write("waiting\\n"); sys.stdout.flush(); time.sleep(timeout)
        folder, out = map(Path, sys.argv[1:])
        cameras = {k: Endless(c) for k, c in folder_pair(folder / "dry", folder / "wet").items()}
        options = record.Options(out=out, codec="raw", least_free_gb=0)
        sys.exit(record.take(options, out, CameraPair(cameras), None, None, {}))
    """
    lines = "\n".join(line[8:] for line in script.splitlines())
    words = [sys.executable, "-c", lines, str(folders), str(tmp_path / "rec")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        assert process.stdout.readline().endswith(b"waiting\n")
        time.sleep(0.7)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
        assert process.returncode == 0
    assert open_recording(tmp_path / "rec").about["ended"] == "interrupted"
    assert len(open_recording(tmp_path / "rec")) == 12
    assert verify(tmp_path / "rec").sound


def test_help_names_the_actions() -> None:
    assert "verify" in (record.Options.__doc__ or "")
