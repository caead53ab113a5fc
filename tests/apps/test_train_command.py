"""`rainstereo train` as a command: what it writes, what it refuses, and the check that it can learn at all."""

import json
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is not installed")

from rainstereo import imagefile
from rainstereo.apps import bench
from rainstereo.apps.cli import main
from rainstereo.apps.train import clock
from rainstereo.apps.train_pictures import read_table, smoothed
from tests.model.training_pairs import write_pairs

RECIPE = """
steps = {steps}
[data]
crop = 32
workers = 0
[[data.train]]
folder = "pairs"
[[data.val]]
folder = "pairs"
limit = 2
[network]
base_channels = 4
downs = 1
blocks = 1
normalisation = "none"
output_residual = true
[losses]
lambda_adversarial = 0
lambda_perceptual = 0
lambda_msadv = 0
lambda_pixel = 1
[optimizer]
batch = 4
rate = 2e-3
[keep]
log = 2
validate = 5
"""


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    write_pairs(tmp_path / "pairs")
    path = tmp_path / "r.toml"
    path.write_text(RECIPE.format(steps=10))
    return path


def test_everything_is_written(recipe: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["train", str(recipe), "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert (report["status"], report["steps"], report["skipped"]) == ("ok", 10, 0)
    assert report["validation"]["psnr_raw"] < report["validation"]["psnr"]
    assert 0 <= report["waited_for_data_share"] <= 1
    assert list(read_table(out / "losses.csv")["step"]) == [2, 4, 6, 8, 10]
    assert list(read_table(out / "validation.csv")["step"]) == [5, 10]
    assert imagefile.read(out / "sheets" / "step-000000005.png").shape[1] == 3 * 80 + 2 * 6
    assert imagefile.read(out / "curves.png").size
    assert any((out / "tensorboard").glob("events.*"))
    assert str(tmp_path) not in (out / "model.toml").read_text()  # a model goes to others
    assert "Skipped" not in (out / "report.html").read_text()[:20]
    assert main(["train", str(recipe), "--out", str(out)]) == 0  # nothing is left to do


def test_mistakes_are_told(recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe.write_text(recipe.read_text() + "sheets = 3\n")
    assert main(["train", str(recipe), "--out", str(tmp_path / "out")]) == 2
    assert "Did you mean 'sheet'" in capsys.readouterr().err
    assert main(["train", str(tmp_path / "none.toml")]) == 2
    assert not (tmp_path / "out").exists()


def test_what_cannot_learn_is_told(recipe: Path, tmp_path: Path) -> None:
    assert main(["train", str(recipe), "--out", str(tmp_path / "out"), "--overfit"]) == 1
    assert json.loads((tmp_path / "out/overfit/report.json").read_text())["status"] == "failed"


@pytest.mark.slow
def test_four_windows_are_learnt(recipe: Path, tmp_path: Path) -> None:
    text = RECIPE.format(steps=3000).replace("base_channels = 4", "base_channels = 16")
    recipe.write_text(text)
    assert main(["train", str(recipe), "--out", str(tmp_path / "out"), "--overfit"]) == 0
    assert json.loads((tmp_path / "out/overfit/report.json").read_text())["validation"]["psnr"] >= 35


def test_smoothing_and_time() -> None:
    import numpy as np

    assert smoothed(np.array([1.0, np.nan, 3.0])).tolist() == pytest.approx([1, float("nan"), 3], nan_ok=True)
    assert smoothed(np.full(200, 2.0)).tolist() == [2.0] * 200
    assert (clock(3725.5), clock(float("nan"))) == ("1:02:05", "-:--:--")


@pytest.mark.slow
def test_the_benchmark_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in bench.SINGLE_THREAD.items():
        monkeypatch.setenv(name, value)
    assert main(["bench", "train", "--quick", "--repeats", "1", "--out", str(tmp_path)]) == 0
    for work in json.loads((tmp_path / "train/report.json").read_text())["works"][:2]:
        assert all(v["error"] < 1e-6 for v in work["variants"]), work["name"]
