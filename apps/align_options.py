"""Options of `rainstereo align`, and what their texts mean."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2

from rainstereo.rectify import INFINITY, Plane
from rainstereo.warp import INTERPOLATION


@dataclass(frozen=True)
class Options:
    """Turn a recording into undistorted, cropped, aligned pairs; each image is interpolated once.

    A run that was interrupted, or killed, goes on where it stopped when it is repeated. Without --rig the alignment is
    estimated from the images.
    """

    dry: str
    """The dry camera: a folder (also Oxford RobotCar's, KITTI's), a quoted glob, a video, or a recording of ours."""
    wet: str
    """The wet camera, likewise: images named alike or by time; the same folder for a recording of ours."""
    out: Path
    """Folder for the pairs: OUT/dry/NAME.png, OUT/wet/NAME.png, OUT/pairs.csv, OUT/report.html, OUT/report.json."""
    rig: Path | None = None
    """Rig folder as `rainstereo calibrate` writes it. Without: a shift or a homography estimated from the images."""
    plane: str = "infinity"
    """Where the scene is taken to be: infinity, a depth in front of the dry camera (5m), a road below it (road:1.5m;
    camera looking down 2 degrees: road:1.5m:2deg), or auto: what leaves least disparity over the recording."""
    refine: Literal["auto", "off", "on"] = "auto"
    """Small rotation of the wet camera estimated from the recording: auto, applied where the rig does not explain the
    images; on, refused where it cannot be told; off."""
    model: Literal["auto", "shift", "homography"] = "auto"
    """Without a rig: how the wet image may lie on the dry one."""
    wet_side: Literal["auto", "left", "right"] = "auto"
    """Without a rig: where the wet camera stands, seen from behind. auto: told from the ground, if it can be."""
    photometric: bool = False
    """Take the wet camera's gray levels to the dry one's: gain and offset of each channel, and vignetting."""
    valid: bool = False
    """Also write OUT/valid/NAME.png: 255 nothing known against the pixel, 128 displaced, 64 hidden from the wet camera,
    0 out of a camera's field."""
    valid_px: float = 2.0
    """Displacement up to which a pixel counts as in place."""
    interpolation: str = "linear"
    """linear, cubic or lanczos."""
    format: str = "png"
    """File format: png, png:0 to png:9, tif, webp (lossless), or jpg:90 to jpg:100 (lossy, full colour resolution)."""
    sync_ms: float = 5.0
    """How far apart in time two images of a pair may be, where times are known."""
    drive: str | None = None
    """What the manifest calls this recording; by default the folder that holds both cameras."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""
    shard: str = "1/1"
    """Which part of the recording to do, such as 3/16 for a cluster's third of sixteen jobs; all may share OUT."""
    workers: int = 0
    """Processes that read, warp and write; 0: one a processor. Their number changes no byte."""
    overwrite: bool = False
    """Replace what other settings made in OUT."""


def parse_format(text: str) -> tuple[str, tuple[int, ...]]:
    """Suffix and the encoder's parameters. ValueError for anything else."""
    match = re.fullmatch(r"(png|jpg|tif|webp)(?::(\d{1,3}))?", text)
    kind, number = (match[1], None if match[2] is None else int(match[2])) if match else ("", None)
    if kind == "png" and (number is None or number <= 9):
        return ".png", (cv2.IMWRITE_PNG_COMPRESSION, 1 if number is None else number)
    if kind == "tif" and number is None:
        return ".tif", (cv2.IMWRITE_TIFF_COMPRESSION, 5)
    if kind == "webp" and number is None:
        return ".webp", (cv2.IMWRITE_WEBP_QUALITY, 101)
    if kind == "jpg" and 1 <= (number or 95) <= 100:
        full = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
        return ".jpg", (cv2.IMWRITE_JPEG_QUALITY, number or 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, full)
    raise ValueError(f"--format {text} is unknown; expected png, png:0 to png:9, tif, webp, or jpg:1 to jpg:100")


def plane_of(options: Options) -> Plane | None:
    """The plane that was asked for; None: to be found. ValueError where an option is wrong."""
    if options.interpolation not in INTERPOLATION:
        raise ValueError(f"interpolation {options.interpolation!r} is unknown; expected {', '.join(INTERPOLATION)}")
    if not options.valid_px > 0:
        raise ValueError(f"--valid-px {options.valid_px} was given; expected pixels above 0")
    plane = None if options.plane == "auto" else Plane.parse(options.plane)
    if options.rig is None and plane is not None and plane != INFINITY:
        raise ValueError(
            f"--plane {options.plane} needs --rig: without a calibration, depths mean nothing. Expected infinity "
            "(align the far scene) or auto (align what most of the images shows)"
        )
    return plane
