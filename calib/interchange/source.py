"""What files describe, whatever their format: recognised by content, turned into a Rig or a Camera."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rainstereo.calib.interchange import bounded, kalibr_file, lens_fit, opencv_file, ros_file
from rainstereo.calib.interchange.described import DescribedSet
from rainstereo.calib.interchange.lens_fit import Loss
from rainstereo.camera import Camera
from rainstereo.pose import invert
from rainstereo.rig import ROLES, Rig, Role

LONGEST_BASELINE = 3.0
"""Metres; a longer one is questioned: most often it stands in millimetres."""
OPENCV = re.compile(r"\s*(%YAML|<\?xml|\{)")
PAIRS = (("dry", "wet"), ("left", "right"))


@dataclass(frozen=True, eq=False)
class Source:
    """A rig, or one camera, the format it came in, what taking it over cost (by camera), and what was left behind."""

    content: Rig | Camera
    format: str
    losses: Mapping[str, Loss]
    notes: tuple[str, ...]


def read(
    paths: Sequence[Path],
    *,
    first: Role | None = None,
    size: tuple[int, int] | None = None,
    metres: float = 1.0,
    tolerance_px: float = 0.1,
) -> Source:
    """Read a rig folder, one or two `.cameramodel` files, or what others wrote; ValueError says what is wrong.

    first: the role of the first camera; by default names decide, and where they say nothing it is dry.
    size: of the images, for OpenCV files that do not say. metres: the length of the file's unit.
    tolerance_px: from which on a lens is worth a splined model.
    """
    if len(paths) not in (1, 2):
        raise ValueError(f"{len(paths)} files were given; expected one, or two of the same format")
    if len(paths) == 1 and paths[0].is_dir():
        if (paths[0] / f"{ROLES[0]}.cameramodel").exists():
            return Source(Rig.load(paths[0]), "rig", {}, ())
        paths = _pair_in(paths[0])
    if all(path.suffix == ".cameramodel" for path in paths):
        return _cameramodels(paths, first)
    described, where = described_in(paths, size), " and ".join(map(str, paths))
    roles, notes = _roles([camera.name for camera in described.cameras], first)
    if described.ignored:
        notes = (*notes, f"left behind, since a rig has no place for it: {', '.join(described.ignored)}")
    fitted = [lens_fit.to_camera(camera, tolerance_px) for camera in described.cameras]
    losses: dict[str, Loss] = {role: loss for role, (_, loss) in zip(roles, fitted, strict=True) if loss is not None}
    if described.rt_second_first is None:
        return Source(fitted[0][0], described.format, losses, notes[1:] if len(roles) == 1 else notes)
    rt = np.concatenate([described.rt_second_first[:3], described.rt_second_first[3:] * metres])
    baseline = float(np.linalg.norm(rt[3:]))
    if not 0 < baseline <= LONGEST_BASELINE:
        raise ValueError(
            f"{where}: the cameras would be {baseline:.4g} m apart; expected 0 to {LONGEST_BASELINE:g} m. "
            "Where lengths are millimetres, give --unit mm"
        )
    cameras = dict(zip(roles, (camera for camera, _ in fitted), strict=True))
    wet = cameras["wet"].with_pose(rt if roles[0] == "dry" else invert(rt))
    return Source(Rig(cameras["dry"], wet), described.format, losses, notes)


def described_in(paths: Sequence[Path], size: tuple[int, int] | None = None) -> DescribedSet:
    """The cameras as they stand in one or two files of a known format."""
    texts = [bounded.text_of(path) for path in paths]
    where = " and ".join(map(str, paths))
    if all(OPENCV.match(text) for text in texts):
        tables = [bounded.opencv_of(text, path) for text, path in zip(texts, paths, strict=True)]
        shared = set(tables[0]) & set(tables[-1]) & set(opencv_file.NAMES) if len(tables) == 2 else set()
        if shared:
            raise ValueError(
                f"{where} both have {', '.join(sorted(shared))}; expected the cameras in one and R, T in the other"
            )
        return opencv_file.read({k: v for table in tables for k, v in table.items()}, where, size)
    tables = [bounded.yaml_of(text, path) for text, path in zip(texts, paths, strict=True)]
    if all(map(ros_file.matches, tables)):
        return ros_file.read([(table, str(path)) for table, path in zip(tables, paths, strict=True)])
    if len(tables) == 1 and kalibr_file.matches(tables[0]):
        return kalibr_file.read(tables[0], where)
    has = "; ".join(", ".join(list(table)[:8]) or "nothing" for table in tables)
    raise ValueError(
        f"{where}: no format that is known here; it has {has}. Expected an OpenCV FileStorage file (begins with "
        "%YAML:1.0 or <?xml), ROS camera_info (camera_matrix, distortion_model, ...) or a Kalibr camchain (cam0, cam1)"
    )


def _pair_in(folder: Path) -> tuple[Path, ...]:
    for names in PAIRS:
        found = tuple(folder / f"{name}{suffix}" for name in names for suffix in (".yaml", ".yml")
                      if (folder / f"{name}{suffix}").exists())  # fmt: skip
        if len(found) == 2:
            return found
    raise ValueError(f"{folder} is no rig folder, nor are dry.yaml and wet.yaml, or left.yaml and right.yaml, in it")


def _cameramodels(paths: Sequence[Path], first: Role | None) -> Source:
    cameras = [Camera.load(path) for path in paths]
    if len(cameras) == 1:
        return Source(cameras[0], "cameramodel", {}, ())
    roles, notes = _roles([path.stem for path in paths], first)
    by_role = dict(zip(roles, cameras, strict=True))
    return Source(Rig(by_role["dry"], by_role["wet"]), "cameramodel", {}, notes)


def _roles(names: Sequence[str], first: Role | None) -> tuple[tuple[Role, ...], tuple[str, ...]]:
    """The role of each camera, and a note that says how they were found."""
    told = [next((role for role in ROLES if role in re.split(r"[^a-z]+", name.lower())), None) for name in names]
    if len(names) == 1:
        return (told[0] or "dry",), ("",)
    if first is None and None not in told and told[0] != told[1]:
        return tuple(role for role in told if role), (f"roles by the cameras' names: {told[0]}, {told[1]}",)
    taken: Role = first or "dry"
    other: Role = "wet" if taken == "dry" else "dry"
    why = "as --first says" if first else "--first wet turns them round"
    return (taken, other), (f"the first camera is taken to be {taken}, the second {other} ({why})",)
