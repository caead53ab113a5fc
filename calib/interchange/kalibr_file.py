"""Kalibr's camchain: cameras cam0, cam1; pinhole with radtan, equi or no distortion; T_cn_cnm1 from each to the next.

`T_cn_cnm1` takes points of the camera before to this one. Lengths are metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rainstereo import pose
from rainstereo.calib.interchange import bounded, entries
from rainstereo.calib.interchange.described import Described, DescribedSet, Kind

NAME = "kalibr"
KINDS: dict[str, tuple[Kind, int]] = {
    "radtan": ("opencv", 4),
    "equidistant": ("equidistant", 4),
    "equi": ("equidistant", 4),
    "none": ("opencv", 0),
}
USED = {"camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "rostopic", "T_cn_cnm1"}
NO_LOSS = {"cam_overlaps"}


def matches(table: entries.Table) -> bool:
    """Whether a parsed YAML file is a camchain."""
    return any(isinstance(table.get(name), dict) for name in ("cam0", "cam1"))


def read(table: entries.Table, where: str) -> DescribedSet:
    """The cameras of a camchain; ValueError says what of it cannot be taken over."""
    names = sorted(name for name in table if str(name).startswith("cam") and isinstance(table[name], dict))
    if names not in (["cam0"], ["cam0", "cam1"]):
        raise ValueError(f"{where} has {', '.join(names)}; expected cam0, or cam0 and cam1 (delete or rename others)")
    cameras = tuple(_camera(table[name], f"{name} of {where}") for name in names)
    lost = sorted({str(key) for name in names for key in table[name]} - USED - NO_LOSS)
    rt = None
    if len(names) == 2:
        example = "a 4 x 4 matrix that takes points of cam0 to cam1"
        rt = entries.homogeneous(entries.need(table["cam1"], "T_cn_cnm1", f"cam1 of {where}", example), "T_cn_cnm1")
    return DescribedSet(NAME, cameras, rt, tuple(lost))


def _camera(table: entries.Table, where: str) -> Described:
    model = entries.words(entries.need(table, "camera_model", where, "pinhole"), f"camera_model of {where}")
    if model != "pinhole":
        raise ValueError(
            f"{where} has the camera model {model}, which neither mrcal nor OpenCV computes and which is not fitted "
            "here; calibrate with Kalibr's pinhole-radtan or pinhole-equi"
        )
    kind = entries.words(entries.need(table, "distortion_model", where, "radtan"), f"distortion_model of {where}")
    if kind not in KINDS:
        raise ValueError(f"{where} has the distortion model {kind}; expected {', '.join(KINDS)}")
    coefficients = entries.numbers(table.get("distortion_coeffs", []), f"distortion_coeffs of {where}")
    described, count = KINDS[kind]
    if len(coefficients) != count:
        raise ValueError(f"{where} has {len(coefficients)} distortion_coeffs; {kind} takes {count}")
    width, height = _two(entries.need(table, "resolution", where, "[752, 480]"), f"resolution of {where}")
    core = entries.numbers(entries.need(table, "intrinsics", where, "[fu, fv, pu, pv]"), f"intrinsics of {where}")
    topic = str(table.get("rostopic", ""))[:200]
    return Described(described, core, coefficients, entries.size(width, height, where), topic)


def _two(value: Any, what: str) -> tuple[Any, Any]:
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"{what} is {str(value)[:60]!r}; expected [width, height]")
    return value[0], value[1]


def text(described: DescribedSet) -> str:
    """A camchain; numbers in full precision. Cameras have at most four coefficients of distortion."""
    lines = []
    for index, camera in enumerate(described.cameras):
        kind = "equidistant" if camera.kind == "equidistant" else "radtan"
        coefficients = camera.distortion if len(camera.distortion) else np.zeros(4)
        lines.append(f"cam{index}:")
        if index and described.rt_second_first is not None:
            T = np.eye(4)
            T[:3, :3] = pose.rotation_matrix(described.rt_second_first[:3])
            T[:3, 3] = described.rt_second_first[3:]
            lines += ["  T_cn_cnm1:", *(f"  - {bounded.row(row)}" for row in T.tolist())]
        overlaps = [1 - index] if len(described.cameras) == 2 else []
        lines += [
            f"  cam_overlaps: {overlaps}",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {bounded.row(coefficients.tolist())}",
            f"  distortion_model: {kind}",
            f"  intrinsics: {bounded.row(camera.core.tolist())}",
            f"  resolution: {list(camera.size)}",
            f"  rostopic: {bounded.word(camera.name or f'cam{index}')}",
        ]
    return "\n".join(lines) + "\n"
