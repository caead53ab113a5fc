"""`rainstereo evaluate restoration`: every layout, figures against the definition, resuming, and what goes wrong."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rainstereo import imagefile
from rainstereo.apps.cli import main
from rainstereo.apps.evaluation_scores import mean_of
from rainstereo.apps.evaluation_sets import find, overlap, shift_between
from rainstereo.model.restore import Restorer
from rainstereo.types import Image
from tests.model.small_restorer import picture, saved


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(tmp_path_factory.mktemp("weights") / "own")


def put(path: Path, image: Image) -> Image:
    path.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(path, image)
    return image


def evaluate(weights: Path, out: Path, *sets: object, more: tuple[str, ...] = ()) -> int:
    given = ["evaluate", "restoration", *map(str, sets), "--out", str(out), "--checkpoint", str(weights)]
    return main([*given, "--no-skip", *more])


def report(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    return found


def rainy(image: Image, seed: int) -> Image:
    spots = np.zeros(image.shape[:2], np.uint8)
    for x, y in np.random.default_rng(seed).integers(10, 80, (12, 2)):
        cv2.circle(spots, (int(x), int(y)), 6, 1, -1)
    return np.where(spots[..., None] > 0, cv2.GaussianBlur(image, (0, 0), 4), image).astype(np.uint8)


def test_pairs_in_every_layout(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for i in range(3):
        clear = picture(i, (96, 260))
        put(tmp_path / f"qian/{i}_clean.png", clear)
        put(tmp_path / f"qian/{i}_rain.png", rainy(clear, i))
        put(tmp_path / f"split/gt/{i}_clean.png", clear)
        put(tmp_path / f"split/data/{i}_rain.png", rainy(clear, i))
        put(tmp_path / f"own/dry/{i}.png", clear)
        put(tmp_path / f"own/wet/{i}.png", rainy(clear, i))
        put(tmp_path / f"robotcar/right_{i}.png", clear[:, 20:])
        put(tmp_path / f"robotcar/left_{i}.png", rainy(clear, i)[:, :-20])
    names = ("qian", "split", "own", "robotcar")
    assert evaluate(weights, tmp_path / "out", *(tmp_path / name for name in names)) == 0
    found = report(tmp_path / "out")["sets"]
    assert [found[name]["layout"] for name in names] == ["qian", "qian", "pairs", "robotcar"]
    own = Restorer(weights, skip=False)
    clear, wet = picture(1, (96, 260)), rainy(picture(1, (96, 260)), 1)
    for image, state in ((wet, "raw"), (own(wet), "derained")):
        psnr = 10 * math.log10(255**2 / np.mean((clear.astype(float) - image) ** 2))
        for name in ("qian", "split", "own"):
            assert found[name]["each"][1][state]["psnr_rgb"] == pytest.approx(psnr, abs=1e-6)
    assert {tuple(note["shift"]) for note in found["robotcar"]["each"]} == {(20, 0)}
    assert found["robotcar"]["each"][0]["raw"]["psnr_rgb"] > 20
    total = found["own"]["total"]
    values = [note["gain"]["psnr_rgb"] for note in found["own"]["each"]]
    assert total["gain"]["psnr_rgb"]["mean"] == pytest.approx(np.mean(values))
    assert total["gain"]["psnr_rgb"]["low"] <= np.mean(values) <= total["gain"]["psnr_rgb"]["high"]
    text = capsys.readouterr().out
    assert "24.09/0.8518 -> 31.55/0.9020" in text
    assert "PSNR and SSIM of scikit-image" in text
    page = (tmp_path / "out/report.html").read_text()
    assert "theirs (the paper" in page
    assert "compare" not in page or "RobotCar real: 13.02/0.5574" in page


def test_rain_is_rendered_on_clear_images_and_the_run_goes_on(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for i in range(3):
        put(tmp_path / f"frames/{i}.png", cv2.resize(picture(i, (12, 16)), (80, 60)))
    more = ("--psnr", "24", "--limit", "2")
    assert evaluate(weights, tmp_path / "out", f"camvid:{tmp_path / 'frames'}", more=more) == 0
    first = report(tmp_path / "out")["sets"]["frames"]
    assert [note["name"] for note in first["each"]] == ["0", "1"]
    for note in first["each"]:
        assert note["raw"]["psnr_rgb"] == pytest.approx(24, abs=0.1)
        assert Path(note["rainy"]).is_file()
        assert Path(note["file"]).is_file()
    monkeypatch.setattr("rainstereo.apps.evaluation_scores._score", lambda *_: pytest.fail("was known"))
    assert evaluate(weights, tmp_path / "out", f"camvid:{tmp_path / 'frames'}", more=more) == 0
    assert report(tmp_path / "out")["sets"]["frames"] == first
    with pytest.raises(pytest.fail.Exception):
        evaluate(weights, tmp_path / "out", f"camvid:{tmp_path / 'frames'}", more=("--debug", "--psnr", "25"))


def test_what_cannot_be_scored_is_named(weights: Path, tmp_path: Path) -> None:
    for i in range(2):
        put(tmp_path / f"own/dry/{i}.png", picture(i))
        put(tmp_path / f"own/wet/{i}.png", picture(i + 5)[: 96 - 8 * i])
    assert evaluate(weights, tmp_path / "out", tmp_path / "own") == 1
    notes = report(tmp_path / "out")["sets"]["own"]["each"]
    assert [note["status"] for note in notes] == ["ok", "failed"]
    assert "expected both alike" in notes[1]["reason"]


def test_sets_without_sense_are_refused(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    put(tmp_path / "own/dry/a.png", picture())
    put(tmp_path / "own/wet/a.png", picture())
    put(tmp_path / "clear/a.png", picture())
    for given, more, words in (
        (tmp_path / "none", (), "is no folder"),
        (f"imagenet:{tmp_path}", (), "expected FOLDER or LAYOUT:FOLDER"),
        (f"camvid:{tmp_path / 'own'}", (), "and was given as camvid"),
        (f"qian:{tmp_path / 'clear'}", (), "holds no pairs"),
        (tmp_path / "clear", ("--psnr", "99"), "expected 1 to 60 dB"),
        (tmp_path / "clear", ("--limit", "-1"), "expected 0 or more"),
    ):
        assert evaluate(weights, tmp_path / "out", given, more=more) == 2, words
        assert words in " ".join(capsys.readouterr().err.split())
    two = find((str(tmp_path / "own"), str(tmp_path / "own")))
    assert [one.name for one in two] == ["own", "own-2"]


@pytest.mark.parametrize("shift", [(0, 0), (23, 2), (-17, -3)])
def test_shifts_are_found_under_drops(shift: tuple[int, int]) -> None:
    wide = picture(3, (160, 320))
    dx, dy = shift
    clear, wet = wide[20:140, 40:280], rainy(wide, 1)[20 - dy : 140 - dy, 40 - dx : 280 - dx]
    assert shift_between(clear, wet) == shift
    a, b = overlap(clear, wet, shift)
    assert a.shape == b.shape
    assert np.mean(np.all(a == b, -1)) > 0.8
    with pytest.raises(ValueError, match="expected one size"):
        shift_between(clear, wet[:-1])
    with pytest.raises(ValueError, match="too small"):
        shift_between(clear[:30], clear[:30])


def test_means_and_their_intervals() -> None:
    values = np.random.default_rng(0).normal(5, 2, 400)
    found = mean_of([*values, math.inf, math.nan])
    assert (found.count, found.mean) == (400, pytest.approx(values.mean()))
    assert found.high - found.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)
    assert mean_of(values.tolist()) == mean_of(values.tolist())
    alone, none = mean_of([3.0]), mean_of([math.nan])
    assert (alone.mean, math.isnan(alone.low), none.count) == (3, True, 0)
