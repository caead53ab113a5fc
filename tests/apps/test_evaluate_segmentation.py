"""`rainstereo evaluate segmentation`: a whole small run, again from what it kept, and what goes wrong."""

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rainstereo import imagefile
from rainstereo.apps.cli import main
from rainstereo.apps.evaluation_sets import RenderedRain
from rainstereo.apps.segmentation_page import as_theirs, legend, overlaid
from rainstereo.model import checkpoint, segmentation_training
from rainstereo.model.restore import Restorer
from rainstereo.model.segmentation import CAMVID11
from rainstereo.model.segmentation_metrics import binary, confusion
from rainstereo.types import Image
from tests.model.small_restorer import CONFIG, generator, saved

SMALL = ("--steps", "2", "--batch", "2", "--crop", "32", "--base-channels", "2", "--no-skip", "--device", "cpu")
CONDITIONS = ["REFERENCE", "RAINY", "AUGMENTED", "DERAINED", "RESTORED ONLY"]


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved(tmp_path_factory.mktemp("weights") / "own")


@pytest.fixture(autouse=True)
def quick_rain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dark discs in place of rain, which takes seconds an image; its rendering has tests of its own."""

    def renderer(self: RenderedRain) -> Callable[[Image, str], Image]:
        def render(clear: Image, name: str) -> Image:
            rainy = clear.copy()
            for x, y in np.random.default_rng([self.seed, len(name)]).integers(5, 40, (6, 2)):
                cv2.circle(rainy, (int(x), int(y)), 4, (90, 90, 90), -1)
            return rainy

        return render

    monkeypatch.setattr(RenderedRain, "renderer", renderer)


def drive(folder: Path, count: int = 12) -> Path:
    """A road with a line that wanders, in CamVid's 32 colours."""
    for i in range(count):
        image = np.random.default_rng(i).integers(60, 90, (48, 64, 3), dtype=np.uint8)
        labels = np.full((48, 64, 3), (128, 64, 128), np.uint8)
        labels[:16] = 128  # sky
        labels[0] = 0  # void
        image[:16] += 120
        cv2.line(image, (10 + i, 47), (30, 16), (240, 240, 240), 3)
        cv2.line(labels, (10 + i, 47), (30, 16), (192, 0, 128), 3)
        for place, array in (("images", image), ("labels", labels)):
            (folder / place).mkdir(parents=True, exist_ok=True)
            imagefile.write(folder / place / (f"s_{i:02d}.png" if place == "images" else f"s_{i:02d}_L.png"), array)
    return folder


def evaluate(weights: Path, out: Path, *more: str) -> int:
    return main(["evaluate", "segmentation", "--out", str(out), "--checkpoint", str(weights), *SMALL, *more])


def report(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    return found


def test_one_command_makes_the_table_and_keeps_what_it_made(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = drive(tmp_path / "drive"), tmp_path / "out"
    sets = f"markings:{folder}", f"semantic:{folder}"
    assert evaluate(weights, out, *sets) == 0
    found = report(out)["sets"]
    one = found["markings-drive"]
    assert (one["trained_on"], one["tested_on"]) == (4, 4)
    assert list(one["conditions"]) == CONDITIONS
    assert set(one["networks"]) == {"clear", "clear+rainy", "clear+derained"}
    states = {"REFERENCE": "clear", "RAINY": "rainy", "DERAINED": "derained"}
    for condition, state in states.items():  # each score again, from the files alone
        total = np.zeros((2, 2), np.int64)
        for name in one["conditions"][condition]["each"]:
            predicted = out / "markings-drive/predicted" / condition.lower() / f"{name}.png"
            total += confusion(imagefile.read(out / f"markings-drive/targets/{name}.png"), imagefile.read(predicted), 2)
        assert one["conditions"][condition]["iou"] == pytest.approx(binary(total).iou)
        assert one["conditions"][condition]["tested"] == state
    rainy, derained = (imagefile.read(out / f"markings-drive/{s}/images/s_09.png") for s in ("rainy", "derained"))
    assert np.array_equal(Restorer(weights, "cpu", skip=False)(rainy), derained)
    assert 0 <= found["semantic-drive"]["conditions"]["RAINY"]["miou"] <= 1
    assert set(found["semantic-drive"]["conditions"]["RAINY"]["classes"]) == set(CAMVID11)
    told = capsys.readouterr().out
    assert "theirs (the paper's, on CamVid synthetic): 0.551 / 0.279 / 0.405 / 0.444" in told
    assert "theirs (the paper's, on Cityscapes synthetic): 0.692 / 0.405 / 0.611 / 0.651" in told
    page = (out / "report.html").read_text()
    assert "theirs: CamVid synthetic" in page
    assert "compares no networks" in page

    # again: nothing is trained, made or predicted
    monkeypatch.setattr("rainstereo.model.segmentation_training.train", lambda *_: pytest.fail("was trained"))
    monkeypatch.setattr("rainstereo.model.segmentation_training.predict", lambda *_: pytest.fail("was found"))
    monkeypatch.setattr(Restorer, "__call__", lambda *_: pytest.fail("was derained"))
    assert evaluate(weights, out, *sets, "--debug") == 0
    assert report(out)["sets"] == found
    with pytest.raises(pytest.fail.Exception, match="was trained"):
        evaluate(weights, out, *sets, "--debug", "--rate", "0.002")


def test_other_weights_remake_what_depends_on_them_and_no_more(
    weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, out = drive(tmp_path / "drive"), tmp_path / "out"
    assert evaluate(weights, out, f"markings:{folder}") == 0
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.png")}
    first, trained, train = report(out)["sets"]["markings-drive"], list[str](), segmentation_training.train

    def told(*given: Any) -> None:
        trained.append(given[3].stem)
        train(*given)

    monkeypatch.setattr(segmentation_training, "train", told)
    other = generator()
    torch.nn.init.normal_(other.head.weight, 0, 0.1)
    card = {"architecture": "generator", "config": asdict(CONFIG)}
    assert evaluate(checkpoint.save(tmp_path / "other", other, card), out, f"markings:{folder}") == 0
    assert trained == ["clear+derained"]
    again = {path for path, when in before.items() if path.stat().st_mtime_ns != when}
    states = {path.relative_to(out / "markings-drive").parts[0] for path in again}
    assert states == {"derained", "predicted"}
    conditions = {
        path.relative_to(out / "markings-drive/predicted").parts[0] for path in again if "predicted" in str(path)
    }
    assert conditions == {"derained", "restored-only"}
    second = report(out)["sets"]["markings-drive"]
    for same in ("REFERENCE", "RAINY", "AUGMENTED"):
        assert second["conditions"][same] == first["conditions"][same]


def test_networks_of_an_earlier_run_are_used_and_what_cannot_be_read_is_named(weights: Path, tmp_path: Path) -> None:
    folder = drive(tmp_path / "drive")
    assert evaluate(weights, tmp_path / "one", f"markings:{folder}", "--width", "40") == 0
    first = report(tmp_path / "one")["sets"]["markings-drive"]
    assert imagefile.read(tmp_path / "one/markings-drive/targets/images/s_10.png").shape == (30, 40)
    (folder / "images/s_09.png").write_bytes((folder / "images/s_09.png").read_bytes()[:200])
    more = ("--width", "40", "--networks", str(tmp_path / "one"))
    assert evaluate(weights, tmp_path / "two", f"markings:{folder}", *more) == 1
    second = report(tmp_path / "two")
    assert second["status"] == "incomplete"
    one = second["sets"]["markings-drive"]
    assert (one["trained_on"], one["tested_on"]) == (0, 3)
    assert "truncated" in one["failed"]["images/s_09"]
    kept = first["conditions"]["RAINY"]["each"]
    kept.pop("images/s_09")
    assert one["conditions"]["RAINY"]["each"] == kept


def test_what_makes_no_sense_is_refused(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = drive(tmp_path / "drive")
    numbered = tmp_path / "numbered"
    for name in ("train/a", "trainannot/a", "val/b", "valannot/b"):
        (numbered / name).parent.mkdir(parents=True, exist_ok=True)
        imagefile.write(numbered / f"{name}.png", np.zeros((40, 40), np.uint8))
    for given, words in (
        ((), "no set was given"),
        ((str(folder),), "expected markings:FOLDER or semantic:FOLDER"),
        ((f"lanes:{folder}",), "expected markings:FOLDER or semantic:FOLDER"),
        ((f"markings:{tmp_path / 'none'}",), "is no folder"),
        ((f"markings:{numbered}",), "do not tell road markings from the road"),
        ((f"markings:{folder}", f"markings:{folder}"), "would be written to markings-drive"),
        ((f"markings:{folder}", "--width", "5"), "at least 32"),
        ((f"markings:{folder}", "--steps", "0"), "expected steps"),
        ((f"markings:{folder}", "--networks", str(tmp_path)), "holds 0 folders markings-*/networks"),
        ((f"markings:{folder}", "--device", "abacus"), "device 'abacus'"),
    ):
        assert evaluate(weights, tmp_path / "out", *given) == 2, words
        told = capsys.readouterr()
        assert words in " ".join((told.err + told.out).split()), words


def test_help_of_the_action(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "segmentation", "--help"]) == 0
    assert "usage: rainstereo evaluate segmentation" in capsys.readouterr().out


def test_orders_and_pictures() -> None:
    theirs = {"RAINY": 0.28, "AUGMENTED": 0.4, "DERAINED": 0.44, "REFERENCE": 0.55}
    assert as_theirs(theirs)
    assert not as_theirs(theirs | {"AUGMENTED": 0.5})
    image = np.full((4, 4, 3), 50, np.uint8)
    labels = np.array([[0, 1, 2, 255]] * 4, np.uint8)
    shown = overlaid(image, labels, 3)
    assert np.array_equal(shown[:, 3], image[:, 3])
    assert len({tuple(pixel) for pixel in shown[0].tolist()}) == 4
    two = overlaid(image, labels % 2, 2)
    assert np.array_equal(two[:, 0], image[:, 0])
    assert legend(CAMVID11).shape == (78, 600, 3)
    assert replace(RenderedRain(), psnr=20).psnr == 20
