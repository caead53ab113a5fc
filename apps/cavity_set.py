"""The cavity set of OpenPTV's: four cameras look at a dot target through 6 mm of plexiglass into water.

A folder holds cam1.png to cam4.png, the target's dots in target_on_a_side.txt (number, x, y, z in mm), and OpenPTV's
own calibration of each camera, camN.tif.ori. The target is lit from the side; dust, glue and the edges of its plates
are in the way; cameras 1 and 2 look from one side, 3 and 4 from the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rainstereo import imagefile
from rainstereo.calib import dots, known_points
from rainstereo.calib.known_points import Free, Window
from rainstereo.camera import Camera
from rainstereo.chamber import Panel
from rainstereo.pose import rotation_vector
from rainstereo.types import Array, Image, Indices

SIZE = (1280, 1024)
PIXEL_MM = 0.012
PLEXIGLASS, WATER = Panel(0.006, 1.46), Panel(np.inf, 1.33)
NUMBERS = (1, 2, 3, 4)
SHIFT = (24.0, 45.0)
"""Pixels by which OpenPTV's files, made on another day, may be off in x and y: less than half of the dots' distance."""
TOGETHER, NEAR = 5.0, 3.0
MATCHES = (10.0, 6.0, 4.0, NEAR, NEAR)


@dataclass(frozen=True, eq=False)
class View:
    """One camera: its image, its wall, OpenPTV's calibration, and the dots it sees: number, position, pixel."""

    number: int
    image: Image
    window: Window
    openptv: Camera
    ids: Indices
    points: Array
    pixels: Array


def load(folder: Path) -> tuple[View, ...]:
    """The four views, their dots found and numbered. ValueError or FileNotFoundError: a file is not as expected."""
    ids, points = target(folder / "target_on_a_side.txt")
    return tuple(_view(folder, number, ids, points) for number in NUMBERS)


def target(path: Path) -> tuple[Indices, Array]:
    """Numbers, (N,), and positions, (N, 3) metres, of the target's dots."""
    rows = np.array(_numbers(path, limit=4000)).reshape(-1, 4)
    return rows[:, 0].astype(np.intp), rows[:, 1:] / 1000


def orientation(path: Path) -> tuple[Camera, Window]:
    """A camera and its wall from OpenPTV's .ori file (centre, angles, matrix, principal point, focal length, glass)."""
    v = _numbers(path, limit=21)
    if len(v) != 21:
        raise ValueError(f"{path} holds {len(v)} numbers; expected the 21 of an OpenPTV .ori file")
    centre, dm, principal, glass = v[:3] / 1000, v[6:15].reshape(3, 3), v[15:17], v[18:21] / 1000
    R = np.stack([dm[:, 0], -dm[:, 1], -dm[:, 2]])  # OpenPTV's camera has y up and looks along -z
    f = v[17] / PIXEL_MM
    cx = SIZE[0] / 2 + principal[0] / PIXEL_MM
    cy = SIZE[1] / 2 - principal[1] / PIXEL_MM
    intrinsics, pose = np.array([f, f, cx, cy, 0, 0, 0, 0]), np.concatenate([rotation_vector(R), -R @ centre])
    away = glass / np.linalg.norm(glass)  # the vector leads from the origin to the wall's face in the water
    window = Window(glass + PLEXIGLASS.thickness * away, -away, (PLEXIGLASS, WATER), (0.0,))
    return Camera("LENSMODEL_OPENCV4", intrinsics, *SIZE, pose), window


def _view(folder: Path, number: int, ids: Indices, points: Array) -> View:
    image = imagefile.read(folder / f"cam{number}.png", gray=True)
    if image.shape != SIZE[::-1]:
        raise ValueError(
            f"cam{number}.png is {image.shape[1]} x {image.shape[0]}; expected {SIZE[0]} x {SIZE[1]} pixels"
        )
    camera, window = orientation(folder / f"cam{number}.tif.ori")
    found = dots.find(image).centres
    which, pixels = _numbered(points, found, camera, window)
    return View(number, image, window, camera, ids[which], points[which], pixels)


def _numbered(points: Array, found: Array, camera: Camera, window: Window) -> tuple[Indices, Array]:
    """Which points were found where: by the commonest shift from OpenPTV's prediction, then by fits that follow it."""
    predicted = known_points.seen(points, camera, window)
    shifts = (found[None] - predicted[:, None]).reshape(-1, 2)
    shifts = shifts[(np.abs(shifts) < SHIFT).all(-1)]
    votes = np.array([(np.hypot(*(shifts - shift).T) < TOGETHER).sum() for shift in shifts])
    if not len(votes) or votes.max() < 12:
        raise ValueError("the target's pattern is not among the dots found; expected the cavity set's images")
    common = np.hypot(*(shifts - shifts[votes.argmax()]).T) < TOGETHER
    predicted = predicted + np.median(shifts[common], axis=0)
    for turn, reach in enumerate(MATCHES):
        apart = np.linalg.norm(found[None] - predicted[:, None], axis=-1)
        nearest, near = apart.argmin(1), apart.min(1) < reach
        free = Free(focal=turn > 0, radial=0)
        camera = known_points.fit(points[near], found[nearest[near]], camera, window, free, robust_px=1.0)
        predicted = known_points.seen(points, camera, window)
    apart = np.linalg.norm(found[None] - predicted[:, None], axis=-1)
    nearest, near = apart.argmin(1), apart.min(1) < NEAR
    return np.flatnonzero(near), found[nearest[near]]


def _numbers(path: Path, limit: int) -> Array:
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected a folder with OpenPTV's cavity set")
    if path.stat().st_size > 1 << 20:
        raise ValueError(f"{path} is too large; expected a few lines of numbers")
    try:
        values = np.array(path.read_text().split(), np.float64)
    except ValueError as error:
        raise ValueError(f"{path} holds something besides numbers ({error}); expected OpenPTV's format") from error
    if len(values) > limit or not np.isfinite(values).all():
        raise ValueError(f"{path} holds {len(values)} numbers; expected at most {limit}, all finite")
    return values
