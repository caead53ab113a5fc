"""What segmentation is evaluated on, made stage by stage and kept: scaled images, labels, rain, derained images."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.evaluation_sets import RenderedRain, Sample, rendered
from rainstereo.apps.rain_frames import stamp
from rainstereo.apps.run_record import write_atomically
from rainstereo.types import Image

if TYPE_CHECKING:
    from rainstereo.model.segmentation import Scene

STATES = ("clear", "rainy", "derained")
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Prepared:
    """A frame: files of its states, by `STATES`, and of its labels, 0 .. classes - 1 and 255 for void."""

    name: str
    states: dict[str, Path]
    target: Path


@dataclass(frozen=True)
class Stages:
    """How frames are made, in `folder`. width: images that are wider are scaled down to it before rain falls; 0: none.

    restore: an image to its derained version; restorer: the identity of what does it. target: a label image to labels.
    """

    folder: Path
    width: int
    rain: RenderedRain
    restore: Callable[[Image], Image]
    restorer: str
    target: Callable[[Image], Image]
    task: str

    def prepare(self, scenes: tuple[Scene, ...], told: Told, what: str) -> tuple[list[Prepared], dict[str, str]]:
        """Frames, those that are there already as they are; and of those that failed, why."""
        render = self.rain.renderer()
        done: list[Prepared] = []
        failed: dict[str, str] = {}
        for scene in scenes:
            try:
                done.append(self._frame(scene, render))
            except (ValueError, OSError, RuntimeError, cv2.error) as error:
                failed[scene.name] = " ".join(str(error).split()) or type(error).__name__
            told(what, 1, len(scenes))
        return done, failed

    def _frame(self, scene: Scene, render: Callable[[Image, str], Image]) -> Prepared:
        name, key = scene.name, f"width {self.width}"
        clear = scene.image
        if self.width:
            clear = kept(self.folder / "clear", name, key, [scene.image], lambda: self._scaled(scene.image))

        def labelled() -> Image:
            found, image = self.target(imagefile.read(scene.label)), imagefile.read(clear)
            size = image.shape[1], image.shape[0]
            return np.asarray(cv2.resize(found, size, interpolation=cv2.INTER_NEAREST_EXACT))

        target = kept(self.folder / "targets", name, f"{key} {self.task}", [scene.label, clear], labelled)
        rainy = rendered(Sample(name, clear, None), self.folder / "rainy", render, repr(self.rain))
        derained = kept(
            self.folder / "derained", name, self.restorer, [rainy], lambda: self.restore(imagefile.read(rainy))
        )
        return Prepared(name, {"clear": clear, "rainy": rainy, "derained": derained}, target)

    def _scaled(self, path: Path) -> Image:
        image = imagefile.read(path)
        height, width = image.shape[:2]
        if width <= self.width:
            return image
        size = self.width, max(1, round(height * self.width / width))
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def kept(folder: Path, name: str, key: str, sources: list[Path], make: Callable[[], Image]) -> Path:
    """Where an image lies, made if it is not there yet, or was made from other files or with another key."""
    path, note = folder / f"{name}.png", folder / ".made" / f"{name}.txt"
    text = digest(key, [stamp(source) for source in sources])
    try:
        if path.is_file() and note.read_text(encoding="utf-8") == text:
            return path
    except OSError:
        pass
    path.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(path, make())
    write_atomically(note, text.encode())
    return path


def digest(*what: object) -> str:
    """A short name for what something depends on."""
    return hashlib.sha256(repr(what).encode()).hexdigest()[:24]
