"""Benchmark stage `cavity`: four cameras that look through plexiglass into water, with that refraction and without."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

from rainstereo.apps import cavity_set
from rainstereo.apps.bench_harness import Picture, Stage, Variant, Work
from rainstereo.apps.canvas import FAINT, PEER, WET, image_axes, sheet, styled
from rainstereo.apps.cavity_set import View
from rainstereo.apps.cavity_trial import MODELS, Model, Trial, rms
from rainstereo.calib.known_points import Free
from rainstereo.camera import Camera
from rainstereo.types import Array, Mask

MAGNIFY = 50
CAPTION = (
    f"Residuals of both models, {MAGNIFY} times longer, on the dots they were fitted to; the middle of each image."
)


@dataclass(frozen=True)
class OpenCVModel(Model):
    """The central camera as cv2.calibrateCamera fits it, with the same unknowns."""

    def fit(self, view: View, use: Mask | None = None) -> Camera:
        """The camera of a view, from all its dots or some."""
        use = np.ones(len(view.ids), np.bool_) if use is None else use
        fx, fy, cx, cy = view.openptv.intrinsics[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
        flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_PRINCIPAL_POINT
        points, pixels = view.points[use].astype(np.float32), view.pixels[use].astype(np.float32)
        _, K, k, r, t = cv2.calibrateCamera([points], [pixels], view.openptv.size, K, np.zeros(5), flags=flags)
        intrinsics = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(k)[:4]])
        return Camera(
            "LENSMODEL_OPENCV4", intrinsics, *view.openptv.size, np.concatenate([np.ravel(r[0]), np.ravel(t[0])])
        )


PEER_MODEL = OpenCVModel("central, cv2.calibrateCamera", False, Free(), "takes no pose to start from")


def build(seed: int, quick: bool, folder: Path | None = None) -> Stage:
    """The stage on a folder with OpenPTV's cavity set; two models only if `quick`. ValueError without a folder."""
    if folder is None:
        raise ValueError(
            "stage cavity needs images: give --cavity FOLDER, with OpenPTV's cavity set (docs/interchange.md)"
        )
    views = cavity_set.load(folder)
    models = MODELS[:2] if quick else (*MODELS, PEER_MODEL)
    trials = [Trial(model, views) for model in models]
    count = sum(len(view.ids) for view in views)
    work = Work(
        "models",
        "Four cameras, each from the dots of a target in water",
        f"{count} dots found, of a target whose dots are known in space, in three depths 8 mm apart; each camera by "
        "itself.",
        tuple(_variant(trial) for trial in trials),
        models[0].name,
        "px",
        "RMS a coordinate on every other column of dots, from a fit to the others. All: on the dots fitted. Plane: on "
        "the dots of one depth, from a fit to the two others. Depth: along the target's z axis, of dots triangulated "
        "by all cameras that see them, from fits to the other columns. Centre: how far the farthest principal point "
        "lies from the middle of the image",
        item="calibration",
    )
    return Stage(
        "cavity",
        "through plexiglass into water",
        "Real images of a dot target in a water tank, seen by four cameras through its wall: air, 6 mm of plexiglass "
        "(n = 1.46), water (n = 1.33), 125 mm of it before the target's centre. The wall is known from OpenPTV's "
        "files, which also are where every fit starts.",
        (work,),
        {
            "dots by camera": ", ".join(str(len(view.ids)) for view in views),
            "OpenPTV's files as they are": ", ".join(f"{rms(_as_filed(view)):.1f} px" for view in views),
            "unknowns": "pose, one focal length, one radial coefficient (8), and the principal point where it says so",
            "seed": f"{seed} (nothing is drawn)",
        },
        (
            "The target limits all of them: residuals from opposite sides correlate by 0.3 to 0.5.",
            "A principal point that may go anywhere lets a central camera imitate much of the refraction on the dots "
            "it was fitted to; then it lies outside of the image, and depth stays wrong.",
            "From all dots cv2.calibrateCamera finds the same central cameras; from one half of camera 1's it ends "
            "with the camera behind the target, so that no error is given.",
            "Detection is not part of the time.",
        ),
        (Picture("residuals", CAPTION,
                 lambda: residual_pictures(Trial(MODELS[0], views), Trial(MODELS[1], views))),),
    )  # fmt: skip


def _variant(trial: Trial) -> Variant:
    def also(cameras: Any) -> Mapping[str, float]:
        errors = trial.in_space()
        return {
            "all, px": rms([trial.model.off(v, c) for v, c in zip(trial.views, cameras, strict=True)]),
            "plane, px": rms(trial.planes),
            "depth, mm": 1e3 * rms(errors[:, 2]),
            "centre, px": max(float(np.hypot(*(c.intrinsics[2:4] - np.array(c.size) / 2))) for c in cameras),
        }

    run: Callable[[], tuple[Camera, ...]] = lambda: tuple(trial.model.fit(view) for view in trial.views)  # noqa: E731
    return Variant(
        trial.model.name, run, lambda _: rms(trial.halves), trial.model.refraction, trial.model.note, 1, also
    )  # fmt: skip


def _as_filed(view: View) -> Array:
    return MODELS[0].off(view, view.openptv)


@styled
def residual_pictures(with_wall: Trial, without: Trial) -> Figure:
    """Residuals of two models as arrows: a row for each model, a column for each camera."""
    figure, axes = sheet(11, 4.7, 2, len(with_wall.views))
    for row, (trial, colour) in enumerate(((with_wall, WET), (without, PEER))):
        for column, (view, residual) in enumerate(zip(trial.views, trial.residuals, strict=True)):
            axis = axes[row, column]
            ends = view.pixels + MAGNIFY * residual
            axis.plot(*np.stack([view.pixels, ends], 1).T, color=colour, lw=1.0)
            axis.plot(*view.pixels.T, ".", ms=2.5, color=colour)
            image_axes(axis, view.openptv.size)
            axis.set(xlim=(100, 1180), ylim=(1000, 220), xticks=[], yticks=[])
            axis.set(xlabel="", ylabel=trial.model.name.split(",")[0] if not column else "")
            axis.set_title(f"camera {view.number}: {rms(residual):.2f} px", fontsize=10, color=FAINT)
    return figure
