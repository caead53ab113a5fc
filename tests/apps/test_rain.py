"""`rainstereo rain` on small images: what is written, in what order whatsoever, and what is refused."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rainstereo import compiled, imagefile
from rainstereo.apps.cli import main
from rainstereo.apps.rain_motion import Drive, Sequence
from rainstereo.apps.rain_presets import PRESETS
from rainstereo.apps.rain_settings import Rain
from rainstereo.height_map import HeightMap
from rainstereo.rain.population import LogNormal
from rainstereo.rain.render import Renderer
from rainstereo.types import Image

SIZE = (96, 72)
FEW = ("--preset", "large", "--seed", "5")


def picture(seed: int, size: tuple[int, int] = SIZE, dtype: type = np.uint8, channels: int = 3) -> Image:
    """Smooth blotches of full contrast."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.random((size[1], size[0], channels)).astype(np.float32), (0, 0), 5)
    noise = (noise - noise.min()) / np.ptp(noise)
    return np.squeeze(noise * np.iinfo(dtype).max).round().astype(dtype)


@pytest.fixture(scope="module")
def clear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images."""
    folder = tmp_path_factory.mktemp("clear")
    for i in range(6):
        imagefile.write(folder / f"{i:03d}.png", picture(i))
    return folder


def rain(source: object, out: Path, *more: str) -> int:
    return main(["rain", str(source), "--out", str(out), *more])


def report(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "report.json").read_text())
    return found


def contents(out: Path) -> dict[str, bytes]:
    """All that a run made but its reports and notes, which tell the time."""
    files = (p for p in out.rglob("*") if p.is_file() and ".rain" not in p.parts and p.stem != "report")
    return {p.relative_to(out).as_posix(): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def rainy(clear: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The six under rain, with all that can be had."""
    out = tmp_path_factory.mktemp("out") / "rainy"
    assert rain(clear, out, *FEW, "--masks", "--displacement", "float32", "--pictures", str(out.parent / "p")) == 0
    return out


def test_everything_is_written(clear: Path, rainy: Path) -> None:
    names = {f"{i:03d}" for i in range(6)}
    expected = {f"{n}.png" for n in names} | {f"masks/{n}.png" for n in names} | {f"drops/{n}.json" for n in names}
    assert contents(rainy).keys() == expected | {f"displacement/{n}.npz" for n in names}
    found = report(rainy)
    assert (found["status"], found["done"], found["failed"], found["seed"]) == ("ok", 6, [], 5)
    page = (rainy / "report.html").read_text()
    assert page.count("data:image/jpeg") == 2 * 3 + 6
    assert "<svg" in page
    assert len(list((rainy.parent / "p").iterdir())) == 13


def test_numbers_are_those_of_the_files(clear: Path, rainy: Path) -> None:
    for row in report(rainy)["images"]:
        before, after = imagefile.read(row["path"]), imagefile.read(rainy / f"{row['name']}.png")
        psnr = peak_signal_noise_ratio(before, after, data_range=255)  # type: ignore[no-untyped-call]
        ssim = structural_similarity(before, after, data_range=255, channel_axis=-1)  # type: ignore[no-untyped-call]
        assert row["psnr"] == pytest.approx(psnr, abs=1e-4)
        assert row["ssim"] == pytest.approx(ssim, abs=1e-5)
        assert 5 < row["psnr"] < 30
        assert row["drops"] > 10


def test_pixels_without_a_drop_are_the_clear_ones_bit_for_bit(clear: Path, rainy: Path) -> None:
    for i in range(6):
        before, after = imagefile.read(clear / f"{i:03d}.png"), imagefile.read(rainy / f"{i:03d}.png")
        unknown, opacity, drop = np.moveaxis(imagefile.read(rainy / f"masks/{i:03d}.png"), -1, 0)
        assert set(np.unique(drop)) == {0, 255}
        assert np.array_equal(before[drop == 0], after[drop == 0])
        assert (before[opacity > 200] != after[opacity > 200]).any(-1).mean() > 0.5
        assert not (unknown[drop == 0]).any()
        moved = np.load(rainy / f"displacement/{i:03d}.npz")["displacement"]
        assert moved.shape == (*before.shape[:2], 2)
        assert moved.dtype == np.float32
        assert not moved[drop == 0].any()
        assert np.nanmax(np.abs(moved[drop > 0])) > 5


def test_the_drop_list_makes_the_frame_again(clear: Path, rainy: Path, tmp_path: Path) -> None:
    listed = rainy / "drops/002.json"
    renderer, drops = Renderer.from_json(listed.read_text())
    expected = imagefile.read(rainy / "002.png")
    assert np.array_equal(renderer.plan(drops).apply(imagefile.read(clear / "002.png")), expected)
    assert rain(clear / "002.png", tmp_path / "again", "--drops", str(listed), "--no-drop-lists") == 0
    assert contents(tmp_path / "again") == {"002.png": (rainy / "002.png").read_bytes()}


@pytest.mark.slow
def test_drops_that_touch_become_bodies_of_their_volume() -> None:
    """--merge, and the drop list makes the frame again, bodies and all."""
    setup = replace(PRESETS["drops"], population=PRESETS["drops"].population.with_cover(0.3), f_number=math.inf)
    merged = Rain(setup, tolerance=20, merge=True)
    drops = merged.in_sight(merged.drops("a", SIZE), SIZE)
    shapes = list(merged.standing(drops, "a", SIZE))
    bodies = [shape for shape in shapes if isinstance(shape, HeightMap)]
    assert bodies
    assert len(shapes) < len(drops)
    assert sum(shape.volume for shape in shapes) == pytest.approx(drops.volume.sum(), rel=0.01)
    image = picture(3)
    plan, _ = merged.plan(image, "a")
    found = plan.render(image)
    again, listed = Renderer.from_json(found.drops_json())
    np.testing.assert_array_equal(again.plan(listed).apply(image), found.image)
    assert (found.image != Rain(setup, tolerance=20).plan(image, "a")[0].apply(image)).any()


def test_every_image_has_drops_of_its_own_that_its_name_decides(clear: Path, rainy: Path, tmp_path: Path) -> None:
    texts = {json.dumps(json.loads(p.read_text())["drops"]) for p in (rainy / "drops").iterdir()}
    assert len(texts) == 6
    assert rain(clear / "004.png", tmp_path / "one", *FEW) == 0
    assert (tmp_path / "one/004.png").read_bytes() == (rainy / "004.png").read_bytes()
    assert rain(clear / "004.png", tmp_path / "two", "--preset", "large", "--seed", "6") == 0
    assert (tmp_path / "two/004.png").read_bytes() != (rainy / "004.png").read_bytes()


@pytest.mark.slow
def test_workers_and_shards_change_no_byte(clear: Path, tmp_path: Path) -> None:
    options = (*FEW, "--psnr", "19", "--masks", "--displacement", "float16")
    assert rain(clear, tmp_path / "one", *options) == 0
    assert rain(clear, tmp_path / "two", *options, "--workers", "2") == 0
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    for shard, there in (("3/4", 1), ("1/4", 3), ("4/4", 4), ("2/4", 6)):
        assert rain(clear, tmp_path / "parts", *options, "--shard", shard) == 0
        assert report(tmp_path / "parts")["done"] == there
    assert contents(tmp_path / "parts") == contents(tmp_path / "one")


def test_what_is_finished_is_kept_and_other_settings_are_refused(
    clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    source = tmp_path / "in"
    shutil.copytree(clear, source)
    assert rain(source, out, *FEW) == 0
    first = contents(out)
    (out / "003.png").unlink()
    times = {p.name: p.stat().st_mtime_ns for p in out.glob("*.png")}
    assert rain(source, out, *FEW) == 0
    assert report(out)["made"] == 1
    assert contents(out) == first
    assert {p.name: p.stat().st_mtime_ns for p in out.glob("*.png") if p.name != "003.png"} == times
    imagefile.write(source / "001.png", picture(99))  # another image of the name
    assert rain(source, out, *FEW) == 0
    assert report(out)["made"] == 1
    assert rain(source, out, *FEW, "--tolerance", "3") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert contents(out)["002.png"] == first["002.png"]
    assert rain(source, out, *FEW, "--f-number", "inf", "--overwrite") == 0
    assert report(out)["made"] == 6
    assert contents(out)["002.png"] != first["002.png"]


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_whole_files_and_goes_on(tmp_path: Path) -> None:
    source, out = tmp_path / "in", tmp_path / "out"
    source.mkdir()
    for i in range(30):
        imagefile.write(source / f"{i:03d}.png", picture(i))
    command = [sys.executable, "-m", "rainstereo.apps.cli", "rain", str(source), "--out", str(out), *FEW]
    for number in (signal.SIGKILL, signal.SIGINT):
        before = len(list(out.glob("*.png")))
        heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # jobs in the background are started deaf to it
        silent = subprocess.DEVNULL
        process = subprocess.Popen(command, stdout=silent, stderr=silent, preexec_fn=heard)  # noqa: PLW1509
        deadline = time.monotonic() + 60
        while len(list(out.glob("*.png"))) < before + 3 and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(process.pid, number)
        assert process.wait(60) == (-9 if number == signal.SIGKILL else 130)
        assert before + 3 <= len(list(out.glob("*.png"))) < 30
        for path in out.glob("*.png"):
            assert imagefile.read(path).shape == (*SIZE[::-1], 3)
    notes = len(list((out / ".rain/notes").glob("*.json")))
    assert rain(source, out, *FEW) == 0
    assert report(out)["made"] == 30 - notes
    whole = tmp_path / "whole"
    assert rain(source, whole, *FEW) == 0
    assert {k: v for k, v in contents(out).items() if ".partial" not in k} == contents(whole)


# -- severity ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("target", [19.0, 24.0])
def test_the_psnr_is_met_by_each_image(clear: Path, tmp_path: Path, target: float) -> None:
    assert rain(clear, tmp_path / "out", *FEW, "--psnr", str(target)) == 0
    found = report(tmp_path / "out")
    assert found["severity"]["images_within"] == 6
    for row in found["images"]:
        before, after = imagefile.read(row["path"]), imagefile.read(tmp_path / "out" / f"{row['name']}.png")
        error = np.mean((before.astype(float) - after) ** 2)
        assert 10 * np.log10(255**2 / error) == pytest.approx(target, abs=0.1)


def test_heavier_rain_holds_the_drops_of_lighter_rain(clear: Path, tmp_path: Path) -> None:
    drops = {}
    for target in ("19", "22"):
        assert rain(clear / "001.png", tmp_path / target, *FEW, "--psnr", target) == 0
        found = json.loads((tmp_path / target / "drops/001.json").read_text())["drops"]
        drops[target] = [(drop["centre"], drop["radius"]) for drop in found]
    light, heavy = drops["22"], drops["19"]
    assert len(light) < len(heavy)
    assert light[:-1] == heavy[: len(light) - 1]


@pytest.mark.slow
def test_the_psnr_is_met_by_the_mean_of_a_set(clear: Path, tmp_path: Path) -> None:
    options = (*FEW, "--psnr", "19", "--psnr-over", "set")
    assert rain(clear, tmp_path / "out", *options) == 0
    found = report(tmp_path / "out")
    assert found["raw"]["psnr"]["mean"] == pytest.approx(19, abs=0.1)
    assert found["raw"]["psnr"]["sd"] > 0.1  # one law for all
    first = contents(tmp_path / "out")
    assert rain(clear, tmp_path / "out", *options) == 0
    assert report(tmp_path / "out")["made"] == 0
    assert rain(clear, tmp_path / "half", *options, "--shard", "1/2") == 0
    assert contents(tmp_path / "half").items() <= first.items()


def test_an_impossible_psnr_names_what_is_possible(
    clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rain(clear / "000.png", tmp_path / "out", *FEW, "--psnr", "4") == 1
    found = report(tmp_path / "out")
    assert "cannot be reached: the heaviest rain of this population leaves" in found["failed"][0]["reason"]
    assert found["status"] == "failed"
    assert contents(tmp_path / "out") == {}
    assert "000.png" in capsys.readouterr().err


# -- labels ------------------------------------------------------------------------------------------------------------


def camvid11(root: Path) -> list[str]:
    for split in ("train", "val"):
        imagefile.write(made(root / split / "a.png"), picture(1))
        imagefile.write(made(root / f"{split}annot" / "a.png"), label())
    return ["trainannot/a.png", "valannot/a.png"]


def camvid32(root: Path) -> list[str]:
    imagefile.write(made(root / "images/a.png"), picture(1))
    imagefile.write(made(root / "labels/a_L.png"), np.stack([label() * 20] * 3, -1))
    return ["labels/a_L.png"]


def cityscapes(root: Path) -> list[str]:
    imagefile.write(made(root / "leftImg8bit/train/ulm/ulm_0_leftImg8bit.png"), picture(1))
    stem = root / "gtFine/train/ulm/ulm_0_gtFine_"
    imagefile.write(made(Path(f"{stem}labelIds.png")), label())
    imagefile.write(Path(f"{stem}instanceIds.png"), label().astype(np.uint16) * 1000)
    imagefile.write(Path(f"{stem}color.png"), np.stack([label() * 20] * 3 + [np.full_like(label(), 255)], -1))
    Path(f"{stem}polygons.json").write_text("{}")
    return [f"gtFine/train/ulm/ulm_0_gtFine_{kind}" for kind in
            ("labelIds.png", "instanceIds.png", "color.png", "polygons.json")]  # fmt: skip


def label() -> Image:
    return np.random.default_rng(3).integers(1, 11, SIZE[::-1], dtype=np.uint8)


def made(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@pytest.mark.parametrize("layout", [camvid11, camvid32, cityscapes])
def test_labels_of_data_sets_are_copied_bit_for_bit(layout: Callable[[Path], list[str]], tmp_path: Path) -> None:
    names = layout(tmp_path / "set")
    assert rain(tmp_path / "set", tmp_path / "out", *FEW, "--no-drop-lists") == 0
    found = contents(tmp_path / "out")
    images = [p.relative_to(tmp_path / "set").as_posix() for p in (tmp_path / "set").rglob("*") if p.is_file()]
    assert found.keys() == set(images)
    for name in names:
        assert found[name] == (tmp_path / "set" / name).read_bytes()
    assert all(found[name] != (tmp_path / "set" / name).read_bytes() for name in set(images) - set(names))


@pytest.mark.parametrize(("layout", "void"), [(camvid11, 11), (camvid32, 0), (cityscapes, 0)])
def test_labels_of_what_drops_hide_are_marked(layout: Callable[[Path], list[str]], void: int, tmp_path: Path) -> None:
    names = layout(tmp_path / "set")
    assert rain(tmp_path / "set", tmp_path / "out", *FEW, "--unknown-labels", "marked", "--masks") == 0
    mask = imagefile.read(next((tmp_path / "out/masks").rglob("*.png")))
    hidden = (mask[..., 1] >= 128) | (mask[..., 0] > 0)
    assert 0.05 < hidden.mean() < 0.95
    for name in names:
        if name.endswith(".json") or name.startswith("valannot"):
            continue
        before, after = (cv2.imread(str(root / name), -1) for root in (tmp_path / "set", tmp_path / "out"))
        assert before.dtype == after.dtype
        assert np.array_equal(before[~hidden], after[~hidden])
        colour = after[hidden].reshape(hidden.sum(), -1)
        assert (colour[:, :3] == void).all()
        if colour.shape[1] == 4:
            assert (colour[:, 3] == 255).all()


def test_labels_of_another_folder(clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    imagefile.write(made(tmp_path / "labels/000.png"), label())
    options = (*FEW, "--labels", str(tmp_path / "labels"))
    assert rain(clear / "000.png", tmp_path / "out", *options) == 0
    assert (tmp_path / "out/labels/000.png").read_bytes() == (tmp_path / "labels/000.png").read_bytes()
    assert rain(clear, tmp_path / "all", *options) == 2
    assert "has no label image" in " ".join(capsys.readouterr().err.split())


# -- sequences ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("motion", ["physical", "paper", pytest.param("still", marks=pytest.mark.slow)])
def test_drops_stay_or_move_over_a_sequence(clear: Path, tmp_path: Path, motion: str) -> None:
    options = (*FEW, "--sequence", "--motion", motion, "--fps", "10")
    assert rain(clear, tmp_path / "out", *options) == 0
    tables = [json.loads((tmp_path / f"out/drops/{i:03d}.json").read_text())["drops"] for i in range(6)]
    places = [{tuple(drop["centre"]) for drop in table if drop["type"] == "SphericalCap"} for table in tables]
    assert len(set.intersection(*places)) > 5  # the same pane
    assert (places[0] == places[5]) == (motion == "still")
    assert rain(clear, tmp_path / "part", *options, "--shard", "2/3") == 0
    assert contents(tmp_path / "part").items() <= contents(tmp_path / "out").items()
    assert {"001.png", "004.png"} <= contents(tmp_path / "part").keys()


def test_quick_frames_of_a_sequence_are_nearly_the_same(clear: Path, tmp_path: Path) -> None:
    options = (*FEW, "--sequence", "--motion", "paper", "--fps", "10", "--f-number", "inf")
    for name, more in (("careful", ()), ("quick", ("--quick",))):
        assert rain(clear, tmp_path / name, *options, *more) == 0
    frames = [imagefile.read(tmp_path / name / "003.png").astype(float) for name in ("careful", "quick")]
    assert 0 < np.sqrt(np.mean((frames[0] - frames[1]) ** 2)) < 8
    renderer, drops = Renderer.from_json((tmp_path / "quick/drops/003.json").read_text())
    assert renderer.moving
    np.testing.assert_array_equal(renderer.plan(drops).apply(imagefile.read(clear / "003.png")), frames[1])
    assert rain(clear, tmp_path / "careful", *options, "--quick") == 2  # another kind of rain's folder


def test_rain_that_goes_on_wets_the_pane_again() -> None:
    counts = {}
    for refill in (0.5, math.inf):
        drive = Drive("a", SIZE, 31, "paper", 10, refill)  # after 3 s, all that were above 4 mm have run off
        counts[refill] = len(Sequence(Rain(PRESETS["large"]), drive).plan(30).drops)
    assert counts[0.5] > 2 * counts[math.inf] > 0


@pytest.mark.skipif(not compiled.available(), reason="needs numba")
def test_a_pane_that_rests_is_planned_to_last() -> None:
    """Where nothing moves, dries or is to come, and drops are many."""

    def rain(cover: float, largest: float) -> Rain:
        law = replace(PRESETS["large"].population, diameter=LogNormal(3e-3, 0.2, 2e-3, largest), cover=cover)
        return Rain(replace(PRESETS["large"], population=law, f_number=math.inf))

    for case, motion, refill, lasting in (
        (rain(0.9, 3.9e-3), "paper", math.inf, True), (rain(0.9, 3.9e-3), "paper", 5.0, False),
        (rain(0.9, 8e-3), "paper", math.inf, False), (rain(0.9, 3.9e-3), "physical", math.inf, False),
        (rain(0.1, 3.9e-3), "paper", math.inf, False),
    ):  # fmt: skip
        plan = Sequence(case, Drive("a", SIZE, 31, motion, 10, refill)).plan(9)
        assert plan.renderer.lasting is lasting


def video(path: Path, count: int = 3) -> list[Image]:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10, SIZE)
    pictures = [picture(i) for i in range(count)]
    for frame in pictures:
        writer.write(frame)
    writer.release()
    return pictures


def read_video(path: Path) -> list[Image]:
    reader, frames = cv2.VideoCapture(str(path)), []
    while (found := reader.read())[0]:
        frames.append(found[1])
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    return frames


def test_a_video_becomes_a_rainy_video(tmp_path: Path) -> None:
    pictures = video(tmp_path / "drive.mkv")
    out = tmp_path / "out"
    assert rain(tmp_path / "drive.mkv", out, *FEW, "--video-format", "mkv", "--masks") == 0
    frames = read_video(out / "drive.mkv")
    assert len(frames) == 3
    for i, (before, after) in enumerate(zip(pictures, frames, strict=True)):
        mask = imagefile.read(out / f"masks/drive/{i:06d}.png")[..., 2]
        assert np.array_equal(before[mask == 0], after[mask == 0])
        assert (before[mask > 0] != after[mask > 0]).any(-1).mean() > 0.5
        renderer, drops = Renderer.from_json((out / f"drops/drive/{i:06d}.json").read_text())
        assert np.array_equal(renderer.plan(drops).apply(before), after)
    found = report(out)["images"][0]
    assert found["frames"] == 3
    assert rain(tmp_path / "drive.mkv", out, *FEW, "--video-format", "mkv", "--masks") == 0
    assert report(out)["made"] == 0


@pytest.mark.slow
def test_a_video_as_mp4_at_a_psnr(tmp_path: Path) -> None:
    video(tmp_path / "drive.mkv")
    options = (*FEW, "--psnr", "19", "--no-drop-lists")
    assert rain(tmp_path / "drive.mkv", tmp_path / "out", *options, "--motion", "still") == 0
    assert len(read_video(tmp_path / "out/drive.mp4")) == 3
    assert report(tmp_path / "out")["images"][0]["psnr"] == pytest.approx(19, abs=0.1)
    assert rain(tmp_path / "drive.mkv", tmp_path / "moving", *options, "--motion", "paper") == 1  # all of them run
    assert "--motion still" in report(tmp_path / "moving")["failed"][0]["reason"]


# -- what images there are ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "channels"), [(np.uint16, 3), (np.uint8, 1), (np.uint16, 1)])
def test_images_of_16_bits_and_gray_ones_keep_their_type(tmp_path: Path, dtype: type, channels: int) -> None:
    image = picture(4, dtype=dtype, channels=channels)
    imagefile.write(made(tmp_path / "in/a.png"), image)
    assert rain(tmp_path / "in", tmp_path / "out", *FEW, "--psnr", "20") == 0
    after = imagefile.read(tmp_path / "out/a.png")
    assert (after.shape, after.dtype) == (image.shape, image.dtype)
    assert report(tmp_path / "out")["raw"]["psnr"]["mean"] == pytest.approx(20, abs=0.1)


def test_a_glob_keeps_folders_and_the_format_of_the_input(clear: Path, tmp_path: Path) -> None:
    for name in ("a/x", "b/x"):
        imagefile.write(made(tmp_path / f"in/{name}.jpg"), picture(1))
    pattern = str(tmp_path / "in/**/*.jpg")
    assert rain(pattern, tmp_path / "out", *FEW, "--format", "input", "--no-drop-lists", "--no-ssim") == 0
    found = contents(tmp_path / "out")
    assert found.keys() == {"a/x.jpg", "b/x.jpg"}
    assert found["a/x.jpg"] != found["b/x.jpg"]
    assert report(tmp_path / "out")["raw"]["ssim"] == {"count": 0, "mean": None}


def test_a_bad_image_is_named_and_the_rest_is_done(
    clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(clear, tmp_path / "in")
    whole = (tmp_path / "in/001.png").read_bytes()
    (tmp_path / "in/001.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "in/bad.jpg").write_text("no picture")
    assert rain(tmp_path / "in", tmp_path / "out", *FEW) == 1
    found = report(tmp_path / "out")
    assert found["status"] == "incomplete"
    assert {Path(row["path"]).name for row in found["failed"]} == {"001.png", "bad.jpg"}
    assert found["done"] == 5
    assert "truncated" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_a_rig_fixes_camera_pane_and_size(recording: Path, clear: Path, tmp_path: Path) -> None:
    shutil.copytree(recording / "drive/wet", tmp_path / "in")
    imagefile.write(tmp_path / "in/small.png", picture(1))
    options = (*FEW, "--rig", str(recording / "truth"), "--cover", "0.02")
    assert rain(tmp_path / "in", tmp_path / "out", *options) == 1
    found = report(tmp_path / "out")
    assert [Path(row["path"]).name for row in found["failed"]] == ["small.png"]
    assert "the rig was calibrated for" in found["failed"][0]["reason"]
    assert found["done"] == 3


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--psnr", "nan"), "expected decibels"),
        (("--psnr", "17", "--cover", "0.3"), "leave out"),
        (("--cover", "2"), "expected the wet share"),
        (("--preset", "hail"), "is unknown; there are adherent"),
        (("--population", "hail"), "is unknown"),
        (("--shard", "5/4"), "expected N/COUNT"),
        (("--workers", "-1"), "expected 0 (one a processor)"),
        (("--seed", "-1"), "expected a whole number"),
        (("--motion", "paper"), "add --sequence"),
        (("--quick",), "add --sequence"),
        (("--distance-mm", "-5"), "first face"),
        (("--f-number", "0"), "F-number"),
        (("--focus-m", "0.001"), "focus distance"),
        (("--fps", "0"), "frames a second"),
        (("--refill-s", "0"), "expected seconds"),
        (("--tolerance", "0"), "tolerance"),
        (("--depth-m", "-1"), "depth"),
        (("--focal-px", "0"), "expected pixels"),
    ],
)
def test_options_without_sense_are_refused(
    clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], words: str
) -> None:
    assert rain(clear, tmp_path / "out", *more) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_places_without_sense_are_refused(clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    shutil.copytree(clear, tmp_path / "in")
    imagefile.write(tmp_path / "in/000.jpg", picture(1))
    broken = made(tmp_path / "list.json")
    broken.write_text("{}")
    for arguments, words in (
        ((str(tmp_path / "empty"), "--out", str(tmp_path / "o")), "no image and no video in"),
        ((str(tmp_path / "nowhere"), "--out", str(tmp_path / "o")), "does not exist"),
        ((str(tmp_path / "*.gif"), "--out", str(tmp_path / "o")), "no image and no video matches"),
        ((str(tmp_path / "in"), "--out", str(tmp_path / "o")), "would both be written as 000"),
        ((str(clear), "--out", str(clear / "rainy")), "lie in one another"),
        ((str(clear / "*.png"), "--out", str(clear)), "lie in one another"),
        (("--out", str(tmp_path / "o")), "no images were given"),
        ((str(clear), "--out", str(tmp_path / "o"), "--drops", str(broken)), "not a drop list"),
    ):
        assert main(["rain", *arguments]) == 2, words
        assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "o").exists()
    assert not (clear / "rainy").exists()


@pytest.mark.parametrize("preset", ["large", "drops", "cityscapes"])
def test_drops_that_are_left_out_cannot_be_seen(preset: str) -> None:
    every = Rain(PRESETS[preset])
    drops = every.drops("a", SIZE)
    shown, image = every.in_sight(drops, SIZE), picture(1)
    assert 0 < len(shown) < len(drops)
    for f_number in (1.4, math.inf):
        rain_ = replace(every, setup=replace(every.setup, f_number=f_number))
        drops, renderer = rain_.drops("a", SIZE), rain_.renderer(SIZE)
        whole, part = renderer.plan(drops), renderer.plan(rain_.in_sight(drops, SIZE))
        assert np.array_equal(whole.opacity > 0, part.opacity > 0)
        difference = whole.apply(image).astype(int) - part.apply(image)
        assert np.abs(difference).max() <= 1  # the mean distance of more drops decides their disc


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_says_where_its_camera_is_from(name: str) -> None:
    setup = PRESETS[name]
    assert setup.source
    camera = setup.camera((640, 480))
    assert camera.intrinsics[0] == pytest.approx(640 * setup.focal)
    assert setup.chamber.distance == setup.distance


# -- real frames -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_camvid_frames_reach_the_severity_of_the_paper(shared_data: Path, tmp_path: Path) -> None:
    """The paper's raw CamVid set has 16.89 dB."""
    frames = str(shared_data / "camvid11_480x360/val/*0.jpg")
    assert rain(frames, tmp_path / "out", "--preset", "camvid", "--psnr", "16.9", "--workers", "2") == 0
    found = report(tmp_path / "out")
    assert found["severity"]["images_within"] == found["done"] > 10
    assert found["raw"]["psnr"]["mean"] == pytest.approx(16.9, abs=0.1)
    assert 0.4 < found["raw"]["ssim"]["mean"] < 0.75  # the paper's: 0.6064


def test_realism_wants_pairs(clear: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = str(clear / "000.png")
    assert rain(clear, tmp_path / "out", *FEW, "--realism-wet", image, image, "--realism-clear", image) == 2
    assert "2 images of --realism-wet and 1 of --realism-clear" in capsys.readouterr().err


@pytest.mark.slow
def test_realism_is_written_beside(clear: Path, tmp_path: Path) -> None:
    wide = picture(1, (320, 240))
    imagefile.write(tmp_path / "clear.png", wide)
    assert rain(tmp_path / "clear.png", tmp_path / "rainy", "--preset", "camvid", "--seed", "3") == 0
    wet, dry = str(tmp_path / "rainy" / "clear.png"), str(tmp_path / "clear.png")
    out = tmp_path / "out"
    assert rain(clear, out, "--preset", "camvid", "--realism-wet", wet, "--realism-clear", dry) == 0
    assert (out / "realism.html").stat().st_size > 10_000
    assert [pair["name"] for pair in report(out)["realism"]["pairs"]] == ["clear"]
