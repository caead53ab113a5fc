"""Benchmark stage `cuda`: rain in torch, training steps and de-raining, on a CUDA device."""

from __future__ import annotations

import copy
from functools import partial

import cv2
import torch

from rainstereo.apps import bench_derain_cuda, bench_derain_skip, bench_rain, bench_train
from rainstereo.apps.bench_harness import Stage, Work
from rainstereo.model import checkpoint
from rainstereo.model.generator import Generator
from rainstereo.types import Image

SIZE = 640, 480


def is_there() -> bool:
    """Whether this machine can run the stage."""
    return torch.cuda.is_available()


def build(seed: int, quick: bool) -> Stage:
    """The stage; ValueError where there is no CUDA device."""
    if not is_there():
        raise ValueError("the stage cuda needs a CUDA device, and torch finds none here; the other stages need none")
    device, (width, height) = torch.device("cuda"), (160, 120) if quick else SIZE
    module = checkpoint.load(checkpoint.shipped()).build()
    if not isinstance(module, Generator):
        raise TypeError(f"{checkpoint.shipped()} holds no generator")
    view = bench_derain_skip.views((width, height), seed, None, True)[0]
    side, base = (48, 4) if quick else (256, 64)
    pixel, adversarial = (
        bench_train.step_work(name, weights, side, base, seed, not quick, device)
        for name, weights in (("pixel", bench_train.PIXELS), ("adversarial", bench_train.PAPER))
    )
    return Stage(
        "cuda",
        "work on a GPU",
        f"Rain drawn, traced and rendered in torch; steps of training on windows of {side} x {side} with {base} base "
        "channels; frames through the de-rainer. Each beside what it could be.",
        (bench_rain.batch_work(seed, quick), pixel, adversarial, *_derained(module, view.full, view.scattered, quick)),
        {
            "device": torch.cuda.get_device_name(device),
            "torch": torch.__version__,
            "CUDA": str(torch.version.cuda),
            "seed": seed,
        },
        ("Every run ends when the device has finished.",),
    )


def _derained(module: Generator, full: Image, scattered: Image, quick: bool) -> list[Work]:
    """At the stage's size, and at twice that."""
    papers = partial(copy.deepcopy, bench_derain_cuda.paper_network())
    shipped, found = partial(copy.deepcopy, module), []
    for scale in (1, 2):
        size = scale * full.shape[1], scale * full.shape[0]
        frames, fewer = (bench_derain_cuda.copies(cv2.resize(image, size)) for image in (full, scattered))
        found += bench_derain_cuda.works(shipped, papers, frames, fewer, torch.device("cuda"), not quick)
    return found
