"""Benchmark stage `align`: from files to files; file formats; and what a second interpolation costs."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo import Rig, imagefile
from rainstereo.align import Alignment, plan
from rainstereo.apps.align_job import Job, Outputs, chunks
from rainstereo.apps.align_options import parse_format
from rainstereo.apps.align_workers import Chunk, Work
from rainstereo.apps.bench_harness import Stage, Target, Variant
from rainstereo.apps.bench_harness import Work as Measured
from rainstereo.apps.bench_warp import bench_rig
from rainstereo.apps.photographs import photograph
from rainstereo.pair_source import FilePairs, open_source
from rainstereo.recipe import Recipe
from rainstereo.types import Array, Image
from rainstereo.warp import Warp

CORES = 2
ENOUGH = 1 / 0.9
"""Times as long as only decoding and encoding that aligning may take."""
FORMATS = ("png", "png:0", "png:3", "tif", "webp", "jpg:98", "jpg:95")


def build(seed: int, quick: bool) -> Stage:
    """The stage at 1280x960, or 320x240 if `quick`."""
    width, height = (320, 240) if quick else (1280, 960)
    rig = bench_rig(width, height)
    alignment = plan(rig)
    folder = Path(tempfile.mkdtemp(prefix="rainstereo-bench-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    source = _recording(folder / "raw", width, height, 8, seed)
    return Stage(
        "align",
        "a recording becomes aligned pairs, from files to files",
        f"Pairs of {width}x{height} colour PNG files are decoded, aligned to {alignment.view.width}x"
        f"{alignment.view.height}, encoded and written. The warp hides behind the codec: against only decoding and "
        "encoding the same files it must keep 0.9 of the rate.",
        (
            _rate_work(folder, source, alignment, not quick),
            _format_work(folder, source, alignment, 2),
            _sharpness_work(rig, alignment, seed),
        ),
        {
            "rig": f"two OPENCV5 cameras of {width}x{height} behind two 4 mm panels, plane at infinity",
            "images": "8-bit BGR, photographs from scikit-image with one gray level of noise, PNG level 1",
            "workers": f"{CORES} processes, each with a thread that decodes and one that warps, encodes and writes",
            "seed": seed,
        },
        (
            "Workers are started before the clock is: a recording of 50,000 pairs pays for that once.",
            "The cropped peer encodes exactly as many pixels as align does, so only the two interpolations differ; "
            "interpolation also averages noise away, after which PNG has less to do.",
            "Sizes depend on the noise of the camera more than on anything else.",
        ),
    )


# -- the rate ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Untouched(Recipe):
    """Decodes and encodes, and does nothing between. window: of the images that is written."""

    window: tuple[int, int, int, int] = (0, 0, 0, 0)

    def make(self, dry: Image, wet: Image) -> dict[str, Image]:
        """A window of the raw images."""
        x, y, w, h = self.window
        return {"dry": dry[y : y + h, x : x + w], "wet": wet[y : y + h, x : x + w]}


def _rate_work(folder: Path, source: FilePairs, alignment: Alignment, promised: bool) -> Measured:
    size, view = alignment.dry.source_size, alignment.view
    align = Recipe(alignment.dry, alignment.wet)
    cropped = (size[0] - view.width) // 2, (size[1] - view.height) // 2, view.width, view.height
    whole = Untouched(Warp.identity(size), Warp.identity(size), window=(0, 0, *size))
    recipes: dict[str, Recipe] = {"align": align, "decode and encode": whole}
    if min(cropped) >= 0:
        recipes["decode and encode, cropped"] = replace(whole, window=cropped)
    works = {
        name: Work(source, recipe, Job(Outputs(folder / f"rate{i}"), "bench"))
        for i, (name, recipe) in enumerate(recipes.items())
    }
    pool = ProcessPoolExecutor(CORES, mp_context=get_context("spawn"), initializer=_prepare, initargs=(works,))
    variants = [
        Variant(name, partial(_job, pool, name, work), _no_error, name == "align") for name, work in works.items()
    ]
    peers = [v.name for v in variants[1:]]
    return Measured(
        "rate", f"Files to files, {CORES} processes",
        f"{len(source)} pairs. The peers read and write the same files and do not interpolate.",
        tuple(variants), "align", "", "none", len(source), "pairs",
        tuple(Target("align", peer, ENOUGH) for peer in peers) if promised else (),
    )  # fmt: skip


_here: dict[str, Work] = {}


def _prepare(works: dict[str, Work]) -> None:
    """A worker learns its plans once, as in a job."""
    cv2.setNumThreads(1)
    _here.update(works)


def _job(pool: ProcessPoolExecutor, name: str, work: Work) -> int:
    """All pairs, by both workers; how many."""
    shutil.rmtree(work.job.outputs.folder, ignore_errors=True)
    Job.claim(work.job.outputs, "bench")
    half = -(-len(work.source) // CORES)
    halves = [(i, range(i * half, min((i + 1) * half, len(work.source)))) for i in range(CORES)]
    return sum(pool.map(_some, [name] * CORES, halves))


def _some(name: str, chunk: Chunk) -> int:
    return len(_here[name].make(chunk).rows)


def _no_error(_: object) -> float:
    return float("nan")


# -- formats -------------------------------------------------------------------------------------------------------


def _format_work(folder: Path, source: FilePairs, alignment: Alignment, count: int) -> Measured:
    some = FilePairs(source.moments[:count])
    recipe = Recipe(alignment.dry, alignment.wet)
    truth = [recipe.make(*some.read(i)[1:]) for i in range(count)]
    variants = tuple(
        Variant(text, partial(_as_format, folder / f"as-{text.replace(':', '-')}", some, recipe, text),
                partial(_loss, truth, some), ours=True, every=8 if text == "webp" else 1, also=_size)
        for text in FORMATS
    )  # fmt: skip
    return Measured(
        "formats", "Output formats, one process",
        f"{count} pairs from files to files. Time against size is the choice; jpg alone loses something.",
        variants, "png", "gray levels", "RMS against the aligned image", count, "pairs",
    )  # fmt: skip


def _as_format(folder: Path, source: FilePairs, recipe: Recipe, text: str) -> Outputs:
    shutil.rmtree(folder, ignore_errors=True)
    outputs = Outputs(folder, *parse_format(text))
    work = Work(source, recipe, Job.claim(outputs, "bench"))
    for chunk in enumerate(chunks(len(source))):
        work.make(chunk)
    return outputs


def _loss(truth: Sequence[Mapping[str, Image]], source: FilePairs, outputs: Outputs) -> float:
    errors = []
    for i, made in enumerate(truth):
        for role in ("dry", "wet"):
            written = imagefile.read(outputs.path(role, source.name(i)))
            errors.append(float(np.mean((written.astype(np.float64) - made[role]) ** 2)))
    return float(np.sqrt(np.mean(errors)))


def _size(outputs: Outputs) -> Mapping[str, float]:
    files = [path for role in ("dry", "wet") for path in (outputs.folder / role).iterdir()]
    return {"MB a pair": sum(path.stat().st_size for path in files) / 1e6 / (len(files) / 2)}


# -- sharpness -----------------------------------------------------------------------------------------------------


def _sharpness_work(rig: Rig, alignment: Alignment, seed: int) -> Measured:
    waves = Waves.drawn(seed, alignment.wet.source_size)
    raw = np.clip(np.rint(waves.at(Warp.identity(alignment.wet.source_size).map_xy)), 0, 255).astype(np.uint8)
    truth = waves.at(alignment.wet.map_xy)
    edge = np.s_[4:-4, 4:-4]
    fine = _energy(truth[edge])

    def error(image: Image) -> float:
        return float(np.sqrt(np.mean((image.astype(np.float64) - truth)[edge] ** 2)))

    def also(image: Image) -> Mapping[str, float]:
        return {"% detail": 100 * _energy(image.astype(np.float64)[edge]) / fine}

    variants = []
    for kind in ("linear", "cubic", "lanczos"):
        once = partial(alignment.wet.apply, raw, interpolation=kind)
        variants.append(Variant(f"one step, {kind}", once, error, True, also=also))
        variants.append(Variant(f"two steps, {kind}", _two_steps(rig, alignment, raw, kind), error,
                                note="undistort, then rotate", also=also))  # fmt: skip
    return Measured(
        "sharpness", "One interpolation or two",
        "A pattern known between its pixels (waves up to 0.35 cycles a pixel) on the wet camera, aligned. Detail is "
        "the energy of differences between neighbours against that of the pattern itself.",
        tuple(variants), "one step, linear", "gray levels", "RMS against the pattern itself", 1, "image",
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Waves:
    """A sum of waves: (N, 2) cycles a pixel, (N,) phases and amplitudes in gray levels."""

    cycles: Array
    phases: Array
    amplitudes: Array

    @classmethod
    def drawn(cls, seed: int, size: tuple[int, int], count: int = 24) -> Waves:
        """Waves of all directions, as much in each octave."""
        rng = np.random.default_rng([seed, size[0]])
        length, angle = np.exp(rng.uniform(np.log(0.01), np.log(0.35), count)), rng.uniform(0, np.pi, count)
        cycles = length[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
        return cls(cycles, rng.uniform(0, 2 * np.pi, count), np.full(count, 120 / np.sqrt(8 * count)))

    def at(self, xy: Array) -> Array:
        """Gray levels at pixels, (..., 2), of which none need be whole."""
        total = np.full(xy.shape[:-1], 127.5)
        for cycle, phase, amplitude in zip(self.cycles, self.phases, self.amplitudes, strict=True):
            total += amplitude * np.sin(2 * np.pi * (xy @ cycle) + phase)
        return total


def _two_steps(rig: Rig, alignment: Alignment, raw: Image, kind: str) -> Callable[[], Image]:
    """The usual recipe: an undistorted image of the camera by itself, then the rotation."""
    camera = rig.wet
    fx, fy, cx, cy = camera.intrinsics[:4]
    margin = camera.width // 8
    size = camera.width + 2 * margin, camera.height + 2 * margin

    def straight(p: Array) -> Array:
        return camera.project(np.concatenate([(p - (cx + margin, cy + margin)) / (fx, fy), np.ones((len(p), 1))], -1))

    first = Warp.from_function(straight, size, camera.size)
    rays = camera.unproject(alignment.wet.map_xy)
    second = Warp(rays[..., :2] / rays[..., 2:] * (fx, fy) + (cx + margin, cy + margin), size)
    return lambda: second.apply(first.apply(raw, interpolation=kind), interpolation=kind)


def _energy(image: Array) -> float:
    return float(np.mean(np.diff(image, axis=0) ** 2) + np.mean(np.diff(image, axis=1) ** 2))


def _recording(folder: Path, width: int, height: int, count: int, seed: int) -> FilePairs:
    rng = np.random.default_rng(seed)
    names: tuple[Any, ...] = ("motorcycle", "astronaut", "coffee", "rocket")
    for role in ("dry", "wet"):
        (folder / role).mkdir(parents=True)
        for i in range(count):
            image = cv2.resize(photograph(names[i % len(names)]), (width, height), interpolation=cv2.INTER_CUBIC)
            noisy = np.clip(np.rint(image + rng.normal(size=image.shape)), 0, 255).astype(np.uint8)
            imagefile.write(folder / role / f"{i:03d}.png", noisy)
    found = open_source(str(folder / "dry"), str(folder / "wet"))
    if not isinstance(found, FilePairs):
        raise TypeError("image folders make pairs of files")
    return found
