"""Benchmark stage `derain`, its works on skipping: they run, and what they call an error is one."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rainstereo import imagefile
from rainstereo.apps import bench_derain_cuda as cuda
from rainstereo.apps import bench_derain_skip as skip
from rainstereo.apps.bench_harness import measure
from rainstereo.apps.cli import main
from rainstereo.apps.rain_settings import psnr
from rainstereo.model.restore import Restorer
from tests.model.small_restorer import CONFIG, generator, network, picture

ZEROS = replace(CONFIG, padding="zeros", normalisation="none", patch=4)
SIZE = (160, 112)


def scene(seed: int) -> skip.View:
    clear = picture(seed, SIZE[::-1])
    drops = np.zeros((7, 10), bool)
    drops[2:4, 3:6] = True
    wet = clear.copy()
    wet[32:64, 48:96] = cv2.blur(clear, (25, 25))[32:64, 48:96]
    return skip.View(clear, wet, wet, cv2.blur(clear, (25, 25)), drops)


def test_skipping_is_measured_against_computing_everything() -> None:
    views, made = [scene(0), scene(1)], network(ZEROS)
    outcome = measure(skip.skip_work(made, views, True), 1)
    assert outcome["drops all over, nothing skipped"].error == 0
    whole, skipping = Restorer(network=made, skip=False), Restorer(network=made)
    lost = [psnr(v.clear, whole(v.scattered)) - psnr(v.clear, skipping(v.scattered)) for v in views]
    assert outcome["a tenth, scattered"].error == pytest.approx(np.mean(lost))
    assert len(outcome.work.targets) == 3


def test_the_curve_has_the_defaults_and_what_could_be_reached() -> None:
    views, made = [scene(0)], network(ZEROS)
    outcome = measure(skip.curve_work(made, views, True), 1)
    known = outcome["cells with drops, if known"]
    assert known.also["computed, %"] == pytest.approx(100 * 6 / 70)
    assert outcome["everything"].error == 0
    assert outcome.work.champion.endswith("the defaults")
    assert any(m.name.startswith("in rectangles") for m in outcome.measurements)


def test_videos_say_what_keeping_pixels_costs() -> None:
    stands, moves = skip.video_works(network(ZEROS), scene(0), 0)
    assert (stands.name, moves.name) == ("stands", "moves")
    outcome = measure(stands, 1)
    assert outcome["each frame for itself"].error == 0
    for levels in (4, 8, 16):
        also = outcome[f"reuse within {levels} gray levels"].also
        assert 0 <= also["RMS difference, gray levels"] <= also["largest difference, gray levels"]


def test_scenes_come_from_a_photograph_or_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (one,) = skip.views(SIZE, 0, None, True)
    assert one.clear.shape == (112, 160, 3)
    assert 0.02 < one.drops.mean() < 0.8
    assert np.array_equal(one.together[:, -16:], one.clear[:, -16:])
    imagefile.write(tmp_path / "a.png", picture(3))
    (own,) = skip.views(SIZE, 0, tmp_path, True)
    assert not np.array_equal(own.clear, one.clear)
    (tmp_path / "none").mkdir()
    with pytest.raises(ValueError, match="holds no images"):
        skip.views(SIZE, 0, tmp_path / "none", True)
    assert main(["bench", "warp", "--images", str(tmp_path)]) == 2
    assert "is for the stage derain" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_frames_go_through_a_device_and_back(where: str) -> None:
    if where == "cuda" and not torch.cuda.is_available():
        pytest.skip("this machine has no CUDA device")
    frames = [picture(i, (48, 64)) for i in range(3)]
    modules = [partial(generator, config) for config in (ZEROS, CONFIG)]
    paper, own = cuda.works(*modules, frames, frames, torch.device(where), True)
    assert paper.items == len(frames)
    assert not paper.targets  # which are for larger frames
    assert not any("skipping" in variant.name for variant in paper.variants)
    outcome = measure(own, 1)
    assert outcome["bf16, stream"].error == outcome["bf16, Restorer, each frame for itself"].error > 0
    assert outcome[f"float32, stream in batches of {cuda.BATCH}"].error <= 1
    assert "bf16, skipping, each frame for itself" in {m.name for m in outcome.measurements}


def test_the_paper_is_promised_at_its_two_sizes() -> None:
    frames = cuda.copies(picture(0, (480, 640)))
    assert len(frames) == cuda.FRAMES[480]
    assert not np.array_equal(frames[0], frames[1])
    small = replace(CONFIG, base_channels=1, blocks=0, patch=16)
    paper, _ = cuda.works(*[partial(generator, small)] * 2, frames[:2], frames[:2], torch.device("cpu"), True)
    assert [target.limit for target in paper.targets] == [2 / 100] * 2
