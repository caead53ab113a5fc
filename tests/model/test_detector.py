"""The drop detector: files, sizes, thresholds, training; the package's own finds drops and passes clear images."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rainstereo import imagefile
from rainstereo.apps.cli import main
from rainstereo.model import detector, detector_training
from rainstereo.model.augment import RandomAdherentRain
from rainstereo.model.detector import CELL, Detector, DetectorConfig, factor_for, packed, worth_computing
from tests.model.small_restorer import picture


@pytest.mark.parametrize("size", [(1, 1), (17, 33), (180, 240), (481, 643), (720, 960)])
def test_a_worth_for_each_cell(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    found = Detector(DetectorConfig(4, (1, 2)).build())
    for image in (picture(0, size), picture(0, size)[..., 0], picture(0, size).astype(np.uint16) * 257):
        cells = found.worth(image)
        assert cells.shape == (-(-size[0] // CELL), -(-size[1] // CELL))
        assert ((cells > 0) & (cells < 1)).all()


def test_what_was_fused_is_the_network() -> None:
    torch.manual_seed(3)
    network = DetectorConfig(6, (1, 2)).build().train()
    network(torch.rand(4, 3, 32, 32))  # statistics that matter
    image = picture(0, (64, 96))
    rgb = torch.from_numpy(image[..., ::-1].transpose(2, 0, 1).copy())[None] / 255
    with torch.inference_mode():
        truth = torch.nn.functional.max_pool2d(network.eval()(rgb).sigmoid(), 2)[0, 0].numpy()
    assert np.abs(Detector(network).worth(image) - truth).max() < 1e-5


def test_how_far_an_image_is_averaged() -> None:
    assert [factor_for(h, w) for h, w in ((1, 1), (240, 320), (360, 480), (480, 640), (960, 1280), (9000, 9000))] == [
        1, 1, 2, 2, 4, 4,
    ]  # fmt: skip


@pytest.mark.parametrize("many", [1, 2, 3])
def test_squares_are_computed_that_are_worth_it(many: int) -> None:
    for seed in range(10):
        worth = np.random.default_rng(seed).random((12, 17)) ** 4
        expected = np.zeros(worth.shape, bool)
        sums = {}
        for row, column in np.ndindex(*worth.shape):  # an independent formulation, cell by cell
            square = row // many, column // many
            sums[square] = sums.get(square, 0.0) + (worth[row, column] if worth[row, column] >= 0.1 else 0.0)
        certain, most = float(np.median(list(sums.values()))), max(sums.values())
        for row, column in np.ndindex(*worth.shape):
            expected[row, column] = worth[row, column] >= 0.1 and sums[row // many, column // many] >= certain - 1e-9
        assert 0 < expected.sum() <= (worth >= 0.1).sum()
        assert np.array_equal(worth_computing(worth, 0.1, certain - 1e-9, most - 1e-9, many), expected)
        assert not worth_computing(worth, 0.1, certain - 1e-9, most + 1e-9, many).any()  # nothing in it is evident
    assert np.array_equal(worth_computing(worth, 0.3, 0.5, 0.0, 1), worth >= 0.5)


@pytest.mark.parametrize("own", [4, 8, 16, 32])
def test_the_networks_cells_become_those_of_the_image(own: int) -> None:
    values = torch.rand(1, 1, 6, 8, generator=torch.Generator().manual_seed(1))
    found = detector.of_cells(values, own)[0, 0]
    for row, column in np.ndindex(*found.shape):
        top, left = row * CELL // own, column * CELL // own
        more = max(1, CELL // own)
        assert found[row, column] == values[0, 0, top : top + more, left : left + more].max()
    assert found.shape == (-(-6 * own // CELL), 8 * own // CELL)


def test_weights_survive_a_file_and_damage_is_refused(tmp_path: Path) -> None:
    network = DetectorConfig(6, (1, 3)).build().eval()
    path = tmp_path / "a.safetensors"
    path.write_bytes(packed(network))
    image = torch.rand(1, 3, 40, 60)
    with torch.inference_mode():
        assert torch.allclose(detector.load(path)(image), network(image), atol=5e-3)  # half precision
    whole = path.read_bytes()
    for data, words in (
        (whole[:-20], "damaged"), (b"", "damaged"), (bytes(2 << 20), "at most"),
        (whole.replace(b"drop detector", b"drop defector"), "expected a drop"),
        (whole.replace(b"[1, 3]", b"[1, 0]"), "."), (whole.replace(b"[1, 3]", b"[1   ]"), "does not fit"),
    ):  # fmt: skip
        path.write_bytes(data)
        with pytest.raises(ValueError, match=words):
            detector.load(path)
    with pytest.raises(FileNotFoundError):
        detector.load(tmp_path / "b.safetensors")
    with pytest.raises(ValueError, match="is no detector"):
        DetectorConfig(0)
    with pytest.raises(ValueError, match="expected what a cell is worth"):
        Detector(network, threshold=2)


def test_a_few_steps_of_training_learn_something(tmp_path: Path) -> None:
    images = [cv2.resize(picture(i, (24, 32)), (128, 96)) for i in range(3)]
    recipe = detector_training.Recipe(steps=40, batch=4, pool=4, size=(48, 64), rate=1e-2)
    rain = RandomAdherentRain("large", (0.2, 0.4), rays=2, p=1.0)
    seen: list[str] = []
    made = detector_training.train(
        images, [rain], recipe, DetectorConfig(8, (1, 2)), lambda what, done, total: seen.append(what)
    )
    assert 0 < made.loss < 0.69  # below that of a coin
    assert seen == ["rendering"] * 4 + ["training"] * 40
    with pytest.raises(ValueError, match="expected at least 64 x 48"):
        detector_training.train([picture(0, (20, 20))], [rain], recipe)
    with pytest.raises(ValueError, match="at least one of each"):
        detector_training.train([], [rain], recipe)


def test_the_command_trains_and_says_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    imagefile.write(tmp_path / "a.png", cv2.resize(picture(1, (24, 32)), (280, 210)))
    out = tmp_path / "d.safetensors"
    few = ("--steps", "10", "--batch", "2", "--pool", "2")
    assert main(["detector", str(tmp_path / "a.png"), "--out", str(out), *few]) == 0
    assert out.stat().st_size <= 200_000
    assert detector.card(out)["training_images"] == 1
    assert json.loads((tmp_path / "d.report.json").read_text())["bytes"] == out.stat().st_size
    assert main(["detector", str(tmp_path / "a.png"), "--out", str(tmp_path / "d.bin")]) == 2
    assert "ends in .safetensors" in " ".join(capsys.readouterr().err.split())


def test_the_command_learns_from_banks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "clear").mkdir()
    (tmp_path / "bank").mkdir()
    for name in "ab":
        clear = cv2.resize(picture(ord(name), (24, 32)), (300, 230))
        rainy = clear.copy()
        rainy[50:150, 60:200] = cv2.blur(clear, (31, 31))[50:150, 60:200]
        imagefile.write(tmp_path / f"clear/{name}.png", clear)
        imagefile.write(tmp_path / f"bank/{name}.png", rainy)
    given = ["detector", str(tmp_path / "clear"), "--steps", "10", "--batch", "2", "--pool", "3"]
    first, second = tmp_path / "d.safetensors", tmp_path / "e.safetensors"
    assert main([*given, "--banks", str(tmp_path / "bank"), "--out", str(first)]) == 0
    assert "folders of rainstereo rain: bank" in str(detector.card(first)["rain"])
    more = ("--banks", str(tmp_path / "bank"), "--start", str(first), "--out", str(second))
    assert main([*given, *more]) == 0
    assert first.read_bytes() != second.read_bytes()
    (tmp_path / "restored").mkdir()
    for name in "ab":
        imagefile.write(tmp_path / f"restored/{name}.png", imagefile.read(tmp_path / f"clear/{name}.png"))
    better = ("--banks", str(tmp_path / "bank"), "--restored", str(tmp_path / "restored"))
    assert main([*given, *better, "--out", str(second)]) == 0
    assert "fall of the squared error" in str(detector.card(second)["worth"])
    assert main([*given, *better, str(tmp_path), "--out", str(second)]) == 2
    assert "expected one for each" in " ".join(capsys.readouterr().err.split())
    assert main([*given, "--banks", str(tmp_path), "--out", str(second)]) == 2
    assert "holds none of these images under rain" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("mended", [False, True])
def test_a_crop_is_worth_what_restoring_mends(mended: bool) -> None:
    clear = np.full((64, 64, 3), 100, np.uint8)
    rainy, restored = clear.copy(), clear.copy()
    rainy[:32, 32:], rainy[32:, 32:] = 200, 106
    restored[:32, :32], restored[32:, 32:] = 104, 103
    given = detector_training.Rained(clear, rainy, restored if mended else None)
    crop, gain = detector_training.cut(given, (64, 64), np.random.default_rng(0))
    worth = detector_training.worth_of(gain)[0]
    if crop[0, 0, -1] < 0.5:  # the crop came mirrored
        crop, worth = crop.flip(-1), worth.flip(-1)
    assert torch.equal(crop, torch.from_numpy(rainy.transpose(2, 0, 1).copy()).float() / 255)
    much = detector_training.MUCH**2
    assert torch.allclose(worth[:4, :4], torch.tensor(-16 / much if mended else 0.0))  # restoring spoils it
    assert (worth[:4, 4:] == 1).all()  # 100 levels off: all that counts
    assert torch.allclose(worth[4:, 4:], torch.tensor((36 - 9 if mended else 36) / much))
    assert (worth[4:, :4] == 0).all()


def test_rain_in_a_band_leaves_the_rest_clear() -> None:
    clear, rainy = np.zeros((40, 60, 3), np.uint8), np.full((40, 60, 3), 9, np.uint8)
    for seed in range(20):
        found = detector_training.banded(clear, [rainy, rainy // 3], np.random.default_rng(seed))
        wet = found[0] == 9
        assert 0 < wet.mean() < 0.8
        assert (wet.all(0) | ~wet.any(0)).all() or (wet.all(1) | ~wet.any(1)).all()  # upright or level
        assert np.array_equal(found[0], 3 * found[1])


def test_the_packages_detector_knows_rain_from_none(shared_data: Path) -> None:
    """On frames that it was not trained on."""
    assert detector.shipped().stat().st_size <= 200_000
    found = Detector.shipped()
    clear = [imagefile.read(path) for path in sorted((shared_data / "camvid11_480x360/val").iterdir())[::8]]
    marked = [found.cells(image).mean() for image in clear]
    assert np.mean(marked) < 0.01
    assert np.mean([share == 0 for share in marked]) > 0.5  # these come back bit for bit
    wet = sorted((shared_data / "raindrop/robotcar_rainy").glob("left_*.png"))
    dry = sorted((shared_data / "raindrop/robotcar_rainy").glob("right_*.png"))
    for rainy, clear_path in zip(wet, dry, strict=True):
        assert found.cells(imagefile.read(rainy)).mean() > 2 * found.cells(imagefile.read(clear_path)).mean()
        assert found.cells(imagefile.read(rainy)).mean() > 0.3
