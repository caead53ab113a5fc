"""`rainstereo convert`: calibrations from and for OpenCV, ROS and Kalibr."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.run_record import Record, write_atomically
from rainstereo.calib.interchange import source, target
from rainstereo.calib.interchange.lens_fit import Loss
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.rig import Rig, Role

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True)
class Options:
    """Turn a calibration into another format: a rig folder, OpenCV FileStorage, ROS camera_info, Kalibr camchain.

    What a format cannot hold is stated in pixels, and refused above --tolerance-px unless --allow-loss is given. A
    report.json is written beside the result. docs/interchange.md has names, conventions and examples.
    """

    sources: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IN [IN]")]
    """A rig folder, a file of any of the formats (its content says which), or the two files of a rig: ROS's, mrcal's,
    or OpenCV's intrinsics and extrinsics. A folder with dry.yaml and wet.yaml, or left.yaml and right.yaml, will do."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """What to write: a rig folder; a .yaml, .xml or .json file; a folder for ROS's two files; NAME.cameramodel."""
    format: Literal["auto", "rig", "opencv", "ros", "kalibr"] = "auto"
    """Format to write. auto: a rig folder (a .cameramodel for a single camera), or opencv where IN is one."""
    first: Literal["auto", "dry", "wet"] = "auto"
    """Role of the first camera. auto: by the cameras' names where they say it, else dry."""
    chamber: Path | None = None
    """The panels that the cameras of IN look through, as a chamber.toml, for the rig that is written."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of lengths in IN: that of the board's squares, if OpenCV wrote it. What is written is in metres."""
    size: str | None = None
    """Image size, such as 1280x960, for files that do not say it."""
    tolerance_px: float = 0.1
    """Loss, at the worst pixel of an image, up to which a lens may be fitted by another one."""
    allow_loss: bool = False
    """Write in any case what can be held, and say what is lost."""


def run(options: Options) -> int:
    """Convert; 0, or 1 where that would lose too much and nothing was written."""
    record = Record("convert", options)
    if not options.tolerance_px >= 0:
        raise ValueError(f"--tolerance-px is {options.tolerance_px}; expected pixels, 0 or more")
    first: Role | None = None if options.first == "auto" else options.first
    read = source.read(
        options.sources, first=first, size=_size(options.size), metres=UNITS[options.unit],
        tolerance_px=options.tolerance_px,
    )  # fmt: skip
    ours = read.format == "rig" or (read.format == "cameramodel" and isinstance(read.content, Camera))
    wanted = options.format if options.format != "auto" else "opencv" if ours else "rig"
    content = read.content if options.chamber is None else _behind(options.chamber, read.content)
    record["from"], record["to"], record["notes"] = read.format, wanted, [n for n in read.notes if n]
    _check_out(options, wanted, content)
    written = None if wanted == "rig" else target.write(content, wanted, options.out)
    losses = {"IN": read.losses, "OUT": written.losses if written else {}}
    chamber = written.chamber if written else ()
    record["lens_losses"], record["chamber_losses"] = losses, chamber
    refusals = [
        f"{role}: {loss.words}" for side in losses.values() for role, loss in side.items() if _too_much(loss, options)
    ]
    refusals += [target.without_refraction(chamber)] if any(c.max_px > options.tolerance_px for c in chamber) else []
    for note in (*read.notes, *_told(losses), *([target.without_refraction(chamber)] if chamber else [])):
        if note:
            print(note)
    refused = bool(refusals) and not options.allow_loss
    record["refused"] = refusals if refused else []
    record.status = "refused" if refused else "ok"
    if refused:  # beside, not inside: a folder of that name may hold an earlier result
        record.write(options.out.with_name(f"{options.out.stem}.report.json"))
        print(
            f"refused: that is more than --tolerance-px {options.tolerance_px:g}; to write nevertheless: --allow-loss"
        )
        return FAILED
    files = _write(options.out, content, written.files if written else {})
    record["files"] = files
    record.write(_beside(options.out, wanted, content))
    print(f"{read.format} to {wanted}: {', '.join(map(str, files))}")
    return DONE


def _write(out: Path, content: Rig | Camera, files: Mapping[Path, bytes]) -> list[Path]:
    if files:
        return [write_atomically(path, data) for path, data in files.items()]
    if isinstance(content, Rig):
        content.save(out)
    else:
        write_atomically(out, content.text().encode())
    return [out]


def _behind(path: Path, content: Rig | Camera) -> Rig:
    if not isinstance(content, Rig):
        raise ValueError("--chamber was given for a single camera; expected the two cameras of a rig")
    return Rig(content.dry, content.wet, Chamber.load(path))


def _check_out(options: Options, wanted: str, content: Rig | Camera) -> None:
    """ValueError where what is to be written does not go into --out."""
    folder = isinstance(content, Rig) and wanted in ("rig", "ros")
    if folder and options.out.is_file():
        raise ValueError(f"--out {options.out} is a file; expected a folder, which a rig in this format needs")
    if not folder and options.out.is_dir():
        raise ValueError(f"--out {options.out} is a folder; expected the name of a file")
    if wanted == "rig" and not folder and options.out.suffix != ".cameramodel":
        raise ValueError(
            f"--out {options.out} was given; a single camera is written as NAME.cameramodel (or choose a --format)"
        )
    if wanted == "rig" and folder and (options.out / "chamber.toml").exists():
        raise ValueError(
            f"--out {options.out} holds a rig with its chamber; give another name, so that nothing is lost"
        )
    if wanted == "rig" and folder and options.out.suffix:
        raise ValueError(f"--out {options.out} looks like a file; a rig is a folder (or choose a --format)")
    for path in options.sources:
        if path.resolve() == options.out.resolve():
            raise ValueError(f"--out {options.out} is what is read; give another name, so that nothing is lost")


def _beside(out: Path, wanted: str, content: Rig | Camera) -> Path:
    if isinstance(content, Rig) and wanted in ("rig", "ros"):
        return out / "report.json"
    return out.with_name(f"{out.stem}.report.json")


def _too_much(loss: Loss, options: Options) -> bool:
    return not loss.within(options.tolerance_px)


def _told(losses: Mapping[str, Mapping[str, Loss]]) -> list[str]:
    return [f"{role}: {loss.words}" for side in losses.values() for role, loss in side.items()]


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise ValueError(f"--size {text} was given; expected WIDTHxHEIGHT, such as 1280x960")
    return int(found[1]), int(found[2])
