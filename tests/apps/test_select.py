"""`rainstereo select` from folders of files to manifest, card and sheet; interrupted, damaged, and with too little."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rainstereo import imagefile
from rainstereo.apps import select_manifest, select_measuring
from rainstereo.apps.cli import main
from rainstereo.apps.select_sources import find
from rainstereo.selection.perceptual_hash import NEAR_DUPLICATE, from_text, nearest


@pytest.fixture(scope="module")
def aligned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives of 40 pairs along painted walls; the wet side has blots. Some files are not as they should be."""
    root, rng = tmp_path_factory.mktemp("aligned"), np.random.default_rng(4)
    for d in range(3):
        wall = np.full((90, 2200, 3), 90, np.uint8)
        for _ in range(400):
            x, y, w, h = (int(v) for v in rng.integers((0, 0, 4, 4), (2200, 90, 50, 40)))
            cv2.rectangle(wall, (x, y), (x + w, y + h), tuple(int(c) for c in rng.integers(0, 250, 3)), -1)
        lines = []
        for i in range(40):
            dry = wall[:, 50 * i : 50 * i + 120]
            wet = dry.copy()
            cv2.circle(wet, (60, 45), 4 + i // 4, (60, 60, 60), -1)
            name = f"{i:03d}"
            for role, image in (("dry", dry), ("wet", wet)):
                (root / f"d{d}" / role).mkdir(parents=True, exist_ok=True)
                imagefile.write(root / f"d{d}" / role / f"{name}.png", image)
            late = 5000 if i == 5 else 20
            lines.append(f"{name},dry/{name}.png,wet/{name}.png,{10**15 + 500_000 * i},night {d},mist,{late}")
        lines = [f"{line},{'gain 1.1; offset 2; vignetting 0 0' if d else ''}" for line in lines]
        head = "name,dry,wet,timestamp_us,drive,regime,sync_us,photometric"
        (root / f"d{d}" / "pairs.csv").write_text("\n".join([head, *lines]) + "\n")
        (root / f"d{d}" / "wet" / "007.png").write_bytes(b"")
    black = imagefile.read(root / "d0" / "dry" / "009.png") // 30
    imagefile.write(root / "d0" / "dry" / "009.png", black)
    return root


def select(aligned: Path, out: Path, *more: str, count: int = 30) -> int:
    drives = [str(folder) for folder in sorted(aligned.iterdir())]
    return main(["select", *drives, "--out", str(out), "--count", str(count), "--workers", "1", *more])


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_folders_become_a_data_set(aligned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert select(aligned, tmp_path, "--reserve", "3", "--licence", "CC BY 4.0, by its makers") == 0
    assert "30 of 120 pairs" in capsys.readouterr().out
    chosen, rest = rows(tmp_path / "manifest.csv"), rows(tmp_path / "rejected.csv")
    assert list(chosen[0])[:4] == ["name", "dry", "wet", "split"]
    assert len(chosen) == 30
    assert len({row["name"] for row in chosen}) == 30  # the drives' own names are alike
    assert len(rest) == 90
    assert {split: sum(r["split"] == split for r in chosen) for split in ("val", "test")} == {"val": 3, "test": 4}
    assert sum(r["reserved"] == "1" for r in chosen if r["split"] == "test") == 3
    reasons = [(r["reason"], r["drive"]) for r in rest]
    assert sum(reason == "out of sync" for reason, _ in reasons) == 3
    assert sum(reason == "incomplete" for reason, _ in reasons) == 3
    assert ("dark", "night 0") in reasons
    assert all("zero bytes" in r["detail"] for r in rest if r["reason"] == "incomplete")
    mapped = {(row["drive"] != "night 0", row["photometric"]) for row in chosen}
    assert mapped == {(False, ""), (True, "gain 1.1; offset 2; vignetting 0 0")}
    for row in chosen:
        for role in ("dry", "wet"):
            assert imagefile.read(tmp_path / row[role]).shape == (90, 120, 3)
    drives = {(r["drive"], r["split"]) for r in chosen}
    assert len({drive for drive, _ in drives}) == len(drives)
    hashes = {s: np.array([from_text(r["hash"]) for r in chosen if r["split"] == s]) for s in ("train", "val", "test")}
    for a, b in (("train", "val"), ("train", "test"), ("val", "test")):
        assert nearest(hashes[a], hashes[b])[1].min() > NEAR_DUPLICATE
    card = json.loads((tmp_path / "card.json").read_text())
    assert (card["pairs"], card["of"], card["licence"]) == (30, 120, "CC BY 4.0, by its makers")
    assert sum(card["rejected"].values()) == 90
    text = (tmp_path / "CARD.md").read_text()
    assert "CC BY 4.0" in text
    assert "| incomplete | 3 |" in text
    assert (tmp_path / "report.html").read_text().count("data:image") >= 4
    assert json.loads((tmp_path / "report.json").read_text())["selected"] == 30


def test_same_seed_same_bytes_whatever_the_workers_and_after_an_interruption(
    aligned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert select(aligned, tmp_path / "a", "--seed", "3") == 0
    real, calls = select_measuring.measure_run, []

    def interrupted(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(select_measuring, "measure_run", interrupted)
    assert select(aligned, tmp_path / "b", "--seed", "3") == 130
    monkeypatch.setattr(select_measuring, "measure_run", real)
    assert not (tmp_path / "b" / "manifest.csv").exists()
    assert select(aligned, tmp_path / "b", "--seed", "3", "--workers", "2") == 0
    assert json.loads((tmp_path / "b" / "report.json").read_text())["measured_before"] == 40
    for name in ("manifest.csv", "rejected.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert select(aligned, tmp_path / "c", "--seed", "4", "--cache", str(tmp_path / "a" / "measures")) == 0
    assert (tmp_path / "c" / "manifest.csv").read_bytes() != (tmp_path / "a" / "manifest.csv").read_bytes()
    assert json.loads((tmp_path / "c" / "report.json").read_text())["measured_before"] == 120


def test_a_file_that_changed_is_measured_again(aligned: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(aligned, copy)
    assert select(copy, tmp_path / "out") == 0
    imagefile.write(copy / "d1" / "dry" / "020.png", np.zeros((90, 120, 3), np.uint8))
    assert select(copy, tmp_path / "out") == 0
    found = {r["name"]: r["reason"] for r in rows(tmp_path / "out" / "rejected.csv") if r["drive"] == "night 1"}
    assert found["night_1_020"] == "dark"


@pytest.mark.parametrize("how", ["copy", "link"])
def test_files_are_laid_out_by_split(aligned: Path, tmp_path: Path, how: str) -> None:
    assert select(aligned, tmp_path, "--layout", how, count=12) == 0
    for row in rows(tmp_path / "manifest.csv"):
        path = tmp_path / row["wet"]
        assert row["wet"] == f"{row['split']}/wet/{row['name']}.png"
        assert path.is_symlink() == (how == "link")
        assert imagefile.read(path).shape == (90, 120, 3)


def test_too_few_is_a_failure_with_reasons_and_leaves_no_manifest(
    aligned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert select(aligned, tmp_path, count=119) == 1
    told = " ".join(capsys.readouterr().err.split())
    assert "119 pairs were asked for" in told
    assert "3 incomplete" in told
    assert not (tmp_path / "manifest.csv").exists()
    assert len(rows(tmp_path / "rejected.csv")) >= 7
    assert json.loads((tmp_path / "report.json").read_text())["status"] == "failed"


def test_parquet_holds_the_same_rows(aligned: Path, tmp_path: Path) -> None:
    try:
        import pyarrow.parquet
    except ImportError as error:
        pytest.skip(f"pyarrow cannot be imported: {error}")
    assert select(aligned, tmp_path, count=12) == 0
    table = pyarrow.parquet.read_table(tmp_path / "manifest.parquet").to_pylist()
    listed = rows(tmp_path / "manifest.csv")
    assert [r["name"] for r in table] == [r["name"] for r in listed]
    assert [r["timestamp_us"] for r in table] == [int(r["timestamp_us"]) for r in listed]
    assert [r["cover"] for r in table] == pytest.approx([float(r["cover"]) for r in listed], rel=1e-5)


def test_without_pyarrow_the_csv_is_written_and_a_line_says_why(
    aligned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    assert select(aligned, tmp_path, count=12) == 0
    assert "pip install pyarrow" in capsys.readouterr().err
    assert len(rows(tmp_path / "manifest.csv")) == 12
    assert not (tmp_path / "manifest.parquet").exists()


def test_plain_folders_use_the_frame_s_number_or_the_name_s_moment(aligned: Path, tmp_path: Path) -> None:
    found = find([], str(aligned / "d0" / "dry"), str(aligned / "d0" / "wet"), 8.0)
    assert [pair.time for pair in found.pairs[:3]] == [0, 0.125, 0.25]
    assert "at 8 pairs a second" in found.notes[0]
    for role in ("dry", "wet"):
        (tmp_path / "x" / role).mkdir(parents=True)
        for moment in (1535202904410922, 1535202904473422):
            shutil.copy(aligned / "d0" / role / "000.png", tmp_path / "x" / role / f"{moment}.png")
    shutil.copy(aligned / "d0" / "dry" / "000.png", tmp_path / "x" / "dry" / "1535202904500000.png")
    moments = find([tmp_path / "x"], None, None, 16.0).pairs
    assert [pair.timestamp_us for pair in moments] == [1535202904410922, 1535202904473422, 1535202904500000]
    assert moments[2].wet is None
    assert moments[1].time - moments[0].time == pytest.approx(0.0625)


def test_times_that_run_backwards_are_put_in_order_and_told(tmp_path: Path) -> None:
    head = "name,dry,wet,timestamp_us,drive,regime,sync_us\n"
    (tmp_path / "pairs.csv").write_text(head + "a,a.png,b.png,30,,,\nb,a.png,b.png,10,,,\nc,a.png,b.png,20,,,\n")
    found = find([tmp_path], None, None, 16.0)
    assert [pair.name for pair in found.pairs] == ["b", "c", "a"]
    assert "backwards 1 times" in found.notes[0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no pairs were given"),
        (["nowhere"], "is no folder"),
        (["--dry", "x"], "belong together"),
        (["HERE", "--fps", "0"], "--fps 0"),
        (["HERE", "--layout", "move"], "--layout move is unknown"),
        (["HERE", "--count", "0"], "expected 1 or more"),
        (["HERE", "--rig", "HERE"], "is no rig folder"),
        (["BROKEN"], "line 2: timestamp_us is 'noon'"),
    ],
)
def test_bad_input_is_told(
    aligned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    (tmp_path / "pairs.csv").write_text("name,dry,wet,timestamp_us\na,a.png,b.png,noon\n")
    places = {"HERE": str(aligned / "d0"), "BROKEN": str(tmp_path)}
    given = [places.get(word, word) for word in arguments]
    assert main(["select", *given, "--out", str(tmp_path / "out")]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_numbers_in_the_manifest_are_plain(tmp_path: Path) -> None:
    select_manifest.write_csv(tmp_path / "m.csv", ("a", "b", "time_s"), [{"a": float("nan"), "b": True, "time_s": 1.5}])
    assert (tmp_path / "m.csv").read_text() == "a,b,time_s\n,1,1.500000\n"
