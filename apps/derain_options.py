"""The options of `rainstereo derain`, and the restorer that they ask for."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from rainstereo.apps.run_record import versions

if TYPE_CHECKING:
    from rainstereo.model.restore import Restorer

MOST_WORKERS = 64
MOST_RAW = 1 << 28


@dataclass(frozen=True)
class Options:
    """Take the rain off images and videos.

    Only cells of an image in which a detector finds drops are computed; the rest comes back bit for bit. A run that
    was interrupted goes on where it stopped when it is repeated, in a video at the frame.
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """Files, folders or quoted globs of images or videos; camera:0 (a camera's number, stopped by Ctrl-C or --frames);
    or - for raw frames on stdin (with --raw), whose restored frames go to stdout."""
    out: Path
    """Folder to write: OUT/NAME.png (videos: NAME.mkv), OUT/report.html, OUT/report.json."""
    checkpoint: Path | None = None
    """Weights (NAME.safetensors) in place of those of the package; for --backend onnx a file of rainstereo export."""
    device: str = "auto"
    """auto, cpu, cuda, cuda:1."""
    precision: Literal["auto", "float32", "bf16", "float16"] = "auto"
    """auto takes what the device multiplies fastest."""
    backend: Literal["torch", "onnx"] = "torch"
    """What runs the network."""
    skip: bool = True
    """Whether cells without drops are left as they are, and not computed."""
    threshold: float | None = None
    """Worth of restoring a cell of 16 pixels, 0 to 1, from which on it is, where it is computed."""
    certain: float | None = None
    """Worth of four cells together, 0 to 4, from which on they are computed; lower finds fainter drops, and more that
    are none."""
    evident: float | None = None
    """What some four cells of an image must be worth for any of it to be computed."""
    halo: int | None = None
    """Pixels that the network sees around what it restores."""
    tile: int | None = None
    """Side of the tiles of large images, in pixels."""
    max_megapixels: float | None = None
    """What is computed at once; larger images are tiled. Less needs less memory."""
    batch: int = 1
    """Images of one size that are computed together (on a GPU)."""
    workers: int = 2
    """Threads that read and write images while the network computes."""
    format: Literal["png", "jpg", "tif", "input"] = "png"
    """Of images."""
    raw: str | None = None
    """WIDTHxHEIGHTx3 (BGR) or x1 (gray), 8 bits: the size of raw frames."""
    frames: int | None = None
    """Frames to take from a camera."""
    video_format: Literal["mkv", "mp4"] = "mkv"
    """mkv holds each frame as a JPEG picture with its time; mp4 is coded by ffmpeg (H.264), which must be installed."""
    lossless: bool = False
    """Frames of mkv as PNG pictures."""
    detect_every: int = 1
    """Video: the detector looks at every n-th frame; drops that stand still keep their places in between."""
    hold: int = 1
    """Video: looks of the detector after which a place that is clear again is left alone."""
    reuse: float | None = None
    """Video: gray levels within which a place that did not change keeps its restored pixels. 8 cost 0.1 dB, and half
    the time where the camera stands; less than the sensor's noise keeps nothing."""
    overwrite: bool = False
    """Replace what other settings made in OUT."""
    sheet: bool = True
    """Whether report.html, with pictures before and after, is written."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""


def checked(options: Options) -> None:
    """ValueError for what makes no sense, before anything is loaded."""
    for name, low, high in (("batch", 1, 1024), ("workers", 1, MOST_WORKERS)):
        if not low <= getattr(options, name) <= high:
            raise ValueError(f"--{name} {getattr(options, name)} was given; expected {low} to {high}")
    if options.frames is not None and options.frames < 1:
        raise ValueError(f"--frames {options.frames} was given; expected 1 or more")
    special = [text for text in options.images if text == "-" or text.startswith("camera:")]
    if special and len(options.images) > 1:
        raise ValueError(f"{special[0]} was given beside other images; expected it alone")
    if ("-" in options.images) != (options.raw is not None):
        raise ValueError("raw frames need both: - as the input, and --raw WIDTHxHEIGHTx3")


def raw_shape(text: str) -> tuple[int, ...]:
    """(H, W, 3) or (H, W) of WIDTHxHEIGHTxCHANNELS."""
    match = re.fullmatch(r"(\d{1,6})x(\d{1,6})x([13])", text)
    width, height, channels = map(int, match.groups()) if match else (0, 0, 0)
    if not 0 < width * height * channels <= MOST_RAW:
        raise ValueError(f"--raw {text} was given; expected WIDTHxHEIGHTx3 (BGR) or x1 (gray), such as 640x480x3")
    return (height, width, 3) if channels == 3 else (height, width)


def restorer(options: Options) -> Restorer:
    """With the network loaded."""
    from rainstereo.model.restore import Restorer

    given: dict[str, float | int | None] = {
        "threshold": options.threshold, "certain": options.certain, "evident": options.evident,
        "halo": options.halo,
        "max_pixels": None if options.max_megapixels is None else int(options.max_megapixels * (1 << 20)),
    }  # fmt: skip
    more = {name: value for name, value in given.items() if value is not None}
    return Restorer(
        options.checkpoint,
        options.device,
        options.precision,
        options.tile,
        options.skip,
        options.backend,
        **more,  # type: ignore[arg-type]
    )


def key_of(options: Options, made: Restorer) -> str:
    """Changes when any byte of the output might, the inputs being the same."""
    from rainstereo.model import checkpoint
    from rainstereo.model.restore import leaves_out

    path = options.checkpoint or checkpoint.shipped()
    weights = hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
    settings = (
        leaves_out() if options.skip else "",
        options.threshold, options.certain, options.evident, options.halo, options.tile, options.max_megapixels,
        options.format, options.video_format, options.lossless, options.detect_every, options.hold, options.reuse,
    )  # fmt: skip
    made_with = [value for name, value in versions().items() if name in ("rainstereo", "torch", "opencv")]
    return hashlib.sha256(repr((weights, made.network.name, settings, made_with)).encode()).hexdigest()[:16]
