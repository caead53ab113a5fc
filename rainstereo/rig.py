"""A rig: the dry camera, the wet camera, and the chamber that both look through; kept as a folder.

A rig folder holds `dry.cameramodel`, `wet.cameramodel` (mrcal's format) and, where there is a chamber,
`chamber.toml`. Its reference frame is the dry camera's.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .pose import compose, invert
from .types import Array

Role: TypeAlias = Literal["dry", "wet"]
ROLES: tuple[Role, Role] = ("dry", "wet")


@dataclass(frozen=True, eq=False)
class Rig:
    """Two cameras and their chamber. The chamber is given in the dry camera's frame; None: nothing in front."""

    dry: Camera
    wet: Camera
    chamber: Chamber | None = None

    def __post_init__(self) -> None:
        if self.dry.rt_cam_ref.any():  # express everything in the dry camera's frame
            wet = self.wet.with_pose(compose(self.wet.rt_cam_ref, invert(self.dry.rt_cam_ref)))
            object.__setattr__(self, "wet", wet)
            object.__setattr__(self, "dry", self.dry.with_pose(np.zeros(6)))

    def camera(self, role: Role) -> Camera:
        """The camera in that role."""
        return self.dry if role == "dry" else self.wet

    def chamber_in(self, role: Role) -> Chamber | None:
        """The chamber in that camera's frame."""
        if self.chamber is None or role == "dry":
            return self.chamber
        return self.chamber.transformed(self.rt_wet_dry)

    @property
    def rt_wet_dry(self) -> Array:
        """Takes points from the dry camera's frame to the wet one's, (6,)."""
        return self.wet.rt_cam_ref

    @property
    def baseline(self) -> float:
        """Distance between the camera centres, metres."""
        return float(np.linalg.norm(self.rt_wet_dry[3:]))

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> Rig:
        """Read a rig folder. FileNotFoundError or ValueError says what is missing or wrong."""
        folder = Path(folder)
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder} is no folder; expected a rig folder as `rainstereo calibrate` writes it")
        dry, wet = (Camera.load(folder / f"{role}.cameramodel") for role in ROLES)
        chamber = folder / "chamber.toml"
        return cls(dry, wet, Chamber.load(chamber) if chamber.exists() else None)

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Write the rig folder: all files or none, also when interrupted. Other files in it stay."""
        folder = Path(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as name:
            fresh = Path(name) / "rig"
            fresh.mkdir()
            if folder.is_dir():
                shutil.copytree(folder, fresh, dirs_exist_ok=True)
                (fresh / "chamber.toml").unlink(missing_ok=True)
            for role in ROLES:
                self.camera(role).save(fresh / f"{role}.cameramodel")
            if self.chamber is not None:
                self.chamber.save(fresh / "chamber.toml")
            if folder.is_dir():
                folder.rename(Path(name) / "before")
            fresh.rename(folder)
