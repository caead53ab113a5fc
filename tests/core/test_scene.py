"""Scenes, drawings and the sensor against closed forms, exact projections and brute force."""

import itertools
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from rainstereo import Camera, Chamber, Panel
from rainstereo.drawing import Drawing, render_drawing
from rainstereo.mipmap import Mipmap
from rainstereo.pose import rotation_matrix, transform
from rainstereo.refraction import backproject, project
from rainstereo.scene import Plane, Scene, Sky, render
from rainstereo.sensor import Sensor
from rainstereo.types import Array, Image
from rainstereo.view import View, coverage

SIZE = 160, 120
CHAMBER = Chamber((0.0, math.sin(0.26), math.cos(0.26)), 0.04, (Panel(0.004, 1.49),) * 2, (0.02,))


def camera(width: int = SIZE[0], height: int = SIZE[1], f: float = 150.0) -> Camera:
    intrinsics = [f, f * 1.01, width * 0.49, height * 0.51, -0.2, 0.06, 4e-4, -3e-4, -0.01, 0.05, -0.01, 0.004]
    return Camera("LENSMODEL_OPENCV8", np.array(intrinsics), width, height)


def flat(value: int, channels: int = 3) -> Mipmap:
    return Mipmap(np.full((8, 8, channels), value, np.uint8))


def facing(x: float, y: float, z: float) -> Array:
    """Pose of a rectangle that faces the camera, its upper left corner there."""
    return np.array([0.0, 0.0, 0.0, x, y, z])


@pytest.fixture(scope="module")
def pinhole() -> View:
    return View.trace(Camera.pinhole(150, 150, 79.5, 59.5, *SIZE))


@pytest.fixture(scope="module")
def view() -> View:
    return View.trace(camera(), CHAMBER)


# -- the picture in levels ---------------------------------------------------------------------------------------------


def test_mipmap_average_of_everything_is_the_mean(rng: np.random.Generator) -> None:
    picture = rng.integers(0, 256, (64, 128, 3), dtype=np.uint8)
    at, across, down = np.array([[0.5], [0.5]]), np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    found = Mipmap(picture).average(at, across, down)
    assert found.shape == (1, 3)
    assert np.abs(found - picture.mean((0, 1))).max() < 3  # each level rounds to 8 bits, and the last two are mixed


def test_mipmap_lookup_of_small_footprints_is_bilinear_at_texel_centres() -> None:
    ramp = np.repeat(np.arange(64, dtype=np.uint8)[None] * 4, 16, 0)
    at = np.stack([np.linspace(0.1, 0.9, 33), np.full(33, 0.5)])
    tiny = np.full((2, 33), 1e-9)
    found = Mipmap(ramp).average(at, tiny, tiny[::-1])[:, 0]
    assert np.abs(found - 4 * (at[0] * 64 - 0.5)).max() <= 0.6  # 8-bit result


@pytest.mark.parametrize("repeat", [True, False])
def test_mipmap_beyond_its_border(repeat: bool, rng: np.random.Generator) -> None:
    picture = rng.integers(0, 256, (32, 32), dtype=np.uint8)
    inside, tiny = rng.uniform(0, 1, (2, 50)), np.full((2, 50), 1e-9)
    mipmap = Mipmap(picture, repeat)
    if repeat:
        shifted = mipmap.average(inside + [[7.0], [-3.0]], tiny, tiny[::-1])
        assert np.abs(shifted - mipmap.average(inside, tiny, tiny[::-1])).max() <= 2
    else:
        left = mipmap.average(np.stack([np.full(50, -5.0), (np.arange(50) % 32 + 0.5) / 32]), tiny, tiny[::-1])
        assert np.array_equal(left[:, 0], picture[np.arange(50) % 32, 0])


def test_mipmap_long_footprint_averages_along_and_not_across() -> None:
    stripes = np.zeros((256, 256), np.uint8)
    stripes[:, 128:] = 200
    at, down = np.array([[0.25, 0.75], [0.5, 0.5]]), np.array([[0.0, 0.0], [0.9, 0.9]])
    across = np.array([[1 / 256, 1 / 256], [0.0, 0.0]])
    assert Mipmap(stripes).average(at, across, down)[:, 0] == pytest.approx([0, 200], abs=0.5)


def test_mipmap_refuses_what_is_no_picture() -> None:
    with pytest.raises(ValueError, match="uint8 or uint16"):
        Mipmap(np.zeros((4, 4)))


# -- rays --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chamber", [None, CHAMBER])
def test_meeting_points_project_back_to_their_pixels(chamber: Chamber | None) -> None:
    view = View.trace(camera(), chamber)
    pose = np.array([0.3, -0.4, 0.2, 0.1, -0.2, 1.5])
    at, depth = view.meet(pose)
    points = transform(pose, np.concatenate([at, np.zeros((1, *depth.shape))]).reshape(3, -1).T)
    pixels, status = project(points, view.camera, chamber)
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]]
    assert not status.any()
    assert np.abs(pixels - np.stack([columns, rows], -1).reshape(-1, 2)).max() < 1e-9
    assert np.abs(points[:, 2] - depth.reshape(-1)).max() < 1e-12


def test_window_holds_the_figure_and_nothing_beside_the_frame(view: View) -> None:
    corners = np.array([[-0.1, -0.1, 1.0], [0.1, -0.1, 1.0], [0.1, 0.1, 1.0], [-0.1, 0.1, 1.0]])
    pixels, _ = project(corners, view.camera, CHAMBER)
    window = view.window(corners, margin=1)
    assert window is not None
    rows, columns = window
    assert rows.start <= pixels[:, 1].min() - 1 <= rows.start + 1
    assert columns.stop - 3 <= pixels[:, 0].max() <= columns.stop
    assert view.window(corners + [1.0, 0, 0], margin=1) is None
    assert view.window(corners - [0, 0, 5.0], margin=1) == (slice(0, SIZE[1]), slice(0, SIZE[0]))


# -- rectangles --------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(turn=st.floats(-3.1, 3.1), width=st.floats(0.002, 0.5), height=st.floats(0.05, 0.4))
def test_coverage_adds_up_to_the_area(turn: float, width: float, height: float) -> None:
    view = View.trace(Camera.pinhole(150, 150, 79.5, 59.5, *SIZE))
    R = rotation_matrix(np.array([0, 0, turn]))
    pose = np.concatenate([[0, 0, turn], np.array([0.003, -0.002, 1.0]) - R @ [width / 2, height / 2, 0]])
    area = coverage(*view.meet(pose), (width, height)).sum()
    assert area == pytest.approx(width * height * 150**2, rel=0.02, abs=0.6)  # down to a third of a pixel wide


@pytest.mark.parametrize("pitch", [0.0, 0.1])
def test_depth_of_a_road_without_chamber_is_its_closed_form(pitch: float) -> None:
    height, cam = 1.5, Camera.pinhole(150, 150, 79.5, 40.0, *SIZE)
    R = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    road = Plane(flat(80), (2000.0, 2000.0), np.concatenate([cv2.Rodrigues(R)[0][:, 0], [-1000, height, 1990]]))
    tilt = np.array([pitch, 0, 0, 0, 0, 0])
    seen = render(View.trace(cam), Scene((road,)), tilt)
    y = (np.arange(SIZE[1]) - 40.0) / 150
    # (0, cos, sin) is the road's normal in a camera that is pitched: it lies where y cos + z sin = height
    with np.errstate(divide="ignore"):
        expected = height / (y * math.cos(pitch) + math.sin(pitch))
    below = (expected > 0) & (expected < 900)
    assert below.sum() > 60
    assert np.abs(seen.depth[below] / expected[below, None] - 1).max() < 1e-12
    assert np.isnan(seen.depth[expected <= 0]).all()


def test_depth_behind_the_chamber_is_of_the_point_that_projects_there(view: View) -> None:
    pose = np.array([0.0, 0.5, 0.0, -3.0, -2.0, 6.0])
    seen = render(view, Scene((Plane(flat(99), (9.0, 6.0), pose),)), np.zeros(6))
    assert np.isfinite(seen.depth).mean() > 0.9
    normal = rotation_matrix(pose[:3])[:, 2]
    rows, columns = np.nonzero(np.isfinite(seen.depth))
    pixels = np.stack([columns, rows], -1).astype(float)
    origins, directions = backproject(pixels, view.camera, CHAMBER)
    points = origins + ((pose[3:] - origins) @ normal / (directions @ normal))[:, None] * directions
    assert np.abs(points[:, 2] - seen.depth[rows, columns]).max() < 1e-10


def test_the_nearest_wins_in_any_order(pinhole: View) -> None:
    planes = [
        Plane(flat(200), (1.0, 1.0), facing(-0.5, -0.5, 2.0), name="far"),
        Plane(flat(120), (0.5, 0.5), facing(-0.3, -0.3, 1.5), name="middle"),
        Plane(flat(40), (0.2, 0.2), facing(-0.1, -0.1, 1.0), name="near"),
    ]
    pictures = [render(pinhole, Scene(order), np.zeros(6)).image for order in itertools.permutations(planes)]
    for picture in pictures[1:]:
        assert np.array_equal(picture, pictures[0])
    seen = render(pinhole, Scene(planes), np.zeros(6))
    assert seen.plane[59, 79] == 2
    assert seen.depth[59, 79] == pytest.approx(1.0, abs=1e-12)
    assert pictures[0][59, 79] == pytest.approx([40] * 3)
    assert seen.plane[32, 52] == 1
    assert seen.depth[25, 110] == pytest.approx(2.0, abs=1e-12)
    assert seen.plane[0, 0] == -1
    assert np.isnan(seen.depth[0, 0])


def test_planes_that_cross_are_cut_where_they_meet(pinhole: View) -> None:
    turned = np.array([0.0, 0.6, 0.0, *(np.array([0, -1, 2.0]) - rotation_matrix(np.array([0, 0.6, 0])) @ [1, 0, 0])])
    planes = Plane(flat(50), (2.0, 2.0), facing(-1, -1, 2.0)), Plane(flat(250), (2.0, 2.0), turned)
    for order, first in ((planes, 0), (planes[::-1], 1)):
        seen = render(pinhole, Scene(order), np.zeros(6))
        assert (seen.plane[59, 20:79] == first).all()  # turned away on the left: the flat one is in front
        assert (seen.plane[59, 81:140] == 1 - first).all()


def test_a_cut_out_shows_what_is_behind(pinhole: View) -> None:
    hole = np.full((64, 64, 4), 255, np.uint8)
    hole[16:48, 16:48] = 0
    planes = Plane(flat(100), (2, 2), facing(-1, -1, 3.0)), Plane(Mipmap(hole), (0.4, 0.4), facing(-0.2, -0.2, 1.0))
    seen = render(pinhole, Scene(planes), np.zeros(6))
    assert seen.image[59, 79] == pytest.approx([100] * 3)
    assert seen.depth[59, 79] == pytest.approx(3)
    assert seen.image[59, 55] == pytest.approx([255] * 3)
    assert seen.depth[59, 55] == pytest.approx(1)


def test_sky_lies_in_its_direction_wherever_the_camera_stands(pinhole: View) -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 8, 0).repeat(3, -1)
    scene = Scene((), Sky(Mipmap(ramp), (-1.0, 1.0), (-1.0, 1.0)))
    here, there = (render(pinhole, scene, facing(*t)).image for t in ((0, 0, 0), (50.0, -3.0, 900.0)))
    assert np.array_equal(here, there)
    azimuth = np.arctan((np.arange(SIZE[0]) - 79.5) / 150)
    assert np.abs(here[59, :, 0] - ((azimuth + 1) / 2 * 256 - 0.5)).max() < 1


def test_pixels_without_a_ray_are_black() -> None:
    cam = Camera("LENSMODEL_OPENCV4", np.array([60, 60, 79.5, 59.5, -0.45, 0, 0, 0]), *SIZE)
    view = View.trace(cam)
    lost = np.isnan(view.directions[0])
    assert 0.05 < lost.mean() < 0.9
    seen = render(view, Scene((Plane(flat(200), (90, 90), facing(-45, -45, 2)),)), np.zeros(6))
    assert np.isnan(seen.depth[lost]).all()
    assert np.isfinite(seen.image).all()
    assert seen.image[lost].mean() < 2


def test_a_scene_is_as_a_finer_camera_averages_it(rng: np.random.Generator) -> None:
    blocks = cv2.resize(rng.integers(0, 256, (24, 24, 3), dtype=np.uint8), (192, 192), interpolation=cv2.INTER_NEAREST)
    picture = Mipmap(blocks, repeat=True)
    R = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    ground = np.concatenate([cv2.Rodrigues(R)[0][:, 0], [-20, 1.5, 60]])
    planes = (
        Plane(picture, (40, 60), ground, (4, 4)),
        Plane(picture, (1.5, 1.2), np.array([0.1, 0.4, 0.2, -1.2, -0.9, 4.0])),
        Plane(picture, (0.05, 2.0), np.array([0, 0, 0.1, 0.8, -0.6, 5.0])),
    )
    scene, n, cam = Scene(planes), 6, camera()
    intrinsics = cam.intrinsics.copy()
    intrinsics[:2] *= n
    intrinsics[2:4] = (intrinsics[2:4] + 0.5) * n - 0.5
    finer = Camera(cam.model, intrinsics, SIZE[0] * n, SIZE[1] * n)
    seen = render(View.trace(cam, CHAMBER), scene, np.zeros(6)).image
    fine = render(View.trace(finer, CHAMBER), scene, np.zeros(6)).image
    exact = cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA)
    error = np.abs(seen - exact)
    assert np.sqrt((error**2).mean()) < 7  # of 256: block edges are softened, nothing is displaced or flickers
    assert np.abs((seen - exact).mean()) < 0.3


def test_planes_and_their_pictures_are_checked() -> None:
    with pytest.raises(ValueError, match="3 or 4"):
        Plane(flat(1, 2), (1, 1), np.zeros(6))
    with pytest.raises(ValueError, match="above 0"):
        Plane(flat(1), (0, 1), np.zeros(6))


# -- drawings ----------------------------------------------------------------------------------------------------------


def checker(square_texels: int = 64) -> tuple[Image, Array]:
    """6 x 5 squares with a white margin of one; the pixel of the first inner corner."""
    squares = np.add.outer(np.arange(5), np.arange(6)) % 2
    inside = np.kron(squares * 255, np.ones((square_texels, square_texels))).astype(np.uint8)
    return np.pad(inside, square_texels, constant_values=255), np.full(2, 2 * square_texels - 0.5)


@pytest.mark.parametrize(("blur", "close"), [(0.0, 0.02), (0.6, 0.004)])
def test_drawing_against_brute_force(blur: float, close: float) -> None:
    """16 x 16 exactly traced samples a pixel, the pattern as a formula, the blur as a direct convolution."""
    cam, k, half, margin = camera(320, 240, 300), 16, 6, 4
    view = View.trace(cam, CHAMBER)
    picture, origin = checker()
    square, pose = 0.03, np.array([0.5, -0.4, 0.15, -0.06, -0.05, 0.35])
    drawing = Drawing.of(picture, origin, square / 64, 30, 220)
    image = render_drawing(view, drawing, pose, np.full(view.shape, 90, np.float32), blur)
    for column, row in ((0, 0), (2, 3), (4, 1)):
        corner = transform(pose, np.array([column * square, row * square, 0.0]))
        x, y = np.round(project(corner, cam, CHAMBER)[0]).astype(int)
        offset = (np.arange((2 * (half + margin) + 1) * k) + 0.5) / k - 0.5 - (half + margin)
        samples = np.stack(np.meshgrid(x + offset, y + offset), -1)
        origins, directions = backproject(samples, cam, CHAMBER)
        R = rotation_matrix(pose[:3])
        start, along = (origins - pose[3:]) @ R, directions @ R
        at = start - (start[..., 2] / along[..., 2])[..., None] * along
        black = np.floor(at[..., :2] / square).sum(-1) % 2 == 0
        fine = np.where(black, 30.0, 220.0)
        if blur:
            fine = gaussian_filter(fine, blur * k, truncate=6)
        exact = fine.reshape(len(offset) // k, k, -1, k).mean((1, 3))[margin:-margin, margin:-margin]
        error = image[y - half : y + half + 1, x - half : x + half + 1] - exact
        slope = np.stack([g.ravel() for g in np.gradient(exact)], -1)
        shift = np.linalg.lstsq(slope, -error.ravel(), rcond=None)[0]
        assert np.abs(shift).max() < close
        assert np.abs(error).max() < (25 if blur else 60)
        assert np.sqrt((error**2).mean()) < 6


def test_drawing_edge_has_the_blur_that_was_asked_for(pinhole: View) -> None:
    half_black = np.zeros((1600, 1600), np.uint8)
    half_black[:, 800:] = 255
    pose = facing(0.0, 0.0, 1.0)
    for blur in (0.5, 1.0, 2.0):
        drawing = Drawing.of(half_black, np.array([799.5, 799.5]), 0.0005)
        image = render_drawing(pinhole, drawing, pose, np.zeros(pinhole.shape, np.float32), blur, 8)
        spread = np.diff(image[40:80, 59:101].astype(float), axis=1).mean(0) / 255
        place = np.arange(len(spread)) - (np.arange(len(spread)) * spread).sum()
        assert spread.sum() == pytest.approx(1, abs=1e-3)
        variance = (place**2 * spread).sum()
        assert variance == pytest.approx(blur**2 + 2 / 12, rel=0.03)  # the lens, the pixel's square, the difference


def test_drawing_beside_the_frame_leaves_the_background(view: View) -> None:
    drawing = Drawing.of(*checker(8), 0.01)
    background = np.full(view.shape, 17, np.float32)
    image = render_drawing(view, drawing, facing(5.0, 0.0, 1.0), background)
    assert np.array_equal(image, background)
    assert image is not background


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Drawing.of(np.zeros((4, 4, 3), np.uint8), np.zeros(2), 1e-3), "uint8"),
        (lambda: Drawing.of(np.zeros((4, 4), np.uint8), np.zeros(2), 0.0), "more than 0"),
        (lambda: Drawing.of(np.zeros((4, 4), np.uint8), np.zeros(2), 1.0, 200, 100), "black < white"),
        (lambda: Sensor(blur=-1), "blur"),
        (lambda: Sensor(noise=float("nan")), "noise"),
    ],
)
def test_bad_arguments_are_named(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        make()


# -- sensor ------------------------------------------------------------------------------------------------------------


def test_sensor_noise_has_its_standard_deviation() -> None:
    light, cosine = np.full((400, 500), 100.0, np.float32), np.ones((400, 500), np.float32)
    for noise in (1.0, 2.0, 5.0):
        image = Sensor(0, 0, noise).expose(light, cosine, np.random.default_rng(1)).astype(float)
        assert image.std() == pytest.approx(math.sqrt(noise**2 + 1 / 12), rel=0.01)  # and the rounding's
        assert image.mean() == pytest.approx(100, abs=0.03)
    assert (light == 100).all()


def test_sensor_vignetting_is_the_power_of_the_cosine(pinhole: View) -> None:
    image = Sensor(0, 4, 0).expose(np.full(pinhole.shape, 200.0, np.float32), pinhole.cosine, np.random.default_rng(0))
    x, y = np.meshgrid((np.arange(SIZE[0]) - 79.5) / 150, (np.arange(SIZE[1]) - 59.5) / 150)
    assert np.abs(image - 200 / (1 + x**2 + y**2) ** 2).max() <= 0.51


def test_sensor_is_seeded_and_clips() -> None:
    light, cosine = np.full((40, 50, 3), 254.0), np.ones((40, 50))
    sensor = Sensor(noise=5)
    first, again, other = (sensor.expose(light, cosine, np.random.default_rng(s)) for s in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.max() == 255
