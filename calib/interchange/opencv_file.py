"""OpenCV FileStorage: K1, D1, K2, D2, R, T of a stereo rig, or the camera_matrix of one camera; YAML, XML or JSON.

R and T are those of `cv2.stereoCalibrate`: X_second = R X_first + T. Other common names are understood when reading:
M1 and M2, cameraMatrix1, distCoeffs1, and intrinsics and extrinsics in two files, as OpenCV's samples write them.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from rainstereo import pose
from rainstereo.calib.interchange import entries
from rainstereo.calib.interchange.described import Described, DescribedSet
from rainstereo.types import Array

NAME = "opencv"
MATRIX = ("K{}", "M{}", "cameraMatrix{}", "camera_matrix_{}", "camera_matrix{}", "CM{}", "mtx{}")
DISTORTION = ("D{}", "distCoeffs{}", "dist_coeffs{}", "distortion_coefficients_{}", "dist{}")
ONE = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M", "mtx")
ONE_DISTORTION = ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "dist_coeffs", "D", "dist")
SIZES = ("image_size", "imageSize", "img_size", "size")
NAMES = [pattern.format(i) for pattern in (*MATRIX, *DISTORTION) for i in (1, 2)] + [*ONE, *ONE_DISTORTION]
SUFFIXES = (".yml", ".yaml", ".xml", ".json")


def read(table: entries.Table, where: str, size: tuple[int, int] | None = None) -> DescribedSet:
    """The cameras of a file. size: of the image, for a file that does not say; ValueError where it is missing."""
    first, second = (entries.first_of(table, [pattern.format(i) for pattern in MATRIX]) for i in (1, 2))
    if first and second:
        cameras = tuple(
            _camera(table, key, [p.format(i) for p in DISTORTION], where, _size(table, where, size, str(i)), i)
            for i, key in ((1, first), (2, second))
        )
        return DescribedSet(NAME, cameras, _pose(table, where))
    only = entries.first_of(table, ONE)
    if only is None:
        has = ", ".join(list(table)[:12]) or "nothing"
        raise ValueError(
            f"{where} describes no camera: it has {has}; expected K1, D1, K2, D2, R, T for a rig, or camera_matrix and "
            "distortion_coefficients for one camera"
        )
    return DescribedSet(NAME, (_camera(table, only, ONE_DISTORTION, where, _size(table, where, size, ""), 0),))


def _camera(
    table: entries.Table, key: str, names: Any, where: str, size: tuple[int, int], index: int
) -> Described:  # fmt: skip
    core = entries.core(table[key], f"{key} of {where}")
    name = entries.first_of(table, names)
    if name is None:
        raise ValueError(f"{where} has {key}, and no distortion beside it; expected {names[0]}, zeros for a pinhole")
    k = entries.numbers(table[name], f"{name} of {where}")
    if len(k) == 14 and not k[12:].any():
        k = k[:12]
    if len(k) == 14:
        raise ValueError(
            f"{name} of {where} tilts the sensor by {k[12]:g}, {k[13]:g} (14 coefficients), which no lens model here "
            "does; calibrate without CALIB_TILTED_MODEL"
        )
    fisheye = table.get("fisheye_model", 0) not in (0, 0.0, None)
    told = table.get(f"camera_{index}" if index else "camera_name", "")
    return Described("equidistant" if fisheye else "opencv", core, k, size, told if isinstance(told, str) else "")


def _size(table: entries.Table, where: str, given: tuple[int, int] | None, index: str) -> tuple[int, int]:
    for name in (*(f"{name}_{index}" for name in SIZES if index), *SIZES):
        if name in table:
            pair = entries.numbers(table[name], f"{name} of {where}")
            if len(pair) != 2:
                raise ValueError(f"{name} of {where} holds {len(pair)} numbers; expected the width and the height")
            return entries.size(float(pair[0]), float(pair[1]), where)
    for width, height in (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height")):
        if width in table and height in table:
            return entries.size(table[width], table[height], where)
    if given is None:
        raise ValueError(f"{where} does not say how large the images are; give --size, such as --size 1280x960")
    return given


def _pose(table: entries.Table, where: str) -> Array:
    for key in ("R", "T"):
        entries.need(table, key, where, "R and T of cv2.stereoCalibrate")
    r = entries.numbers(table["R"], f"R of {where}")
    if len(r) != 3:
        r = entries.rotation(entries.matrix(table["R"], 3, 3, f"R of {where}"), f"R of {where}")
    return np.concatenate([r, entries.matrix(table["T"], 3, 1, f"T of {where}").ravel()])


def text(described: DescribedSet, suffix: str) -> str:
    """The file's text, written by cv2.FileStorage; the suffix chooses YAML, XML or JSON."""
    storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    cameras = described.cameras
    names = [("K1", "D1"), ("K2", "D2")] if len(cameras) == 2 else [("camera_matrix", "distortion_coefficients")]
    alike = len({camera.size for camera in cameras}) == 1
    if alike:
        storage.write("image_width", cameras[0].size[0])
        storage.write("image_height", cameras[0].size[1])
    for index, (camera, (matrix, distortion)) in enumerate(zip(cameras, names, strict=True), 1):
        fx, fy, cx, cy = camera.core.tolist()
        if not alike:
            storage.write(f"image_size_{index}", np.array([camera.size], np.float64))
        if camera.name:
            storage.write(f"camera_{index}" if len(cameras) == 2 else "camera_name", camera.name)
        storage.write(matrix, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        D = camera.distortion if len(camera.distortion) else np.zeros(5)
        storage.write(distortion, D.reshape(1, -1))
    if described.rt_second_first is not None:
        storage.write("R", pose.rotation_matrix(described.rt_second_first[:3]))
        storage.write("T", described.rt_second_first[3:].reshape(3, 1))
    return str(storage.releaseAndGetString())
