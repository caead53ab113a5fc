"""Benchmark stage `drops`: tracing rays through drops, and every fidelity tier's error against its time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np

from rainstereo import Camera, Chamber, Panel
from rainstereo.aperture import aperture
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.photographs import photograph
from rainstereo.defocus import apparent_distance, defocused
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.fermat import discrepancy
from rainstereo.footprint import window
from rainstereo.layer import Layer
from rainstereo.patch import Patch, sample_pixels
from rainstereo.thin_lens import ThinLens
from rainstereo.tiers import LADDER, Method, Tier, disc, tracer
from rainstereo.trace import Fate, Trace, clear_transmittance, trace
from rainstereo.types import Array, Image
from rainstereo.young_laplace_drop import YoungLaplaceDrop

ANGLE = np.radians(60.0)
RADIUS = 1e-3
DEPTH = 20.0
COVER = 0.1
MANY = 120
SIDE = 12
"""Samples along each side of a pixel in the reference of the sharp tiers."""
APERTURE_SAMPLES = 1024
CHECKED = 300
"""Pixels at which Fermat's principle is asked."""


def build(seed: int, quick: bool) -> Stage:
    """The stage at 1280x960, or 320x240 if `quick`."""
    width, height = (320, 240) if quick else (1280, 960)
    f = 1200 * width / 1280
    camera = Camera.pinhole(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
    pane = Chamber((0.0, 0.0, 1.0), 0.057, (Panel(0.003, 1.49),))
    image: Image = cv2.resize(photograph("motorcycle"), (width, height), interpolation=cv2.INTER_AREA)
    lens = ThinLens(0.0045, 1.4)
    cap = SphericalCap((0.0, 0.0), RADIUS, ANGLE)
    return Stage(
        "drops",
        "rays through drops, and fidelity tiers",
        f"What a pixel of a {width}x{height} camera sees through water on a pane: the exact trace beside the cost of "
        "one interpolation of the whole frame, and the same drop in every tier, from the paper's texture to many "
        "samples of the aperture.",
        (
            _trace_work(camera, pane, image, seed, not quick),
            _sharp_work("cap", "One drop, sharp", "A spherical cap", cap, camera, pane, image),
            _sharp_work(
                "gravity",
                "One drop under gravity, sharp",
                "A drop that gravity has bent",
                YoungLaplaceDrop((0.0, 0.0), RADIUS, ANGLE),
                camera,
                pane,
                image,
            ),
            _blurred_work(cap, camera, pane, image, lens, 64 if quick else APERTURE_SAMPLES),
        ),
        {
            "camera": f"pinhole {width}x{height}, f {f:.0f} px; or a lens of 4.5 mm at F/1.4, focused at infinity",
            "pane": "3 mm, index 1.49, its far face at 60 mm, square to the camera",
            "drop": "contact radius 1 mm, contact angle 60 degrees, on the far face, in the middle; scene at 20 m",
            "image": "8-bit BGR, a photograph from scikit-image",
            "seed": seed,
        },
        (
            "A drop that stands still is traced once and then costs one interpolation of its pixels, whatever its "
            "tier: these are the costs of drops that move.",
            "Sharp drops shrink the scene, so one sample a pixel aliases: that, not the optics, is most of the error "
            "of the exact trace in gray levels. Behind a wide aperture it does not matter.",
            "The paper's textures are given their best scale, fitted to the exact trace, and the time of the fit.",
        ),
    )


# -- tracing -------------------------------------------------------------------------------------------------------


def _trace_work(camera: Camera, pane: Chamber, image: Image, seed: int, promised: bool) -> Work:
    """One drop, or many, over a tenth of the frame; beside one remap of the whole frame."""
    drop = _covering(camera, pane)
    pixels = _covered(drop, camera, pane)
    many, owner, among = _scattered(camera, pane, len(pixels), seed)
    exact = trace(pixels, drop, camera, pane, DEPTH)
    kept = trace(pixels.astype(np.float32), drop, camera, pane, DEPTH)
    deeper = trace(pixels, drop, camera, pane, 2.0)
    reference = trace(among, many, camera, pane, DEPTH, which=owner)
    rng = np.random.default_rng(seed)
    maps = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in camera.size)), -1)
    maps += rng.uniform(-3, 3, maps.shape).astype(np.float32)
    narrow: Image = pixels.astype(np.float32)
    narrow_many: Image = among.astype(np.float32)

    def error(truth: Trace) -> Callable[[Trace], float]:
        return lambda found: _worst(found, truth, camera)

    def fermat(_: Trace) -> float:
        return float(np.nanmax(discrepancy(pixels[:: max(1, len(pixels) // CHECKED)], drop, camera, pane, DEPTH)))

    single = "one drop, float32"
    again = "the same at another depth"
    frame = "cv2.remap of the frame"
    return Work(
        "trace",
        "A tenth of the frame",
        f"{len(pixels):,} pixels through the pane and a drop that covers them, or {MANY} drops that do.",
        (
            Variant(single, lambda: trace(narrow, drop, camera, pane, DEPTH), error(exact), True),
            Variant(
                "one drop, float64", lambda: trace(pixels, drop, camera, pane, DEPTH), fermat, True, "error by Fermat"
            ),
            Variant(again, lambda: kept.at(2.0), error(deeper), True, "float32, slope and offset in 1/Z"),
            Variant(
                f"{MANY} drops, known whose",
                lambda: trace(narrow_many, many, camera, pane, DEPTH, which=owner),
                error(reference),
                True,
                "float32",
            ),
            Variant(
                f"{MANY} drops, to be found",
                lambda: trace(narrow_many, many, camera, pane, DEPTH),
                error(reference),
                True,
                "float32",
            ),
            Variant(
                frame,
                lambda: cv2.remap(image, maps, None, cv2.INTER_LINEAR),  # type: ignore[call-overload]
                lambda _: float("nan"),
                note="the yardstick: float maps, linear, 3 channels",
            ),
        ),
        single,
        "px",
        "largest in the frame against float64; that one's against Fermat's principle",
        len(pixels),
        "rays",
        (Target(single, frame, 1.0), Target(again, frame, 0.1)) if promised else (),
    )


def _covering(camera: Camera, pane: Chamber) -> SphericalCap:
    """A drop in the middle that covers a tenth of the frame."""
    unit = _pixels_per_metre(camera, pane)
    return SphericalCap((0.0, 0.0), np.sqrt(COVER * camera.width * camera.height / np.pi) / unit, ANGLE)


def _pixels_per_metre(camera: Camera, pane: Chamber) -> float:
    return float(camera.intrinsics[0]) / apparent_distance(SphericalCap((0.0, 0.0), RADIUS, ANGLE), pane)


def _covered(drop: Drop, camera: Camera, pane: Chamber) -> Array:
    """The pixels that a drop covers, (N, 2)."""
    pixels = sample_pixels(*window(drop, camera, pane), dtype=np.float64).reshape(-1, 2)
    return np.asarray(pixels[trace(pixels, drop, camera, pane).status != Fate.NO_DROP])


def _scattered(camera: Camera, pane: Chamber, count: int, seed: int) -> tuple[list[Drop], Any, Array]:
    """Drops on a jittered grid that cover `count` pixels between them; whose each pixel is, and the pixels."""
    rng = np.random.default_rng(seed)
    unit = _pixels_per_metre(camera, pane)
    radius = np.sqrt(count / MANY / np.pi) / unit
    across, down = 12, MANY // 12
    x, y = np.meshgrid((np.arange(across) + 0.5) / across - 0.5, (np.arange(down) + 0.5) / down - 0.5)
    centres = np.stack([x.ravel() * camera.width, y.ravel() * camera.height], -1) / unit
    centres += rng.uniform(-0.1, 0.1, centres.shape) * radius
    drops: list[Drop] = [SphericalCap((float(u), float(v)), float(radius), ANGLE) for u, v in centres]
    pixels = [_covered(drop, camera, pane) for drop in drops]
    return drops, np.repeat(np.arange(MANY), [len(p) for p in pixels]), np.concatenate(pixels)


def _worst(found: Trace, truth: Trace, camera: Camera) -> float:
    both = (found.status == Fate.THROUGH) & (truth.status == Fate.THROUGH)
    inside = both & ((truth.source >= -0.5) & (truth.source <= np.array(camera.size) - 0.5)).all(-1)
    return float(np.abs(found.source - truth.source)[inside].max())


# -- tiers ---------------------------------------------------------------------------------------------------------


def _sharp_work(name: str, title: str, what: str, drop: Drop, camera: Camera, pane: Chamber, image: Image) -> Work:
    truth = Patch.trace(drop, camera, pane, DEPTH, density=SIDE, dtype=np.float64).layer(image)
    whole = truth.over(image.astype(np.float32))
    tiers = [tier for tier in LADDER if not tier.is_defocused and not tier.suits(drop)]
    peers = (Method.LITERAL,)
    return Work(
        name,
        title,
        f"{what}, traced and drawn into the frame, as when it has just moved: {truth.opacity.size:,} pixels.",
        tuple(
            Variant(
                tier.name,
                partial(_drawn, tier, drop, camera, pane, image),
                partial(_rms, truth=whole, layer=truth),
                tier.method not in peers,
                "the paper's" if tier.method in peers else "",
            )
            for tier in tiers
        ),
        Tier(Method.EXACT).name,
        "gray levels",
        f"RMS over the drop against exact tracing with {SIDE} x {SIDE} samples a pixel",
    )


def _blurred_work(drop: Drop, camera: Camera, pane: Chamber, image: Image, lens: ThinLens, samples: int) -> Work:
    rows, columns = window(drop, camera, pane, np.ceil(disc(lens, drop, camera, pane) / 2) + 1)
    truth = aperture(drop, camera, pane, lens, DEPTH, image, samples, window=(rows, columns))
    whole = truth.over(image.astype(np.float32))
    rms = partial(_rms, truth=whole, layer=truth)
    layer = Tier(Method.LAYER).name
    many = [Tier(Method.APERTURE, 16), *(tier for tier in LADDER if tier.method is Method.APERTURE)]

    def sampled(count: int) -> Image:
        return aperture(drop, camera, pane, lens, DEPTH, image, count, window=(rows, columns)).over(image)

    return Work(
        "defocus",
        "One drop, out of focus",
        f"The cap behind 4.5 mm at F/1.4 focused at infinity: a disc of {disc(lens, drop, camera, pane):.0f} px.",
        (
            Variant("nothing drawn", image.copy, rms),
            Variant("a sharp drop", partial(_drawn, Tier(Method.EXACT), drop, camera, pane, image), rms),
            Variant(
                layer,
                lambda: defocused(drop, camera, pane, lens, DEPTH).layer(image).over(image),
                rms,
                True,
                "traced, blurred and drawn",
            ),
            *(Variant(tier.name, partial(sampled, tier.count), rms, True, every=5) for tier in many),
        ),
        layer,
        "gray levels",
        f"RMS over what the blurred drop touches, against {samples} samples of the aperture",
    )


def _drawn(tier: Tier, drop: Drop, camera: Camera, pane: Chamber, image: Image) -> Image:
    """The frame with a drop in it, traced in float32."""
    if tier.method is Method.EXACT:
        return Patch.trace(drop, camera, pane, DEPTH, density=tier.count).layer(image).over(image)
    rows, columns = window(drop, camera, pane)
    pixels = sample_pixels(rows, columns)
    seen = tracer(tier, drop, camera, pane, DEPTH)(pixels)
    return Patch.of_trace(seen, rows, columns, 1.0, clear_transmittance(pixels, camera, pane)).layer(image).over(image)


def _rms(found: Image, truth: Image, layer: Layer) -> float:
    at = layer.rows, layer.columns
    touched = layer.opacity > 1 / 255
    return float(np.sqrt(np.mean(np.square(found[at].astype(np.float64) - truth[at])[touched])))
