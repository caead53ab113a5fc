"""Benchmark stage `train`: our training step beside a plain PyTorch loop with the same networks, and reading of
data."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from rainstereo import imagefile
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.model.dataset import Batch, Windows, collate
from rainstereo.model.losses import GeneratorLoss, LossWeights, discriminator_loss
from rainstereo.model.pair_folders import Item
from rainstereo.model.pool import DerainedPool
from rainstereo.model.recipe import Recipe, parse
from rainstereo.model.train_step import Trainer

STEPS = 3
CPU = torch.device("cpu")
PIXELS = {"lambda_adversarial": 0.0, "lambda_perceptual": 0.0, "lambda_msadv": 0.0, "lambda_pixel": 1.0}
PAPER = {"lambda_perceptual": 0.0}


def build(seed: int, quick: bool) -> Stage:
    """The stage at windows of 256 x 256, a recipe's default, or 48 x 48 if `quick`."""
    side, base = (48, 4) if quick else (256, 16)
    return Stage(
        "train",
        "training",
        f"{STEPS} steps on windows of {side} x {side}, batch 2, the paper's generator and discriminator with "
        f"{base} base channels, beside a loop written out in plain PyTorch; and how long the data takes.",
        (step_work("pixel", PIXELS, side, base, seed, not quick),
         step_work("adversarial", PAPER, side, base, seed, not quick),
         _data_work(side, base, seed, not quick)),
        {"window": side, "batch": 2, "base channels": base, "seed": seed},
        (
            "The plain loop has Adam, the losses and the pool of ours, and neither checks for values that are not "
            "finite, nor seeds, schedules or counts.",
            "Data is read and augmented by another process while a step computes; it holds training up where it takes "
            "longer.",
        ),
    )  # fmt: skip


def _recipe(weights: dict[str, float], side: int, base: int, seed: int) -> Recipe:
    network = {"base_channels": base, "normalisation": "channel"}
    return parse({
        "seed": seed, "data": {"crop": side}, "network": network, "discriminator": {"base_channels": base},
        "losses": weights, "optimizer": {"batch": 2}, "compute": {"channels_last": False},
    })  # fmt: skip


def _batch(side: int, seed: int) -> Batch:
    draws = torch.Generator().manual_seed(seed)
    rainy, clear = (torch.rand(2, 3, side, side, generator=draws) for _ in range(2))
    return Batch(rainy, clear, torch.ones(2, 1, side, side), (0, 1), ("a", "b"))


def step_work(
    name: str, weights: dict[str, float], side: int, base: int, seed: int, promised: bool, device: torch.device = CPU
) -> Work:
    """A few steps of ours, and of a plain loop, on a device."""
    batch, recipe = _batch(side, seed), _recipe(weights, side, base, seed)
    trainer, plain = Trainer(recipe, device), _plain(recipe, device)

    def ours() -> float:
        return next(trainer.step(batch, 0.0).losses["total"] for _ in range(STEPS))

    def theirs() -> float:
        return next(plain(batch) for _ in range(STEPS))

    first = _plain(recipe, device)(batch)
    titles = {"pixel": "Mean absolute difference alone", "adversarial": "Adversarial and discriminator-feature losses"}
    return Work(
        name, titles[name], "Generator, discriminator where there is one, Adam.",
        (Variant("plain PyTorch", theirs, lambda loss: abs(loss - first)),
         Variant("rainstereo", ours, lambda loss: abs(loss - first), True)),
        "rainstereo", "", "difference of the first loss", 2 * STEPS, "images",
        (Target("rainstereo", "plain PyTorch", round(1 / 0.95, 4)),) if promised else (),
    )  # fmt: skip


def _plain(recipe: Recipe, device: torch.device) -> Callable[[Batch], float]:
    """A loop as one would write it."""
    ours = Trainer(recipe, device)
    generator = ours.config.build().to(device)
    generator.load_state_dict(ours.generator.state_dict())
    adversarial = recipe.losses.need_discriminator
    critic = recipe.discriminator.build().to(device) if adversarial else None
    if critic is not None and ours.discriminator is not None:
        critic.load_state_dict(ours.discriminator.state_dict())
    g = torch.optim.Adam(generator.parameters(), 2e-4, (0.5, 0.999))
    d = None if critic is None else torch.optim.Adam(critic.parameters(), 2e-4, (0.5, 0.999))
    loss_of = GeneratorLoss(LossWeights(**dataclasses.asdict(recipe.losses)))
    pool = DerainedPool(50, recipe.seed)

    def step(batch: Batch) -> float:
        rainy, clear = batch.rainy.to(device), batch.clear.to(device)
        derained = generator(rainy)
        if critic is not None and d is not None:
            d.zero_grad()
            discriminator_loss(critic, clear, pool.query(derained)).backward()  # type: ignore[no-untyped-call]
            d.step()
        g.zero_grad()
        loss = loss_of(clear, derained, critic)["total"]
        loss.backward()
        g.step()
        return float(loss.detach())

    return step


def _data_work(side: int, base: int, seed: int, promised: bool) -> Work:
    folder = Path(tempfile.mkdtemp(prefix="rainstereo-bench-"))
    clear = cv2.resize(photograph("motorcycle"), (480, 360), interpolation=cv2.INTER_AREA)
    rainy = cv2.GaussianBlur(clear, (0, 0), 3)
    imagefile.write(folder / "clear.png", clear)
    imagefile.write(folder / "rainy.png", rainy)
    recipe = _recipe(PIXELS, side, base, seed)
    items = [Item("a", folder / "clear.png", (folder / "rainy.png",))]
    windows = Windows(items, recipe.data, recipe.rain, recipe.augment, seed)
    trainer, batch = Trainer(recipe, CPU), _batch(side, seed)

    def read() -> Any:
        return [collate([windows[2 * i], windows[2 * i + 1]]) for i in range(STEPS)]

    def step() -> None:
        for _ in range(STEPS):
            trainer.step(batch, 0.0)

    def error(found: Any) -> float:
        return (
            float("nan") if found is None else float(np.mean([b.rainy.isfinite().logical_not().sum() for b in found]))
        )

    return Work(
        "data", "Reading", "Pairs of 480 x 360 PNG read, cut and mirrored, beside the steps that learn from them.",
        (Variant("steps (mean absolute difference)", step, error), Variant("reading", read, error, True)),
        "reading", "", "values that are not finite", 2 * STEPS, "images",
        (Target("reading", "steps (mean absolute difference)", 1.0),) if promised else (),
    )  # fmt: skip
