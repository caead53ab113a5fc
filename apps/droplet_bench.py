"""The set-up in which `rainstereo droplets` judges drops: camera, panels, face, lens, depth, and a scene to look at."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from rainstereo import Camera, Chamber, Panel, Rig, footprint, imagefile
from rainstereo.apps.street import drive, street
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.panel_plane import FACES, PanelFrame, room
from rainstereo.pose import compose
from rainstereo.refraction import backproject
from rainstereo.scene import render
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.thin_lens import ThinLens
from rainstereo.tiers import Sampling, Tier, Tracer, sampling, tracer
from rainstereo.types import Array, Image, Mask
from rainstereo.view import View

REFERENCE_CAMERA = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
REFERENCE_PANE = Chamber((0.0, 0.0, 1.0), 0.057, (Panel(0.003, 1.49),))
"""The set-up that the literature's figures are for: a pane of acrylic, its far face at 60 mm."""

RADII_MM = (0.05, 10.0)
RAYS = 400_000  # that are traced at once
STRIP = 32000  # places that are looked up at once: OpenCV's maps are shorter than 32767


@dataclass(frozen=True, eq=False)
class Bench:
    """Where the drops are. Everything in the camera's frame, metres; `image` is what the camera sees without drops.

    statistics: of the images in whose gray levels errors are expected.
    """

    camera: Camera
    chamber: Chamber
    panel: int
    face: str
    depth: float
    lens: ThinLens
    image: Image
    statistics: SceneStatistics

    def cap(self, radius: float, contact_angle: float, field: float) -> SphericalCap:
        """A cap on the bench's face, metres and radians, a share of the way from the image's middle to its corner."""
        return SphericalCap(self.place(field), radius, contact_angle, panel=self.panel, face=self.face)

    def place(self, field: float) -> tuple[float, float]:
        """Where on the panel's plane the pixel at that share of the way to the lower right corner sees it."""
        corner = np.array(self.camera.size) - 1.0
        pixel = corner * (0.5 + 0.5 * field)
        layer = 2 * self.panel + (2 if self.face == "far" else 1)
        if self.face == "far" and math.isinf(self.chamber.panels[self.panel].thickness):
            layer -= 1
        frame = PanelFrame.of(self.chamber)
        point = frame.R_panel_cam @ backproject(pixel, self.camera, self.chamber, layer).origins
        x, y = (point - frame.base(self.chamber, (0.0, 0.0), self.panel, self.face))[:2]
        if not (math.isfinite(x) and math.isfinite(y)):
            raise ValueError(
                f"the pixel {pixel.round(1).tolist()} does not see the panels (they lean too far, or the lens model "
                "ends before); choose a --field nearer to 0, or check the chamber's normal"
            )
        return float(x), float(y)

    def at_distance(self, distance: float) -> Bench:
        """The same with the drop's face that far from the camera along the normal, metres."""
        return replace(self, chamber=replace(self.chamber, distance=self.chamber.distance + distance - self.distance))

    @property
    def distance(self) -> float:
        """Of the drop's face along the normal, metres."""
        shift = self.chamber.panels[self.panel].thickness if self.face == "far" else 0.0
        return float(self.chamber.faces[self.panel]) + shift

    @cached_property
    def faces(self) -> list[tuple[int, str]]:
        """All faces that can carry a drop, the camera's side first."""
        every = [(i, face) for i in range(len(self.chamber.panels)) for face in FACES]
        return [(i, face) for i, face in every if face == "near" or math.isfinite(self.chamber.panels[i].thickness)]

    # -- looking ---------------------------------------------------------------------------------------------------

    def tracer(self, tier: Tier, drop: Drop) -> Tracer:
        """`tiers.tracer` on this bench."""
        return tracer(tier, drop, self.camera, self.chamber, self.depth)

    def window(self, drop: Drop, margin: float = 0.0) -> tuple[slice, slice]:
        """`footprint.window` on this bench. ValueError if the camera does not see the drop."""
        rows, columns = footprint.window(drop, self.camera, self.chamber, margin)
        if rows.start == rows.stop or columns.start == columns.stop:
            raise ValueError(
                f"the camera does not see a drop of {drop.reach * 1000:.3g} mm at {drop.centre}; choose a --field "
                "between 0 (the middle of the image) and 1 (its corner)"
            )
        return rows, columns

    def lattice(self, drop: Drop, side: int) -> Array:
        """side x side places, (side^2, 2) pixels, evenly over the drop's window, between the whole pixels too."""
        rows, columns = footprint.window(drop, self.camera, self.chamber)
        if rows.start == rows.stop or columns.start == columns.stop:
            return np.empty((0, 2))
        along = (np.arange(side) + 0.5) / side
        x = columns.start - 0.5 + (columns.stop - columns.start) * along
        y = rows.start - 0.5 + (rows.stop - rows.start) * along
        return np.asarray(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))

    def sampling(self, tier: Tier, look: Tracer, pixels: Array, drop: Drop, lens: ThinLens | None = None) -> Sampling:
        """`tiers.sampling` on this bench; lens: None takes the bench's own."""
        return sampling(tier, look, pixels, drop, self.camera, self.chamber, self.depth, lens or self.lens)

    def values(self, found: Sampling) -> Array:
        """Gray levels, (P, 3), of pixels that are made so, before they are rounded."""
        colours = look_up(self._light, found.places, found.weights > 0)
        return np.asarray((found.weights[..., None] * colours).sum(1))

    @cached_property
    def _light(self) -> Array:
        return self.image.astype(np.float32)

    def render(
        self, tier: Tier, drop: Drop, window: tuple[slice, slice], lens: ThinLens | None = None
    ) -> tuple[Array, Mask]:
        """Gray levels of a window of the image by a tier, (h, w, 3), and which of its pixels the drop touches."""
        look = self.tracer(tier, drop)
        pixels = grid(window)
        shape = pixels.shape[:2]
        pixels = pixels.reshape(-1, 2)
        step = max(1, RAYS // (256 if tier.is_defocused else tier.rays))
        light, touched = np.empty((len(pixels), 3)), np.zeros(len(pixels), dtype=np.bool_)
        for begin in range(0, len(pixels), step):
            block = slice(begin, begin + step)
            found = self.sampling(tier, look, pixels[block], drop, lens)
            light[block], touched[block] = self.values(found), (found.drop > 0).any(-1)
        return light.reshape(*shape, 3), touched.reshape(shape)


def look_up(image: Array, places: Array, wanted: Mask) -> Array:
    """Values, (..., 3), of a float32 image at places, (..., 2): bilinear, mirrored at its edges; 0 where not wanted."""
    last = np.array(image.shape[1::-1]) - 1.0
    safe = np.where(wanted[..., None], places, 0.0)
    folded = last - np.abs(np.mod(safe, 2 * last) - last)
    maps = folded.astype(np.float32).reshape(1, -1, 2)
    strips = [maps[:, i : i + STRIP] for i in range(0, maps.shape[1], STRIP)]
    found = [cv2.remap(image, strip, None, cv2.INTER_LINEAR) for strip in strips]  # type: ignore[call-overload]
    values: Array = np.concatenate(found, 1)[0].reshape(*places.shape[:-1], 3)
    return np.asarray(np.where(wanted[..., None], values, 0.0))


def grid(window: tuple[slice, slice]) -> Array:
    """Centres of a window's pixels, (h, w, 2)."""
    rows, columns = window
    along = np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop))
    return np.asarray(np.stack(along, -1), dtype=np.float64)


def camera_and_chamber(rig: Path | None) -> tuple[Camera, Chamber]:
    """The wet camera of a rig folder and its chamber in that camera's frame, or the reference set-up."""
    if rig is None:
        return REFERENCE_CAMERA, REFERENCE_PANE
    found = Rig.load(rig)
    chamber = found.chamber_in("wet")
    if chamber is None or not chamber.panels:
        raise ValueError(
            f"the rig {rig} has no panels, and a drop needs one to sit on. Put a chamber.toml into the folder (normal, "
            "distance_mm, gaps_mm, and a [[panel]] with thickness_mm and index for each), or leave --rig out to see "
            "the reference pane"
        )
    return found.wet, chamber


def checked_face(chamber: Chamber, panel: int | None, face: str) -> tuple[int, str]:
    """The panel (None: the last) and the face; ValueError where the chamber lacks them or stands behind the camera."""
    PanelFrame.of(chamber)
    panel = len(chamber.panels) - 1 if panel is None else panel
    room(chamber, panel, face)
    return panel, face


def checked_radius(radius_mm: float) -> float:
    """The radius in metres; ValueError says so if it looks like metres."""
    if RADII_MM[0] <= radius_mm <= RADII_MM[1]:
        return radius_mm / 1000
    metres = f" That looks like metres: try --radius-mm {radius_mm * 1000:g}." if 2e-5 <= radius_mm < 0.02 else ""
    raise ValueError(
        f"--radius-mm {radius_mm:g} was given; expected the radius of the drop's contact circle in millimetres, "
        f"{RADII_MM[0]:g} to {RADII_MM[1]:g}.{metres}"
    )


def scene_image(camera: Camera, photograph: Path | None, seed: int, *, coarse: bool = False) -> Image:
    """What the camera sees without drops, (H, W, 3) uint8: a photograph cut to its size, or the street.

    coarse: render the street at a third of the resolution and enlarge it, which takes a ninth of the time.
    """
    if photograph is None:
        eye = _reduced(camera, 3) if coarse else camera
        seen = render(View.trace(eye), street(seed), compose(np.zeros(6), drive(1, seed)[0]))
        return fitted(np.asarray(np.clip(np.rint(seen.image), 0, 255), dtype=np.uint8), camera.size)
    try:
        image = imagefile.read(photograph)
    except imagefile.UnreadableImageError as error:
        raise ValueError(f"--image {photograph}: {error}") from error
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    return fitted(np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image, camera.size)


def _reduced(camera: Camera, step: int) -> Camera:
    """A pinhole camera of the same view with pixels that many times as large."""
    fx, fy, cx, cy = camera.intrinsics[:4] / step
    return Camera.pinhole(fx, fy, cx, cy, -(-camera.width // step), -(-camera.height // step))


def fitted(image: Image, size: tuple[int, int]) -> Image:
    """The middle of an image, cut and scaled to (width, height)."""
    scale = max(size[0] / image.shape[1], size[1] / image.shape[0])
    width, height = (max(n, round(m * scale)) for n, m in zip(size, image.shape[1::-1], strict=True))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    scaled = cv2.resize(image, (width, height), interpolation=method)
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    return np.ascontiguousarray(scaled[top : top + size[1], left : left + size[0]])
