"""From a lens as others describe it to a Camera and back: exactly where both know it, else fitted over the image.

What a fit costs is measured on pixels all over the image: how far apart the two lenses see the same ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from rainstereo import lens
from rainstereo.calib.interchange import equidistant
from rainstereo.calib.interchange.described import Described, Kind
from rainstereo.camera import NATIVE, Camera
from rainstereo.types import Array

ACROSS = 33
"""Points of the grid along the longer side, to fit with; losses are taken on a grid of twice as many."""
NEAR_THE_PLANE = 0.1
"""Rays with a smaller cosine to the axis take no part in fits of OpenCV's models, which cannot reach 90 degrees."""


@dataclass(frozen=True)
class Loss:
    """What a fit costs: pixels between the lenses for the same ray, and the share of the image without an answer."""

    lens: str
    rms_px: float
    max_px: float
    unanswered: float

    @property
    def words(self) -> str:
        """The loss in one sentence's worth of words."""
        lost = f", and {self.unanswered:.1%} of the image has no answer" if self.unanswered else ""
        return f"fitted as {self.lens}: off by {self.rms_px:.2g} px RMS and {self.max_px:.2g} px at most{lost}"

    def within(self, tolerance_px: float) -> bool:
        """Whether it costs no more than that anywhere in the image."""
        return self.max_px <= tolerance_px and self.unanswered == 0


def to_camera(described: Described, tolerance_px: float) -> tuple[Camera, Loss | None]:
    """A Camera at the origin that sees as the lens described, and what that costs (None: nothing).

    Kannala and Brandt's lens is fitted as LENSMODEL_OPENCV8, or, where that is off by more than the tolerance and
    mrcal is there to compute it, as a splined model.
    """
    if described.kind == "opencv":
        return described.as_camera(), None
    pixels = grid(described.size, ACROSS)
    rays = described.unproject(pixels)
    fitted = _fit_opencv(rays, pixels, 8, described).as_camera()
    loss = measured(described, fitted, fitted.model)
    if not loss.within(tolerance_px):
        try:
            from rainstereo.calib.interchange import splined_fit

            many = grid(described.size, 2 * ACROSS)
            camera = splined_fit.fit(described.unproject(many), many, described.size)
        except ImportError:
            return fitted, loss
        better = measured(described, camera, camera.model)
        if (better.unanswered, better.max_px) < (loss.unanswered, loss.max_px):
            return camera, better
    return fitted, loss


def from_camera(camera: Camera, kinds: Sequence[tuple[Kind, int]], name: str = "") -> tuple[Described, Loss | None]:
    """The camera's lens in one of the kinds that a format knows (kind, largest count of coefficients), and the loss.

    Without loss where coefficients that the format lacks are zero; else each kind is fitted, and the closest taken.
    """
    if camera.model in NATIVE:
        k = np.trim_zeros(camera.distortion, "b")
        count = next(n for n in (0, 4, 5, 8, 12) if n >= len(k))
        if any(kind == "opencv" and count <= most for kind, most in kinds):
            padded = np.concatenate([k, np.zeros(count - len(k))])
            return Described("opencv", camera.intrinsics[:4], padded, camera.size, name), None
    pixels = grid(camera.size, ACROSS)
    rays = camera.unproject(pixels)
    like = Described("opencv", _core_of(camera, rays, pixels), np.zeros(0), camera.size, name)
    found = []
    for kind, count in kinds:
        fitted = (
            _fit_equidistant(rays, pixels, like) if kind == "equidistant" else _fit_opencv(rays, pixels, count, like)
        )
        found.append((fitted, measured(camera, fitted, f"{kind} with {count} coefficients")))
    return min(found, key=lambda pair: (pair[1].unanswered, pair[1].max_px))


def grid(size: tuple[int, int], across: int) -> Array:
    """Pixels, (N, 2), all over an image, its edges among them."""
    step = max(size) / across
    x, y = (np.linspace(-0.5, side - 0.5, max(2, round(side / step) + 1)) for side in size)
    return np.asarray(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))


def measured(true: Camera | Described, fitted: Camera | Described, name: str) -> Loss:
    """How far apart two lenses see the rays of pixels all over the image of the first."""
    pixels = grid(true.size, 2 * ACROSS + 7)  # not the points that were fitted
    rays = true.unproject(pixels)
    known = np.isfinite(rays).all(-1)
    off = np.hypot(*(fitted.project(rays[known]) - pixels[known]).T)
    answered = np.isfinite(off)
    if not answered.any():
        return Loss(name, np.inf, np.inf, 1.0)
    off = off[answered]
    return Loss(name, float(np.sqrt(np.mean(off**2))), float(off.max()), float(1 - answered.mean()))


def _core_of(camera: Camera, rays: Array, pixels: Array) -> Array:
    """fx, fy, cx, cy to start from: of models whose first four intrinsics are not these, too."""
    use = np.isfinite(rays).all(-1) & (rays[:, 2] > 0.7)
    if not use.any():
        raise ValueError(f"{camera.model} sees nothing ahead within its image; expected a camera that looks along z")
    a, b = rays[use, 0] / rays[use, 2], rays[use, 1] / rays[use, 2]
    (fx, cx), (fy, cy) = (
        np.linalg.lstsq(np.column_stack([t, np.ones_like(t)]), pixels[use, i], rcond=None)[0]
        for i, t in ((0, a), (1, b))
    )
    return np.array([fx, fy, cx, cy])


def _fit_opencv(rays: Array, pixels: Array, count: int, like: Described) -> Described:
    """The closest lens of OpenCV's with that many coefficients."""
    use = np.isfinite(rays).all(-1)
    use[use] = rays[use, 2] > NEAR_THE_PLANE
    if use.sum() < 20 + count:
        raise ValueError("the lens described has no rays ahead within its image; expected a camera that looks along z")
    a, b, seen = rays[use, 0] / rays[use, 2], rays[use, 1] / rays[use, 2], pixels[use]

    def off(state: Array) -> Array:
        u, v = lens.distort(a, b, state[4:])
        found = np.stack([u * state[0] + state[2], v * state[1] + state[3]])
        return np.asarray(np.nan_to_num(found - seen.T, nan=1e9).ravel())

    state = like.core
    for n in sorted({min(count, n) for n in (4, 8, 12)}):  # a few coefficients first: the rational ones need a start
        start = np.concatenate([state, np.zeros(4 + n - len(state))])
        state = scipy.optimize.least_squares(
            off, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-15, max_nfev=3000
        ).x
    return Described("opencv", state[:4], state[4:], like.size, like.name)


def _fit_equidistant(rays: Array, pixels: Array, like: Described) -> Described:
    """The closest lens of Kannala and Brandt's."""
    use = np.isfinite(rays).all(-1)
    directions, seen = rays[use], pixels[use]

    def off(state: Array) -> Array:
        found = equidistant.project(directions, state[:4], state[4:])
        return np.asarray(np.nan_to_num(found - seen, nan=1e9).ravel())

    start = np.concatenate([like.core, np.zeros(4)])
    state = scipy.optimize.least_squares(off, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-15, max_nfev=3000).x
    return Described("equidistant", state[:4], state[4:], like.size, like.name)
