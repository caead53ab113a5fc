"""`rainstereo droplets`: how far simple drop models can be trusted, in general and for a user's own rig."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from rainstereo.apps import droplet_page
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.droplet_bench import Bench, camera_and_chamber, checked_face, checked_radius, scene_image
from rainstereo.apps.droplet_checks import checks
from rainstereo.apps.droplet_findings import Findings, figures
from rainstereo.apps.droplet_pictures import blurred, defocused, rim, sharp
from rainstereo.apps.droplet_tradeoff import timings
from rainstereo.apps.droplet_verdict import verdict
from rainstereo.apps.regime_maps import misuses, regime_map, sag, sweeps
from rainstereo.apps.run_record import Record
from rainstereo.drop_stack import DropStack
from rainstereo.droplet import SphericalCap
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.thin_lens import ThinLens

T = TypeVar("T")

FOCAL_LENGTHS_MM = (0.1, 2000.0)


@dataclass(frozen=True)
class Options:
    """See where the simple drop model x = u + R*B, y = v + G*B is good to a pixel, and where wrong by a hundred."""

    out: Path
    """Folder for OUT/report.html and OUT/report.json."""
    rig: Path | None = None
    """Rig folder as `rainstereo calibrate` writes it, with a chamber.toml: answers for its wet camera. Without it, the
    reference set-up of the field: a 3 mm pane of index 1.49 at 57 mm, 1280 x 960 pixels, focal length 1200 px."""
    radius_mm: float = 1.0
    """Radius of the drop's contact circle."""
    contact_angle_deg: float = 60.0
    """Angle at which the drop meets the panel, above 0 and at most 90."""
    field: float = 0.0
    """Where the drop is seen: 0 in the middle of the image, 1 in its corner."""
    depth_m: float = 20.0
    """Depth of the scene, or inf."""
    panel: int | None = None
    """Panel that the drop sits on, 0 being nearest to the camera; by default the last one."""
    face: Literal["near", "far"] = "far"
    """Its face towards the camera (near) or towards the scene (far)."""
    f_number: float = 1.4
    """F-number of the lens; inf is a pinhole. Sharp and blurred drops are both shown."""
    focal_length_mm: float = 4.5
    """Focal length of the lens, for the size of its aperture."""
    focus_m: float = math.inf
    """Distance at which the lens is focused."""
    tolerance: float = 2.0
    """Error that is allowed, in gray levels of 255."""
    tolerance_px: float = 1.0
    """Error that is allowed in where a drop's pixels look, in pixels."""
    image: Path | None = None
    """Your own photograph as the scene; by default a street drawn from the seed."""
    seed: int = 0
    """Of the street."""
    quick: bool = False
    """Coarser maps, a coarser scene and fewer drops, in half the time."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""


def run(options: Options) -> int:
    """Judge the drop models; 1 if a self-check fails."""
    record = Record("droplets", options)
    bench, drop = set_up(options)
    radius, angle, quick = drop.radius, drop.contact_angle, options.quick
    subject = "The reference set-up" if options.rig is None else "Your rig"
    with _Stages() as stage:
        in_focus = stage("the drop, sharp", lambda: sharp(bench, drop))
        out_of_focus = stage("the drop, blurred", lambda: blurred(bench, drop, quick))
        found = Findings(
            bench=bench,
            drop=drop,
            field=options.field,
            quick=quick,
            checks=stage("self-checks", lambda: checks(bench, drop, quick)),
            verdict=stage(
                "which tier, drop by drop",
                lambda: verdict(bench, radius, options.tolerance_px, options.tolerance, subject, quick),
            ),
            sharp=in_focus,
            blurred=out_of_focus,
            defocus=stage("F-numbers", lambda: defocused(bench, drop)),
            rim=stage("dark rim", lambda: rim(bench, drop)),
            maps=[
                stage(f"errors by {sweep.name}", partial(regime_map, bench, sweep, radius, options.field, quick))
                for sweep in sweeps(bench, quick)
            ],
            misuses=stage("textures used elsewhere", lambda: misuses(bench, radius, angle, options.field)),
            sag=stage("gravity", lambda: sag(bench, options.field, quick)),
            timings=stage("time against error", lambda: timings(bench, drop, in_focus, out_of_focus, quick)),
        )
    if not found.sound:
        record.status = "failed"
    for key, value in figures(found).items():
        record[key] = value
    record.write(options.out / "report.json")
    page = droplet_page.page(found, record)
    page.write(options.out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures)
    print(f"{found.sentence}\nSee {options.out / 'report.html'}")
    return DONE if found.sound else FAILED


def set_up(options: Options) -> tuple[Bench, SphericalCap]:
    """The bench and the drop that the options describe; ValueError says which option is wrong, and how to mend it."""
    radius = checked_radius(options.radius_mm)
    if not 0 < options.contact_angle_deg <= 90:
        raise ValueError(
            f"--contact-angle-deg {options.contact_angle_deg:g} was given; expected degrees, above 0 (a film without "
            "shape) and at most 90 (beyond, a drop overhangs, and no texture or height map describes it)"
        )
    if not 0 <= options.field <= 1:
        raise ValueError(f"--field {options.field:g} was given; expected 0 (middle of the image) to 1 (its corner)")
    if not FOCAL_LENGTHS_MM[0] <= options.focal_length_mm <= FOCAL_LENGTHS_MM[1]:
        raise ValueError(
            f"--focal-length-mm {options.focal_length_mm:g} was given; expected millimetres, {FOCAL_LENGTHS_MM[0]:g} "
            f"to {FOCAL_LENGTHS_MM[1]:g}"
        )
    for name, tolerance in (("--tolerance", options.tolerance), ("--tolerance-px", options.tolerance_px)):
        if not 0 < tolerance < math.inf:
            raise ValueError(f"{name} {tolerance:g} was given; expected more than 0")
    camera, chamber = camera_and_chamber(options.rig)
    panel, face = checked_face(chamber, options.panel, options.face)
    lens = ThinLens(options.focal_length_mm / 1000, options.f_number, options.focus_m)
    blank = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    bench = Bench(camera, chamber, panel, face, options.depth_m, lens, blank, SceneStatistics.natural())
    drop = bench.cap(radius, math.radians(options.contact_angle_deg), options.field)
    drop.check_fits(chamber)
    DropStack(chamber, [drop]).check_depth(options.depth_m)
    bench.window(drop)
    image = scene_image(camera, options.image, options.seed, coarse=options.quick)
    own = options.image is not None
    return replace(bench, image=image, statistics=SceneStatistics.of(image) if own else bench.statistics), drop


class _Stages:
    """Runs the stages one after the other while a line says which."""

    def __init__(self) -> None:
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self._bar = Progress(SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), transient=True)
        self._task = self._bar.add_task("")

    def __enter__(self) -> _Stages:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, name: str, work: Callable[[], T]) -> T:
        """What the work gives."""
        self._bar.update(self._task, description=name)
        return work()
