"""Benchmark stage `derain`: frames a second by size, width, precision and backend; what skipping saves, and costs."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.apps.rain_presets import preset
from rainstereo.apps.rain_settings import Rain, psnr
from rainstereo.model import checkpoint, detector, export
from rainstereo.model.detector import Detector
from rainstereo.model.frame_sequence import FrameSequence
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.macs import size_of
from rainstereo.model.networks import Network, OnnxNetwork, TorchNetwork
from rainstereo.model.restore import Restorer
from rainstereo.types import Image

STAND_IN = GeneratorConfig(base_channels=16, normalisation="channel", output_residual=True)
CLEAR_VIEW = 0.1
"""Share of a frame that drops cover in the middle case."""
THEIRS = "The paper (theirs, on a Titan X, in 2019): 3 Hz at 640x480, 1 Hz at 1280x960."


@dataclass(frozen=True)
class Frames:
    """The same view clear, with drops on a tenth of it, scattered or in one place, and with drops all over."""

    clear: Image
    scattered: Image
    together: Image
    full: Image


def build(seed: int, quick: bool) -> Stage:
    """The stage at 640x480 and 1280x960, or 160x120 and 320x240 if `quick`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    torch.set_num_threads(cores)  # the other stages run on one
    width, height = (160, 120) if quick else (640, 480)
    path = checkpoint.shipped()
    found = checkpoint.load(path) if path.is_file() else None
    module = found.build() if found else _random(STAND_IN)
    if not isinstance(module, Generator):
        raise ValueError(f"{path} holds no generator")
    frames = _frames((width, height), seed)
    shipped = TorchNetwork(module, "cpu", "float32")
    missing = () if found else ("The package has no weights: a stand-in with random ones ran. Its errors say nothing.",)
    works = [
        _size_work("vga", module, shipped, frames.full, cores, not quick),
        _size_work("large", module, shipped, cv2.resize(frames.full, (2 * width, 2 * height)), cores, False),
        _width_work(frames.full, quick),
        _skip_work(shipped, frames, not quick),
        _curve_work(shipped, frames),
        _tile_work(shipped, cv2.resize(frames.full, (2 * width, 2 * height)), quick),
        _video_work(shipped, frames, seed),
    ]
    return Stage(
        "derain",
        "de-raining a frame",
        f"From a decoded frame to a decoded frame, {width}x{height} colour, on {cores} cores. {THEIRS}",
        tuple(works),
        {
            "model": str(found.path.name if found else "stand-in"), "configuration": str(module.config),
            "MACs": f"{size_of(module.config, width, height)[1] / 1e9:.2f} G at {width}x{height}",
            "rain": "preset camvid; full: 16.9 dB or the heaviest there is; others: a tenth of the frame under drops",
            "torch threads": cores, "seed": seed,
        },
        (
            *missing, THEIRS,
            "`bare network call`: the generator on a tensor that is ready; nothing is converted, detected or copied.",
            "Random weights have the times of trained ones; where only the width changes, no error is shown.",
            "bf16 is emulated on processors without AVX512-BF16 or AMX, and is then slower than float32.",
        ),
    )  # fmt: skip


def _random(config: GeneratorConfig) -> Generator:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return config.build().eval()


def _frames(size: tuple[int, int], seed: int) -> Frames:
    clear: Image = np.ascontiguousarray(cv2.resize(photograph("motorcycle"), size, interpolation=cv2.INTER_AREA))
    setup = preset("camvid")

    def rained(cover: float) -> tuple[Image, Any]:
        law = replace(setup, population=setup.population.with_cover(cover))
        plan, _ = Rain(law, seed).plan(clear, "bench")
        return plan.apply(clear), plan.opacity

    full, opacity = rained(0.6)
    # the same rain where a wiper left it: a band of the frame, as wide as a tenth of all pixels under drops takes
    shares = np.cumsum(opacity.sum(0)) / opacity.size
    edge = int(np.searchsorted(shares, CLEAR_VIEW))
    together = clear.copy()
    together[:, :edge] = full[:, :edge]
    return Frames(clear, rained(CLEAR_VIEW)[0], together, full)


def _tensor(image: Image) -> torch.Tensor:
    rgb = np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))
    return torch.from_numpy(rgb).float().div(255).unsqueeze(0)


def _levels(found: Image, truth: Image) -> float:
    return float(np.abs(found.astype(np.int16) - truth).max())


def _onnx(module: Generator, threads: int) -> OnnxNetwork:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "derain.onnx"
        path.write_bytes(export.to_onnx(module))
        return OnnxNetwork(path, threads)


def _size_work(name: str, module: Generator, shipped: Network, image: Image, cores: int, promised: bool) -> Work:
    height, width = image.shape[:2]
    tensor = _tensor(image).contiguous(memory_format=torch.channels_last)
    truth = Restorer(network=shipped, skip=False, max_pixels=1 << 22)(image)

    def run(network: Network, skip: bool) -> Callable[[], Image]:
        return partial(Restorer(network=network, skip=skip, max_pixels=1 << 22), image)

    ours, bare = "float32, torch", "bare network call"
    error = partial(_levels, truth=truth)
    half = TorchNetwork(_copy(module), "cpu", "bf16")
    variants = [
        Variant(bare, lambda: shipped(tensor), lambda _: 0.0, note="float32, torch; the yardstick"),
        Variant(ours, run(shipped, False), error, True, "skips nothing"),
        Variant("float32, torch, detector on", run(shipped, True), error, True, "drops all over: little to skip"),
        Variant("bf16, torch", run(half, False), error, True, every=4),
    ]
    if promised:
        variants.append(Variant("float32, ONNX Runtime", run(_onnx(module, cores), False), error, True))
    targets = [Target(ours, bare, 1.1), Target(ours, None, 1 / 8)] if promised else []
    return Work(
        name, f"{width} x {height}, drops all over", "The model of the package.", tuple(variants), ours, "gray levels",
        "largest difference to float32 without skipping", 1, "frames", tuple(targets),
    )  # fmt: skip


def _copy(module: Generator) -> Generator:
    made = module.config.build()
    made.load_state_dict(module.state_dict())
    return made.eval()


def _width_work(image: Image, quick: bool) -> Work:
    tensor = _tensor(image).contiguous(memory_format=torch.channels_last)
    widths = (4, 8) if quick else (16, 32, 64)
    variants = []
    for base in widths:
        config = GeneratorConfig(base_channels=base)
        module, macs = _random(config), size_of(config, image.shape[1], image.shape[0])[1] / 1e9
        network = TorchNetwork(module, "cpu", "float32")
        slow = 4 if base == 64 else 2 if base == 32 else 1
        variants.append(Variant(f"base_channels {base}", partial(network, tensor), lambda _: float("nan"), True,
                                f"{macs:.1f} GMACs", every=slow))  # fmt: skip
    if not quick:
        slim = _random(GeneratorConfig(base_channels=32))
        by_onnx = _onnx(slim, torch.get_num_threads())
        call, none = partial(by_onnx, tensor), lambda _: float("nan")
        variants.append(Variant("base_channels 32, ONNX Runtime", call, none, True, every=2))
    target = () if quick else (Target("base_channels 32", None, 1 / 4),)
    return Work(
        "widths", "The paper's network, by its width", "Bare network calls, float32, random weights.", tuple(variants),
        variants[0].name, "", "none: random weights", 1, "frames", target,
    )  # fmt: skip


def _skip_work(shipped: Network, frames: Frames, promised: bool) -> Work:
    whole, skipping = Restorer(network=shipped, skip=False), Restorer(network=shipped)

    def lost(image: Image) -> Callable[[Image], float]:
        """dB that skipping loses against no skipping; without drops, both against the truth, capped."""
        reference = min(psnr(frames.clear, whole(image)), 99.0)
        return lambda found: reference - min(psnr(frames.clear, found), 99.0)

    def share(image: Image) -> dict[str, float]:
        found = skipping.restored(image)
        return {"marked, %": 100 * found.marked, "computed, %": 100 * found.computed}

    everything = "drops all over, nothing skipped"
    cases = {
        "no drops": frames.clear, "a tenth, in one place": frames.together, "a tenth, scattered": frames.scattered,
        "drops all over": frames.full,
    }  # fmt: skip
    none = {"marked, %": 100.0, "computed, %": 100.0}
    variants = [
        Variant(everything, partial(whole, frames.full), lambda _: 0.0, also=lambda _: none, note="full-drop frame")
    ]
    for name, image in cases.items():
        variants.append(Variant(name, partial(skipping, image), lost(image), True, also=partial(_also, share(image))))
    targets = [Target("no drops", everything, 0.1)]
    targets += [Target(name, everything, 0.5) for name in ("a tenth, in one place", "a tenth, scattered")]
    return Work(
        "skip", "What is clear is skipped",
        "A frame under less and less rain. The error is what skipping loses in PSNR against computing everything; "
        "below zero, leaving clear cells as they are is better.",
        tuple(variants), "no drops", "dB", "PSNR lost against no skipping", 1, "frames",
        tuple(targets) if promised else (),
    )  # fmt: skip


def _also(found: dict[str, float], _: Image) -> dict[str, float]:
    return found


def _curve_work(shipped: Network, frames: Frames) -> Work:
    """Quality against time over halo and threshold, on scattered drops."""
    image, whole = frames.scattered, Restorer(network=shipped, skip=False)
    reference = psnr(frames.clear, whole(image))
    weights = detector.load(detector.shipped())

    def lost(found: Image) -> float:
        return reference - psnr(frames.clear, found)

    variants = [Variant("everything", partial(whole, image), lost)]
    for halo in (0, 16, 32, 64):
        made = Restorer(network=shipped, halo=halo)
        variants.append(Variant(f"halo {halo}", partial(made, image), lost, True))
    for low, high in ((0.05, 0.3), (0.15, 0.7), (0.2, 0.8), (0.5, 0.9)):
        made = Restorer(network=shipped, detector=Detector(weights, "cpu", low, high))
        variants.append(Variant(f"thresholds {low:g}, {high:g}", partial(made, image), lost, True))
    return Work(
        "curve", "Halo and thresholds, by what they cost",
        "A tenth of the frame under scattered drops. The rest of the settings are the defaults.",
        tuple(variants), "halo 32", "dB", "PSNR lost against no skipping", 1, "frames",
    )  # fmt: skip


def _tile_work(shipped: Network, image: Image, quick: bool) -> Work:
    whole = Restorer(network=shipped, skip=False, max_pixels=1 << 24)
    truth = whole(image)
    variants = [Variant("whole frame", partial(whole, image), partial(_levels, truth=truth))]
    for tile in (64, 128) if quick else (256, 512):
        made = Restorer(network=shipped, skip=False, tile=tile, max_pixels=1 << 16)
        variants.append(Variant(f"tiles of {tile}", partial(made, image), partial(_levels, truth=truth), True, every=3))
    return Work(
        "tiles", f"Tiles of a frame of {image.shape[1]} x {image.shape[0]}",
        "With the whole receptive field around each tile, and blended overlaps.",
        tuple(variants), variants[1].name, "gray levels", "largest difference to the whole frame", 1, "frames",
    )  # fmt: skip


def _video_work(shipped: Network, frames: Frames, seed: int) -> Work:
    """Eight frames of a still camera whose sensor is noisy."""
    draws = np.random.default_rng(seed)
    noise = [draws.normal(0, 1, frames.full.shape) for _ in range(8)]
    drive = [np.clip(np.rint(frames.together + n), 0, 255).astype(np.uint8) for n in noise]
    made = Restorer(network=shipped)

    def run(every: int, reuse: float | None) -> list[Image]:
        sequence = FrameSequence(made, every=every, reuse=reuse)
        return [sequence(frame).image for frame in drive]

    alone = run(1, None)

    def error(found: list[Image]) -> float:
        return float(np.sqrt(np.mean([(a.astype(float) - b) ** 2 for a, b in zip(found, alone, strict=True)])))

    variants = [
        Variant("each frame for itself", partial(run, 1, None), error, True),
        Variant("detector every 4th frame", partial(run, 4, None), error, True),
        Variant("reuse within 4 gray levels", partial(run, 1, 4.0), error, True),
        Variant("reuse within 8 gray levels", partial(run, 1, 8.0), error, True),
    ]
    return Work(
        "video", "Frames of a video",
        "Eight frames of a still camera with 1 gray level of noise, a tenth under drops in one place.",
        tuple(variants), "each frame for itself", "gray levels", "RMS difference to each frame for itself", 8, "frames",
    )  # fmt: skip
