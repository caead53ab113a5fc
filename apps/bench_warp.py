"""Benchmark stage `warp`: a recorded pair becomes an aligned pair, and what the maps for it cost."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import skimage.data
import skimage.transform

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.align import Alignment, plan
from rainstereo.apps.bench_harness import Stage, Target, Variant, Work

Float = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Pair = tuple[Image, Image]
BASELINE = 0.029
TURN = np.radians((0.35, -0.55, 0.4))
"""How the wet camera is turned against the dry one: what hands and glue leave."""


def build(seed: int, quick: bool) -> Stage:
    """The stage at 1280x960, or 320x240 if `quick`."""
    width, height = (320, 240) if quick else (1280, 960)
    rig = bench_rig(width, height)
    alignment = plan(rig)
    pair = _photographs(width, height, seed)
    return Stage(
        "warp",
        "undistorting, cropping and aligning a pair",
        f"One recorded pair of {width}x{height} colour images becomes an aligned pair of "
        f"{alignment.view.width}x{alignment.view.height}. The plan is made once a rig; each pair then costs one "
        "interpolation an image, hardly more than a bare call of cv2.remap.",
        (
            _pair_work("pair", "One pair, one thread", rig, alignment, pair, 1, not quick),
            _pair_work("threads", "One pair, all cores", rig, alignment, pair, os.cpu_count() or 1, False),
            _plan_work(rig, alignment),
        ),
        {
            "rig": f"two OPENCV5 cameras of {width}x{height}, f {rig.dry.intrinsics[0]:.0f} px, "
            f"{1e3 * BASELINE:g} mm apart, turned against each other by {np.degrees(np.linalg.norm(TURN)):.2f} "
            "degrees, behind two 4 mm panels",
            "images": "8-bit BGR, photographs from scikit-image with one gray level of noise",
            "plane": "infinity",
            "seed": seed,
        },
        (
            "OpenCV rounds source coordinates to 1/32 px, in bare calls as in ours; that is the error shown.",
            "In two steps (undistort, then rotate) each image is interpolated twice: softer, and slower.",
            "Maps more exact than 1/64 px show in no image; who needs neither refraction nor crop: use OpenCV.",
            "Memory-bound work: on a busy machine trust the ratios within a round, not the milliseconds.",
        ),
    )


def bilinear(image: npt.NDArray[Any], xy: Float) -> Float:
    """Exact bilinear interpolation of `image` (H, W, C) at `xy` (..., 2) inside it, float64."""
    height, width = image.shape[:2]
    low = np.minimum(np.floor(xy).astype(np.intp), (width - 2, height - 2))
    part = xy - low
    x, y, a, b = low[..., 0], low[..., 1], part[..., :1], part[..., 1:]
    upper = image[y, x] * (1 - a) + image[y, x + 1] * a
    lower = image[y + 1, x] * (1 - a) + image[y + 1, x + 1] * a
    return np.asarray(upper * (1 - b) + lower * b, np.float64)


def exact_map(camera: Camera, view: Camera, turn: Float) -> Float:
    """Source pixel (H, W, 2) of each pixel of `view`, whose rays are turned by `turn` (3, 3) into the camera's frame:
    Brown's distortion formula, written out, in extended precision."""
    x, y = np.meshgrid(np.arange(view.width, dtype=np.longdouble), np.arange(view.height, dtype=np.longdouble))
    fx, fy, cx, cy = view.intrinsics
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1) @ turn.T.astype(np.longdouble)
    x, y = rays[..., 0] / rays[..., 2], rays[..., 1] / rays[..., 2]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera.intrinsics
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.asarray(np.stack([fx * u + cx, fy * v + cy], -1), np.float64)


def _pair_work(name: str, title: str, rig: Rig, alignment: Alignment, pair: Pair, threads: int, promised: bool) -> Work:
    maps = [np.asarray(warp.map_xy, np.float32) for warp in (alignment.dry, alignment.wet)]
    fixed = [cv2.convertMaps(xy[..., 0], xy[..., 1], cv2.CV_16SC2) for xy in maps]
    exact = [bilinear(image, at) for image, at in zip(pair, _exact_maps(rig, alignment.view), strict=True)]
    backward = [np.broadcast_to(xy[..., None, ::-1], (*xy.shape[:2], 3, 2)) for xy in _exact_maps(rig, alignment.view)]
    for_skimage = [_skimage_coordinates(xy) for xy in backward]
    two_steps = _two_steps(rig, alignment.view)
    skimage_warp: Any = skimage.transform.warp

    def error(images: Sequence[npt.NDArray[Any]]) -> float:
        return float(np.sqrt(np.mean([(image - truth) ** 2 for image, truth in zip(images, exact, strict=True)])))

    variants = [
        Variant("align", lambda: alignment.apply(*pair), error, True),
        Variant(
            "2 x cv2.remap, fixed-point",
            lambda: [cv2.remap(i, *m, cv2.INTER_LINEAR) for i, m in zip(pair, fixed, strict=True)],
            error,
            note="bare call, maps at hand",
        ),
        Variant(
            "2 x cv2.remap, float",
            lambda: [cv2.remap(i, m, None, cv2.INTER_LINEAR) for i, m in zip(pair, maps, strict=True)],  # type: ignore[call-overload]
            error,
            note="bare call, maps at hand",
        ),
        Variant("undistort, then rotate", lambda: two_steps(pair), error, note="cv2.remap + cv2.warpPerspective"),
    ]
    if threads == 1:
        variants.append(
            Variant(
                "skimage.transform.warp",
                lambda: [
                    skimage_warp(i, at, order=1, preserve_range=True) for i, at in zip(pair, for_skimage, strict=True)
                ],
                error,
                note="float64",
                every=5,
            )
        )
    return Work(
        name,
        title,
        "Colour images in memory, maps already made. All variants are given the same crop.",
        tuple(variants),
        "align",
        "gray levels",
        "RMS against exact bilinear interpolation in float64",
        2,
        "images",
        tuple(Target("align", peer.name, 1.15) for peer in variants[1:3]) if promised else (),
        threads,
    )


def _plan_work(rig: Rig, alignment: Alignment) -> Work:
    exact = _exact_maps(rig, alignment.view)
    view = _matrix(alignment.view)
    cameras = [
        (_matrix(rig.camera(role)), rig.camera(role).intrinsics[4:], _turn(rig, role)) for role in ("dry", "wet")
    ]

    def error(maps: Sequence[npt.NDArray[Any]]) -> float:
        return float(max(np.abs(xy - truth).max() for xy, truth in zip(maps, exact, strict=True)))

    def opencv() -> list[npt.NDArray[Any]]:
        size = (alignment.view.width, alignment.view.height)
        made = (cv2.initUndistortRectifyMap(K, k, R.T, view, size, cv2.CV_32FC2)[0] for K, k, R in cameras)
        return [np.asarray(xy) for xy in made]

    bare = Rig(rig.dry, rig.wet, None)
    return Work(
        "plan",
        "Making the maps",
        "Once a rig. Ours finds the crop too: the largest rectangle that both cameras see. OpenCV is told the crop.",
        (
            Variant("plan", lambda: _maps(plan(rig)), error, True, "with the chamber"),
            Variant("plan, no chamber", lambda: _maps(plan(bare)), error, True),
            Variant("2 x cv2.initUndistortRectifyMap", opencv, error, note="knows neither crop nor refraction"),
        ),
        "plan",
        "px",
        "largest over all pixels of both maps, against the distortion formula in extended precision",
    )


def _maps(alignment: Alignment) -> list[Float]:
    return [alignment.dry.map_xy, alignment.wet.map_xy]


def _exact_maps(rig: Rig, view: Camera) -> list[Float]:
    return [exact_map(rig.camera(role), view, _turn(rig, role)) for role in ("dry", "wet")]


def _two_steps(rig: Rig, view: Camera) -> Callable[[Pair], list[Any]]:
    """The usual recipe: undistort each image on its own, then turn it by a homography."""
    K, size = _matrix(view), (view.width, view.height)
    plans = []
    for role in ("dry", "wet"):
        camera = rig.camera(role)
        turn = _turn(rig, role)
        flat, canvas = _roomy(camera)
        maps = cv2.initUndistortRectifyMap(
            _matrix(camera), camera.intrinsics[4:], np.eye(3), flat, canvas, cv2.CV_16SC2
        )
        plans.append((maps, flat @ turn @ np.linalg.inv(K)))

    def run(pair: Pair) -> list[Any]:
        straight = [cv2.remap(image, *maps, cv2.INTER_LINEAR) for image, (maps, _) in zip(pair, plans, strict=True)]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return [cv2.warpPerspective(i, H, size, flags=flags) for i, (_, H) in zip(straight, plans, strict=True)]

    return run


def _roomy(camera: Camera) -> tuple[Float, tuple[int, int]]:
    """A pinhole view of a camera with its focal length, with room for what undistortion pushes outwards."""
    margin = camera.width // 8
    matrix = _matrix(camera)
    matrix[:2, 2] += margin
    return matrix, (camera.width + 2 * margin, camera.height + 2 * margin)


def _skimage_coordinates(row_column: npt.NDArray[Any]) -> Float:
    """Coordinates (3, H, W, C) as `skimage.transform.warp` takes them: row, column, channel."""
    channel = np.broadcast_to(np.arange(3.0), row_column.shape[:3])
    return np.ascontiguousarray(np.stack([row_column[..., 0], row_column[..., 1], channel]))


def _turn(rig: Rig, role: str) -> Float:
    rotation = rig.dry.rt_cam_ref[:3] if role == "dry" else rig.wet.rt_cam_ref[:3]
    return np.asarray(cv2.Rodrigues(rotation)[0], np.float64)


def _matrix(camera: Camera) -> Float:
    fx, fy, cx, cy = camera.intrinsics[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def bench_rig(width: int, height: int) -> Rig:
    """The stage's rig: two distorted cameras behind two panels."""
    scale, model = width / 1280, "LENSMODEL_OPENCV5"
    pose = np.array([*TURN, -BASELINE, 0.0003, -0.0002])
    dry = [1200 * scale, 1201 * scale, 641 * scale, 478 * scale, -0.11, 0.08, 4e-4, -3e-4, -0.01]
    wet = [1196 * scale, 1197 * scale, 636 * scale, 483 * scale, -0.10, 0.07, -2e-4, 5e-4, -0.02]
    panel = Panel(0.004, 1.49)
    tilt = np.radians(15.0)
    chamber = Chamber((np.sin(tilt), 0.0, np.cos(tilt)), 0.040, (panel, panel), (0.020,))
    cameras = Camera(model, np.array(dry), width, height), Camera(model, np.array(wet), width, height, pose)
    return Rig(*cameras, chamber)


def _photographs(width: int, height: int, seed: int) -> Pair:
    """Two photographs, as a rig would deliver them: 8 bit, BGR, a gray level of noise."""
    rng = np.random.default_rng(seed)
    made = []
    photographs: Any = skimage.data
    for photograph in (photographs.coffee(), photographs.astronaut()):
        image = cv2.resize(photograph[..., ::-1], (width, height), interpolation=cv2.INTER_AREA).astype(float)
        made.append(np.clip(np.rint(image + rng.normal(0, 1, image.shape)), 0, 255).astype(np.uint8))
    return made[0], made[1]
