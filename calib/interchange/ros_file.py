"""ROS: a camera_info YAML for each camera, as `camera_calibration` writes it and `camera_info_manager` reads it.

The two cameras' pose stands in `rectification_matrix` (R) and `projection_matrix` (P): camera i sees a point X of the
rectified frame that both share at P (X, 1), so that it stands at R_i' (X + K'^-1 P_i[:, 3]) before it, K' = P_i[:, :3].
For a horizontal pair whose first camera stands left, P2[0, 3] = -fx' baseline (sensor_msgs/CameraInfo).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rainstereo import pose
from rainstereo.calib.interchange import bounded, entries
from rainstereo.calib.interchange.described import Described, DescribedSet, Kind
from rainstereo.types import Array

NAME = "ros"
KINDS: dict[str, tuple[Kind, tuple[int, ...]]] = {
    "plumb_bob": ("opencv", (4, 5)),
    "rational_polynomial": ("opencv", (8, 12)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
}


def matches(table: entries.Table) -> bool:
    """Whether a parsed YAML file is a camera_info."""
    return "distortion_model" in table or {"camera_matrix", "rectification_matrix"} <= set(table)


def read(tables: list[tuple[entries.Table, str]]) -> DescribedSet:
    """The camera of one file, or the rig of two; ValueError says what of them cannot be taken over."""
    cameras = tuple(_camera(table, where) for table, where in tables)
    rt = None
    if len(tables) == 2:
        (R1, t1), (R2, t2) = (_rectified(table, where) for table, where in tables)
        if np.allclose(t1, t2, atol=1e-12):
            raise ValueError(
                f"{tables[0][1]} and {tables[1][1]} have the same last column of projection_matrix, so that the "
                "cameras would stand in one place; expected the files of a stereo calibration, in which that of "
                "the second camera is -fx * baseline"
            )
        rt = np.concatenate([pose.rotation_vector(R2.T @ R1), R2.T @ (t2 - t1)])
    return DescribedSet(NAME, cameras, rt)


def _camera(table: entries.Table, where: str) -> Described:
    core = entries.core(entries.need(table, "camera_matrix", where), f"camera_matrix of {where}")
    model = entries.words(entries.need(table, "distortion_model", where, "plumb_bob"), f"distortion_model of {where}")
    if model not in KINDS:
        raise ValueError(f"{where} has the distortion model {model}; expected {', '.join(KINDS)}")
    what = f"distortion_coefficients of {where}"
    coefficients = entries.numbers(entries.need(table, "distortion_coefficients", where), what)
    kind, counts = KINDS[model]
    if len(coefficients) not in counts and not (kind == "opencv" and not coefficients.any()):
        raise ValueError(f"{what} are {len(coefficients)}; {model} takes {' or '.join(map(str, counts))}")
    if kind == "opencv" and not coefficients.any():
        coefficients = np.zeros(0)
    width, height = (entries.need(table, f"image_{side}", where, "1280") for side in ("width", "height"))
    return Described(kind, core, coefficients, entries.size(width, height, where), str(table.get("camera_name", "")))


def _rectified(table: entries.Table, where: str) -> tuple[Array, Array]:
    """R and t of R X_camera = X_shared + t."""
    R, P = (entries.need(table, f"{key}_matrix", where) for key in ("rectification", "projection"))
    P = entries.matrix(P, 3, 4, f"projection_matrix of {where}")
    entries.core(P[:, :3].tolist(), f"the left 3 x 3 of projection_matrix of {where}")
    r = entries.rotation(entries.matrix(R, 3, 3, "R"), f"rectification_matrix of {where}")
    return pose.rotation_matrix(r), np.linalg.solve(P[:, :3], P[:, 3])


def texts(described: DescribedSet) -> dict[str, str]:
    """A camera_info YAML for each camera, by name; R and P are those of `cv2.stereoRectify` with alpha 0.

    ROS wants the camera on the left (or above) to be the one whose P ends in zeros, whatever its name.
    """
    return {
        camera.name or f"camera_{index}": _text(camera, R, P)
        for index, (camera, (R, P)) in enumerate(zip(described.cameras, _rectifications(described), strict=True))
    }


def _rectifications(described: DescribedSet) -> list[tuple[Array, Array]]:
    if described.rt_second_first is None:
        camera = described.cameras[0]
        K, _ = cv2.getOptimalNewCameraMatrix(_matrix(camera), camera.distortion, camera.size, 0)
        return [(np.eye(3), np.column_stack([K, np.zeros(3)]))]
    first, second = described.cameras
    rt = described.rt_second_first
    if np.linalg.norm(rt[3:]) == 0:
        raise ValueError("both cameras stand in one place; ROS's files cannot hold such a rig")
    across = 0 if abs(rt[3]) >= abs(rt[4]) else 1
    swapped = rt[3 + across] > 0
    if swapped:
        first, second, rt = second, first, pose.invert(rt)
    R1, R2, P1, P2, *_ = cv2.stereoRectify(
        _matrix(first), first.distortion, _matrix(second), second.distortion, first.size,
        pose.rotation_matrix(rt[:3]), rt[3:].reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    found = [(np.asarray(R, np.float64), np.asarray(P, np.float64)) for R, P in ((R1, P1), (R2, P2))]
    return found[::-1] if swapped else found


def _matrix(camera: Described) -> Array:
    fx, fy, cx, cy = camera.core
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _text(camera: Described, R: Array, P: Array) -> str:
    rational = len(camera.distortion) > 5
    D = np.zeros(8 if rational else 5)
    D[: len(camera.distortion)] = camera.distortion
    lines = [
        f"image_width: {camera.size[0]}",
        f"image_height: {camera.size[1]}",
        f"camera_name: {bounded.word(camera.name or 'camera')}",
        *_block("camera_matrix", _matrix(camera)),
        f"distortion_model: {'rational_polynomial' if rational else 'plumb_bob'}",
        *_block("distortion_coefficients", D[None]),
        *_block("rectification_matrix", R),
        *_block("projection_matrix", P),
    ]
    return "\n".join(lines) + "\n"


def _block(name: str, values: Any) -> list[str]:
    rows, columns = np.shape(values)
    return [f"{name}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: {bounded.row(np.ravel(values).tolist())}"]
