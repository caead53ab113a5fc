"""Trains the drop detector: clear images, rain rendered on them by this toolkit, and the renderer's own masks as truth.

A pool of rainy crops is rendered once; each step draws a batch of them, turned and recoloured anew. A share of the
batch is clear: sharp, blurred, noisy or compressed, so that blur alone is not taken for a drop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rainstereo.model.augment import RandomAdherentRain
from rainstereo.model.detector import OWN, DetectorConfig, DropDetector
from rainstereo.types import Image

VISIBLE = 0.15
"""Opacity from which a drop counts: below, the clear scene is what one sees."""


@dataclass(frozen=True)
class Recipe:
    """How long, on what. size: (height, width) of the crops, in pixels of the averaged image. pool: rainy crops."""

    steps: int = 1500
    batch: int = 16
    pool: int = 640
    size: tuple[int, int] = (192, 256)
    rate: float = 2e-3
    clear_share: float = 0.3
    seed: int = 0


@dataclass(frozen=True)
class Trained:
    """The network; the mean loss of the last tenth of the steps; and of cells of held-out crops: which share of those
    with a drop is found, and which share of those without one is marked all the same."""

    network: DropDetector
    loss: float
    found: float
    false: float


Told = Callable[[str, int, int], None]


def train(
    images: Sequence[Image],
    rains: Sequence[RandomAdherentRain],
    recipe: Recipe | None = None,
    config: DetectorConfig | None = None,
    told: Told = lambda what, done, total: None,
) -> Trained:
    """Train on clear images, uint8 BGR, all larger than the crops; rains are drawn from evenly.

    told: what is being done, how much of it is done, of how much. The same seed gives the same network on one machine.
    """
    recipe, config = recipe or Recipe(), config or DetectorConfig()
    if not images or not rains:
        raise ValueError("no clear images, or no rain, were given; expected at least one of each")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        draws = np.random.default_rng(recipe.seed)
        pool, labels = rendered(images, rains, recipe.pool, recipe.size, draws, told)
        held = max(1, len(pool) // 16)
        network = config.build().train()
        losses = _fit(network, pool[held:], labels[held:], images, recipe, draws, told)
    network.eval()
    with torch.inference_mode():
        seen = network(pool[:held].float() / 255).sigmoid() > 0.5
    truth = labels[:held]
    tail = losses[-max(1, len(losses) // 10) :]
    return Trained(network, float(np.mean(tail)), _share(seen, truth), _share(seen, ~truth))


def _fit(
    network: DropDetector, pool: Tensor, labels: Tensor, images: Sequence[Image], recipe: Recipe,
    draws: np.random.Generator, told: Told,
) -> list[float]:  # fmt: skip
    optimizer = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.rate, recipe.steps)
    clear = round(recipe.clear_share * recipe.batch)
    losses = []
    for step in range(recipe.steps):
        chosen = torch.from_numpy(draws.integers(len(pool), size=recipe.batch - clear))
        rainy, truth = pool[chosen].float() / 255, labels[chosen].float()
        if draws.random() < 0.5:
            rainy, truth = rainy.flip(-1), truth.flip(-1)
        dry = torch.stack([_as_tensor(spoiled(crop(images, recipe.size, draws), draws)) for _ in range(clear)] or [])
        batch = torch.cat([rainy, dry.float() / 255]) if clear else rainy
        truth = torch.cat([truth, torch.zeros(clear, *truth.shape[1:])])
        gain = torch.from_numpy(draws.uniform(0.6, 1.4, (len(batch), 1, 1, 1)).astype(np.float32))
        tint = torch.from_numpy(draws.uniform(0.9, 1.1, (len(batch), 3, 1, 1)).astype(np.float32))
        noise = torch.from_numpy((draws.random() * 0.02 * draws.standard_normal(batch.shape)).astype(np.float32))
        logits = network((batch * gain * tint + noise).clamp(0, 1))
        loss = functional.binary_cross_entropy_with_logits(logits, truth)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        told("training", step + 1, recipe.steps)
    return losses


def rendered(
    images: Sequence[Image], rains: Sequence[RandomAdherentRain], count: int, size: tuple[int, int],
    draws: np.random.Generator, told: Told = lambda what, done, total: None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Rainy crops, (count, 3, H, W) uint8 RGB, and labels, (count, 1, H / 4, W / 4): a visible drop there."""
    pool, labels = [], []
    for number in range(count):
        clear = _as_tensor(spoiled(crop(images, size, draws), draws) if number % 4 == 3 else crop(images, size, draws))
        rain = rains[number % len(rains)]
        rainy = rain(clear.float().unsqueeze(0) / 255)
        if rain.layer is None:
            raise RuntimeError("the rain left no layer")
        pool.append((255 * rainy[0]).round().clamp(0, 255).to(torch.uint8))
        labels.append(functional.max_pool2d(rain.layer.opacity, OWN, ceil_mode=True)[0] > VISIBLE)
        told("rendering", number + 1, count)
    return torch.stack(pool), torch.stack(labels)


def crop(images: Sequence[Image], size: tuple[int, int], draws: np.random.Generator) -> Image:
    """A part of one of the images, between the crop's own size and the whole, averaged down to that size; mirrored."""
    image = images[int(draws.integers(len(images)))]
    height, width = image.shape[:2]
    most = min(height / size[0], width / size[1])
    if most < 1:
        raise ValueError(f"an image has {width} x {height} pixels; expected at least {size[1]} x {size[0]}")
    scale = draws.uniform(1, most)
    rows, columns = int(scale * size[0]), int(scale * size[1])
    top, left = int(draws.integers(height - rows + 1)), int(draws.integers(width - columns + 1))
    part = image[top : top + rows, left : left + columns]
    part = part[:, ::-1] if draws.random() < 0.5 else part
    found: Image = cv2.resize(np.ascontiguousarray(part), size[::-1], interpolation=cv2.INTER_AREA)
    return found


def spoiled(image: Image, draws: np.random.Generator) -> Image:
    """The image as a poor camera might have taken it: sharp, out of focus, shaken or compressed."""
    kind = int(draws.integers(4))
    if kind == 1:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), draws.uniform(0.5, 3)))
    if kind == 2:
        length = int(draws.integers(2, 12))
        return np.asarray(cv2.blur(image, (length, 1)))
    if kind == 3:
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(draws.integers(20, 90))])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))
    return image


def _as_tensor(image: Image) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1)))


def _share(marked: Tensor, among: Tensor) -> float:
    return float(marked[among].float().mean()) if bool(among.any()) else float("nan")
