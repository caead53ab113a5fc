"""Frames of a drive under rain that moves: folders of frames and videos.

The rain at a frame depends on the frame's time alone, so frames may be made in any order and by any worker.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from rainstereo.apps.rain_frames import Note, Outputs, failure, stamp, write_frame, write_note
from rainstereo.apps.rain_settings import Rain, Size, psnr_under
from rainstereo.apps.rain_sources import Source
from rainstereo.rain.drops import Drops
from rainstereo.rain.motion import Motion, PaneState
from rainstereo.rain.render import Plan, Renderer
from rainstereo.rain.sequence import Sequence as Plans
from rainstereo.rain.sequence import TrailShapes
from rainstereo.types import Image

MotionKind = Literal["physical", "paper", "still"]
CODECS = {".mp4": "mp4v", ".mkv": "FFV1", ".avi": "MJPG"}
"""By suffix; that of .mkv is lossless."""


@dataclass(frozen=True)
class Drive:
    """What makes images a sequence. name: seeds it. size: (width, height). length: frames. fps: of them a second.

    refill: seconds in which as many drops fall as are there at the start, as long as it lasts; inf: none fall.
    """

    name: str
    size: Size
    length: int
    motion: MotionKind = "physical"
    fps: float = 30.0
    refill: float = 5.0


@dataclass(eq=False)
class Sequence:
    """Moving rain in front of a camera."""

    rain: Rain
    drive: Drive
    _last: tuple[PaneState, Plan] | None = field(default=None, repr=False)
    _motion: Motion | None = field(default=None, repr=False)
    _still: Plan | None = field(default=None, repr=False)
    _trails: TrailShapes = field(default_factory=TrailShapes, init=False, repr=False)

    def plan(self, frame: int) -> Plan:
        """The rain in a frame, traced; a pane on which nothing moved is not traced again."""
        drive = self.drive
        renderer = self.rain.renderer(drive.size)
        if drive.motion == "still" or self.rain.drop_list:
            if self._still is None:
                listed = self.rain.drop_list
                self._still = renderer.plan(listed[1] if listed else self.rain.drops(drive.name, drive.size))
            return self._still
        state = self._moving(renderer).at(frame / drive.fps)
        if self._last is None or not _same(self._last[0], state):
            trails = self._trails.of(state)
            self._last = state, self._plans.plan([*trails, self.rain.in_sight(state.drops, drive.size)], state.rests)
        return self._last[1]

    @cached_property
    def _plans(self) -> Plans:
        """Makes plans, and traces what has not moved only once; wherever it begins, in the same way."""
        return self.rain.renderer(self.drive.size).sequence()

    def _moving(self, renderer: Renderer) -> Motion:
        if self._motion is None:
            drops, pane = self._falling(), self.rain.pane(self.drive.size)
            seed = int(self.rain.seeds(f"{self.drive.name}, motion").integers(2**62))
            if self.drive.motion == "paper":
                self._motion = Motion.paper(drops, pane, renderer.camera, renderer.chamber, seed=seed)
            else:
                self._motion = Motion.physical(drops, pane, seed=seed)
        return self._motion

    def _falling(self) -> Drops:
        """All drops of the drive: those of the start, and the same number again at any time in each refill."""
        name, size, refill = self.drive.name, self.drive.size, self.drive.refill
        parts = [self.rain.drops(name, size)]
        for block in range(math.ceil(self.drive.length / self.drive.fps / refill)):
            fallen = self.rain.drops(f"{name}, {block}", size)
            birth = refill * (block + self.rain.seeds(f"{name}, {block}, when").random(len(fallen)))
            parts.append(replace(fallen, birth=np.maximum(birth, 1e-9)))
        everyone = Drops.joined(parts)
        return replace(everyone, id=np.arange(len(everyone)))

    def psnr_at(self, image: Image, frame: int) -> float:
        """PSNR of a frame."""
        return psnr_under(self.plan(frame), image)

    def with_share(self, share: float) -> Sequence:
        """The same with a share of the heaviest rain's drops at the start."""
        return Sequence(replace(self.rain, share=share), self.drive)

    def mean_psnr(self, images: Mapping[int, Image], share: float) -> float:
        """Mean PSNR of some frames under a share of the heaviest rain's drops."""
        if not images:
            raise ValueError("no frame of the sequence can be decoded")
        moving = self.with_share(share)
        return float(np.mean([moving.psnr_at(image, number) for number, image in sorted(images.items())]))


def _same(one: PaneState, other: PaneState) -> bool:
    drops, others = one.drops, other.drops
    return (
        one.rests == other.rests
        and len(drops) == len(others) == len(one.unchanged(other))
        and len(one.trails) == len(other.trails)
        and all(a.same(b) for a, b in zip(one.trails, other.trails, strict=True))
    )


# -- videos ------------------------------------------------------------------------------------------------------------


def video_size(path: Path) -> tuple[Size, int, float]:
    """(width, height), number of frames as the file tells, and frames a second. ValueError if it is no video."""
    reader = cv2.VideoCapture(str(path))
    try:
        size = int(reader.get(cv2.CAP_PROP_FRAME_WIDTH)), int(reader.get(cv2.CAP_PROP_FRAME_HEIGHT))
        rate, count = float(reader.get(cv2.CAP_PROP_FPS)), int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
        if not reader.isOpened() or min(size) < 1:
            raise ValueError(f"{path} is not a video that OpenCV can read, or a damaged one")
        return size, max(count, 0), rate if math.isfinite(rate) and 1e-3 < rate < 1e5 else 30.0
    finally:
        reader.release()


def frames(path: Path, wanted: set[int] | None = None) -> Iterator[tuple[int, Image]]:
    """Number and picture of each frame of a video, or of those that are wanted."""
    reader = cv2.VideoCapture(str(path))
    try:
        number = 0
        while wanted is None or number <= max(wanted, default=-1):
            if not reader.grab():
                return
            if wanted is None or number in wanted:
                done, image = reader.retrieve()
                if not done:
                    return
                yield number, image
            number += 1
    finally:
        reader.release()


def render_video(
    source: Source, sequence: Sequence, outputs: Outputs, suffix: str, found: Note, progress: Callable[[], None]
) -> Note:
    """Render a video; its note. Its sound is not kept. The file appears under its name only when it is whole.

    found: more for the note. progress: called after each frame.
    """
    target = outputs.folder / f"{source.name}{suffix}"
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.stem}.partial{suffix}")
    size = sequence.rain.renderer(sequence.drive.size).camera.size
    writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*CODECS[suffix]), sequence.drive.fps, size)
    notes: list[Note] = []
    try:
        if not writer.isOpened():
            raise ValueError(f"this OpenCV cannot write {suffix} with {CODECS[suffix]}; take --video-format mkv or avi")
        for number, image in frames(source.path):
            plan = sequence.plan(number)
            rainy, name = plan.apply(image), f"{source.name}/{number:06d}"
            notes.append(write_frame(image, rainy, plan, name, sequence.rain.seed, outputs, None))
            writer.write(rainy)
            progress()
        writer.release()
        if not notes:
            raise ValueError(f"{source.path} holds no frame that can be decoded")
        partial.replace(target)
    except (ValueError, OSError, cv2.error) as error:
        return failure(source, error)
    finally:
        writer.release()
        partial.unlink(missing_ok=True)
    note = _whole(source, notes, outputs.key, target.name) | found
    write_note(outputs, source.name, note)
    return note


def _whole(source: Source, notes: list[Note], key: str, target: str) -> Note:
    """The note of a video: means over its frames."""
    parent = Path(source.name).parent
    means = {}
    for name in ("psnr", "ssim", "cover", "drops"):
        values = [note[name] for note in notes if note[name] is not None]
        means[name] = round(float(np.mean(values)), 4) if values else None
    return {
        "name": source.name, "path": str(source.path), "status": "ok", "key": key, "stamp": stamp(source.path),
        "files": [(parent / target).as_posix(), *(file for note in notes for file in note["files"])],
        **means, "frames": len(notes),
    }  # fmt: skip
