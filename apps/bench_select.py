"""Benchmark stage `select`: what measuring a pair costs beside reading it, and how right the drop cover is."""

from __future__ import annotations

import atexit
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.apps.rain_presets import preset
from rainstereo.apps.rain_settings import Rain
from rainstereo.rain.appearance import Exposure, dissimilarity
from rainstereo.selection.candidate import Candidate, Measures
from rainstereo.selection.drop_cover import HIDDEN, drop_cover
from rainstereo.selection.farthest_point import farthest_points
from rainstereo.selection.measure import measure_run
from rainstereo.selection.perceptual_hash import Hashes, nearest
from rainstereo.types import Array, Image

SCENES = ("motorcycle", "coffee", "rocket", "chelsea")
COVERS = (0.0, 0.05, 0.15, 0.3)
PARALLAX = 8.0
"""Pixels at the foot of an image, none above the middle."""
DIFFERENT = 25
"""Gray levels from which a plain difference counts: of 15, 25 and 40 the best."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A pair and the share of its wet image that drops more than half hide."""

    dry: Image
    wet: Image
    cover: float


def build(seed: int, quick: bool) -> Stage:
    """The stage at 1280x960, or 320x240 if `quick`."""
    size = (320, 240) if quick else (1280, 960)
    scenes = [_scene(name, cover, size, seed + i) for i, (name, cover) in enumerate(zip(SCENES, COVERS, strict=True))]
    return Stage(
        "select",
        "choosing pairs",
        f"Pairs of {size[0]}x{size[1]} colour images are measured once, from their files; the choice itself needs only "
        "their numbers and hashes.",
        (_cover_work(scenes), _pair_work(scenes, not quick), _choice_work(seed, quick)),
        {
            "pairs": f"photographs from scikit-image; wet: rendered drops (preset `drops`, F/5, covers {COVERS}), then "
            f"gain 0.85, offset 8, parallax up to {PARALLAX:g} px at 1280, noise of 2 gray levels",
            "truth": "share of pixels that the renderer hides by more than half",
            "seed": seed,
        },
        (
            "Few photographs: docs/select.md has the error over 37 street scenes.",
            "A drop that shows what it hides, such as sky before sky, is not seen by any of these.",
        ),
    )  # fmt: skip


def _scene(name: str, cover: float, size: tuple[int, int], seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    clear: Image = cv2.resize(photograph(name), size, interpolation=cv2.INTER_AREA)
    wet: Image = clear
    opacity: Image = np.zeros(clear.shape[:2], np.float32)
    if cover:
        setup = preset("drops")
        rain = Rain(replace(setup, population=setup.population.with_cover(cover)), seed=seed, tolerance=math.inf)
        plan = rain.renderer(size).plan(rain.drops(name, size))
        wet, opacity = plan.apply(clear), plan.opacity.astype(np.float32)
    rows, columns = np.indices(clear.shape[:2], dtype=np.float32)
    moved = columns + np.maximum(2 * rows / size[1] - 1, 0) * np.float32(PARALLAX * size[0] / 1280)
    wet, opacity = (cv2.remap(i, moved, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for i in (wet, opacity))
    noisy = [i + rng.normal(0, 2, i.shape) for i in (clear, 0.85 * wet + 8)]
    dry, wet = (np.clip(i, 0, 255).astype(np.uint8) for i in noisy)
    return Scene(dry, wet, float((opacity > 0.5).mean()))


def _cover_work(scenes: Sequence[Scene]) -> Work:
    truth = np.array([scene.cover for scene in scenes])

    def all_by(estimate: Callable[[Image, Image], float]) -> Callable[[], Array]:
        return lambda: np.array([estimate(scene.wet, scene.dry) for scene in scenes])

    def error(found: Array) -> float:
        return float(np.abs(found - truth).mean())

    variants = (
        Variant("drop_cover", all_by(drop_cover), error, True),
        Variant("SSIM at full size, exposure matched", all_by(_by_ssim), error, True, every=5),
        Variant("plain difference", all_by(_by_difference), error, note=f"above {DIFFERENT} gray levels"),
    )
    return Work(
        "cover", "How much drops hide", "Of pairs in memory, one thread.", variants, "drop_cover", "", "mean error of "
        "the covered share", len(scenes), "pairs",
    )  # fmt: skip


def _by_ssim(wet: Image, dry: Image) -> float:
    return float((dissimilarity(wet, Exposure.between(wet, dry).on(dry)) > HIDDEN).mean())


def _by_difference(wet: Image, dry: Image) -> float:
    a, b = (cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (wet, dry))
    return float((cv2.absdiff(a, b) > DIFFERENT).mean())


def _pair_work(scenes: Sequence[Scene], promised: bool) -> Work:
    folder = Path(tempfile.mkdtemp(prefix="rainstereo-bench-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    pairs = []
    for i, scene in enumerate(scenes):
        paths = folder / f"{i}_dry.png", folder / f"{i}_wet.png"
        for path, image in zip(paths, (scene.dry, scene.wet), strict=True):
            imagefile.write(path, image)
        pairs.append(Candidate(str(i), *paths, "bench", float(i)))

    def read() -> list[Image]:
        return [imagefile.read(p) for p in _paths(pairs)]

    def error(found: Sequence[Measures]) -> float:
        return float(np.mean([abs(m.cover - s.cover) for m, s in zip(found, scenes, strict=True)]))

    return Work(
        "pair", "A pair, from its files to its numbers",
        "Reading both PNG files, brightness, blur, drop cover, movement, dirt and hash; one thread.",
        (
            Variant("measured", lambda: measure_run(pairs), error, True),
            Variant("read only", read, lambda _: math.nan, note="both files decoded"),
        ),
        "measured", "", "mean error of the covered share", len(scenes), "pairs",
        (Target("measured", "read only", 3.0),) if promised else (),
    )  # fmt: skip


def _paths(pairs: Sequence[Candidate]) -> list[Path]:
    return [path for pair in pairs for path in (pair.dry, pair.wet) if path is not None]


def _drive(rng: np.random.Generator, length: int) -> Hashes:
    """Hashes of consecutive frames, (length, 32)."""
    flips = rng.random((length, 256)) < rng.choice([0.0, 0.01, 0.1], (length, 1), p=[0.6, 0.3, 0.1])
    return np.packbits(np.logical_xor.accumulate(flips, axis=0), axis=1)


def _choice_work(seed: int, quick: bool) -> Work:
    many, few = (2000, 200) if quick else (20_000, 4818)
    rng = np.random.default_rng(seed)
    hashes = _drive(rng, many)

    def gap(rows: Array) -> float:
        """Bits from the least far of those that were left out to the nearest chosen: the hole that remains."""
        left = np.setdiff1d(np.arange(many), rows)
        return float(nearest(hashes[left], hashes[rows.astype(np.intp)])[1].max())

    return Work(
        "choice", f"{few} of {many} hashes",
        "The most different ones, against any. Hashes of a drive that stands now and then; one thread.",
        (
            Variant("farthest_points", lambda: farthest_points(hashes, few, seed)[0], gap, True, every=5),
            Variant("at random", lambda: np.random.default_rng(seed).permutation(many)[:few], gap),
        ),
        "farthest_points", "bits", "largest gap that is left", few, "pairs",
    )  # fmt: skip
