"""Alignment as a job: killed and resumed, in shards, by any number of workers, on full disks and broken files."""

import csv
import errno
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

from rainstereo import Camera, Rig, imagefile
from rainstereo.apps import align_job
from rainstereo.apps.cli import main

PAIRS = 44


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig folder and many small pairs."""
    folder = tmp_path_factory.mktemp("job")
    dry = Camera.pinhole(150, 150, 79.5, 59.5, 160, 120)
    wet = Camera.pinhole(151, 151, 78.0, 60.0, 160, 120).with_pose(np.array([2e-3, -3e-3, 1e-3, 0.029, 0, 0]))
    Rig(dry, wet).save(folder / "rig")
    rng = np.random.default_rng(7)
    for role in ("dry", "wet"):
        (folder / role).mkdir()
        for i in range(PAIRS):
            cv2.imwrite(str(folder / role / f"{i:04d}.png"), rng.integers(0, 255, (120, 160, 3), dtype=np.uint8))
    return folder


def words(drive: Path, out: Path, *more: str) -> list[str]:
    options = {"--dry": drive / "dry", "--wet": drive / "wet", "--rig": drive / "rig", "--out": out}
    return ["align", *(str(word) for pair in options.items() for word in pair), "--workers", "1", *more]


def content(folder: Path) -> dict[str, bytes]:
    """Every file that the job promises to be the same."""
    kept = [*folder.glob("dry/*"), *folder.glob("wet/*"), *folder.glob("valid/*"), folder / "pairs.csv"]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in kept}


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "pairs.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def whole(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What an uninterrupted run of one worker writes."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main(words(drive, out)) == 0
    return content(out)


def test_the_manifest_lists_every_pair_in_order(drive: Path, whole: dict[str, bytes]) -> None:
    lines = whole["pairs.csv"].decode().splitlines()
    assert lines[0] == "name,dry,wet,timestamp_us,drive,regime,sync_us,photometric"
    assert lines[1] == f"0000,dry/0000.png,wet/0000.png,,{drive.name},,,"
    assert [line.split(",")[0] for line in lines[1:]] == [f"{i:04d}" for i in range(PAIRS)]
    assert len(whole) == 2 * PAIRS + 1


def test_workers_change_no_byte(drive: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    assert main(words(drive, tmp_path / "out", "--workers", "3")) == 0
    assert content(tmp_path / "out") == whole


def test_shards_are_a_partition(drive: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    apart = []
    for i in (1, 2, 3):
        assert main(words(drive, tmp_path / f"apart{i}", "--shard", f"{i}/3")) == 0
        assert main(words(drive, tmp_path / "shared", "--shard", f"{i}/3")) == 0
        apart.append({k: v for k, v in content(tmp_path / f"apart{i}").items() if k != "pairs.csv"})
    assert content(tmp_path / "shared") == whole
    assert sum(map(len, apart)) == 2 * PAIRS
    assert {**apart[0], **apart[1], **apart[2]} == {k: v for k, v in whole.items() if k != "pairs.csv"}
    assert main(words(drive, tmp_path / "x", "--shard", "4/3")) == 2


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_killed_and_restarted_it_equals_an_uninterrupted_run(
    drive: Path, whole: dict[str, bytes], tmp_path: Path, workers: int
) -> None:
    out = tmp_path / "out"
    enough = int(np.random.default_rng(time.time_ns()).integers(1, PAIRS))  # the moment is meant to be random
    command = [sys.executable, "-m", "rainstereo.apps.cli", *words(drive, out, "--workers", str(workers))]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while process.poll() is None and len(list(out.glob("*/*.png"))) < enough:
            time.sleep(0.002)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    for path in out.glob("*/[0-9]*.png"):  # what is there is whole
        assert path.read_bytes() == whole[path.relative_to(out).as_posix()], f"killed after {enough} files"
    time.sleep(0.3)  # its workers notice within a tenth of a second
    assert main(words(drive, out)) == 0
    assert content(out) == whole, f"killed after {enough} files"


def test_a_second_run_has_nothing_to_do_and_changes_nothing(drive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(words(drive, out)) == 0
    times = {path: path.stat().st_mtime_ns for path in out.glob("*/*.png")}
    (out / "wet" / "0005.png").unlink()
    (out / "dry" / "0006.png").write_bytes(b"\x89PNG cut")
    assert main(words(drive, out)) == 0
    report = json.loads((out / "report.json").read_text())
    assert (report["pairs"], report["pairs_made"], report["pairs_kept"]) == (PAIRS, 2, PAIRS - 2)
    redone = {path.name for path, old in times.items() if path.stat().st_mtime_ns != old}
    assert redone == {"0005.png", "0006.png"}


def damaged(drive: Path, folder: Path) -> Path:
    """The drive with one image in a hundred cut off or empty, one missing, and one of another size."""
    for role in ("dry", "wet"):
        (folder / role).mkdir(parents=True)
        for path in (drive / role).iterdir():
            os.link(path, folder / role / path.name)
    (folder / "rig").symlink_to(drive / "rig")
    bad = {"wet/0003.png": (drive / "wet" / "0003.png").read_bytes()[:9000], "dry/0017.png": b""}
    bad["wet/0030.png"] = cv2.imencode(".png", np.zeros((60, 80), np.uint8))[1].tobytes()
    for name, data in bad.items():
        (folder / name).unlink()
        (folder / name).write_bytes(data)
    (folder / "dry" / "0040.png").unlink()
    return folder


def test_bad_files_are_named_the_rest_is_done_and_mended_files_follow(
    drive: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    bad, out = damaged(drive, tmp_path / "bad"), tmp_path / "out"
    assert main(words(bad, out, "--drive", drive.name)) == 0
    report = json.loads((out / "report.json").read_text())
    reasons = {Path(entry["file"]).relative_to(bad).as_posix(): entry["reason"] for entry in report["skipped"]}
    assert reasons == {
        "wet/0003.png": "truncated: the file ends before the image does",
        "dry/0017.png": "zero bytes",
        "wet/0030.png": "80 x 60 pixels; the rig was calibrated at 160 x 120",
        "wet/0040.png": "has no partner among the 43 dry images",
    }
    assert {row["name"] for row in rows(out)} == {f"{i:04d}" for i in range(PAIRS)} - {"0003", "0017", "0030", "0040"}
    for name in ("wet/0003.png", "dry/0017.png", "wet/0030.png"):
        (bad / name).unlink()
        os.link(drive / name, bad / name)
    assert main(words(bad, out, "--drive", drive.name)) == 0
    assert json.loads((out / "report.json").read_text())["pairs_made"] == 3
    found = content(out)
    assert all(found[name] == data for name, data in whole.items() if name != "pairs.csv" and "0040" not in name)


def test_an_image_that_changed_is_aligned_again(drive: Path, tmp_path: Path) -> None:
    mine = damaged(drive, tmp_path / "mine")
    assert main(words(mine, tmp_path / "out")) == 0
    (mine / "dry" / "0008.png").unlink()
    (mine / "dry" / "0008.png").write_bytes((drive / "dry" / "0009.png").read_bytes())
    before = (tmp_path / "out" / "dry" / "0008.png").read_bytes()
    assert main(words(mine, tmp_path / "out")) == 0
    after = (tmp_path / "out" / "dry" / "0008.png").read_bytes()
    assert after == (tmp_path / "out" / "dry" / "0009.png").read_bytes() != before


def test_a_full_disk_stops_with_the_name_and_loses_nothing(
    drive: Path,
    whole: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, written, write = tmp_path / "out", [], imagefile.write_bytes

    def full_after_forty(path: os.PathLike[str], data: bytes) -> None:
        if len(written) >= 40:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, data)
        written.append(Path(path))

    with monkeypatch.context() as patch:
        patch.setattr(imagefile, "write_bytes", full_after_forty)
        assert main(words(drive, out)) == 1
    complaint = " ".join(capsys.readouterr().err.split())
    assert "cannot be written (No space left on device). What is finished stays" in complaint
    assert str(out / "dry") in complaint.replace(" ", "") or str(out / "wet") in complaint.replace(" ", "")
    assert all(path.exists() for path in written)
    assert main(words(drive, out)) == 0
    assert content(out) == whole


def test_a_folder_belongs_to_its_settings(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(words(drive, out)) == 0
    assert main(words(drive, out, "--plane", "5m")) == 2
    assert "other settings, another rig or another version" in " ".join(capsys.readouterr().err.split())
    assert main(words(drive, out, "--plane", "5m", "--overwrite", "--format", "jpg:98", "--valid")) == 0
    assert {path.suffix for path in out.glob("dry/*")} == {".jpg"}
    assert len(list(out.glob("valid/*.png"))) == PAIRS
    strange = tmp_path / "strange"
    (strange / "dry").mkdir(parents=True)
    (strange / "dry" / "mine.png").write_bytes(b"mine")
    assert main(words(drive, strange)) == 2
    assert "holds images already" in " ".join(capsys.readouterr().err.split())
    assert main(words(drive, drive)) == 2
    assert "among the recording's own files" in " ".join(capsys.readouterr().err.split())
    assert main(words(drive, tmp_path / "y", "--format", "gif")) == 2
    assert main(words(drive, tmp_path / "y", "--workers", "-1")) == 2


def test_two_processes_do_not_share_a_shard(drive: Path, tmp_path: Path) -> None:
    job = align_job.Job.claim(align_job.Outputs(tmp_path / "out"), "key")
    refused = pytest.raises(ValueError, match="another process is aligning shard 1/2")
    with job.alone((1, 2)), job.alone((2, 2)), refused, job.alone((1, 2)):
        pass
    with job.alone((1, 2)):  # it is free again
        pass


def test_timestamps_and_synchronisation_reach_the_manifest(drive: Path, tmp_path: Path) -> None:
    start, folder = 1_535_202_904_410_922, tmp_path / "2018-08-25"
    for role, late in (("dry", 0), ("wet", 250)):
        (folder / role).mkdir(parents=True)
        for i in range(3):
            os.link(drive / role / f"{i:04d}.png", folder / role / f"{start + 62_500 * i + late}.png")
    (folder / "rig").symlink_to(drive / "rig")
    assert main(words(folder, tmp_path / "out")) == 0
    found = rows(tmp_path / "out")
    assert [row["timestamp_us"] for row in found] == [str(start + 62_500 * i) for i in range(3)]
    assert {(row["drive"], row["sync_us"]) for row in found} == {("2018-08-25", "250")}
    assert (tmp_path / "out" / found[0]["wet"]).is_file()


def test_mapped_gray_levels_are_stated_in_the_manifest(drive: Path, tmp_path: Path) -> None:
    folder = tmp_path / "darker"
    rng = np.random.default_rng(3)
    for i in range(3):  # so smooth that the rig's small turn does not matter
        image = cv2.resize(rng.uniform(20, 230, (5, 6, 3)), (160, 120), interpolation=cv2.INTER_CUBIC).clip(0, 255)
        for role, seen in (("dry", image), ("wet", 0.8 * image + 5)):
            (folder / role).mkdir(parents=True, exist_ok=True)
            imagefile.write(folder / role / f"{i:04d}.png", np.rint(seen).astype(np.uint8))
    (folder / "rig").symlink_to(drive / "rig")
    assert main(words(folder, tmp_path / "out", "--photometric")) == 0
    said = {row["photometric"] for row in rows(tmp_path / "out")}
    assert len(said) == 1
    parts = dict(part.strip().split(" ", 1) for part in said.pop().split(";"))
    assert set(parts) == {"gain", "offset", "vignetting"}
    assert np.array(parts["gain"].split(), float) == pytest.approx(1 / 0.8, abs=0.05)
    report = json.loads((tmp_path / "out" / "report.json").read_text())["model"]["photometric"]
    for name, numbers in parts.items():
        assert np.array(numbers.split(), float) == pytest.approx(report[name], rel=1e-5)
    assert main(words(folder, tmp_path / "plain")) == 0
    assert {row["photometric"] for row in rows(tmp_path / "plain")} == {""}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is counted in Linux's kilobytes")
def test_memory_does_not_grow_with_the_recording(drive: Path, tmp_path: Path) -> None:
    """Each job in a process of its own, one of them eight times as long as the other."""
    most = []
    for pairs in (200, 1600):
        folder = tmp_path / str(pairs)
        for role in ("dry", "wet"):
            (folder / role).mkdir(parents=True)
            for i in range(pairs):
                os.link(drive / role / f"{i % PAIRS:04d}.png", folder / role / f"{i:06d}.png")
        (folder / "rig").symlink_to(drive / "rig")
        command = [sys.executable, "-m", "rainstereo.apps.cli", *words(folder, folder / "out")]
        subprocess.run(command, check=True, capture_output=True, timeout=600)
        report = json.loads((folder / "out" / "report.json").read_text())
        assert report["pairs"] == pairs
        most.append(report["memory_mb"]["this_process"])
    assert most[1] < most[0] + 15, most  # names and times of 1400 more pairs; a decoded pair each would be 160 MB
    assert most[1] < 1000


@pytest.mark.slow
def test_real_rainy_pairs_without_a_rig(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "raindrop" / "robotcar_rainy"
    command = ["align", "--dry", f"{folder}/right*.png", "--wet", f"{folder}/left*.png", "--out", str(tmp_path / "o")]
    assert main([*command, "--photometric", "--workers", "1"]) == 0
    report = json.loads((tmp_path / "o" / "report.json").read_text())
    dx, dy = report["model"]["pair"]["shift"]
    assert abs(dx - 143) < 0.5
    assert abs(dy) < 0.5
    for values in report["psnr_db"].values():
        assert values["aligned"] > 13
        assert values["as_recorded"] < 12.1
    assert report["model"]["photometric"]["after"] < report["model"]["photometric"]["before"]
    assert [row["timestamp_us"] for row in rows(tmp_path / "o")] == ["1535202904410922", "1535204973999542"]
    assert main([*command[:-1], str(tmp_path / "p"), "--plane", "5m"]) == 2
