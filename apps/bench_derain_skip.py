"""Of benchmark stage `derain`: what it saves, and costs, to leave what is clear, and what was seen before, as it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.bench_harness import Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.apps.rain_presets import preset
from rainstereo.apps.rain_settings import Rain, psnr
from rainstereo.model import detector
from rainstereo.model.detector import CELL, CERTAIN, THRESHOLD, Detector
from rainstereo.model.frame_sequence import FrameSequence
from rainstereo.model.networks import Network
from rainstereo.model.restore import CELLS_HALO, Restored, Restorer
from rainstereo.types import Array, Image, Mask

if TYPE_CHECKING:
    from torch import Tensor

    from rainstereo.model.cell_generator import CellGenerator

TENTH = 0.1
"""Share of a frame that drops cover in the middle cases."""
HEAVY = 0.6
VISIBLE = 0.15
MANY = 4
SECONDS = 8
"""Frames of the videos."""
PAIRS = ((0.02, 0.06), (0.03, 0.1), (0.03, 0.15), (0.04, 0.25), (0.05, 0.3), (0.1, 0.6))
"""Thresholds that are compared: of cells that are restored if computed, and of squares that are computed."""


@dataclass(frozen=True)
class View:
    """A scene clear, with drops on a tenth of the frame, scattered or in one place, and with drops all over.

    drops: cells in which the scattered ones are, as the renderer knows.
    """

    clear: Image
    scattered: Image
    together: Image
    full: Image
    drops: Mask


def views(size: tuple[int, int], seed: int, images: Path | None, quick: bool) -> list[View]:
    """Scenes of (width, height): of the images in a folder, evenly over it, or of one photograph, rained on anew."""
    many = 1 if quick else MANY
    if images is None:
        scenes = [photograph("motorcycle")] * many
    else:
        paths = [p for p in sorted(images.iterdir()) if p.suffix.lower() in imagefile.SUFFIXES]
        if not paths:
            raise ValueError(f"--images {images} holds no images; expected a folder of photographs")
        scenes = [imagefile.read(paths[i]) for i in np.linspace(0, len(paths) - 1, many).round().astype(int)]
    return [_view(scene, size, seed, f"bench {i}") for i, scene in enumerate(scenes)]


def _view(scene: Image, size: tuple[int, int], seed: int, name: str) -> View:
    clear: Image = np.ascontiguousarray(cv2.resize(scene, size, interpolation=cv2.INTER_AREA))
    scattered, drops = _rained(clear, TENTH, seed, name)
    full, opacity = _rained(clear, HEAVY, seed, name)
    # the same rain where a wiper left it: a band of the frame, as wide as a tenth of all pixels under drops takes
    shares = np.cumsum(opacity.sum(0)) / opacity.size
    edge = int(np.searchsorted(shares, TENTH))
    together = clear.copy()
    together[:, :edge] = full[:, :edge]
    return View(clear, scattered, together, full, _cells(drops))


def _rained(clear: Image, cover: float, seed: int, name: str) -> tuple[Image, Array]:
    law = preset("camvid")
    plan, _ = Rain(replace(law, population=law.population.with_cover(cover)), seed).plan(clear, name)
    return plan.apply(clear), plan.opacity


def _cells(opacity: Array) -> Mask:
    down, right = -opacity.shape[0] % CELL, -opacity.shape[1] % CELL
    wide = np.pad(opacity, ((0, down), (0, right)))
    found: Mask = wide.reshape(wide.shape[0] // CELL, CELL, -1, CELL).max((1, 3)) > VISIBLE
    return found


def _all(restore: Callable[[Image], Image], images: Sequence[Image]) -> list[Image]:
    return [restore(image) for image in images]


@dataclass(frozen=True)
class _Lost:
    """dB that are lost against computing everything; where nothing is wrong, 99 dB are reached."""

    views: Sequence[View]
    at_best: list[float]

    @classmethod
    def against(cls, whole: Restorer, views: Sequence[View], images: Sequence[Image]) -> _Lost:
        return cls(views, [min(psnr(v.clear, whole(image)), 99.0) for v, image in zip(views, images, strict=True)])

    def each(self, found: Sequence[Image]) -> Array:
        reached = [min(psnr(v.clear, image), 99.0) for v, image in zip(self.views, found, strict=True)]
        return np.asarray(self.at_best) - reached

    def mean(self, found: Sequence[Image]) -> float:
        return float(self.each(found).mean())

    def also(self, shares: dict[str, float], found: Sequence[Image]) -> dict[str, float]:
        """With the loss of the worst frame."""
        return {"lost at worst, dB": float(self.each(found).max()), **shares}


def _shares(found: Sequence[Restored]) -> dict[str, float]:
    marked, computed = (np.mean([getattr(one, name) for one in found]) for name in ("marked", "computed"))
    return {"marked, %": 100 * float(marked), "computed, %": 100 * float(computed)}


ALL = {"lost at worst, dB": 0.0, "marked, %": 100.0, "computed, %": 100.0}
"""Where everything is computed."""


def skip_work(shipped: Network, views: list[View], promised: bool) -> Work:
    """Frames under less and less rain."""
    whole, skipping = Restorer(network=shipped, skip=False), Restorer(network=shipped)
    everything = "drops all over, nothing skipped"
    cases = {
        "no drops": [v.clear for v in views], "a tenth, in one place": [v.together for v in views],
        "a tenth, scattered": [v.scattered for v in views], "drops all over": [v.full for v in views],
    }  # fmt: skip
    run = partial(_all, whole, cases["drops all over"])
    variants = [Variant(everything, run, lambda _: 0.0, also=lambda _: ALL, note="full-drop frame")]
    for name, images in cases.items():
        shares = _shares([skipping.restored(image) for image in images])
        lost = _Lost.against(whole, views, images)
        run = partial(_all, skipping, images)
        variants.append(Variant(name, run, lost.mean, True, also=partial(lost.also, shares)))
    targets = [Target("no drops", everything, 0.1)]
    targets += [Target(name, everything, 0.5) for name in ("a tenth, in one place", "a tenth, scattered")]
    return Work(
        "skip", "What is clear is skipped",
        "Frames under less and less rain. The error is what skipping loses in PSNR against computing everything; "
        "below zero, leaving clear cells as they are is better.",
        tuple(variants), "no drops", "dB", "PSNR lost against no skipping", len(views), "frames",
        tuple(targets) if promised else (),
    )  # fmt: skip


def curve_work(shipped: Network, views: list[View], quick: bool) -> Work:
    """Quality against time over the way, the halo and the thresholds, on scattered drops."""
    images, whole = [v.scattered for v in views], Restorer(network=shipped, skip=False)
    lost, weights = _Lost.against(whole, views, images), detector.load(detector.shipped())
    variants = [Variant("everything", partial(_all, whole, images), lost.mean, also=lambda _: ALL)]

    def add(name: str, made: Restorer) -> None:
        shares = _shares([made.restored(image) for image in images])
        also = partial(lost.also, shares)
        variants.append(Variant(name, partial(_all, made, images), lost.mean, True, also=also))

    default = f"halo {CELLS_HALO}, thresholds {THRESHOLD:g}, {CERTAIN:g}: the defaults"
    add(default, Restorer(network=shipped))
    for halo in (32,) if quick else (32, 64):
        add(f"halo {halo}", Restorer(network=shipped, halo=halo))
    add("cells around never looked at", Restorer(network=shipped, around=0.0))
    add("cells around always looked at", Restorer(network=shipped, around=9.0))
    for halo in (32,) if quick else (0, 32):
        add(f"in rectangles, halo {halo}", Restorer(network=_Rectangles(shipped), halo=halo))
    for low, high in PAIRS[:1] if quick else PAIRS:
        if (low, high) != (THRESHOLD, CERTAIN):
            found = Detector(weights, "cpu", low, high)
            add(f"thresholds {low:g}, {high:g}", Restorer(network=shipped, detector=found))
    add("no square need be evident", Restorer(network=shipped, evident=0.0))
    made = Restorer(network=shipped)
    told = [made.with_cells(v.scattered, v.drops) for v in views]
    variants.append(Variant(
        "cells with drops, if known", lambda: [made.with_cells(v.scattered, v.drops).image for v in views], lost.mean,
        True, "no detector: as the renderer knows", also=partial(lost.also, _shares(told)),
    ))  # fmt: skip
    return Work(
        "curve", "Halo and thresholds, by what they cost",
        "A tenth of the frame under scattered drops. What is not named is the default.",
        tuple(variants), default, "dB", "PSNR lost against no skipping", len(views), "frames",
    )  # fmt: skip


class _Rectangles:
    """A network that cannot compute single cells."""

    def __init__(self, network: Network) -> None:
        self.cells: CellGenerator | None = None
        self.device, self.name = network.device, network.name
        self.multiple, self.halo, self.local = network.multiple, network.halo, network.local
        self.run = network

    def __call__(self, images: Tensor) -> Tensor:
        return self.run(images)


def video_works(shipped: Network, view: View, seed: int) -> list[Work]:
    """Drops that stand still on the pane of a camera that stands, and of one that moves past the scene."""
    draws = np.random.default_rng(seed)
    height, width = view.clear.shape[:2]
    law = preset("camvid")
    plan, _ = Rain(replace(law, population=law.population.with_cover(TENTH)), seed).plan(view.clear, "video")
    wide = cv2.resize(view.clear, None, fx=1.25, fy=1.25, interpolation=cv2.INTER_CUBIC)
    moving = [np.ascontiguousarray(wide[4:][:height, 2 * i : 2 * i + width]) for i in range(SECONDS)]
    made = Restorer(network=shipped)
    found = []
    for name, title, scenes in (
        ("stands", "A camera that stands", [view.clear] * SECONDS),
        ("moves", "A camera that moves", moving),
    ):
        rainy = [plan.apply(scene) for scene in scenes]
        drive = [np.clip(np.rint(r + draws.normal(0, 1, r.shape)), 0, 255).astype(np.uint8) for r in rainy]
        found.append(_video_work(name, title, made, scenes, drive))
    return found


def _video_work(name: str, title: str, made: Restorer, scenes: list[Image], drive: list[Image]) -> Work:
    def run(every: int, reuse: float | None) -> list[Image]:
        sequence = FrameSequence(made, every=every, reuse=reuse)
        return [sequence(frame).image for frame in drive]

    alone = run(1, None)
    at_best = np.mean([psnr(a, b) for a, b in zip(scenes, alone, strict=True)])

    def lost(found: list[Image]) -> float:
        return float(at_best - np.mean([psnr(a, b) for a, b in zip(scenes, found, strict=True)]))

    def also(found: list[Image]) -> dict[str, float]:
        difference = [np.abs(a.astype(float) - b) for a, b in zip(found, alone, strict=True)]
        return {
            "largest difference, gray levels": float(np.max(difference)),
            "RMS difference, gray levels": float(np.sqrt(np.mean(np.square(difference)))),
        }

    variants = [Variant("each frame for itself", partial(run, 1, None), lost, True, every=3, also=also)]
    variants += [Variant("detector every 4th frame", partial(run, 4, None), lost, True, every=3, also=also)]
    for levels in (4, 8, 16):
        again = partial(run, 1, float(levels))
        variants.append(Variant(f"reuse within {levels} gray levels", again, lost, True, every=3, also=also))
    return Work(
        name, title,
        f"{len(drive)} frames with 1 gray level of noise, a tenth under scattered drops that stay where they are. "
        + ("Nothing in the scene moves." if name == "stands" else "The scene moves by 2 pixels a frame.")
        + " Differences are those to each frame for itself.",
        tuple(variants), "each frame for itself", "dB", "PSNR lost against each frame for itself", len(drive), "frames",
    )  # fmt: skip
