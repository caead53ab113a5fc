"""Benchmark stage `refraction`: pixels of a million points seen through two acrylic panels, and rays of pixels."""

from __future__ import annotations

import importlib
import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rainstereo import Camera, Chamber, Panel
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.refraction import backproject, project

Float = npt.NDArray[np.float64]
FOCAL, WIDTH, HEIGHT = 1200.0, 1280, 960
TILT = np.radians(15.0)
NEAREST, FARTHEST = 0.3, 50.0


@dataclass(frozen=True)
class Scene:
    """The camera, the chamber, points (N, 3) in front of both, and where exactly they are seen, (N, 2)."""

    camera: Camera
    chamber: Chamber
    points: Float
    seen: Float


def build(seed: int, quick: bool) -> Stage:
    """The stage on 1e6 points, or 1e4 if `quick`."""
    count = 10_000 if quick else 1_000_000
    scene = _scene(count, seed)
    error = _distance_from(scene.seen)
    optv = _optv(scene, error)
    bare = _distance_from(_pinhole(scene.points))
    points32: Any = scene.points.astype(np.float32)
    return Stage(
        "refraction",
        "refraction",
        f"{count:,} points, {NEAREST}–{FARTHEST:g} m away, through two 4 mm acrylic panels tilted by 15 degrees. "
        "Every error is the worst of all points, against Snell's law solved another way in extended precision.",
        (
            Work(
                "project",
                "Points to pixels",
                "Where does the camera see each point? Those who ignore the acrylic are off by as much as their error.",
                (
                    Variant(
                        "project", lambda: project(scene.points, scene.camera, scene.chamber)[0], error, True, "float64"
                    ),
                    Variant("project, float32", lambda: project(points32, scene.camera, scene.chamber)[0], error, True),
                    Variant(
                        "textbook numpy", lambda: _textbook(scene), error, note="same equation, whole arrays at once"
                    ),
                    *_numba(scene, error),
                    *optv,
                    Variant("cv2.projectPoints", lambda: _opencv(scene.points), error, note="cannot refract"),
                ),
                "project",
                "px",
                "largest over all points",
                count,
                "points",
                _targets(quick, bool(optv)),
            ),
            Work(
                "bare",
                "Points to pixels, nothing in front of the camera",
                "The same call without a chamber must cost no refraction.",
                (
                    Variant("project, no chamber", lambda: project(scene.points, scene.camera)[0], bare, True),
                    Variant("cv2.projectPoints", lambda: _opencv(scene.points), bare),
                ),
                "project, no chamber",
                "px",
                "largest over all points, against the pinhole formula in extended precision",
                count,
                "points",
            ),
            _few_points(scene),
            Work(
                "backproject",
                "Pixels to rays",
                "The ray behind the chamber of each pixel; it must pass through the point that is seen there.",
                (
                    Variant(
                        "backproject",
                        lambda: tuple(backproject(scene.seen, scene.camera, scene.chamber)),
                        lambda rays: _miss(rays, scene.points),
                        True,
                    ),
                    Variant(
                        "cv2.undistortPoints",
                        lambda: _opencv_rays(scene.seen),
                        lambda rays: _miss(rays, scene.points),
                        note="cannot refract",
                    ),
                ),
                "backproject",
                "px",
                "largest distance of a ray from its point, as an angle seen from the camera",
                count,
                "pixels",
            ),
        ),
        {
            "camera": f"pinhole, f {FOCAL:g} px, {WIDTH}x{HEIGHT}",
            "chamber": "two panels of 4 mm, index 1.49, 40 mm away, 20 mm apart, tilted by 15 degrees",
            "points": f"{count:,}, uniform over the image, log-uniform in depth",
            "reference": f"Snell's law in {np.finfo(np.longdouble).nmant + 1}-bit arithmetic",
            "threads": "1",
            "seed": seed,
        },
        (
            "Everything runs on one thread; nothing is compiled for this page: numpy, and peers as PyPI ships them.",
            "optv sees two panels in air as one slab of 8 mm, which is what they are to points beyond them; it stops "
            "iterating at 0.001 mm on the slab, hence its error. It handles one tilted glass, not N layers.",
            "cv2.projectPoints can do lens distortion too; here it has none to do, which does not make it faster.",
            "Where numba is installed, a bare compiled loop of the same equation shows what an accelerator could add.",
            "Points lie beyond the panels. Points inside or between them need other layers, and cost us a little more.",
        ),
    )


def _targets(quick: bool, optv: bool) -> tuple[Target, ...]:
    """What is promised, of the full work only."""
    peers = ["cv2.projectPoints", *(["optv"] if optv else [])]
    return () if quick else tuple(Target("project", peer, 1 / 5) for peer in peers)


def _few_points(scene: Scene, count: int = 54, calls: int = 200) -> Work:
    """One board's corners a call: here the price of a call counts, not that of a point."""
    points, error = scene.points[:count].copy(), _distance_from(scene.seen[:count])

    def repeated(run: Callable[[], Any]) -> Callable[[], Any]:
        def many() -> Any:
            for _ in range(calls):
                result = run()
            return result

        return many

    few = Scene(scene.camera, scene.chamber, points, scene.seen[:count])
    variants = (
        Variant("project", repeated(lambda: project(points, scene.camera, scene.chamber)[0]), error, True),
        *(Variant(v.name, repeated(v.run), v.error, note=v.note) for v in _optv(few, error)),
        Variant("cv2.projectPoints", repeated(lambda: _opencv(points)), error, note="cannot refract"),
    )
    return Work(
        "few",
        f"{count} points a call",
        f"The corners of one board, {calls} calls. An array library pays for each call what compiled code does not.",
        variants,
        "project",
        "px",
        "largest over these points",
        calls,
        "calls",
    )


def reference(points: Float, chamber: Chamber) -> npt.NDArray[np.longdouble]:
    """Pixels (N, 2) of points beyond the chamber, in extended precision and by another route than rainstereo's.

    The unknown is u, the tangent of the ray's angle in air: u (z - T) + sum T_i u / sqrt(n_i^2 + (n_i^2 - 1) u^2) = r,
    solved by Newton's method from u = r/z. The pixel is where the ray, in the plane of point and normal, meets z = f.
    """
    P, n = points.astype(np.longdouble), np.asarray(chamber.normal, np.longdouble)
    n = n / np.sqrt((n * n).sum())
    z = (P * n).sum(-1)
    across = P - z[:, None] * n
    r = np.sqrt((across * across).sum(-1))
    layers = [(np.longdouble(panel.thickness), np.longdouble(panel.index)) for panel in chamber.panels]
    u, air = r / z, z - sum(t for t, _ in layers)
    for _ in range(12):
        value, slope = u * air - r, air.copy()
        for thickness, index in layers:
            root = np.sqrt(index**2 + (index**2 - 1) * u * u)
            value += thickness * u / root
            slope += thickness * index**2 / root**3
        u = u - value / slope
    ray = n + np.where(r > 0, u / np.where(r > 0, r, 1), 0)[:, None] * across
    centre = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], np.longdouble)
    return np.asarray(np.longdouble(FOCAL) * ray[:, :2] / ray[:, 2:] + centre)


def _scene(count: int, seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    camera = Camera.pinhole(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    panel = Panel(0.004, 1.49)
    chamber = Chamber((np.sin(TILT), 0.0, np.cos(TILT)), 0.040, (panel, panel), (0.020,))
    pixels = rng.uniform((0, 0), (WIDTH - 1, HEIGHT - 1), (count, 2))
    depth = np.exp(rng.uniform(np.log(NEAREST), np.log(FARTHEST), count))
    rays = np.column_stack([(pixels - (camera.intrinsics[2], camera.intrinsics[3])) / FOCAL, np.ones(count)])
    points = np.asarray(rays * depth[:, None], np.float64)
    seen = np.concatenate([reference(block, chamber) for block in np.array_split(points, max(1, count // 50_000))])
    return Scene(camera, chamber, points, np.asarray(seen, np.float64))


def _distance_from(truth: Float) -> Callable[[Any], float]:
    return lambda pixels: float(np.hypot(*(np.asarray(pixels, np.float64).reshape(-1, 2) - truth).T).max())


def _pinhole(points: Float) -> Float:
    P = points.astype(np.longdouble)
    centre = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], np.longdouble)
    return np.asarray(FOCAL * P[:, :2] / P[:, 2:] + centre, np.float64)


def _miss(rays: Any, points: Float) -> float:
    """How far rays pass beside their points, as pixels at the depth of the point."""
    origins, directions = (np.asarray(part, np.longdouble) for part in rays)
    towards = points - origins
    along = (towards * directions).sum(-1) / (directions * directions).sum(-1)
    beside = towards - along[:, None] * directions
    return float((FOCAL * np.sqrt((beside * beside).sum(-1)) / points[:, 2]).max())


def _textbook(scene: Scene) -> Float:
    """The equation of `rainstereo.refraction` as one would first write it: whole arrays, a fixed five iterations."""
    normal = np.asarray(scene.chamber.normal)
    z = scene.points @ normal
    r2 = ((scene.points - z[:, None] * normal) ** 2).sum(-1)
    thickness, n2 = sum(panel.thickness for panel in scene.chamber.panels), scene.chamber.panels[0].index ** 2
    delta = np.full_like(z, thickness * (1 - 1 / np.sqrt(n2)))
    for _ in range(5):
        w = z - delta
        root = np.sqrt(n2 * w**2 + (n2 - 1) * r2)
        delta = delta - (delta - thickness * (1 - w / root)) / (1 - thickness * (n2 - 1) * r2 / root**3)
    moved = scene.points - delta[:, None] * normal
    return np.asarray(FOCAL * moved[:, :2] / moved[:, 2:] + scene.camera.intrinsics[2:4], np.float64)


def _numba(scene: Scene, error: Callable[[Any], float]) -> list[Variant]:
    """The same equation in a compiled loop, where numba is installed: what an accelerator would add."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        return []
    nx, ny, nz = scene.chamber.normal
    thickness, n2 = sum(panel.thickness for panel in scene.chamber.panels), scene.chamber.panels[0].index ** 2
    cx, cy = scene.camera.intrinsics[2:4]

    @numba.njit(error_model="numpy")  # type: ignore[untyped-decorator]
    def loop(points: Float) -> Float:
        pixels = np.empty((len(points), 2))
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            zn = x * nx + y * ny + z * nz
            rx, ry, rz = x - zn * nx, y - zn * ny, z - zn * nz
            bend = (n2 - 1) * (rx * rx + ry * ry + rz * rz)
            delta = thickness * (1 - 1 / np.sqrt(n2))
            for _ in range(3):
                w = zn - delta
                inverse = 1 / np.sqrt(n2 * w * w + bend)
                step = (delta - thickness * (1 - w * inverse)) / (1 - thickness * bend * inverse**3)
                delta -= step
            depth = z - delta * nz
            pixels[i, 0] = FOCAL * (x - delta * nx) / depth + cx
            pixels[i, 1] = FOCAL * (y - delta * ny) / depth + cy
        return pixels

    note = f"numba {numba.__version__}; this slab only, no checks, no status"
    return [Variant("numba loop", lambda: loop(scene.points), error, note=note)]


def _matrix() -> Float:
    return np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])


def _opencv(points: Float) -> Any:
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), _matrix(), np.zeros(5))[0]


def _opencv_rays(pixels: Float) -> tuple[Float, Float]:
    flat = cv2.undistortPoints(pixels, _matrix(), np.zeros(5)).reshape(-1, 2)
    directions = np.column_stack([flat, np.ones(len(flat))])
    return np.zeros_like(directions), directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _optv(scene: Scene, error: Callable[[Any], float]) -> list[Variant]:
    """OpenPTV, where it is installed. Its camera looks along -z with y up, its lengths are millimetres, and its glass
    is a vector from the world's origin, behind the glass, to the glass. Panels of one index in air act as one slab."""
    try:
        from optv.calibration import Calibration
        from optv.imgcoord import flat_image_coordinates
        from optv.parameters import MultimediaParams
    except ImportError:
        return []
    flip = np.array([1.0, -1.0, -1.0])
    slab = 1e3 * sum(panel.thickness for panel in scene.chamber.panels)
    towards_camera = -flip * np.asarray(scene.chamber.normal)
    origin_to_glass = 100.0
    camera = (origin_to_glass + slab + 1e3 * scene.chamber.distance) * towards_camera
    calibration = Calibration(
        pos=camera,
        angs=np.zeros(3),
        prim_point=np.array([0.0, 0.0, FOCAL]),
        rad_dist=np.zeros(3),
        decent=np.zeros(2),
        affine=np.array([1.0, 0.0]),
        glass=origin_to_glass * towards_camera,
    )
    media = MultimediaParams(n1=1.0, n2=[scene.chamber.panels[0].index], n3=1.0, d=[slab])
    world = np.ascontiguousarray(1e3 * scene.points * flip + camera)

    def pixels(flat: Any) -> Float:
        return np.asarray(flat) * (1.0, -1.0) + ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)

    return [
        Variant(
            "optv",
            lambda: flat_image_coordinates(world, calibration, media),
            lambda flat: error(pixels(flat)),
            note=f"OpenPTV {importlib.metadata.version('optv')}, C",
        )
    ]
