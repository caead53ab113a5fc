"""Benchmark stage `record`: pairs of frames onto the disk and back, by every codec and beside plain files."""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.hardware.codec import available
from rainstereo.hardware.pair_frame import CameraFrame, PairFrame, PairStatus
from rainstereo.hardware.pixel_format import mosaic
from rainstereo.hardware.recording import open_recording
from rainstereo.hardware.recording_writer import RecordingWriter
from rainstereo.imagefile import read
from rainstereo.rig import ROLES
from rainstereo.types import Image

FORMAT = "BayerRG8"
RATE_HZ = 16
SCENES = ("coffee", "motorcycle", "brick", "astronaut")
NOISE = 1.0


def build(seed: int, quick: bool) -> Stage:
    """The stage with 1280x960 mosaics, or 320x240 if `quick`."""
    width, height = (320, 240) if quick else (1280, 960)
    count = 4 if quick else 32
    pairs = _pairs(width, height, count, seed)
    place = Path(tempfile.gettempdir())
    return Stage(
        "record",
        "recording pairs without loss",
        f"{count} pairs of {width}x{height} {FORMAT} frames are written, synced and closed. Two cameras at {RATE_HZ} "
        f"pairs a second need {count / RATE_HZ:g} s for as many; what takes less keeps up.",
        (_work(pairs, place, not quick),),
        {
            "frames": f"mosaics of photographs from scikit-image with {NOISE:g} gray level of noise",
            "disk": "the folder for temporary files",
            "seed": seed,
        },
        (
            "Ours: the segment log, two threads that compress, a sync every half second, index and recording.toml at "
            "the end. Every record carries its checksum.",
            "Plain files know no trigger numbers, times or regimes; after a crash, the last ones may be empty.",
            "The error is the largest difference of any pixel read back: 0 is lossless.",
            "Sizes depend on the scene and its noise; `--codec auto` measures both on your own frames.",
        ),
    )


def _work(pairs: list[PairFrame], place: Path, promised: bool) -> Work:
    variants = [_ours(pairs, place, name) for name in available()]
    variants.append(_files("plain raw files, synced", pairs, place, ".raw", _save_raw, _load_raw))
    variants.append(_files("cv2.imwrite PNG, level 1", pairs, place, ".png", _save_png, read))
    variants.append(_files("cv2.imwrite PNG", pairs, place, ".png", _save_default_png, read))
    seconds = len(pairs) / RATE_HZ
    return Work(
        "write",
        "Writing pairs, two cores",
        "Frames in memory to files that a power cut leaves.",
        tuple(variants),
        "record, raw",
        "gray levels",
        "largest difference of what is read back",
        len(pairs),
        "pairs",
        (Target("record, raw", None, seconds / 2),) if promised else (),
        2,
    )


def _ours(pairs: list[PairFrame], place: Path, codec: str) -> Variant:
    number = itertools.count()
    folder = place / f"rainstereo-bench-{os.getpid()}-{codec}"

    def run() -> Path:
        shutil.rmtree(folder, ignore_errors=True)
        target = folder / str(next(number))
        with RecordingWriter(target, codec=codec, workers=2) as writer:
            for pair in pairs:
                writer.write(pair)
        return target

    def error(target: Path) -> float:
        recording = open_recording(target)
        back = [recording.read(i) for i in range(len(recording))]
        if len(back) != len(pairs):
            return float("nan")
        return max(
            _difference(a.frame(r).image, b.frame(r).image) for a, b in zip(back, pairs, strict=True) for r in ROLES
        )

    note = f"segment log, {codec}"
    return Variant(f"record, {codec}", run, error, True, note, 1 if codec == "raw" else 3, lambda t: _sizes(t, pairs))


def _files(
    title: str,
    pairs: list[PairFrame],
    place: Path,
    suffix: str,
    save: Callable[[Path, Image], None],
    load: Callable[[Path], Image],
) -> Variant:
    folder = place / f"rainstereo-bench-{os.getpid()}-{title.replace(' ', '-')}"

    def run() -> Path:
        shutil.rmtree(folder, ignore_errors=True)
        for role in ROLES:
            (folder / role).mkdir(parents=True)
            for i, pair in enumerate(pairs):
                save(folder / role / f"{i:06d}{suffix}", pair.frame(role).image)
        return folder

    def error(target: Path) -> float:
        worst = 0.0
        for role in ROLES:
            for i, pair in enumerate(pairs):
                image = pair.frame(role).image
                back = load(target / role / f"{i:06d}{suffix}")
                worst = max(worst, _difference(back.reshape(image.shape), image))
        return worst

    return Variant(title, run, error, note="one thread, one file a frame", every=3, also=lambda t: _sizes(t, pairs))


def _sizes(folder: Path, pairs: list[PairFrame]) -> dict[str, float]:
    raw = sum(pair.frame(role).image.nbytes for pair in pairs for role in ROLES)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.name != "recording.toml")
    return {"MB a pair": size / len(pairs) / 1e6, "of raw": size / raw}


def _difference(a: Image, b: Image) -> float:
    return float(np.abs(a.astype(np.int32) - b).max())


def _save_raw(path: Path, image: Image) -> None:
    with path.open("wb") as file:
        file.write(image.tobytes())
        file.flush()
        os.fdatasync(file.fileno())


def _load_raw(path: Path) -> Image:
    return np.fromfile(path, np.uint8)


def _save_png(path: Path, image: Image) -> None:
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _save_default_png(path: Path, image: Image) -> None:
    cv2.imwrite(str(path), image)


def _pairs(width: int, height: int, count: int, seed: int) -> list[PairFrame]:
    rng = np.random.default_rng(seed)
    scenes = []
    for name in SCENES:
        scene = cv2.resize(photograph(name), (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
        noisy = scene + np.float32(NOISE) * rng.standard_normal(scene.shape, np.float32)
        scenes.append(mosaic(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), FORMAT))
    made = []
    for i in range(count):
        frames = [
            CameraFrame(scenes[(i + k) % len(scenes)], i % 65535 + 1, i * 62_500_000, None, FORMAT) for k in range(2)
        ]
        made.append(PairFrame(i, frames[0], frames[1], PairStatus.OK, 0.0, "mist"))
    return made
