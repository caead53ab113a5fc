"""Videos and cameras restored frame by frame, each at its own time; the sound comes along where ffmpeg is there.

Frames go to a Matroska file that may be cut off at any time: a killed run goes on behind its last whole frame. The file
gets its name when the video is done; of a video that ends early, or a camera that vanished, what there was is kept.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from rainstereo.apps.derain_files import Folder, Note
from rainstereo.apps.matroska import PictureVideo
from rainstereo.apps.rain_frames import failure
from rainstereo.apps.rain_sources import Source
from rainstereo.types import Image

if TYPE_CHECKING:
    from rainstereo.model.frame_sequence import FrameSequence

UNKNOWN_FPS = 30.0
TRIES = 3
"""Times that a camera may fail to give a frame before it counts as gone."""


class Frame(NamedTuple):
    """seconds: since the first frame."""

    seconds: float
    image: Image


@dataclass(frozen=True)
class Format:
    """suffix: ".mkv" or ".mp4". lossless: PNG pictures, of .mkv."""

    suffix: str = ".mkv"
    lossless: bool = False


class Reader:
    """Frames of a video file with their times."""

    def __init__(self, path: Path) -> None:
        self.capture = cv2.VideoCapture(str(path))
        self.size = (int(self.capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(self.capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if not self.capture.isOpened() or min(self.size) < 1:
            raise ValueError("not a video that OpenCV can read, or a damaged one")
        fps, count = float(self.capture.get(cv2.CAP_PROP_FPS)), float(self.capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.fps = fps if math.isfinite(fps) and 1e-2 < fps < 1e4 else UNKNOWN_FPS
        self.count = int(count) if math.isfinite(count) and 0 < count < 1e9 else 0
        self.unreadable = 0

    @property
    def lasts(self) -> float:
        """Seconds, as the file says; 0: it does not."""
        return self.count / self.fps

    def frames(self, skip: int = 0) -> Iterator[Frame]:
        """From the one with that number on. A frame that cannot be decoded is counted and left out."""
        last = -math.inf
        number = 0
        while self.capture.grab():
            told = self.capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            seconds = told if math.isfinite(told) and told > last else max(last, 0.0) + 1 / self.fps
            last = seconds
            number += 1
            if number <= skip:
                continue
            done, image = self.capture.retrieve()
            if done and image is not None and image.dtype == np.uint8:
                yield Frame(seconds, image)
            else:
                self.unreadable += 1


def restore_video(
    source: Source, sequence: FrameSequence, folder: Folder, kind: Format, told: Callable[[str, int, int], None]
) -> Note:
    """Restore a video; its note, whose `trouble` says what was wrong with it though there is an output."""
    start = time.perf_counter()
    target = folder.path / f"{source.name}{kind.suffix}"
    partial = target.with_name(f".{target.stem}.partial.mkv")
    try:
        reader = Reader(source.path)
        times, totals = _fill(partial, reader, sequence, kind.lossless, lambda n: told(source.name, n, reader.count))
        if not times:
            raise ValueError("it holds no frame that can be decoded")
        trouble = _shortage(times, reader)
        remarks = finish(partial, target, source.path)
    except (ValueError, OSError, RuntimeError, cv2.error) as error:
        if isinstance(error, ValueError):
            partial.unlink(missing_ok=True)
        return failure(source, error)
    more: dict[str, Any] = {"frames": len(times), "remarks": remarks, "seconds": round(time.perf_counter() - start, 3)}
    if trouble:
        return {"name": source.name, "path": str(source.path), "status": "incomplete", "reason": trouble,
                "files": [target.name], **more, **totals}  # fmt: skip
    return folder.done(source, [target.relative_to(folder.path).as_posix()], **more, **totals)


def restore_camera(
    number: int, most: int | None, sequence: FrameSequence, folder: Folder, kind: Format,
    told: Callable[[str, int, int], None],
) -> Note:  # fmt: skip
    """Restore what a camera sees, until that many frames, Ctrl-C, or until it is gone; its note."""
    source = Source(Path(f"camera:{number}"), f"camera-{number}")
    target = free_name(folder.path / f"{source.name}{kind.suffix}")
    partial = target.with_name(f".{target.stem}.partial.mkv")
    camera, trouble, writer = cv2.VideoCapture(number), "", None
    begin, misses, count = time.monotonic(), 0, 0
    try:
        if not camera.isOpened():
            return failure(source, ValueError(f"camera {number} cannot be opened; is it plugged in, and free?"))
        while most is None or count < most:
            done, image = camera.read()
            seconds = time.monotonic() - begin
            if not done or image is None:
                misses += 1
                if misses >= TRIES:
                    trouble = f"the camera gave no more frames after {count}"
                    break
                continue
            misses = 0
            if writer is None:
                writer = PictureVideo(partial, (image.shape[1], image.shape[0]), UNKNOWN_FPS, kind.lossless)
            writer.write(sequence(image).image, seconds)
            count += 1
            told(source.name, 1, most or 0)
    except KeyboardInterrupt:
        if writer is None:
            raise
    except cv2.error as error:
        trouble = f"the camera failed after {count} frames ({error.err})"
    finally:
        camera.release()
        if writer is not None:
            writer.close()
    if not count:
        return failure(source, ValueError(trouble or "the camera gave no frame"))
    remarks = finish(partial, target, None)
    status = {"status": "incomplete", "reason": trouble} if trouble else {"status": "ok"}
    return {"name": source.name, "path": str(source.path), "files": [target.name], "frames": count,
            "remarks": remarks, "seconds": round(time.monotonic() - begin, 3), **status}  # fmt: skip


def _fill(
    partial: Path, reader: Reader, sequence: FrameSequence, lossless: bool, told: Callable[[int], None]
) -> tuple[list[float], Note]:
    """Restore all frames that are not there yet; the times of all, and means of what was done."""
    writer, computed = None, []
    try:
        try:
            writer = PictureVideo(partial, reader.size, reader.fps, lossless, resume=True)
        except ValueError:  # what lies there is not of this video
            writer = PictureVideo(partial, reader.size, reader.fps, lossless)
        told(len(writer.times))
        for frame in reader.frames(skip=len(writer.times)):
            found = sequence(frame.image)
            writer.write(found.image, frame.seconds)
            computed.append(found.computed)
            told(1)
    except BaseException:
        if writer is not None:
            writer.close(whole=False)  # the next run goes on in it
        raise
    finally:
        reader.capture.release()
    writer.close()
    return writer.times, {"computed": round(float(np.mean(computed)), 4) if computed else None}


def _shortage(times: list[float], reader: Reader) -> str:
    step = 1 / reader.fps
    missing = reader.lasts - (times[-1] - times[0] + step)
    if reader.lasts and missing > 2.5 * step:
        return (
            f"the video ends after {len(times)} frames ({times[-1] + step:.2f} s), though it says that it lasts "
            f"{reader.lasts:.2f} s: the file is cut off, or damaged there"
        )
    return f"{reader.unreadable} frames could not be decoded and were left out" if reader.unreadable else ""


def finish(partial: Path, target: Path, source: Path | None) -> list[str]:
    """Give the video its name, with the sound of its source where there is one; what could not be kept, in words."""
    program = shutil.which("ffmpeg")
    remarks = []
    if program is None:
        if target.suffix == ".mp4":
            raise RuntimeError(
                f"mp4 needs ffmpeg, which is not installed (sudo apt-get install ffmpeg). The frames are in {partial}; "
                "take --video-format mkv to keep them as they are"
            )
        if source is not None:
            remarks.append("ffmpeg is not installed, so a sound track, if there is one, was not kept")
    elif source is not None or target.suffix == ".mp4":
        joined = target.with_name(f".{target.stem}.joined{target.suffix}")
        try:
            problem = _join(program, partial, source, joined)
            if not problem:
                joined.replace(target)
                partial.unlink(missing_ok=True)
                return remarks
        finally:
            joined.unlink(missing_ok=True)
        if target.suffix == ".mp4":
            raise RuntimeError(f"ffmpeg could not make an mp4 ({problem}); take --video-format mkv")
        remarks.append(f"ffmpeg could not add the sound ({problem})")
    partial.replace(target)
    return remarks


def _join(program: str, frames: Path, source: Path | None, target: Path) -> str:
    """Frames and the sound of a source in one file; what went wrong, in words."""
    sound = ["-i", str(source), "-map", "0:v", "-map", "1:a?", "-c:a", "copy"] if source is not None else []
    coded = ["-c:v", "libx264", "-crf", "17", "-preset", "fast", "-pix_fmt", "yuv420p", "-fps_mode", "passthrough",
             "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]  # fmt: skip
    video = coded if target.suffix == ".mp4" else ["-c:v", "copy"]
    command = [program, "-nostdin", "-v", "error", "-y", "-i", str(frames), *sound, *video, str(target)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0 and target.is_file():
        return ""
    return (done.stderr.strip().splitlines() or ["no reason given"])[-1]


def free_name(path: Path) -> Path:
    """The path, or the first with a number behind it that is not taken: a recording is never written over."""
    found, number = path, 1
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found
