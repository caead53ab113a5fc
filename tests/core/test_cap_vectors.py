"""Vector steps of the loops over caps against numpy; circles in the image against many points of drops."""

import math

import cv2
import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel
from rainstereo.compiled import available
from rainstereo.droplet import SphericalCap
from rainstereo.panel_plane import PanelFrame
from rainstereo.patch import folded_along
from rainstereo.rain.boxes import Boxes
from rainstereo.rain.outlines import MARGIN, Outlines
from rainstereo.refraction import project

needs_numba = pytest.mark.skipif(not available(), reason="needs numba: pip install rainstereo[fast]")


@needs_numba
def test_weighted_sums_are_those_of_channels():
    from rainstereo.compiled import cap_vectors
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def of_weights(words, at, first, rays, weights):
        return cap_vectors.weighed(words, at, first, rays, weights)

    rng = np.random.default_rng(0)
    bytes_ = rng.integers(0, 256, (500, 3)).astype(np.uint32)
    bytes_[:100] = 255  # the largest sums there can be
    words = bytes_[:, 0] | bytes_[:, 1] << np.uint32(8) | bytes_[:, 2] << np.uint32(16)
    at = rng.integers(0, 500, 72).astype(np.uint32)
    rays = rng.uniform(0, 1, 128).astype(np.float32)
    found = of_weights(words, at, np.uint64(3), rays, np.uint64(40))
    np.testing.assert_allclose(found[:3], rays[40:56] @ bytes_[at[3:19]], rtol=1e-6)
    assert found[3] == pytest.approx(rays[40:56].sum(), rel=1e-6)


@needs_numba
@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_pairs_of_products(machine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the instruction that some processors have for it, and without."""
    import numba
    from numba.core import types
    from numba.extending import intrinsic

    from rainstereo.compiled import cap_vectors
    from rainstereo.compiled.llvm import LONG, TWO, arguments, ir, load, store

    monkeypatch.setattr(cap_vectors, "machine", lambda: machine)

    @intrinsic
    def step(_context, one, other, found):
        def code(context, builder, signature, given):
            *both, to = arguments(context, builder, signature, given)
            eight = (load(builder, each, LONG(0), ir.VectorType(TWO, 8)) for each in both)
            store(builder, cap_vectors.pairs_times(builder, *eight), to, LONG(0))
            return context.get_dummy_value()

        return types.void(one, other, found), code

    @numba.njit
    def pairs(one, other, found):
        step(one, other, found)

    one, other = np.random.default_rng(3).integers(-(1 << 15), 1 << 15, (2, 8)).astype(np.int16)
    found = np.zeros(4, dtype=np.int32)
    pairs(one, other, found)
    np.testing.assert_array_equal(found, (one.astype(np.int64) * other).reshape(4, 2).sum(1))


@needs_numba
@pytest.mark.parametrize("border", ["mirror", "edge"])
@pytest.mark.parametrize("first", [0, 3, 41])
def test_patches_are_means_over_grids_of_boxes(border: str, first: int) -> None:
    """Eight pixels side by side against each by itself: grids of looks between four boxes, in numpy."""
    from rainstereo.compiled import cap_patches, cap_rays, cap_tiles
    from rainstereo.compiled.cap_looks import BIAS
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def shown(border, every, words, starts, last, rays, boxes, parts):
        cap_patches.show_whole(every, words, starts, last, border, rays, boxes, parts)

    rng, size, count = np.random.default_rng(first), (317, 203), 13
    image = cv2.GaussianBlur(rng.integers(0, 256, (*size[::-1], 3)).astype(np.uint8), (0, 0), 4)
    image = cv2.normalize(image, image, 0, 255, cv2.NORM_MINMAX)
    boxes = Boxes.of(size)
    words = boxes.words(image)
    rays = np.full((cap_rays.PLANES, 64), np.nan, dtype=np.float32)  # of pixels that are no patches
    chosen = first + np.flatnonzero(rng.uniform(size=count) < 0.7)
    every = sum(1 << int(lane) for lane in chosen)
    planes = {name: rays[int(getattr(cap_tiles, name)) // 64] for name in (
        "CX", "CY", "AX", "AY", "BX", "BY", "AXX", "AYY", "BXX", "BYY", "ABX", "ABY", "GAINS", "SIZE", "ACROSS",
        "DOWN", "FAR",
    )}  # fmt: skip
    for name, plane in planes.items():
        plane[chosen] = rng.uniform(-6, 6, len(chosen)) if len(name) == 3 else rng.uniform(-30, 30, len(chosen))
    far = rng.uniform(size=64) < 0.5  # looks beyond the scene
    for name, middle in (("CX", size[0] / 2), ("CY", size[1] / 2)):
        planes[name][chosen] = middle + rng.uniform(-30, 30, len(chosen)) * np.where(far[chosen], 40, 1)
    planes["GAINS"][chosen] = rng.uniform(0.2, 1, len(chosen))
    planes["SIZE"][chosen] = rng.integers(0, 7, len(chosen))
    planes["ACROSS"][chosen] = rng.integers(2, 6, len(chosen))
    planes["DOWN"][chosen], planes["FAR"][chosen] = rng.integers(2, 6, len(chosen)), np.where(far[chosen], -1, 1)
    rays[int(cap_rays.HIDDEN) // 64, chosen] = rng.uniform(0.5, 1, len(chosen))
    expected = np.zeros((64, 3))
    values = np.stack([words >> np.uint32(8 * channel) & np.uint32(255) for channel in range(3)], -1) - float(BIAS)
    for lane in chosen:
        p = {name: float(plane[lane]) for name, plane in planes.items()}
        s, t = (part.ravel() for part in np.meshgrid(*(
            (np.arange(n) + 0.5) / n - 0.5 for n in (int(p["ACROSS"]), int(p["DOWN"]))
        )))  # fmt: skip
        x, y = (
            p["C" + i] + p["A" + i] * s + p["B" + i] * t + p["A" + 2 * i] * s * s / 2 + p["B" + 2 * i] * t * t / 2
            + p["AB" + i] * s * t for i in "XY"
        )  # fmt: skip
        x, y = (folded_along(part.astype(np.float32), n - 1, border) for part, n in ((x, size[0]), (y, size[1])))
        k = int(p["SIZE"])
        step, some = 1 / float(boxes.inverse[k]), boxes.part(values, k)
        column, row = (x + 0.5) / step, (y + 0.5) / step  # box j lies about the edge before pixel `step` j
        u, v = (np.floor(8 * part + 0.5) / 8 for part in (column, row))
        j, i = np.floor(u).astype(int), np.floor(v).astype(int)
        u, v = (u - j)[:, None], (v - i)[:, None]
        looks = (1 - v) * ((1 - u) * some[i, j] + u * some[i, j + 1])
        looks += v * ((1 - u) * some[i + 1, j] + u * some[i + 1, j + 1])
        expected[lane] = p["GAINS"] * rays[int(cap_rays.HIDDEN) // 64, lane] * looks.mean(0)
    where = slice(int(cap_rays.SHOWN), int(cap_rays.SHOWN) + 192)
    flat = rays.ravel()
    flat[where] = 0
    places = np.zeros((2, cap_patches.PLACES), dtype=np.uint32)
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    shown(0 if border == "mirror" else 1, np.uint64(every), words, boxes.start, last, flat, *places)
    found = flat[where].reshape(64, 3)
    off = np.abs(found - expected)
    assert expected.max() > 50
    assert off.max() < 0.2, off.max()  # a look between two eighths may fall to either
    assert np.median(off[chosen]) < 1e-3
    assert not found[np.setdiff1d(np.arange(64), chosen)].any()


@needs_numba
def test_what_is_beside_the_light_stays_dark():
    """Vectors end where they end: pixels behind the last that is lit have no patch, and get no rays of their own."""
    from rainstereo.compiled import cap_rays, cap_tiles
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def patches(rays, low, high, bands, sizes, shift, last):
        cap_tiles.patches(rays, low, high, bands, sizes, shift, last)

    rays = np.full((cap_rays.PLANES, 64), np.nan, dtype=np.float32)
    lights = rays[int(cap_tiles.LITS) // 64]
    lights[:] = 0
    lights[3:6] = cap_tiles.WHOLE
    x = np.arange(64, dtype=np.float32)
    for plane, left, down in ((cap_rays.OWN, 0.5, 0.5), (cap_rays.ABOVE, 0, 0), (cap_rays.BELOW, 0, 1)):
        first = int(plane) // 64
        rays[first, 3:8] = 100 + 9 * (x + left)[3:8]
        rays[first + 1, 3:8] = 100 + 9 * down
        rays[first + 2] = np.where((x > 2) & (x < 8), 0.9, 0)
    rays[int(cap_rays.OWN) // 64 + 2, 6:] = 0
    bands = np.array([[64, 8], [1e14, 25]], dtype=np.float32)
    zero, last = np.float32(0), np.float32(1000)
    patches(rays.ravel(), 3, 6, bands, 12, (zero, zero), (last, last))
    np.testing.assert_array_equal(lights[:16], [0, 0, 0, 2, 2, 2, *[0] * 10])
    np.testing.assert_allclose(rays[int(cap_tiles.AX) // 64, 3:6], 9, rtol=1e-5)
    np.testing.assert_allclose(rays[int(cap_tiles.BY) // 64, 3:6], 9, rtol=1e-5)
    np.testing.assert_allclose(rays[int(cap_tiles.CX) // 64, 3:6], 100 + 9 * (x + 0.5)[3:6], rtol=1e-5)
    np.testing.assert_array_equal(rays[int(cap_tiles.ACROSS) // 64, 3:6] * rays[int(cap_tiles.DOWN) // 64, 3:6], 25)


@needs_numba
def test_lanes_are_found_by_bits_and_summed():
    from rainstereo.compiled import cap_vectors
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def lanes(rays, low, high, found):
        left, count = cap_vectors.lanes_from(cap_vectors.above_zero(rays, np.uint64(16)), low, high), 0
        while left:
            found[count] = cap_vectors.lowest(left)
            left &= left - np.uint64(1)
            count += 1
        return count

    @fused_part
    def summed(rays, first):
        return cap_vectors.sum_of_16(rays, first)

    rng = np.random.default_rng(1)
    rays = np.concatenate([np.ones(16), rng.uniform(-1, 1, 64), np.ones(48)]).astype(np.float32)
    rays[20], rays[21] = 0.0, np.nan
    for low, high in ((0, 56), (3, 63), (17, 18), (9, 9), (12, 5)):
        found = np.zeros(64, dtype=np.int64)
        count = lanes(rays, low, high, found)
        expected = low + np.flatnonzero(rays[16 + low : 16 + max(low, high)] > 0)
        np.testing.assert_array_equal(found[:count], expected)
    assert summed(rays, np.uint64(37)) == pytest.approx(rays[37:53].sum(), rel=1e-6)


@needs_numba
@pytest.mark.parametrize("channels", [3, 2, 1])
def test_rows_are_mixed_into_bytes(channels):
    """Only the lanes asked for, also where the frame ends beside them, up to white."""
    from rainstereo.compiled import cap_bytes, cap_rays

    rng, width, v = np.random.default_rng(channels), 61, 1
    rays = np.zeros((cap_rays.PLANES, 64), np.float32)
    hidden = rays[int(cap_rays.HIDDEN) // 64]
    shown = rays[int(cap_rays.SHOWN) // 64 :][:3].reshape(64, 3)
    for first, stop, u in ((0, 21, 0), (8, 40, 3), (0, 5, 56), (16, 29, 32), (0, 56, 5)):
        hidden[:], shown[:] = 0, 0
        lanes = slice(first, stop)
        hidden[lanes] = rng.choice([0.0, 0.25, 0.7, 1.0], stop - first)
        shown[lanes, :channels] = hidden[lanes, None] * rng.uniform(0, 290, (stop - first, channels))
        out = rng.integers(0, 256, (3, width, channels)).astype(np.uint8)
        expected = out.astype(np.float64)
        expected[v, u + first : u + stop] *= 1 - hidden[lanes, None]
        expected[v, u + first : u + stop] += shown[lanes, :channels]
        found = out.copy()
        cap_bytes.write_bytes(found.reshape(-1), width, channels, v, u, (first, stop), rays.reshape(-1))
        assert (np.abs(found - np.minimum(expected, 255)) <= 0.5001).all()
        untouched = np.ones(out.shape[:2], dtype=bool)
        untouched[v, u + first : u + stop] = False
        np.testing.assert_array_equal(found[untouched], out[untouched])


@needs_numba
def test_rows_of_a_tile_are_polynomials_and_their_slopes():
    from rainstereo.compiled import cap_lanes, cap_rays, cap_tiles
    from rainstereo.compiled.cap_edges import slopes_of_row

    rng, lanes, s, t = np.random.default_rng(5), np.arange(24), np.float32(-7.5), np.float32(3.25)
    tile = rng.uniform(-1, 1, (3, cap_lanes.POLYNOMIALS)).astype(np.float32)
    line, slopes = np.zeros((2, cap_lanes.POLYNOMIALS), np.float32)
    rays = np.zeros((cap_rays.PLANES, 64), np.float32)
    cap_rays.of_row(tile, t, line)
    slopes_of_row(tile, t, slopes)
    cap_rays.take_up(line, s, 0, 24, rays.reshape(-1))
    cap_rays.room_of_row(line, s, 24, np.float32(9), rays.reshape(-1))
    at = np.full(24, float(t)), lanes + float(s)
    plane_of = [int(plane) // 64 for plane in (cap_rays.PX, cap_rays.PY, cap_rays.KX, cap_rays.KY, cap_rays.DIM)]
    for plane in range(5):
        powers = tile[:, 3 * plane : 3 * plane + 3].astype(np.float64)
        values = np.polynomial.polynomial.polyval2d(*at, powers)
        np.testing.assert_allclose(rays[plane_of[plane], :24], values, rtol=1e-4, atol=1e-3)
        changes = np.polynomial.polynomial.polyval2d(*at, np.polynomial.polynomial.polyder(powers))
        np.testing.assert_allclose(np.polyval(slopes[3 * plane : 3 * plane + 3][::-1], at[1]), changes, rtol=1e-4)
    room = 9 - np.square(rays[:2, :24].astype(np.float64)).sum(0)
    np.testing.assert_allclose(rays[int(cap_rays.NEXT) // 64, :24], room, rtol=1e-4, atol=1e-2)
    gains = rng.choice([0.0, 0.5], (2, 25))
    for plane, row in zip((cap_rays.ABOVE, cap_rays.BELOW), gains, strict=True):
        rays[int(plane + cap_rays.GAIN) // 64, :25] = row
    cap_tiles.lit(rays.reshape(-1), 0, 24)
    corners = (gains[:, :-1] > 0).sum(0) + (gains[:, 1:] > 0).sum(0)
    np.testing.assert_array_equal(rays[int(cap_tiles.LITS) // 64, :24], np.select([corners == 4, corners > 0], [2, 1]))


@pytest.mark.parametrize(("normal", "coefficients"), [((0, 0, 1), ()), ((0.3, -0.2, 0.93), (-0.2, 0.05, 1e-3, -5e-4))])
def test_outlines_enclose_drops_whose_images_are_bent(normal, coefficients):
    """Five points are traced of each ring; all others must lie inside, and not far inside."""
    numbers = np.array([1200, 1200, 639.5, 479.5, *coefficients])
    camera = Camera("LENSMODEL_OPENCV4" if coefficients else "LENSMODEL_PINHOLE", numbers, 1280, 960)
    chamber = Chamber(tuple(np.array(normal) / np.linalg.norm(normal)), 0.05, (Panel(0.003, 1.49),))
    rng = np.random.default_rng(2)
    drops = [
        SphericalCap((float(x), float(y)), float(radius), float(angle))
        for x, y, radius, angle in rng.uniform((-0.02, -0.015, 3e-4, 0.3), (0.02, 0.015, 4e-3, 2.2), (60, 4))
    ]
    found = Outlines.of(drops, camera, chamber)
    frame, phi = PanelFrame.of(chamber), np.linspace(0, 2 * math.pi, 90)
    for i, drop in enumerate(drops):
        base = frame.base(chamber, drop.centre, 0, "far")
        ring = np.stack([drop.reach * np.cos(phi), drop.reach * np.sin(phi), 0 * phi], -1)
        points = base + np.concatenate([ring + (0, 0, part * drop.top) for part in (0, 0.3, 1)])
        pixels = project(frame.to_camera(points), camera, chamber)[0]
        if found.radius[i] > 0:
            farthest = np.hypot(pixels[:, 0] - found.x[i], pixels[:, 1] - found.y[i]).max()
            assert farthest + 0.95 * MARGIN < found.radius[i] < 1.03 * farthest + MARGIN


@needs_numba
def test_lanes_compute_what_numpy_does():
    from rainstereo.compiled import cap_lanes
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def side(numbers):
        a, b = numbers[:6], numbers[6:]
        return cap_lanes.side_sum(a[0], a[1], a[2], a[3], a[4], a[5], b[0], b[1], b[2], b[3], b[4], b[5])

    rng = np.random.default_rng(3)
    along = (np.arange(4) + 0.5) / 4 - 0.5
    s, t = (part.ravel() for part in np.meshgrid(along, along))
    partly = 0
    for _ in range(200):
        phi, radius, away = rng.uniform((0, 0.5, 0.95), (2 * math.pi, 2, 1.1))
        px, py = (away * radius * part for part in (math.cos(phi), math.sin(phi)))
        kx, ky = rng.uniform(-0.6, 0.6, 2)
        kz, depth, per = math.sqrt(1 - kx * kx - ky * ky), rng.uniform(-1, 1), rng.uniform(5, 40)
        xu, xv, yu, yv = rng.uniform(-0.1, 0.1, 4)
        x, y = px + s * xu + t * xv, py + s * yu + t * yv
        b = x * kx + y * ky + kz * depth  # what a ray has to go yet to where it is closest to the sphere's centre
        closest = np.hypot(b * kx - x, b * ky - y)
        side_away = 0.5 * (b * b + radius**2 - x * x - y * y) / closest
        away = radius - np.hypot(x, y)
        away = np.where((b < 0) & (side_away > away), side_away, away)
        expected = np.clip(0.5 + away * per, 0, 1).sum()
        partly += 0 < expected < 16
        found = side(np.array([px, py, kx, ky, kz, radius, depth, xu, xv, yu, yv, per], np.float32))
        assert found == pytest.approx(expected, abs=2e-3)
    assert partly > 50


@needs_numba
def test_spans_are_of_the_lanes_that_are_marked():
    from rainstereo.compiled import cap_vectors
    from rainstereo.compiled.compile import fused_part

    @fused_part
    def span(rays, limit):
        return cap_vectors.ends(cap_vectors.above(rays, np.uint64(64), limit))

    rng = np.random.default_rng(4)
    for _ in range(50):
        rays = rng.normal(size=192).astype(np.float32)
        limit = np.float32(rng.uniform(0, 4))
        marked = np.flatnonzero(rays[64:128] > limit)
        expected = (marked[0], marked[-1] + 1) if len(marked) else (0, 0)
        assert span(rays, limit) == expected
    assert span(np.full(192, np.nan, np.float32), np.float32(-1)) == (0, 0)
    assert span(np.ones(192, np.float32), np.float32(0)) == (0, 64)
