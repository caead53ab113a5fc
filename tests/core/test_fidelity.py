"""Fidelity tiers: that error bounds hold against renderings, and that the choice is the cheapest that keeps them."""

import math
from functools import cache

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from rainstereo import Camera, Chamber, Panel, footprint
from rainstereo.defocus import defocused
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.fidelity import SAFETY, bounds, choose_tier, cost, displacement_error
from rainstereo.height_map import HeightMap
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.thin_lens import ThinLens
from rainstereo.tiers import LADDER, Method, Tier, cap_of, shifts, tracer
from rainstereo.trace import Fate, clear_transmittance, trace, trace_rays
from rainstereo.young_laplace_drop import YoungLaplaceDrop

CAMERA = Camera.pinhole(600, 600, 319.5, 239.5, 640, 480)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
SHARP = [tier for tier in LADDER if not tier.is_defocused]
LENS = ThinLens(0.0045, 1.4)


@cache
def photograph() -> np.ndarray:
    return np.asarray(cv2.resize(data.astronaut()[..., 1], (640, 480)).astype(np.float32))


def look_up(places: np.ndarray) -> np.ndarray:
    """Values of the photograph, mirrored beyond its edges; the test's own bilinear interpolation."""
    image = photograph().astype(np.float64)
    height, width = image.shape
    x, y = (
        n - 1 - np.abs((places[..., axis] % (2 * (n - 1))) - (n - 1)) for axis, n in enumerate((width, height))
    )  # fmt: skip
    i, j = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    v, u = y - i, x - j
    top = image[i, j] * (1 - u) + image[i, j + 1] * u
    return top * (1 - v) + (image[i + 1, j] * (1 - u) + image[i + 1, j + 1] * u) * v


def values(seen, own: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Gray levels of traced samples, (P, n), averaged: black where light is lost, the clear image beside the drop."""
    through, beside = seen.status == Fate.THROUGH, seen.status == Fate.NO_DROP
    source = np.where(through[..., None], seen.source, own[:, None])
    gain = np.where(through, seen.transmittance / clear[:, None], np.where(beside, 1.0, 0.0))
    return (look_up(source) * gain).mean(-1)


def window(drop: Drop, margin: float = 0.0) -> np.ndarray:
    rows, columns = footprint.window(drop, CAMERA, PANE, margin)
    return np.stack(np.meshgrid(*(np.arange(s.start, s.stop, dtype=float) for s in (columns, rows))), -1).reshape(-1, 2)


def split(pixels: np.ndarray, side: int) -> np.ndarray:
    along = (np.arange(side) + 0.5) / side - 0.5
    return pixels[:, None] + np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)


def rendered_error(tier: Tier, drop: Drop, depth: float, side: int = 10) -> float:
    """RMS gray levels of a sharp tier against side x side samples of every pixel, over the pixels that it touches."""
    pixels = window(drop)
    clear = clear_transmittance(pixels, CAMERA, PANE)
    exact = trace(split(pixels, side), drop, CAMERA, PANE, depth)
    touched = (exact.status != Fate.NO_DROP).any(-1)
    look = tracer(tier, drop, CAMERA, PANE, depth)
    found = look(split(pixels, tier.count if tier.method is Method.EXACT else 1))
    error = values(found, pixels, clear) - values(exact, pixels, clear)
    return float(np.sqrt(np.mean(error[touched] ** 2)))


caps = st.builds(
    lambda x, y, radius, angle: SphericalCap((x, y), radius, angle),
    st.floats(-0.012, 0.012), st.floats(-0.008, 0.008), st.floats(0.3e-3, 2e-3), st.floats(0.1, 1.4),
)  # fmt: skip


@settings(deadline=None, max_examples=12, derandomize=True)
@given(caps, st.sampled_from([2.0, 20.0, math.inf]))
def test_bounds_in_pixels_hold(drop: SphericalCap, depth: float) -> None:
    pixels = window(drop)
    exact = tracer(Tier(Method.EXACT), drop, CAMERA, PANE, depth)
    for bound in bounds(drop, CAMERA, PANE, depth, ladder=[t for t in SHARP if t.rays == 1]):
        if not bound.reason:
            error, lost = displacement_error(pixels, tracer(bound.tier, drop, CAMERA, PANE, depth), exact, CAMERA)
            assert error <= bound.pixels + 1e-9, bound.tier.name
            assert lost <= bound.lost + 0.01, bound.tier.name


@settings(deadline=None, max_examples=6, derandomize=True)
@given(caps)
def test_bounds_in_gray_levels_hold_and_are_not_idle(drop: SphericalCap) -> None:
    scene = SceneStatistics.of(photograph())
    for bound in bounds(drop, CAMERA, PANE, 20.0, scene=scene, ladder=SHARP):
        if not bound.reason:
            error = rendered_error(bound.tier, drop, 20.0)
            assert error <= bound.gray, bound.tier.name
            assert bound.gray <= 8 * error + 1.0, bound.tier.name


@pytest.mark.parametrize(("radius", "angle", "f_number"), [(1e-3, 0.9, 1.4), (0.5e-3, 0.6, 2.8), (1e-3, 0.2, 4.0)])
def test_bounds_of_defocus_hold(radius: float, angle: float, f_number: float) -> None:
    drop, lens = SphericalCap((0.001, 0.002), radius, angle), ThinLens(0.0045, f_number)
    pixels = window(drop, 40)[::7]
    clear = clear_transmittance(pixels, CAMERA, PANE)
    origins, directions = (a.swapaxes(0, 1) for a in lens.rays(pixels, CAMERA, lens.points(1500)))
    full = trace_rays(origins, directions, drop, CAMERA, PANE)
    touched = (full.status != Fate.NO_DROP).any(-1)
    truth = values(full, pixels, clear)
    scene = SceneStatistics.of(photograph())
    ladder = [Tier(Method.LAYER), Tier(Method.APERTURE, 64)]
    layer, aperture = bounds(drop, CAMERA, PANE, lens=lens, scene=scene, ladder=ladder)
    drawn = defocused(drop, CAMERA, PANE, lens).layer(photograph()).over(photograph())
    blurred = drawn[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    origins, directions = (a.swapaxes(0, 1) for a in lens.rays(pixels, CAMERA, lens.points(64)))
    few = values(trace_rays(origins, directions, drop, CAMERA, PANE), pixels, clear)
    for bound, image in ((layer, blurred), (aperture, few)):
        error = float(np.sqrt(np.mean((image - truth)[touched] ** 2)))
        assert error <= bound.gray, bound.tier.name
        assert bound.gray <= 10 * error + 0.5, bound.tier.name


def test_the_disc_is_where_the_aperture_looks() -> None:
    # the pinhole ray of pixel + shift meets the drop's face where the pixel's ray from the aperture point does
    drop, points = SphericalCap((0.004, -0.003), 1e-3, 0.5), LENS.points(20)
    centre = footprint.outline(drop, CAMERA, PANE)[0].mean(0)
    plane_z, glass = 0.057, 0.003
    origins, directions = LENS.rays(centre[None], CAMERA, points)

    def on_the_far_face(o: np.ndarray, d: np.ndarray) -> np.ndarray:
        at = o[:, :2] + d[:, :2] / d[:, 2:] * plane_z
        sine = d[:, :2] / np.linalg.norm(d, axis=-1, keepdims=True) / 1.49
        return at + glass * sine / np.sqrt(1 - (sine**2).sum(-1, keepdims=True))

    rays = CAMERA.unproject(centre + shifts(LENS, drop, CAMERA, PANE, 20))
    there = on_the_far_face(origins[:, 0], directions[:, 0])
    here = on_the_far_face(np.zeros_like(rays), rays)
    assert np.abs(there - here).max() < 2e-5  # a fiftieth of the drop


@pytest.mark.parametrize("unit", ["pixels", "gray"])
@pytest.mark.parametrize("tolerance", [0.2, 2.0, 30.0])
@pytest.mark.parametrize("angle", [0.05, 0.5, 1.2])
def test_the_choice_is_the_cheapest_that_keeps_the_tolerance(unit: str, tolerance: float, angle: float) -> None:
    drop = SphericalCap((0, 0), 1e-3, angle)
    every = bounds(drop, CAMERA, PANE, 20.0)
    choice = choose_tier(drop, CAMERA, PANE, 20.0, tolerance, unit=unit)
    good = [b for b in every if b.meets(tolerance, unit)]
    assert choice.met == bool(good)
    if good:
        assert choice.bound.cost == min(b.cost for b in good)
        assert choice.bound.meets(tolerance, unit)
    else:
        assert unit == "gray"
        assert choice.bound.gray == min(b.gray for b in every)


def test_a_thin_drop_needs_little_and_a_steep_one_much() -> None:
    flat, steep = (SphericalCap((0, 0), 1e-3, math.radians(a)) for a in (3, 65))
    assert choose_tier(flat, CAMERA, PANE, tolerance=1.0, unit="pixels").tier.method is Method.SLOPES
    needed = choose_tier(steep, CAMERA, PANE, tolerance=1e-6, unit="pixels").tier
    assert needed.method is Method.EXACT
    literal = bounds(steep, CAMERA, PANE, ladder=[Tier(Method.LITERAL)])[0]
    assert literal.pixels > 30


def test_a_lens_wide_open_needs_one_layer_and_not_many_samples() -> None:
    drop = SphericalCap((0, 0), 1e-3, 1.0)
    choice = choose_tier(drop, CAMERA, PANE, tolerance=2.5, lens=LENS)
    assert choice.met
    assert choice.tier.method is Method.LAYER
    stopped = choose_tier(drop, CAMERA, PANE, tolerance=2.5, lens=ThinLens(0.0045, math.inf))
    assert not stopped.tier.is_defocused


def test_gravity() -> None:
    small, large = (YoungLaplaceDrop((0, 0), radius, 0.8) for radius in (0.15e-3, 1.5e-3))
    cap = [Tier(Method.CAP)]
    assert bounds(small, CAMERA, PANE, ladder=cap)[0].pixels < 1
    assert bounds(large, CAMERA, PANE, ladder=cap)[0].pixels > 5
    assert cap_of(large).volume == pytest.approx(large.volume)
    assert cost(Tier(Method.EXACT), large) > cost(Tier(Method.EXACT), cap_of(large))
    heights = HeightMap.of(large)
    assert bounds(heights, CAMERA, PANE, ladder=[Tier(Method.HEIGHTS, 3)])[0].pixels < 1


def test_a_drop_that_is_not_seen_needs_nothing() -> None:
    away = SphericalCap((0.5, 0.0), 1e-3, 0.8)
    assert all(b.pixels == b.gray == b.lost == 0 for b in bounds(away, CAMERA, PANE, 20.0) if not b.reason)
    assert choose_tier(away, CAMERA, PANE, tolerance=0.1).bound.cost == min(cost(t, away) for t in SHARP)


def test_where_nothing_keeps_the_tolerance_the_best_is_given() -> None:
    drop = SphericalCap((0, 0), 1e-3, 1.0)
    choice = choose_tier(drop, CAMERA, PANE, tolerance=1e-9)
    assert not choice.met
    assert choice.tier == Tier(Method.EXACT, 4)


def test_bounds_carry_the_safety_factor() -> None:
    drop = SphericalCap((0, 0), 1e-3, 0.7)
    probes = window(drop)
    exact = tracer(Tier(Method.EXACT), drop, CAMERA, PANE, 20.0)
    error, _ = displacement_error(probes, tracer(Tier(Method.SLOPES), drop, CAMERA, PANE, 20.0), exact, CAMERA)
    found = bounds(drop, CAMERA, PANE, 20.0, ladder=[Tier(Method.SLOPES)])[0].pixels
    assert 0.8 * SAFETY * error < found < 2 * SAFETY * error


def test_bad_input() -> None:
    drop = SphericalCap((0, 0), 1e-3, 0.7)
    with pytest.raises(ValueError, match="tolerance of 0"):
        choose_tier(drop, CAMERA, PANE, tolerance=0)
    with pytest.raises(ValueError, match="'gray'"):
        choose_tier(drop, CAMERA, PANE, unit="mm")
    with pytest.raises(ValueError, match="suits the drop"):
        choose_tier(drop, CAMERA, PANE, ladder=[Tier(Method.CAP)])
    with pytest.raises(ValueError, match="cannot show"):
        tracer(Tier(Method.CAP), drop, CAMERA, PANE)
    with pytest.raises(ValueError, match="count"):
        Tier(Method.BAKED, 16)
