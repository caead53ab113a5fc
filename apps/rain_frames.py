"""One image under rain: rendered, measured, written with whatever else is asked for, and noted as done.

Each image's note, OUT/.rain/notes/NAME.json, is written last: a note means that all its files are there and whole. It
holds the key of the settings and the source's size and time, so that a later run knows what need not be made again.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rainstereo import imagefile
from rainstereo.apps.rain_sources import Label, Source
from rainstereo.apps.run_record import write_atomically
from rainstereo.rain import drop_list
from rainstereo.rain.render import Plan
from rainstereo.rain.severity import Met
from rainstereo.types import Image, Mask

NOTES = ".rain"
PROTOCOL = (
    "scikit-image, before encoding, on all channels as stored (BGR order does not matter), data_range 255 or 65535; "
    "SSIM with its 7 x 7 uniform window, mean of the channels"
)
OPAQUE = 0.5
SMALLEST = 7
"""Pixels along a side, for SSIM's window."""
Note = dict[str, Any]


@dataclass(frozen=True)
class Outputs:
    """What is written. suffix: of images; "": as the source's. displacement: type of its numbers, or none."""

    folder: Path
    key: str
    suffix: str = ".png"
    masks: bool = False
    displacement: Literal["none", "float16", "float32"] = "none"
    lists: bool = True
    unknown_labels: bool = False
    ssim: bool = True

    def note(self, name: str) -> Path:
        """Where the note of an image is."""
        return self.folder / NOTES / "notes" / f"{name}.json"


Planner = Callable[[Image], tuple[Plan, Met | None]]
"""The rain for an image, and how its PSNR was met."""


def render(source: Source, planner: Planner, seed: int, outputs: Outputs) -> Note:
    """Render an image and write it; its note. What is wrong with an image is said there, and nothing is written."""
    start = time.perf_counter()
    try:
        clear = imagefile.read(source.path)
        plan, met = planner(clear)
        suffix = outputs.suffix or source.path.suffix
        labels = {label.name: _label(label, plan, outputs.unknown_labels) for label in source.labels}
        note = write_frame(clear, plan.apply(clear), plan, source.name, seed, outputs, suffix)
        note["files"] += [_write(outputs.folder, name, data) for name, data in labels.items()]
    except (ValueError, OSError, cv2.error) as error:
        return failure(source, error)
    note |= {"path": str(source.path), "status": "ok", "key": outputs.key, "stamp": stamp(source.path)}
    if met is not None:
        note |= {"amount": met.amount, "trials": met.trials}
    note["seconds"] = round(time.perf_counter() - start, 4)
    write_note(outputs, source.name, note)
    return note


def failure(source: Source, error: Exception) -> Note:
    """The note of an image that could not be made."""
    words = " ".join(str(error).split()) or type(error).__name__
    return {"name": source.name, "path": str(source.path), "status": "failed", "reason": words}


def write_note(outputs: Outputs, name: str, note: Note) -> None:
    """The last file of an image."""
    write_atomically(outputs.note(name), json.dumps(note, allow_nan=False).encode())


def finished(source: Source, outputs: Outputs) -> Note | None:
    """The note of an image that these settings have made already, from the file as it is; else None."""
    try:
        note: Note = json.loads(outputs.note(source.name).read_text(encoding="utf-8"))
        same = note["key"] == outputs.key and note["stamp"] == stamp(source.path)
        whole = same and all((outputs.folder / name).is_file() for name in note["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return note if whole else None


def stamp(path: Path) -> list[int]:
    """Size and time of a file: another one is another image."""
    found = path.stat()
    return [found.st_size, found.st_mtime_ns]


def write_frame(
    clear: Image, rainy: Image, plan: Plan, name: str, seed: int, outputs: Outputs, suffix: str | None
) -> Note:
    """Write what belongs to a rendered frame; the numbers about it. suffix None: the image itself goes to a video."""
    files = []
    if suffix is not None:
        files.append(_write_image(outputs.folder, f"{name}{suffix}", rainy))
    if outputs.masks:
        files.append(_write_image(outputs.folder, f"masks/{name}.png", masks(plan)))
    if outputs.displacement != "none":
        stream = io.BytesIO()
        np.savez_compressed(stream, displacement=plan.displacement.astype(outputs.displacement))
        files.append(_write(outputs.folder, f"displacement/{name}.npz", stream.getvalue()))
    if outputs.lists:
        text = drop_list.to_json(plan.drops, seed=seed, **plan.renderer.settings)
        files.append(_write(outputs.folder, f"drops/{name}.json", text.encode()))
    quality = measured(plan.renderer.framed(clear), rainy, outputs.ssim)
    return {
        "name": name,
        "files": files,
        **quality,
        "cover": round(float(plan.opacity.mean()), 5),
        "drops": len(plan.drops),
    }


def masks(plan: Plan) -> Image:
    """(H, W, 3) uint8, BGR as files are written. Red: 255 where a drop is; green: opacity; blue: unknown content."""
    opacity = plan.opacity
    found: Image = np.stack([255 * plan.unknown, np.rint(255 * opacity), 255 * (opacity > 0)], -1).astype(np.uint8)
    return found


def measured(clear: Image, rainy: Image, ssim: bool) -> Note:
    """PSNR, dB, and SSIM of a rainy image; see `PROTOCOL`. PSNR None: nothing differs. SSIM None: not asked for."""
    most = np.iinfo(clear.dtype).max
    psnr = None
    if not np.array_equal(clear, rainy):
        psnr = round(float(peak_signal_noise_ratio(clear, rainy, data_range=most)), 4)  # type: ignore[no-untyped-call]
    if not ssim or min(clear.shape[:2]) < SMALLEST:
        return {"psnr": psnr, "ssim": None}
    axis = -1 if clear.ndim == 3 else None
    value = structural_similarity(clear, rainy, data_range=most, channel_axis=axis)  # type: ignore[no-untyped-call]
    return {"psnr": psnr, "ssim": round(float(value), 5) if math.isfinite(float(value)) else None}


def _write(folder: Path, name: str, data: bytes) -> str:
    write_atomically(folder / name, data)
    return name


def _write_image(folder: Path, name: str, image: Image) -> str:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    if image.dtype != np.uint8 and Path(name).suffix.lower() in (".jpg", ".jpeg", ".bmp", ".webp"):
        raise ValueError(f"{Path(name).suffix} holds no 16 bits; take --format png or tif")
    imagefile.write(folder / name, image)
    return name


def _label(label: Label, plan: Plan, unknown: bool) -> bytes:
    """The file, bit for bit, or the frame's part of it, or with what drops hide marked."""
    data = imagefile.read_bytes(label.path)
    where = hidden(plan) if unknown and label.void is not None else None
    if where is None and plan.renderer.scene_size == plan.renderer.camera.size:
        return data
    return _marked(data, label, plan, where)


def hidden(plan: Plan) -> Mask:
    """Where an image no longer shows its own scene: under opaque drops, and where they show what is not in it."""
    return np.asarray((plan.opacity >= OPAQUE) | plan.unknown)


def _marked(data: bytes, label: Label, plan: Plan, where: Mask | None) -> bytes:
    """The frame's part of a label; void where it says so."""
    if data[:4] == b"\x89PNG" and data[25] == 3:
        raise ValueError(f"{label.path} has a palette, whose numbers would be lost; store the labels as gray PNG")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"the label {label.path} is not an image, or a damaged one")
    (width, height), (x, y), size = plan.renderer.scene_size, plan.renderer.shift, plan.renderer.camera.size
    if image.shape[:2] != (height, width):
        raise ValueError(
            f"the label {label.path} has {image.shape[1]} x {image.shape[0]} pixels, its image {width} x {height}"
        )
    image = image[y : y + size[1], x : x + size[0]]
    if where is not None:
        image[where] = (*(label.void,) * 3, 255)[: image.shape[2]] if image.ndim == 3 else label.void
    return cv2.imencode(".png", image)[1].tobytes()
