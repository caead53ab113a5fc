"""The options of `rainstereo rain`, and the rain that they ask for."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

from rainstereo import Rig, imagefile
from rainstereo.apps.rain_motion import MotionKind
from rainstereo.apps.rain_presets import REGIMES, Setup, preset
from rainstereo.apps.rain_settings import Rain, Size
from rainstereo.apps.rain_sources import Source
from rainstereo.rain.render import Surround
from rainstereo.rig import Role


@dataclass(frozen=True)
class Options:
    """Put adherent rain on images: drops on a pane, refracted exactly, out of focus as the lens has it.

    The same options and seed give the same bytes, whatever the number of workers, shards or other images. A run that
    was interrupted goes on where it stopped when it is repeated. A video's sound is not kept.
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """Files, folders or quoted globs of images or videos; or the folder of a data set with labels (Cityscapes:
    leftImg8bit and gtFine; CamVid: images and labels, or train and trainannot)."""
    out: Path
    """Folder to write: OUT/NAME.png, OUT/drops/NAME.json, OUT/report.html, OUT/report.json."""
    preset: str = "adherent"
    """adherent, paper, mist, drops, large or streaks; or camvid, cityscapes or robotcar, with that camera."""
    psnr: float | None = None
    """Severity: PSNR in dB against the clear image, met by the number of drops (the paper: 16.8 and 16.9)."""
    psnr_over: Literal["image", "set"] = "image"
    """Whether each image has that PSNR, whatever else is rendered; or the mean over the set, all images under rain of
    one law, as the paper's figures are means. A sequence or video is one set."""
    psnr_tolerance: float = 0.1
    """dB by which it may be missed."""
    seed: int = 0
    """Decides everything that is drawn at random."""
    drops: Path | None = None
    """Render this drop list (OUT/drops/NAME.json of an earlier run) on all images instead."""
    population: str | None = None
    """Population in place of the preset's: adherent, paper, mist, drops, large or streaks."""
    cover: float | None = None
    """Share of the pane that is wet, 0 to 0.95, in place of the population's."""
    merge: bool = False
    """Make one body of drops that touch, of their volume, on images, too; in motion they always are."""
    focal_px: float | None = None
    """Focal length in pixels at the images' own width, in place of the preset's."""
    distance_mm: float | None = None
    """Camera to the near face of the pane."""
    thickness_mm: float | None = None
    """Thickness of the pane; its far face is wet."""
    f_number: float | None = None
    """Aperture; inf: a pinhole, all drops sharp."""
    focal_length_mm: float | None = None
    """Focal length of the lens, which with the F-number makes the aperture."""
    focus_m: float | None = None
    """Distance that is in focus; inf."""
    depth_m: float = math.inf
    """Distance of the scene."""
    rig: Path | None = None
    """Rig folder: its camera and chamber in place of the preset's. Images must have the camera's size."""
    role: Role = "wet"
    """Which camera of the rig."""
    tolerance: float = 1.0
    """Gray levels of 8 bits, RMS inside sharp drops, that rendering may be off."""
    border: Literal["mirror", "edge"] = "mirror"
    """How the scene goes on beyond the image, where drops look there."""
    surround: tuple[int, int, int, int] | None = None
    """LEFT TOP RIGHT BOTTOM, pixels: rain is put on the part of each image inside these, and what drops show from
    beyond it is the image itself. OUT holds that part, of images and labels; camera and --rig are the whole image's."""
    linear_light: bool = False
    """Take values for sRGB and average light."""
    masks: bool = False
    """Also OUT/masks/NAME.png: red where a drop is, green its opacity, blue where unknown content shows."""
    displacement: Literal["none", "float16", "float32"] = "none"
    """Also OUT/displacement/NAME.npz: pixels from each pixel to what it shows; NaN in dark rims."""
    drop_lists: bool = True
    """Whether OUT/drops/NAME.json is written, from which --drops makes the frame again."""
    labels: Path | None = None
    """Folder of label images, PNG, named as the images; copied to OUT/labels."""
    void_label: int = 255
    """What means no label there. Data sets have their own."""
    unknown_labels: Literal["copied", "marked"] = "copied"
    """marked: void where a drop hides more than half of a pixel's scene, or shows what the image does not hold."""
    sequence: bool = False
    """Take the images, in order of their names, for frames of one drive."""
    motion: MotionKind | None = None
    """Of drops in sequences and videos: physical (default), the paper's rule, or still."""
    quick: bool = False
    """For sequences and videos whose sharp drops mostly move: traced for each frame, off by 1 gray level or so with
    numba (the extra `fast`), and by 4 without."""
    refill_s: float = 5.0
    """Seconds in which as many drops fall on a sequence's pane as are there at the start; inf: none fall."""
    fps: float | None = None
    """Frames a second of a sequence (default 30), or in place of a video's own."""
    format: Literal["png", "jpg", "tif", "input"] = "png"
    """Of images."""
    video_format: Literal["mp4", "mkv", "avi"] = "mp4"
    """Of videos; mkv is lossless (FFV1)."""
    ssim: bool = True
    """Whether SSIM is measured, too."""
    realism_wet: tuple[Path, ...] = ()
    """Real rainy images: OUT/realism.html shows rain of these options, fitted to them, beside each."""
    realism_clear: tuple[Path, ...] = ()
    """The same scenes without rain, of the same sizes, in the same order; shifted sideways if they must be."""
    workers: int = 1
    """Processes that render; 0: one a processor."""
    shard: str = "1/1"
    """Make only a part of the images: 3/16 is the third of sixteen."""
    overwrite: bool = False
    """Replace what other settings made in OUT."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""


def parse_shard(text: str) -> tuple[int, int]:
    """Number, from 1, and count."""
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    number, count = map(int, match.groups()) if match else (0, 0)
    if not 1 <= number <= count:
        raise ValueError(f"--shard {text} was given; expected N/COUNT, such as 3/16 for the third of sixteen")
    return number, count


def settings(options: Options, images: list[Source]) -> Rain:
    """What decides the rain. ValueError where an option is wrong."""
    if options.seed < 0:
        raise ValueError(f"--seed {options.seed} was given; expected a whole number, 0 or more")
    if options.psnr is not None and not 1 <= options.psnr <= 60:
        raise ValueError(f"--psnr {options.psnr} was given; expected decibels from 1 to 60, such as 16.9")
    if options.psnr is not None and (options.cover is not None or options.drops is not None):
        raise ValueError("--psnr decides how many drops there are; leave out --cover and --drops, or --psnr")
    if options.fps is not None and not 0.1 <= options.fps <= 1000:
        raise ValueError(f"--fps {options.fps} was given; expected frames a second, 0.1 to 1000")
    if not options.refill_s >= 0.1:
        raise ValueError(f"--refill-s {options.refill_s} was given; expected seconds, 0.1 or more, or inf")
    seen = None
    if options.rig is not None:
        rig = Rig.load(options.rig)
        chamber = rig.chamber_in(options.role)
        if chamber is None or not chamber.panels:
            raise ValueError(f"the rig {options.rig} has no chamber, so there is nothing for rain to fall on")
        seen = rig.camera(options.role), chamber
    rain = Rain(
        _setup(options, images), options.seed, options.depth_m, options.tolerance, _border(options),
        options.linear_light, options.psnr, options.psnr_tolerance, None, seen,
        None if options.drops is None else options.drops.read_text(encoding="utf-8"), options.merge, options.quick,
    )  # fmt: skip
    listed = rain.drop_list
    sides = options.surround or (0, 0, 0, 0)
    any_size = 64 + sides[0] + sides[2], 48 + sides[1] + sides[3]
    rain.renderer(listed[0].scene_size if listed else seen[0].size if seen else any_size)  # says what is wrong
    return rain


def _border(options: Options) -> str | Surround:
    if options.surround is None:
        return options.border
    if options.drops is not None:
        raise ValueError(
            "--surround and --drops were given; a drop list says itself what is around its frame, so leave out "
            "--surround"
        )
    if options.border != "mirror":
        raise ValueError(
            "--surround and --border edge were given; what lies beyond the whole image is mirrored, so leave out one"
        )
    if not any(options.surround):
        raise ValueError(
            "--surround 0 0 0 0 was given; expected pixels LEFT TOP RIGHT BOTTOM around the part of each image that "
            "gets rain, such as 64 48 64 48"
        )
    try:
        return Surround(*options.surround)
    except ValueError as error:
        raise ValueError(f"--surround {' '.join(map(str, options.surround))}: {error}") from error


def size_of(source: Source) -> Size:
    """(width, height) of an image; ValueError names a file that cannot be read."""
    try:
        height, width = imagefile.read(source.path).shape[:2]
    except imagefile.UnreadableImageError as error:
        raise ValueError(f"the first image, {source.path}, tells no size: {error}") from error
    return width, height


def _setup(options: Options, images: list[Source]) -> Setup:
    setup = preset(options.preset)
    if options.population is not None:
        if options.population not in REGIMES:
            raise ValueError(f"--population {options.population} is unknown; there are {', '.join(REGIMES)}")
        setup = replace(setup, population=REGIMES[options.population])
    if options.cover is not None:
        setup = replace(setup, population=setup.population.with_cover(options.cover))
    if options.focal_px is not None:
        if not images or not 1 <= options.focal_px <= 1e6:
            raise ValueError(f"--focal-px {options.focal_px} was given; expected pixels, above 1, and images")
        setup = replace(setup, focal=options.focal_px / size_of(images[0])[0], source="given")
    given = {
        "distance": options.distance_mm, "thickness": options.thickness_mm, "focal_length": options.focal_length_mm,
    }  # fmt: skip
    metres = {name: value / 1000 for name, value in given.items() if value is not None}
    plain = {"f_number": options.f_number, "focus": options.focus_m}
    setup = replace(setup, **metres, **{name: value for name, value in plain.items() if value is not None})  # type: ignore[arg-type]
    _ = setup.chamber, setup.lens  # say what is wrong with the numbers
    return setup
