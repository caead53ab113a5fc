"""A recording by the digital rig: everything that decides it, and the truth about it on disk.

The folder:

    truth/        dry.cameramodel, wet.cameramodel, chamber.toml, poses.json, BOARD-{bare,chamber}.npz (exact corners)
    BOARD/bare/{dry,wet}/NNN.png       the board without the chamber (chessboard, charuco, chessboard-2, ...)
    BOARD/chamber/{dry,wet}/NNN.png    the board behind the chamber
    drive/{dry,wet}/NNN.png            the street behind the chamber
    drive/depth/NNN.npz                its depth: z in the dry camera's frame in metres, float32; NaN where sky
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rainstereo import Rig
from rainstereo.apps.board_views import board_drawing
from rainstereo.apps.digital_rig import exact_observations
from rainstereo.apps.run_record import versions, write_atomically, write_json
from rainstereo.apps.street import LANES, street
from rainstereo.calib.board import Board
from rainstereo.drawing import Drawing
from rainstereo.rig import ROLES
from rainstereo.scene import Scene
from rainstereo.sensor import Sensor
from rainstereo.types import Array

POSES = Path("truth") / "poses.json"


@dataclass(frozen=True, eq=False)
class Capture:
    """Images of one board, without or with the chamber. poses: (N, 6) rt_ref_board."""

    name: str
    board: Board
    through: bool
    poses: Array

    @property
    def folder(self) -> str:
        """Its folder in the recording."""
        return f"{self.name}/{'chamber' if self.through else 'bare'}"


@dataclass(frozen=True, eq=False)
class Simulation:
    """Everything that decides the bytes of a recording.

    drive: (N, 6) rt_ref_scene of the frames of the drive.
    """

    rig: Rig
    sensor: Sensor
    captures: Sequence[Capture]
    drive: Array
    seed: int = 0
    supersampling: int = 4

    @cached_property
    def scene(self) -> Scene:
        """The street; only made when a drive is rendered."""
        return street(self.seed)

    @cached_property
    def drawings(self) -> dict[str, Drawing]:
        """The boards' prints by their words, fine enough for the nearest pose."""
        drawings = {}
        for spec in dict.fromkeys(capture.board.spec for capture in self.captures):
            shown = [c for c in self.captures if c.board.spec == spec]
            nearest = max(min(float(c.poses[:, 5].min(initial=1.0)) for c in shown), 0.1)
            samples = self.supersampling * float(self.rig.dry.intrinsics[0]) / nearest
            drawings[spec] = board_drawing(shown[0].board, samples)
        return drawings

    @cached_property
    def fingerprint(self) -> str:
        """Changes when any byte of the recording might."""
        truth = dict(self._truth())
        made_with = {k: v for k, v in versions().items() if k in ("rainstereo", "numpy", "opencv", "platform")}
        return hashlib.sha256(json.dumps([truth, made_with]).encode()).hexdigest()[:16]

    # -- the truth ----------------------------------------------------------------------------------------------

    def write_truth(self, folder: Path) -> None:
        """Write the poses with the fingerprint, the rig, and the exact corners of every board image."""
        write_json(folder / POSES, {"fingerprint": self.fingerprint, **self._truth(), "street": self._street()})
        self.rig.save(folder / "truth")
        for capture in self.captures:
            dry, wet = exact_observations(self.rig, capture.board, capture.poses, capture.through)
            stream = io.BytesIO()
            np.savez(stream, dry=dry, wet=wet, rt_ref_board=capture.poses)
            write_atomically(folder / "truth" / f"{capture.folder.replace('/', '-')}.npz", stream.getvalue())

    def _truth(self) -> dict[str, Any]:
        rig = self.rig
        chamber = rig.chamber
        return {
            "frames": "rt_a_b takes coordinates in b to a: Rodrigues vector (radians), translation (metres); "
            "ref: the dry camera; x right, y down, z forward",
            "seed": self.seed,
            "cameras": {
                role: {"model": camera.model, "intrinsics": camera.intrinsics.tolist(), "size": list(camera.size)}
                for role, camera in ((role, rig.camera(role)) for role in ROLES)
            },
            "rt_wet_dry": rig.rt_wet_dry.tolist(),
            "chamber": None
            if chamber is None
            else {
                "normal": list(chamber.normal),
                "distance": chamber.distance,
                "panels": [[panel.thickness, panel.index] for panel in chamber.panels],
                "gaps": list(chamber.gaps),
            },
            "sensor": {"blur_px": self.sensor.blur, "vignetting": self.sensor.vignetting, "noise": self.sensor.noise},
            "supersampling": self.supersampling,
            "captures": [
                {
                    "folder": capture.folder,
                    "board": capture.board.spec,
                    "through_chamber": capture.through,
                    "images": [
                        {"name": f"{i:03d}", "rt_ref_board": pose.tolist()} for i, pose in enumerate(capture.poses)
                    ],
                }
                for capture in self.captures
            ],
            "drive": {
                "folder": "drive",
                "images": [{"name": f"{i:03d}", "rt_ref_scene": pose.tolist()} for i, pose in enumerate(self.drive)],
            },
        }

    def _street(self) -> dict[str, Any] | None:
        if not len(self.drive):
            return None
        return {
            "frame": "x right, y down, z ahead; origin on the road at the start",
            "road": {"plane": "y = 0 of the scene", "width": LANES},
            "planes": [
                {"name": plane.name, "size": list(plane.size), "rt_scene_plane": plane.rt_scene_plane.tolist()}
                for plane in self.scene.planes
            ],
        }


def fingerprint_in(folder: Path) -> str | None:
    """The fingerprint of the recording in a folder; None where there is none."""
    try:
        found = json.loads((folder / POSES).read_text(encoding="utf-8")).get("fingerprint")
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, AttributeError):
        return "unreadable"
    return str(found)
