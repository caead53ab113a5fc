"""A Rig or a Camera as the files of a format, and what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rainstereo import refraction
from rainstereo.calib.interchange import kalibr_file, lens_fit, opencv_file, ros_file
from rainstereo.calib.interchange.described import DescribedSet, Kind
from rainstereo.calib.interchange.lens_fit import Loss
from rainstereo.camera import Camera
from rainstereo.rig import ROLES, Rig

LENSES: dict[str, tuple[tuple[Kind, int], ...]] = {
    "opencv": (("opencv", 12),),
    "ros": (("opencv", 8),),
    "kalibr": (("opencv", 4), ("equidistant", 4)),
}
"""The lenses that each format holds, by largest number of coefficients."""
RANGES = (0.3, 1.0, 3.0, 10.0, 30.0)


@dataclass(frozen=True)
class ChamberLoss:
    """Pixels by which the panels shift what a camera sees at a range in metres: all over the image, and at most."""

    range_m: float
    median_px: float
    max_px: float


@dataclass(frozen=True, eq=False)
class Target:
    """The files of a format, by path, and what writing them cost: lenses by role, and the panels that none can hold."""

    files: Mapping[Path, bytes]
    losses: Mapping[str, Loss]
    chamber: tuple[ChamberLoss, ...] = ()


def write(content: Rig | Camera, format_name: str, out: Path) -> Target:
    """The files as bytes; nothing is written. out: a file, or for a rig in ROS's format a folder."""
    named = {"": content} if isinstance(content, Camera) else {role: content.camera(role) for role in ROLES}
    found = {role: lens_fit.from_camera(camera, LENSES[format_name], role) for role, camera in named.items()}
    rt = None if isinstance(content, Camera) else content.rt_wet_dry
    described = DescribedSet(format_name, tuple(lens for lens, _ in found.values()), rt)
    losses = {role or "camera": loss for role, (_, loss) in found.items() if loss is not None}
    chamber = chamber_losses(content) if isinstance(content, Rig) else ()
    return Target(_files(described, format_name, out), losses, chamber)


def chamber_losses(rig: Rig) -> tuple[ChamberLoss, ...]:
    """What leaving the panels out costs at some ranges, over both cameras' images; empty without panels."""
    if rig.chamber is None:
        return ()
    found = []
    for distance in RANGES:
        shifts = []
        for role in ROLES:
            camera, chamber = rig.camera(role), rig.chamber_in(role)
            pixels = lens_fit.grid(camera.size, lens_fit.ACROSS)
            seen, _ = refraction.project(distance * camera.unproject(pixels), camera, chamber)
            shifts.append(np.hypot(*(seen - pixels).T))
        shift = np.concatenate(shifts)
        shift = shift[np.isfinite(shift)]
        if shift.size:
            found.append(ChamberLoss(distance, float(np.median(shift)), float(shift.max())))
    return tuple(found)


def _files(described: DescribedSet, format_name: str, out: Path) -> dict[Path, bytes]:
    if format_name == "opencv":
        if out.suffix.lower() not in opencv_file.SUFFIXES:
            raise ValueError(f"--out {out} was given; expected a file name ending in {', '.join(opencv_file.SUFFIXES)}")
        return {out: opencv_file.text(described, out.suffix.lower()).encode()}
    if format_name == "kalibr":
        return {out: kalibr_file.text(described).encode()}
    texts = ros_file.texts(described)
    if len(texts) == 1:
        return {out: next(iter(texts.values())).encode()}
    if out.suffix.lower() in (".yaml", ".yml"):
        raise ValueError(f"--out {out} was given; ROS keeps each camera in a file of its own: expected a folder")
    return {out / f"{name}.yaml": text.encode() for name, text in texts.items()}


def without_refraction(losses: tuple[ChamberLoss, ...]) -> str:
    """In words, what it means that no format holds the panels."""
    parts = ", ".join(f"{one.max_px:.2g} px at {one.range_m:g} m (median {one.median_px:.2g})" for one in losses)
    return f"no such file holds the panels: without them the rig is wrong by up to {parts}, and right at infinity"
