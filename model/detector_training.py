"""Trains the drop detector: clear images, rain rendered on them by this toolkit, and what the rain changed as truth.

A cell's label is the harm done to it: the mean square change of its pixels, over that from which more counts no
further. So the network's answer is the harm to expect, and what one hardly sees need not be found. A pool of rainy
crops is rendered once; each step draws a batch of them, turned and recoloured anew. A share of the batch is clear:
sharp, blurred, noisy or compressed, so that blur alone is not taken for a drop.
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
from rainstereo.model.detector import OWN, THRESHOLD, DetectorConfig, DropDetector
from rainstereo.types import Image

HURTS = 24.0
"""Gray levels, RMS over a cell, of a change that is all the harm that a drop can do."""
NONE = 0.01
"""Harm below which a cell is as good as clear."""


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
class Rained:
    """An image, and the same under rain, both uint8 BGR."""

    clear: Image
    rainy: Image


@dataclass(frozen=True)
class Pool:
    """What is trained on. crops: (N, 3, H, W) uint8 RGB. labels: (N, 1, H / 4, W / 4), the harm there in 0..1."""

    crops: Tensor
    labels: Tensor


@dataclass(frozen=True)
class Trained:
    """The network; the mean loss of the last tenth of the steps; and of held-out crops, with what is above `THRESHOLD`
    marked: which share of all harm is in marked cells, and which share of cells without any is marked all the same."""

    network: DropDetector
    loss: float
    found: float
    false: float


Told = Callable[[str, int, int], None]


def train(
    images: Sequence[Image],
    rains: Sequence[RandomAdherentRain] | Callable[[int], Rained],
    recipe: Recipe | None = None,
    config: DetectorConfig | None = None,
    told: Told = lambda what, done, total: None,
    start: DropDetector | None = None,
) -> Trained:
    """Train on clear images, uint8 BGR, all larger than the crops; rains are drawn from evenly.

    rains: rain to put on crops of these images; or in its place images under rain, of which any number is asked for.
    told: what is being done, how much of it is done, of how much. start: a network to go on with; it is changed.
    The same seed gives the same network on one machine.
    """
    recipe, config = recipe or Recipe(), config or DetectorConfig()
    if not images or not rains:
        raise ValueError("no clear images, or no rain, were given; expected at least one of each")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        draws = np.random.default_rng(recipe.seed)
        if callable(rains):
            pool = cut(rains, recipe.pool, recipe.size, draws, told)
        else:
            pool = rendered(images, rains, recipe.pool, recipe.size, draws, told)
        held = max(1, len(pool.crops) // 16)
        network = (start or config.build()).train()
        rest = Pool(pool.crops[held:], pool.labels[held:])
        losses = _fit(network, rest, images, recipe, draws, told)
    network.eval()
    with torch.inference_mode():
        seen = network(pool.crops[:held].float() / 255).sigmoid() > THRESHOLD
    harm = pool.labels[:held]
    tail = losses[-max(1, len(losses) // 10) :]
    return Trained(network, float(np.mean(tail)), _share(seen, harm), _share(seen, (harm < NONE).float()))


def _fit(
    network: DropDetector, pool: Pool, images: Sequence[Image], recipe: Recipe, draws: np.random.Generator, told: Told
) -> list[float]:
    optimizer = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.rate, recipe.steps)
    clear = round(recipe.clear_share * recipe.batch)
    losses = []
    for step in range(recipe.steps):
        chosen = torch.from_numpy(draws.integers(len(pool.crops), size=recipe.batch - clear))
        rainy, truth = pool.crops[chosen].float() / 255, pool.labels[chosen]
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
) -> Pool:  # fmt: skip
    """Crops of clear images on which rain is put."""
    found = []
    for number in range(count):
        clear = _as_tensor(spoiled(crop(images, size, draws), draws) if number % 4 == 3 else crop(images, size, draws))
        rain = rains[number % len(rains)]
        rainy = rain(clear.float().unsqueeze(0) / 255)
        found.append(_labelled(clear, (255 * rainy[0]).round().clamp(0, 255).to(torch.uint8)))
        told("rendering", number + 1, count)
    return _pooled(found)


def cut(
    rained: Callable[[int], Rained], count: int, size: tuple[int, int], draws: np.random.Generator,
    told: Told = lambda what, done, total: None,
) -> Pool:  # fmt: skip
    """Crops of images that are under rain already."""
    found = []
    for number in range(count):
        given = rained(number)
        part = crop([np.dstack([given.clear, given.rainy])], size, draws)
        found.append(_labelled(_as_tensor(part[..., :3]), _as_tensor(part[..., 3:])))
        told("reading", number + 1, count)
    return _pooled(found)


def _labelled(clear: Tensor, rainy: Tensor) -> tuple[Tensor, Tensor]:
    """A crop, and the harm done to each of its cells."""
    change = (rainy.float() - clear.float()).square().mean(0, keepdim=True)
    hurts = functional.avg_pool2d(change[None], OWN, ceil_mode=True)[0] / HURTS**2
    return rainy, hurts.clamp(max=1)


def _pooled(found: Sequence[tuple[Tensor, Tensor]]) -> Pool:
    crops, labels = zip(*found, strict=True)
    return Pool(torch.stack(crops), torch.stack(labels))


def crop(images: Sequence[Image], size: tuple[int, int], draws: np.random.Generator) -> Image:
    """A part of one of the images, between the crop's own size and the whole, averaged down to that size; mirrored.
    Images may have any number of channels."""
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
    layers = [part[..., first : first + 3] for first in range(0, part.shape[2], 3)]  # OpenCV takes 4 at most
    small = [cv2.resize(np.ascontiguousarray(layer), size[::-1], interpolation=cv2.INTER_AREA) for layer in layers]
    return small[0] if len(small) == 1 else np.dstack(small)


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


def _share(marked: Tensor, of: Tensor) -> float:
    """Which share of something, by cell, is in marked ones."""
    return float(of[marked].sum() / of.sum()) if bool(of.any()) else float("nan")
