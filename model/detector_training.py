"""Trains the drop detector: clear images, rain rendered on them by this toolkit, and what restoring mends as truth.

A cell's label is what it is worth to restore it: by how much the mean square error of its pixels falls, over a fall
from which more counts no further; below zero where restoring makes it worse. Where no restored images are given, all
that the rain changed counts as mended. So the network's answer is the gain to expect, and what one hardly sees need not
be found, nor what would not come out better. Each step cuts
crops of images under rain anew, at every scale at which images are looked at, and alters them: of some, the rain is
left in a band only, as a wiper leaves it; some are gray, some compressed. A share of the batch is clear: sharp,
blurred, noisy or compressed, so that blur alone is not taken for a drop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from rainstereo.model.augment import RandomAdherentRain
from rainstereo.model.detector import OWN, THRESHOLD, DetectorConfig, DropDetector
from rainstereo.types import Image

MUCH = 24.0
"""Gray levels, RMS over a cell, of an error whose removal is all that a cell can be worth."""
WORST = -0.3
"""What a cell is worth, at least."""
NONE = 0.01
"""Worth below which a cell is as good as clear."""
BANDS, GRAY, COMPRESSED, LEAST = 0.35, 0.15, 0.3, 0.35
"""Shares of crops that have rain in a band only, are gray, are compressed, and are averaged down as far as they go."""


@dataclass(frozen=True)
class Recipe:
    """How long, on what. size: (height, width) of the crops, in pixels of the averaged image: half the least images
    that are used. pool: images under rain that are kept."""

    steps: int = 4000
    batch: int = 8
    pool: int = 2500
    size: tuple[int, int] = (176, 240)
    rate: float = 2e-3
    clear_share: float = 0.3
    seed: int = 0


@dataclass(frozen=True)
class Rained:
    """An image, the same under rain, and that restored, if known; all uint8 BGR."""

    clear: Image
    rainy: Image
    restored: Image | None = None


@dataclass(frozen=True)
class Trained:
    """The network; the mean loss of the last tenth of the steps; and of held-out crops, with what is above `THRESHOLD`
    marked: which share of all that can be gained is in marked cells, and which share of cells without any is marked,
    too."""

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

    rains: rain to put on parts of these images; or in its place images under rain, of which any number is asked for.
    told: what is being done, how much of it is done, of how much. start: a network to go on with; it is changed.
    The same seed gives the same network on one machine.
    """
    recipe, config = recipe or Recipe(), config or DetectorConfig()
    if not images or not rains:
        raise ValueError("no clear images, or no rain, were given; expected at least one of each")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        draws = np.random.default_rng(recipe.seed)
        pool, doing = [], "reading" if callable(rains) else "rendering"
        for number in range(recipe.pool):
            pool.append(rains(number) if callable(rains) else rendered(images, rains, number, recipe.size, draws))
            told(doing, number + 1, recipe.pool)
        held = max(1, len(pool) // 16)
        network = cast(Any, (start or config.build()).train()).to(memory_format=torch.channels_last)
        losses = _fit(network, pool[held:] or pool, images, recipe, draws, told)
        seen = [cut(one, recipe.size, draws) for one in pool[:held]]
    network.eval()
    with torch.inference_mode():
        marked = network(torch.stack([rainy for rainy, _ in seen])).sigmoid() > THRESHOLD
    worth = worth_of(torch.stack([gain for _, gain in seen]))
    tail = losses[-max(1, len(losses) // 10) :]
    return Trained(
        network, float(np.mean(tail)), _share(marked, worth.clamp(0)), _share(marked, (worth < NONE).float())
    )


def _fit(
    network: DropDetector, pool: Sequence[Rained], images: Sequence[Image], recipe: Recipe,
    draws: np.random.Generator, told: Told,
) -> list[float]:  # fmt: skip
    optimizer = torch.optim.AdamW(network.parameters(), recipe.rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.rate, recipe.steps)
    clear = round(recipe.clear_share * recipe.batch)
    losses = []
    for step in range(recipe.steps):
        chosen = draws.integers(len(pool), size=recipe.batch - clear)
        made = [cut(pool[i], recipe.size, draws, altered=True) for i in chosen]
        dry = [as_tensor(spoiled(crop(images, recipe.size, draws), draws)) for _ in range(clear)]
        batch = torch.stack([rainy for rainy, _ in made] + dry)
        gain = torch.stack([gain for _, gain in made])
        gain = torch.cat([gain, gain.new_zeros(clear, *gain.shape[1:])])
        light = torch.from_numpy(draws.uniform(0.6, 1.4, (len(batch), 1, 1, 1)).astype(np.float32))
        tint = torch.from_numpy(draws.uniform(0.9, 1.1, (len(batch), 3, 1, 1)).astype(np.float32))
        noise = torch.from_numpy(draws.standard_normal(batch.shape, np.float32)) * float(0.02 * draws.random())
        logits = network((batch * light * tint + noise).clamp(0, 1).contiguous(memory_format=torch.channels_last))
        loss = functional.binary_cross_entropy_with_logits(logits, worth_of(gain * light.square()))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
        losses.append(float(loss.detach()))
        told("training", step + 1, recipe.steps)
    return losses


def rendered(
    images: Sequence[Image], rains: Sequence[RandomAdherentRain], number: int, size: tuple[int, int],
    draws: np.random.Generator,
) -> Rained:  # fmt: skip
    """Rain on a part of an image, up to twice as large as crops are."""
    most = min(2.0, *(min(im.shape[0] / size[0], im.shape[1] / size[1]) for im in images))
    clear = crop(images, (int(most * size[0]), int(most * size[1])), draws) if most >= 1 else crop(images, size, draws)
    if number % 4 == 3:
        clear = spoiled(clear, draws)
    rainy = rains[number % len(rains)](as_tensor(clear).unsqueeze(0))[0]
    levels = (255 * rainy).round().clamp(0, 255).byte().flip(0).permute(1, 2, 0)
    return Rained(np.ascontiguousarray(clear), np.ascontiguousarray(levels.numpy()))


def cut(
    given: Rained, size: tuple[int, int], draws: np.random.Generator, altered: bool = False
) -> tuple[Tensor, Tensor]:
    """A crop under rain, (3, H, W) RGB in 0..1, and what restoring gains in each of its cells, levels squared.

    altered: some have rain in a band only, some are gray, some compressed.
    """
    better = given.clear if given.restored is None else given.restored
    clear, rainy, better = same_part([given.clear, given.rainy, better], size, draws)
    if altered and draws.random() < BANDS:
        rainy, better = banded(clear, [rainy, better], draws)
    if altered and draws.random() < GRAY:
        clear, rainy, better = grayed(clear), grayed(rainy), grayed(better)
    before, after = (np.square(cv2.absdiff(clear, one), dtype=np.float32) for one in (rainy, better))
    if altered and draws.random() < COMPRESSED:
        rainy = compressed(rainy, draws)
    cells = functional.avg_pool2d(torch.from_numpy((before - after).mean(2))[None, None], OWN, ceil_mode=True)[0]
    return as_tensor(rainy), cells


def banded(clear: Image, others: Sequence[Image], draws: np.random.Generator) -> list[Image]:
    """Each of the others in a band of the image only, upright or level; the rest is clear."""
    axis = int(draws.integers(2))
    length = clear.shape[axis]
    wide = int(length * draws.uniform(0.1, 0.6))
    first = int(draws.integers(-wide // 2, length - wide // 2))
    where = slice(max(0, first), max(0, first + wide))
    part = (where, slice(None)) if axis == 0 else (slice(None), where)
    found = [clear.copy() for _ in others]
    for one, other in zip(found, others, strict=True):
        one[part] = other[part]
    return found


def worth_of(gain: Tensor) -> Tensor:
    """Of what restoring gains, levels squared: 1 at most."""
    return (gain / MUCH**2).clamp(WORST, 1)


def crop(images: Sequence[Image], size: tuple[int, int], draws: np.random.Generator) -> Image:
    """A part of one of the images, between the crop's own size and the whole, averaged down to that size; mirrored."""
    return same_part([images[int(draws.integers(len(images)))]], size, draws)[0]


def same_part(images: Sequence[Image], size: tuple[int, int], draws: np.random.Generator) -> list[Image]:
    """The same part of each of these images, as `crop` takes it."""
    height, width = images[0].shape[:2]
    most = min(height / size[0], width / size[1])
    if most < 1:
        raise ValueError(f"an image has {width} x {height} pixels; expected at least {size[1]} x {size[0]}")
    scale = most if draws.random() < LEAST else draws.uniform(1, most)
    rows, columns = int(scale * size[0]), int(scale * size[1])
    top, left = int(draws.integers(height - rows + 1)), int(draws.integers(width - columns + 1))
    mirrored = draws.random() < 0.5
    found = []
    for image in images:
        part = image[top : top + rows, left : left + columns]
        small = cv2.resize(part, size[::-1], interpolation=cv2.INTER_AREA)
        found.append(cv2.flip(small, 1) if mirrored else small)
    return cast(list[Image], found)


def spoiled(image: Image, draws: np.random.Generator) -> Image:
    """The image as a poor camera might have taken it: sharp, out of focus, shaken or compressed; some gray."""
    kind = int(draws.integers(4))
    if draws.random() < GRAY:
        image = grayed(image)
    if kind == 1:
        return np.asarray(cv2.GaussianBlur(image, (0, 0), draws.uniform(0.5, 3)))
    if kind == 2:
        length = int(draws.integers(2, 12))
        return np.asarray(cv2.blur(image, (length, 1)))
    return compressed(image, draws) if kind == 3 else image


def grayed(image: Image) -> Image:
    """Without colour, of three channels."""
    return np.asarray(cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR))


def compressed(image: Image, draws: np.random.Generator) -> Image:
    """The image, from a JPEG file."""
    data = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, int(draws.integers(20, 95))])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR))


def as_tensor(image: Image) -> Tensor:
    """(H, W, 3) uint8 BGR -> (3, H, W) RGB in 0..1."""
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))).float() / 255


def _share(marked: Tensor, of: Tensor) -> float:
    """Which share of something, by cell, is in marked ones."""
    return float(of[marked].sum() / of.sum()) if bool(of.any()) else float("nan")
