"""Benchmark stage `derain`: frames a second by size, width, precision and backend; what skipping saves, and costs."""

from __future__ import annotations

import copy
import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from rainstereo.apps import bench_derain_skip
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.model import checkpoint, export
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.macs import size_of
from rainstereo.model.networks import Network, OnnxNetwork, TorchNetwork
from rainstereo.model.restore import Restorer
from rainstereo.types import Image

STAND_IN = GeneratorConfig(base_channels=16, normalisation="channel", output_residual=True)
THEIRS = "The paper (theirs, on a Titan X, in 2019): 3 Hz at 640x480, 1 Hz at 1280x960."


def build(seed: int, quick: bool, images: Path | None = None) -> Stage:
    """The stage at 640x480 and 1280x960, or 160x120 and 320x240 if `quick`.

    images: a folder of photographs for the works on skipping, in place of one that scikit-image has.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    torch.set_num_threads(cores)  # the other stages run on one
    width, height = (160, 120) if quick else (640, 480)
    path = checkpoint.shipped()
    found = checkpoint.load(path) if path.is_file() else None
    module = found.build() if found else _random(STAND_IN)
    if not isinstance(module, Generator):
        raise ValueError(f"{path} holds no generator")
    views = bench_derain_skip.views((width, height), seed, images, quick)
    full = views[0].full
    shipped = TorchNetwork(module, "cpu", "float32")
    missing = () if found else ("The package has no weights: a stand-in with random ones ran. Its errors say nothing.",)
    works = [
        _size_work("vga", module, shipped, full, cores, not quick),
        _size_work("large", module, shipped, cv2.resize(full, (2 * width, 2 * height)), cores, False),
        _width_work(full, quick),
        bench_derain_skip.skip_work(shipped, views, not quick),
        bench_derain_skip.curve_work(shipped, views, quick),
        _tile_work(shipped, cv2.resize(views[0].scattered, (2 * width, 2 * height)), quick),
        *bench_derain_skip.video_works(shipped, views[0], seed),
    ]
    return Stage(
        "derain",
        "de-raining a frame",
        f"From a decoded frame to a decoded frame, {width}x{height} colour, on {cores} cores. {THEIRS}",
        tuple(works),
        {
            "model": str(found.path.name if found else "stand-in"), "configuration": str(module.config),
            "MACs": f"{size_of(module.config, width, height)[1] / 1e9:.2f} G at {width}x{height}",
            "rain": "preset camvid; drops all over: cover 0.6; others: a tenth of the frame under drops",
            "views": f"{len(views)} of {'the images given' if images else 'one photograph (motorcycle), rain differs'}",
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
    half = TorchNetwork(copy.deepcopy(module), "cpu", "bf16")
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


def _width_work(image: Image, quick: bool) -> Work:
    tensor = _tensor(image).contiguous(memory_format=torch.channels_last)
    widths = (4, 8) if quick else (16, 32, 64)
    variants = []
    for base in widths:
        config = GeneratorConfig(base_channels=base)
        module, macs = _random(config), size_of(config, image.shape[1], image.shape[0])[1] / 1e9
        network = TorchNetwork(module, "cpu", "float32")
        slow = 15 if base == 64 else 5 if base == 32 else 2
        variants.append(Variant(f"base_channels {base}", partial(network, tensor), lambda _: float("nan"), True,
                                f"{macs:.1f} GMACs", every=slow))  # fmt: skip
    if not quick:
        slim = _random(GeneratorConfig(base_channels=32))
        by_onnx = _onnx(slim, torch.get_num_threads())
        half = TorchNetwork(copy.deepcopy(slim), "cpu", "bf16")
        call, none = partial(by_onnx, tensor), lambda _: float("nan")
        variants.append(Variant("base_channels 32, ONNX Runtime", call, none, True, every=5))
        variants.append(Variant("base_channels 32, bf16", partial(half, tensor), none, True, every=15))
    target = () if quick else (Target("base_channels 32", None, 1 / 4),)
    return Work(
        "widths", "The paper's network, by its width", "Bare network calls, float32, random weights.", tuple(variants),
        variants[0].name, "", "none: random weights", 1, "frames", target,
    )  # fmt: skip


def _tile_work(shipped: Network, image: Image, quick: bool) -> Work:
    variants = []
    for skip, words in ((False, ""), (True, ", skipping")):
        whole = Restorer(network=shipped, skip=skip, max_pixels=1 << 24)
        error = partial(_levels, truth=whole(image))
        variants.append(Variant(f"whole frame{words}", partial(whole, image), error))
        for tile in (64,) if quick else (512,):
            made = Restorer(network=shipped, skip=skip, tile=tile, max_pixels=1 << 16)
            variants.append(Variant(f"tiles of {tile}{words}", partial(made, image), error, True, every=5))
    return Work(
        "tiles", f"Tiles of a frame of {image.shape[1]} x {image.shape[0]}",
        "A tenth under scattered drops. With the whole receptive field around each tile, and blended overlaps. "
        "Skipping, a tile computes some cells where the frame computes others, or all; its error is the difference to "
        "the whole frame, skipping.",
        tuple(variants), variants[1].name, "gray levels", "largest difference to the whole frame, done alike", 1,
        "frames",
    )  # fmt: skip
