"""`rainstereo convert`: what it writes, what it refuses, what it says."""

import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rainstereo import Camera, Rig
from rainstereo.apps import cli
from tests.calib import synthetic


def convert(*words: object) -> int:
    return cli.main(["convert", *map(str, words)])


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    synthetic.rig(None).save(tmp_path / "bare")
    return tmp_path / "bare"


def test_there_and_back_through_all_three(bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert convert(bare, "--out", tmp_path / "rig.yaml") == 0
    assert convert(tmp_path / "rig.yaml", "--out", tmp_path / "ros", "--format", "ros") == 0
    assert convert(tmp_path / "ros", "--out", tmp_path / "chain.yaml", "--format", "kalibr", "--allow-loss") == 0
    assert convert(tmp_path / "ros" / "dry.yaml", tmp_path / "ros" / "wet.yaml", "--out", tmp_path / "back") == 0
    assert convert(tmp_path / "chain.yaml", "--out", tmp_path / "chained") == 0
    before, back, chained = (Rig.load(tmp_path / name) for name in ("bare", "back", "chained"))
    np.testing.assert_allclose(back.rt_wet_dry, before.rt_wet_dry, atol=1e-12)
    np.testing.assert_array_equal(back.wet.intrinsics, before.wet.intrinsics)
    np.testing.assert_allclose(chained.rt_wet_dry, before.rt_wet_dry, atol=1e-12)
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 20), np.linspace(0, 959, 20)), -1).reshape(-1, 2)
    off = np.hypot(*(chained.dry.project(before.dry.unproject(pixels)) - pixels).T)
    record = json.loads((tmp_path / "chain.report.json").read_text())
    told = record["lens_losses"]["OUT"]["dry"]
    assert 0.1 < off.max() <= 1.01 * told["max_px"]
    assert record["from"] == "ros"
    assert record["to"] == "kalibr"
    assert f"off by {told['rms_px']:.2g} px RMS" in capsys.readouterr().out
    assert json.loads((tmp_path / "back" / "report.json").read_text())["command"] == "convert"


def test_a_lossy_lens_is_refused_and_nothing_written(
    bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert convert(bare, "--out", tmp_path / "chain.yaml", "--format", "kalibr") == 1
    assert not (tmp_path / "chain.yaml").exists()
    assert "--allow-loss" in capsys.readouterr().out
    record = json.loads((tmp_path / "chain.report.json").read_text())
    assert record["status"] == "refused"
    assert len(record["refused"]) == 2
    assert convert(bare, "--out", tmp_path / "chain.yaml", "--format", "kalibr", "--tolerance-px", 0.5) == 0


def test_the_chamber_is_never_lost_in_silence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    synthetic.rig(synthetic.chamber(15)).save(tmp_path / "rig")
    assert convert(tmp_path / "rig", "--out", tmp_path / "rig.xml") == 1
    told = capsys.readouterr().out
    assert "no such file holds the panels" in told
    assert "px at 1 m" in told
    assert convert(tmp_path / "rig", "--out", tmp_path / "rig.xml", "--allow-loss") == 0
    assert json.loads((tmp_path / "rig.report.json").read_text())["chamber_losses"][0]["range_m"] == 0.3
    chamber = tmp_path / "rig" / "chamber.toml"
    assert convert(tmp_path / "rig.xml", "--out", tmp_path / "again", "--chamber", chamber) == 0
    assert Rig.load(tmp_path / "again").chamber == Rig.load(tmp_path / "rig").chamber


def test_a_single_camera_goes_to_a_cameramodel_and_back(bare: Path, tmp_path: Path) -> None:
    one = bare / "wet.cameramodel"
    assert convert(one, "--out", tmp_path / "one.yaml", "--format", "ros") == 0
    assert convert(tmp_path / "one.yaml", "--out", tmp_path / "one.cameramodel") == 0
    found = Camera.load(tmp_path / "one.cameramodel")
    np.testing.assert_array_equal(found.intrinsics, Camera.load(one).intrinsics)
    assert convert(bare / "dry.cameramodel", one, "--out", tmp_path / "two") == 0
    assert Rig.load(tmp_path / "two").baseline == pytest.approx(synthetic.BASELINE)


BAD = [
    (["--out", "{tmp}/x"], "0 files were given"),
    (["{tmp}/none", "--out", "{tmp}/x"], "does not exist"),
    (["{bare}", "--out", "{tmp}/x.txt"], "ending in .yml, .yaml, .xml, .json"),
    (["{bare}", "--out", "{tmp}/x.yaml", "--format", "ros"], "expected a folder"),
    (["{bare}", "--out", "{bare}", "--format", "rig"], "is what is read"),
    (["{bare}", "--out", "{tmp}/x.yaml", "--format", "rig"], "looks like a file"),
    (["{bare}/dry.cameramodel", "--out", "{tmp}/x", "--format", "rig"], "NAME.cameramodel"),
    (["{bare}", "--out", "{tmp}", "--format", "opencv"], "is a folder; expected the name of a file"),
    (["{bare}", "--out", "{tmp}/x.yaml", "--size", "large"], "WIDTHxHEIGHT"),
    (["{bare}", "--out", "{tmp}/x.yaml", "--tolerance-px", "-1"], "expected pixels, 0 or more"),
    (["{bare}/dry.cameramodel", "--out", "{tmp}/x.yaml", "--chamber", "{tmp}/c.toml"], "for a single camera"),
]


@pytest.mark.parametrize(("words", "told"), BAD)
def test_bad_usage_is_explained(
    words: list[str], told: str, bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(p for p in tmp_path.rglob("*"))
    assert convert(*(word.format(tmp=tmp_path, bare=bare) for word in words)) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert sorted(p for p in tmp_path.rglob("*")) == before


def test_a_chamber_in_the_way_stays(bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    synthetic.rig(synthetic.chamber(15)).save(tmp_path / "rig")
    assert convert(bare, "--out", tmp_path / "rig.yaml") == 0
    assert convert(tmp_path / "rig.yaml", "--out", tmp_path / "rig") == 2
    assert "holds a rig with its chamber" in " ".join(capsys.readouterr().err.split())
    assert (tmp_path / "rig" / "chamber.toml").exists()


@pytest.mark.parametrize(
    "command", [["mrcal-to-cahvor"], ["mrcal-convert-lensmodel", "--sampled", "--intrinsics-only", "LENSMODEL_OPENCV4"]]
)
def test_mrcals_own_tools_open_what_we_write(command: list[str], bare: Path, tmp_path: Path) -> None:
    tool = shutil.which(command[0])
    if tool is None:
        pytest.skip(f"{command[0]} is not installed (Debian's package mrcal)")
    assert convert(bare, "--out", tmp_path / "rig.yaml") == 0
    assert convert(tmp_path / "rig.yaml", "--out", tmp_path / "back") == 0
    arguments = [tool, *command[1:], str(tmp_path / "back" / "wet.cameramodel")]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr


def test_mrcals_loader_opens_what_we_write(bare: Path, tmp_path: Path) -> None:
    mrcal = pytest.importorskip("mrcal", reason="mrcal is not installed")
    assert convert(bare, "--out", tmp_path / "rig.yaml") == 0
    assert convert(tmp_path / "rig.yaml", "--out", tmp_path / "back") == 0
    model = mrcal.cameramodel(str(tmp_path / "back" / "wet.cameramodel"))
    rig = Rig.load(bare)
    assert model.intrinsics()[0] == rig.wet.model
    np.testing.assert_allclose(model.intrinsics()[1], rig.wet.intrinsics, rtol=1e-15)
    P = np.array([[0.1, -0.1, 1.0]])
    np.testing.assert_allclose(mrcal.project(P, *model.intrinsics()), rig.wet.project(P), atol=1e-9)
