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
from rainstereo.types import Array, Image

VISIBLE = 0.15
"""Opacity from which a drop counts: below, the clear scene is what one sees."""
HURTS = 16.0
"""Gray levels, on average over a cell, of a drop that counts as much in the loss as a cell without one."""
WEIGHTS = 0.1, 3.0
"""Least and most that a cell with a drop counts."""


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
    """An image, the same under rain, both uint8 BGR, and the opacity of its drops, (H, W) in 0..1."""

    clear: Image
    rainy: Image
    opacity: Array


@dataclass(frozen=True)
class Pool:
    """What is trained on. crops: (N, 3, H, W) uint8 RGB. labels: (N, 1, H / 4, W / 4), a visible drop there.
    weights: how much each of these counts; drops that one hardly sees count little."""

    crops: Tensor
    labels: Tensor
    weights: Tensor


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
        rest = Pool(pool.crops[held:], pool.labels[held:], pool.weights[held:])
        losses = _fit(network, rest, images, recipe, draws, told)
    network.eval()
    with torch.inference_mode():
        seen = network(pool.crops[:held].float() / 255).sigmoid() > 0.5
    truth = pool.labels[:held]
    tail = losses[-max(1, len(losses) // 10) :]
    return Trained(network, float(np.mean(tail)), _share(seen, truth), _share(seen, ~truth))


def _fit(
    network: DropDetector, pool: Pool, images: Sequence[Image], recipe: Recipe, draws: np.random.Generator, told: Told
) -> list[float]:
    optimizer = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.rate, recipe.steps)
    clear = round(recipe.clear_share * recipe.batch)
    losses = []
    for step in range(recipe.steps):
        chosen = torch.from_numpy(draws.integers(len(pool.crops), size=recipe.batch - clear))
        rainy, truth, weight = pool.crops[chosen].float() / 255, pool.labels[chosen].float(), pool.weights[chosen]
        if draws.random() < 0.5:
            rainy, truth, weight = rainy.flip(-1), truth.flip(-1), weight.flip(-1)
        dry = torch.stack([_as_tensor(spoiled(crop(images, recipe.size, draws), draws)) for _ in range(clear)] or [])
        batch = torch.cat([rainy, dry.float() / 255]) if clear else rainy
        truth = torch.cat([truth, torch.zeros(clear, *truth.shape[1:])])
        weight = torch.cat([weight, torch.ones(clear, *weight.shape[1:])])
        gain = torch.from_numpy(draws.uniform(0.6, 1.4, (len(batch), 1, 1, 1)).astype(np.float32))
        tint = torch.from_numpy(draws.uniform(0.9, 1.1, (len(batch), 3, 1, 1)).astype(np.float32))
        noise = torch.from_numpy((draws.random() * 0.02 * draws.standard_normal(batch.shape)).astype(np.float32))
        logits = network((batch * gain * tint + noise).clamp(0, 1))
        loss = functional.binary_cross_entropy_with_logits(logits, truth, weight)
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
        if rain.layer is None:
            raise RuntimeError("the rain left no layer")
        found.append(_labelled(clear, (255 * rainy[0]).round().clamp(0, 255).to(torch.uint8), rain.layer.opacity[0]))
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
        opacity = np.rint(255 * given.opacity).astype(np.uint8)
        whole = np.dstack([given.clear, given.rainy, opacity])
        part = crop([whole], size, draws)
        clear, rainy, drops = part[..., :3], part[..., 3:6], part[..., 6]
        found.append(_labelled(_as_tensor(clear), _as_tensor(rainy), torch.from_numpy(drops / np.float32(255))[None]))
        told("reading", number + 1, count)
    return _pooled(found)


def _labelled(clear: Tensor, rainy: Tensor, opacity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A crop, which of its cells hold a visible drop, and what each of them counts."""
    label = functional.max_pool2d(opacity[None], OWN, ceil_mode=True)[0] > VISIBLE
    change = (rainy.float() - clear.float()).abs().mean(0, keepdim=True)
    hurts = functional.avg_pool2d(change[None], OWN, ceil_mode=True)[0] / HURTS
    return rainy, label, torch.where(label, hurts.clamp(*WEIGHTS), 1.0)


def _pooled(found: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Pool:
    crops, labels, weights = zip(*found, strict=True)
    return Pool(torch.stack(crops), torch.stack(labels), torch.stack(weights))


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


def _share(marked: Tensor, among: Tensor) -> float:
    return float(marked[among].float().mean()) if bool(among.any()) else float("nan")
