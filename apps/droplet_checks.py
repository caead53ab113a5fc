"""Self-checks of the drop's optics, made anew in every run: what theory says against what the tracer gives."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rainstereo import Camera, fermat
from rainstereo.apps.droplet_bench import REFERENCE_CAMERA, REFERENCE_PANE, Bench
from rainstereo.droplet import SphericalCap
from rainstereo.refraction import project
from rainstereo.trace import Fate, trace, trace_rays
from rainstereo.types import Array

ENDS = (0.5, 2.0, 20.0, 200.0)  # metres, planes on which the law of 1/Z is tried
FERMAT_DEPTH = 2.0
GIVEN_UP = 0.75  # the search starts far from where steep drops in the corner send the light
MIDDLE = 1e-5  # pixels; step of the slope in the middle
ALONG_A_RADIUS = 200_001


@dataclass(frozen=True)
class Check:
    """One law: what it says, what was found, and the most that it may be off by. NaN never passes."""

    name: str
    words: str
    found: float
    limit: float
    unit: str
    detail: str = ""

    @property
    def passed(self) -> bool:
        """Whether the law holds."""
        return bool(self.found <= self.limit)


def checks(bench: Bench, drop: SphericalCap, quick: bool) -> list[Check]:
    """All of them. Fermat, 1/Z, vanishing water and bare panels on the bench; the rest where theory has a formula."""
    return [
        *_fermat(bench, drop, 9 if quick else 21),
        _linear_in_inverse_depth(bench, drop),
        _central_slope(drop),
        _total_reflection(drop),
        _no_water(bench, drop),
        _bare_panels(bench, drop),
    ]


def _fermat(bench: Bench, drop: SphericalCap, side: int) -> list[Check]:
    """Of all paths, light takes one of stationary length: another way to the same pixel that bends no ray."""
    if drop.contact_angle > math.pi / 2:
        return []
    error = fermat.discrepancy(bench.lattice(drop, side), drop, bench.camera, bench.chamber, FERMAT_DEPTH)
    asked = _seen(bench, drop, side)
    known = error[np.isfinite(error)]
    share = len(known) / max(asked, 1)
    median = float(np.median(known)) if len(known) else math.nan
    largest = float(known.max()) if len(known) else math.nan
    return [
        Check(
            "fermat", "Fermat's principle: the pixel of the path of stationary optical length, against the traced one",
            largest, 1e-6, "px", f"median {median:.2g} px; {len(known)} of {asked} paths settled",
        ),
        Check(
            "fermat_settled", "share of Fermat's paths whose search gave up",
            1 - share, GIVEN_UP, "", "it starts from the path without a drop",
        ),
    ]  # fmt: skip


def _seen(bench: Bench, drop: SphericalCap, side: int) -> int:
    found = trace(bench.lattice(drop, side), drop, bench.camera, bench.chamber, FERMAT_DEPTH)
    return int(np.count_nonzero(found.status == Fate.THROUGH))


def _linear_in_inverse_depth(bench: Bench, drop: SphericalCap) -> Check:
    """Relative spread of (x(Z) - x(inf)) Z over depths, without lens distortion, which comes after it."""
    camera = _straight(bench.camera)
    pixels = replace(bench, camera=camera).lattice(drop, 24)
    far = trace(pixels, drop, camera, bench.chamber, math.inf).source
    products = np.stack([(trace(pixels, drop, camera, bench.chamber, z).source - far) * z for z in ENDS])
    known = np.isfinite(products).all((0, 2))
    spread = np.ptp(products[:, known], axis=0)
    scale = np.abs(products[:, known]).max(initial=1e-300)
    return Check(
        "inverse_depth", f"(x(Z) - x(inf)) Z is the same for Z = {', '.join(f'{z:g}' for z in ENDS)} m",
        float(spread.max() / scale) if known.any() else math.nan, 1e-9, "", "relative spread",
    )  # fmt: skip


def _straight(camera: Camera) -> Camera:
    """The camera without its distortion, on a sensor of twice the size: what a barrel drew in still lies on it."""
    fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
    width, height = camera.size
    return Camera.pinhole(fx, fy, cx + width / 2, cy + height / 2, 2 * width, 2 * height)


def _on_the_reference_pane(drop: SphericalCap) -> SphericalCap:
    """A drop of the same shape in the middle of the reference pane's far face."""
    return replace(drop, centre=(0.0, 0.0), panel=0, face="far")


def _central_slope(drop: SphericalCap) -> Check:
    """The thin-lens formula of the reference pane, far scene: 1 - (d + t/n_p + h/n_w)(n_w - 1)/R_s."""
    drop = _on_the_reference_pane(drop)
    pane, middle = REFERENCE_PANE.panels[0], REFERENCE_CAMERA.intrinsics[2:4]
    ends = trace(middle + np.array([[-MIDDLE, 0], [MIDDLE, 0]]), drop, REFERENCE_CAMERA, REFERENCE_PANE).source
    found = float(ends[1, 0] - ends[0, 0]) / (2 * MIDDLE)
    path = REFERENCE_PANE.distance + pane.thickness / pane.index + drop.top / drop.index
    theory = 1 - path * (drop.index - 1) / drop.sphere_radius
    return Check(
        "central_slope", "magnification in the drop's middle, against 1 - (d + t/n_p + h/n_w)(n_w - 1)/R_s",
        abs(found / theory - 1), 1e-5, "", f"traced {found:.6f}, formula {theory:.6f} (reference pane)",
    )  # fmt: skip


def _total_reflection(drop: SphericalCap) -> Check:
    """Share of a cap that is dark under collimated light: 1 - (1 / (n sin theta))^2."""
    drop = _on_the_reference_pane(drop)
    steep = drop.index * math.sin(drop.contact_angle)
    theory = max(0.0, 1 - 1 / steep**2)
    along = (np.arange(ALONG_A_RADIUS) + 0.5) / ALONG_A_RADIUS
    origins = np.stack([along * drop.radius, np.zeros_like(along), np.zeros_like(along)], -1)
    seen = trace_rays(origins, np.array([[0.0, 0.0, 1.0]]), drop, REFERENCE_CAMERA, REFERENCE_PANE)
    dark = seen.status != Fate.THROUGH
    found = 1 - float(along[dark].min(initial=1.0)) ** 2
    return Check(
        "total_reflection", "dark share of the drop under collimated light, against 1 - (1/(n sin theta))^2",
        abs(found - theory), 2e-5, "", f"traced {found:.5f}, formula {theory:.5f} (reference pane)",
    )  # fmt: skip


def _no_water(bench: Bench, drop: SphericalCap) -> Check:
    """A drop of the index of air does nothing."""
    pixels = bench.lattice(drop, 24)
    air = trace(pixels, replace(drop, index=1.0), bench.camera, bench.chamber, bench.depth)
    bare = trace(pixels, None, bench.camera, bench.chamber, bench.depth)
    inside = air.status == Fate.THROUGH
    return Check(
        "no_water", "a drop whose index is that of air moves nothing",
        _largest(air.source[inside] - bare.source[inside]), 1e-9, "px", f"{np.count_nonzero(inside)} pixels",
    )  # fmt: skip


def _bare_panels(bench: Bench, drop: SphericalCap) -> Check:
    """Without a drop, the traced source is the place whose refracted projection is the pixel."""
    depth = bench.depth if math.isfinite(bench.depth) else ENDS[-1]
    width, height = bench.camera.size
    pixels = np.stack(np.meshgrid(np.linspace(0, width - 1, 15), np.linspace(0, height - 1, 11)), -1).reshape(-1, 2)
    bare = trace(pixels, None, bench.camera, bench.chamber, depth)
    seen = bare.status == Fate.THROUGH
    rays = bench.camera.unproject(bare.source[seen])
    back, _ = project(rays * (depth / rays[:, 2:]), bench.camera, bench.chamber)
    return Check(
        "bare_panels", "panels without a drop: `trace` against `refraction.project`",
        _largest(back - pixels[seen]), 1e-6, "px", f"{np.count_nonzero(seen)} pixels over the whole image",
    )  # fmt: skip


def _largest(difference: Array) -> float:
    return float(np.linalg.norm(difference, axis=-1).max()) if len(difference) else math.nan


__all__ = ["Check", "checks"]
