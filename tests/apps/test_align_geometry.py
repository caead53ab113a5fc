"""Alignment models on scenes of known depth, rendered through the chamber of the digital rig."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rainstereo import Rig
from rainstereo.align import Alignment, plan, residual_shift
from rainstereo.apps.digital_rig import RigOptions, digital_rig
from rainstereo.mipmap import Mipmap
from rainstereo.occlusion import DISPLACED, OCCLUDED, VALID, Occlusion
from rainstereo.parallax import check_homography, disparity, rule_of_thumb
from rainstereo.plane_fit import fit_plane, inverse_depths
from rainstereo.pose import compose
from rainstereo.rectify import INFINITY, Plane
from rainstereo.refine import refine, turned, without_turn
from rainstereo.scene import Plane as Rectangle
from rainstereo.scene import Scene, render
from rainstereo.tile_votes import TileVotes
from rainstereo.types import Array, Image
from rainstereo.view import View

SIZE = 480, 360


@cache
def rig() -> Rig:
    return digital_rig(RigOptions(*SIZE), seed=5)


@cache
def views() -> dict[str, View]:
    return {role: View.trace(rig().camera(role), rig().chamber_in(role)) for role in ("dry", "wet")}  # type: ignore[arg-type]


@cache
def print_of(seed: int) -> Mipmap:
    rng = np.random.default_rng(seed)
    gray = 128 + 900 * gaussian_filter(rng.normal(size=(1200, 1600)), 3.0)
    return Mipmap(np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, axis=2))


def wall(depth: float, seed: int = 0, size: tuple[float, float] | None = None) -> Rectangle:
    width, height = size or (1.6 * depth, 1.2 * depth)
    return Rectangle(print_of(seed), (width, height), np.array([0, 0, 0, -width / 2, -height / 2, depth]))


def road(height: float) -> Rectangle:
    """A ground plane `height` below the dry camera: z of its frame points up, y of it towards the cameras."""
    return Rectangle(print_of(2), (40.0, 60.0), np.array([np.pi / 2, 0, 0, -20.0, height, 1.0]), tile=(40.0, 30.0))


def taken(*planes: Rectangle) -> tuple[Image, Image]:
    """What the rig's cameras see, without noise."""
    images = []
    for role in ("dry", "wet"):
        seen = render(views()[role], Scene(planes), compose(rig().camera(role).rt_cam_ref, np.zeros(6)), 0.6)  # type: ignore[arg-type]
        images.append(np.clip(np.rint(seen.image), 0, 255).astype(np.uint8))
    return images[0], images[1]


@cache
def wall_at(depth: float) -> tuple[Image, Image]:
    return taken(wall(depth))


def tiles(alignment: Alignment, raw: tuple[Image, Image]) -> tuple[Array, Array]:
    centres, shifts, sigmas = residual_shift(*alignment.apply(*raw), tile=64)
    assert (sigmas < 0.05).mean() > 0.8
    return centres[sigmas < 0.05], shifts[sigmas < 0.05]


@pytest.mark.parametrize("depth", [2.0, 4.0])
def test_on_the_aligned_plane_nothing_remains(depth: float) -> None:
    _, shifts = tiles(plan(rig(), Plane((0, 0, 1), depth)), wall_at(depth))
    assert np.median(np.hypot(*shifts.T)) < 0.05
    assert np.abs(np.median(shifts, axis=0)).max() < 0.02


@pytest.mark.parametrize(("plane", "depth"), [(INFINITY, 2.0), (INFINITY, 4.0), (Plane((0, 0, 1), 4.0), 2.0)])
def test_at_other_depths_the_predicted_parallax_remains(plane: Plane, depth: float) -> None:
    alignment = plan(rig(), plane)
    centres, shifts = tiles(alignment, wall_at(depth))
    exact = disparity(rig(), alignment, depth, centres)
    assert np.abs(exact[:, 0]).min() > 1.5
    assert np.median(np.hypot(*(shifts - exact).T)) < 0.05
    assert np.abs(np.median(shifts - exact, axis=0)).max() < 0.03
    thumb = rule_of_thumb(rig(), alignment, depth, centres)
    assert np.abs(thumb - exact).max() < 0.05  # the panels matter little here
    simple = rig().baseline * float(alignment.view.intrinsics[0]) * (1 / depth - 1 / plane.distance)
    np.testing.assert_allclose(np.median(thumb[:, 0]), simple, atol=0.05)


def test_disparity_vanishes_on_the_plane_and_grows_with_nearness() -> None:
    alignment = plan(rig(), Plane((0, 0, 1), 3.0))
    pixels = np.array([[60.0, 50], [200, 150], [350, 260]])
    assert np.abs(disparity(rig(), alignment, 3.0, pixels)).max() < 1e-6
    by_depth = [disparity(rig(), alignment, z, pixels)[:, 0] for z in (0.5, 1.0, 2.0, 4.0, 1e6)]
    assert (np.diff(by_depth, axis=0) < 0).all()


def test_a_homography_is_exact_without_panels_and_not_with_thick_ones() -> None:
    near = Plane((0, 0, 1), 0.4)
    bare = digital_rig(RigOptions(*SIZE, panels=0), seed=5)
    none = check_homography(bare, plan(bare, near))
    assert np.nanmax(none.textbook) < 1e-6
    assert none.share == 0
    thick = digital_rig(RigOptions(*SIZE, thickness_mm=25, tilt_deg=35, yaw_deg=30, distance_mm=80), seed=5)
    some = check_homography(thick, plan(thick, near))
    assert some.share > 0.2
    assert np.nanmax(some.textbook) > 0.1
    assert np.nanmean(some.fitted) < np.nanmean(some.textbook)


def test_auto_finds_a_wall_and_a_road() -> None:
    far = plan(rig())
    votes = TileVotes.measure([far.apply(*wall_at(2.0))], tile=64)
    inverse, _ = inverse_depths(votes, rig(), far.view)
    assert np.median(inverse) == pytest.approx(0.5, abs=0.01)
    found = fit_plane(votes, rig(), far.view)
    assert found.plane.distance == pytest.approx(2.0, abs=0.03)
    assert found.plane.normal[2] > 0.999
    assert found.after[0] < 0.1
    assert found.before[0] > 5
    raw = taken(road(1.2))
    votes = TileVotes.measure([far.apply(*raw)], tile=48)
    first = fit_plane(votes, rig(), far.view)
    assert first.plane.distance == pytest.approx(1.2, abs=0.2)
    there = plan(rig(), first.plane)
    found = fit_plane(TileVotes.measure([there.apply(*raw)], tile=48), rig(), there.view, first.plane)
    assert found.plane.distance == pytest.approx(1.2, abs=0.04)
    assert found.plane.normal[1] > 0.999
    assert found.after[0] < first.after[0] < found.before[0]
    assert "a ground 1.2" in found.words
    few = votes.take(np.arange(len(votes)) < 5)
    assert fit_plane(few, rig(), far.view).plane is INFINITY


def test_infinity_is_kept_where_nothing_is_better() -> None:
    far = plan(rig())
    votes = TileVotes.measure([far.apply(*wall_at(4000.0))], tile=64)
    assert fit_plane(votes, rig(), far.view).plane is INFINITY


@cache
def scenes() -> list[tuple[Image, Image]]:
    """Walls at three depths, each with a nearer one before it."""
    return [taken(wall(z, i), wall(z / 2, i + 3, (0.5 * z, 0.3 * z))) for i, z in enumerate((3.0, 5.0, 8.0))]


@pytest.mark.parametrize("truth", [(6e-4, -2e-3, 1.5e-3), (0.0, 0.0, 1.2e-3)])
def test_a_turned_camera_is_found_whatever_the_depths(truth: tuple[float, float, float]) -> None:
    wrong = turned(rig(), -np.array(truth))
    far = plan(wrong)
    rng = np.random.default_rng(1)
    pairs = [far.apply(*pair) for pair in scenes()]
    for _, wet in pairs:  # drops: a third of the tiles show something else
        for _ in range(9):
            x, y = int(rng.integers(0, wet.shape[1] - 60)), int(rng.integers(0, wet.shape[0] - 60))
            wet[y : y + 60, x : x + 60] = wet[::-1, ::-1][y : y + 60, x : x + 60]
    votes = TileVotes.measure(pairs, tile=64)
    found = refine(votes, wrong, far.view)
    assert found.applied
    assert found.moved_px > 0.2
    error = np.abs(found.rotation - truth)
    assert (error < 4 * found.sigma + 2e-5).all()
    assert (error[[0, 2]] * 450 < 0.05).all()  # pixels
    assert found.across_px[1] < 0.5 * found.across_px[0]
    again = plan(turned(wrong, found.rotation))
    measured = TileVotes.measure([again.apply(*pair) for pair in scenes()], tile=64)
    assert abs(np.median(measured.shifts[:, 1])) < 0.05
    corrected = without_turn(votes, far.view, found.rotation)
    assert abs(np.median(corrected.shifts[:, 1])) < 0.05


def test_a_rig_that_explains_the_images_is_left_alone() -> None:
    far = plan(rig())
    votes = TileVotes.measure([far.apply(*pair) for pair in scenes()], tile=64)
    found = refine(votes, rig(), far.view)
    assert not found.applied
    assert "the rig explains the images" in found.words
    few = refine(votes.take(np.arange(len(votes)) < 12), rig(), far.view)
    assert not few.applied
    assert few.words.startswith("12 tiles")


def test_turned_keeps_the_camera_s_place() -> None:
    other = turned(rig(), np.array([0.01, -0.02, 0.03]))
    assert other.baseline == pytest.approx(rig().baseline, abs=1e-15)
    back = turned(other, -np.array([0.01, -0.02, 0.03]))
    np.testing.assert_allclose(back.rt_wet_dry, rig().rt_wet_dry, atol=1e-15)


def test_the_mask_marks_what_only_one_camera_sees() -> None:
    alignment = plan(rig())
    near = wall(1.0, 4, (0.35, 0.3))
    dry, wet = alignment.apply(*taken(wall(4.0), near))
    reach = rig().baseline * float(alignment.view.intrinsics[0])
    mask = Occlusion(1, -2, 20, 5.0).mask(dry, wet, alignment.dry.valid)
    fx, fy, cx, cy = alignment.view.intrinsics
    left, right = cx - 0.175 * fx, cx + 0.175 * fx
    rows = slice(int(cy - 0.1 * fy), int(cy + 0.1 * fy))
    band = reach * (
        1 / 1.0 - 1 / 4.0
    )  # the wet camera stands on the left: it cannot see what is right of the near wall
    hidden = mask[rows, int(right) + 2 : int(right + band) - 2] == OCCLUDED
    assert hidden.mean() > 0.6
    assert (mask[rows, int(left) - 40 : int(left) - 8] == VALID).mean() > 0.95
    assert (mask[rows, int(left) + 12 : int(right) - 12] == DISPLACED).mean() > 0.9
    assert (mask == OCCLUDED).mean() < 2.5 * band * 0.3 * fy / mask.size
    noise = np.random.default_rng(0).integers(0, 255, dry.shape, dtype=np.uint8)
    assert (
        Occlusion(1, -2, 20, 5.0).mask(dry, noise, alignment.dry.valid) == VALID
    ).mean() > 0.97  # drops claim nothing
