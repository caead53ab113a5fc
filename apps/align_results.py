"""What an alignment leaves, measured on pairs and predicted by depth, as numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rainstereo.align import residual_shift
from rainstereo.apps.align_job import Skip
from rainstereo.apps.align_model import Plan, eight_bits, spread
from rainstereo.apps.run_record import Record
from rainstereo.pair_source import BadPairError, PairSource
from rainstereo.parallax import NOTICEABLE, HomographyCheck, check_homography, disparity, grid
from rainstereo.tile_votes import TRUSTED, TileVotes
from rainstereo.types import Array, Image, Mask

SAMPLES = 4
"""Pairs of a recording whose remaining shift is measured and shown."""
DEPTHS = (3.0, 5.0, 10.0, 20.0, 60.0)
"""Metres for which the remaining disparity is predicted."""
COLUMNS = 8
"""Of the map of remaining disparity."""


@dataclass(frozen=True, eq=False)
class Sample:
    """An aligned pair, the raw one, and what shift remains: tile centres, shifts (N, 2) and their sigmas, pixels.

    before: the aligned wet image before its gray levels were mapped. valid: the validity mask, if there is one.
    psnr: of the raw and of the aligned pair, decibels; NaN where the raw images differ in size.
    """

    name: str
    raw: tuple[Image, Image]
    aligned: tuple[Image, Image]
    before: Image
    valid: Image | None
    centres: Array
    shifts: Array
    sigmas: Array
    psnr: tuple[float, float]

    @property
    def trustworthy(self) -> Mask:
        """Which tiles have texture that both views show, (N,)."""
        return self.sigmas < TRUSTED

    @property
    def trusted(self) -> Array:
        """Shifts of those, (M, 2) pixels."""
        return self.shifts[self.trustworthy]


def measure(source: PairSource, plan: Plan) -> list[Sample]:
    """What remains in a few pairs, evenly over the recording; those that cannot be read are passed over."""
    samples = []
    recipe = plan.recipe
    for i in spread(len(source), SAMPLES):
        try:
            moment, dry, wet = source.read(i)
        except BadPairError:
            continue
        if (dry.shape[1::-1], wet.shape[1::-1]) != (recipe.dry.source_size, recipe.wet.source_size):
            continue
        made = recipe.make(dry, wet)
        before = recipe.wet.apply(wet, interpolation=recipe.interpolation) if recipe.photometric else made["wet"]
        raw = eight_bits(dry), eight_bits(wet)
        aligned = eight_bits(made["dry"]), eight_bits(made["wet"])
        same = raw[0].shape == raw[1].shape
        psnr = _psnr(*raw) if same else float("nan"), _psnr(*aligned)
        shifts = residual_shift(*aligned)
        samples.append(Sample(moment.name, raw, aligned, eight_bits(before), made.get("valid"), *shifts, psnr))
    return samples


def votes_of(samples: list[Sample]) -> TileVotes:
    """Trusted tiles of all samples."""
    return TileVotes.of([(s.centres, s.shifts, s.sigmas) for s in samples])


def homographies(plan: Plan) -> HomographyCheck | None:
    """The exact warp beside homographies; None where there is none, or at infinity, where they are the same."""
    if plan.rig is None or plan.alignment is None or not np.isfinite(plan.alignment.plane.distance):
        return None
    return check_homography(plan.rig, plan.alignment)


def predicted(plan: Plan) -> dict[float, tuple[Array, tuple[int, int]]]:
    """Disparity by depth, metres: (N,) pixels along the rows over the aligned image, and its (rows, columns)."""
    if plan.rig is None or plan.alignment is None:
        return {}
    pixels, shape = grid(plan.alignment, 2 * COLUMNS)
    return {depth: (disparity(plan.rig, plan.alignment, depth, pixels)[:, 0], shape) for depth in DEPTHS}


def residual_map(votes: TileVotes, size: tuple[int, int]) -> tuple[Array, Array]:
    """Median remaining shift by place, (rows, columns, 2) pixels, and its size's 90th percentile, (rows, columns).

    NaN where no tile is trusted.
    """
    rows = max(round(COLUMNS * size[1] / size[0]), 2)
    cell = np.clip((votes.centres / size * (COLUMNS, rows)).astype(int), 0, (COLUMNS - 1, rows - 1))
    median, most = np.full((rows, COLUMNS, 2), np.nan), np.full((rows, COLUMNS), np.nan)
    for row in range(rows):
        for column in range(COLUMNS):
            here = votes.shifts[(cell == (column, row)).all(1)]
            if len(here):
                median[row, column] = np.median(here, axis=0)
                most[row, column] = np.percentile(np.hypot(*here.T), 90)
    return median, most


def note_results(
    record: Record, plan: Plan, model: dict[str, Any], samples: list[Sample], counts: tuple[int, int, int],
    skipped: list[Skip],
) -> None:  # fmt: skip
    """Write what was found into the record. counts: pairs in the folder, made now, kept."""
    votes = votes_of(samples)
    size = plan.recipe.dry.size
    record.status = "ok" if counts[0] else "failed"
    record["pairs"], record["pairs_made"], record["pairs_kept"] = counts
    record["skipped"] = [{"file": file, "reason": reason} for file, reason in skipped]
    record["model"] = model
    shift = np.median(votes.shifts, axis=0) if len(votes) else np.full(2, np.nan)
    length = np.hypot(*votes.shifts.T) if len(votes) else np.full(1, np.nan)
    record["remaining_shift_px"] = {
        "median_xy": shift, "median": np.median(length), "90th_percentile": np.percentile(length, 90),
        "tiles": len(votes), "pairs_measured": len(samples),
    }  # fmt: skip
    record["psnr_db"] = {s.name: {"as_recorded": s.psnr[0], "aligned": s.psnr[1]} for s in samples}
    median, most = residual_map(votes, size)
    record["residual_map_px"] = {
        "rows": len(median), "columns": COLUMNS, "median_x": median[..., 0], "median_y": median[..., 1],
        "90th_percentile": most,
    }  # fmt: skip
    if plan.alignment is None or plan.rig is None:
        record["view"] = {"width": size[0], "height": size[1]}
        return
    view, plane = plan.alignment.view, plan.alignment.plane
    record["plane"] = {"normal": plane.normal, "distance_m": plane.distance}
    record["view"] = {"width": view.width, "height": view.height, "focal_px": view.intrinsics[0],
                      "centre_px": view.intrinsics[2:]}  # fmt: skip
    record["parallax_px"] = {
        f"at_{depth:g}m": plan.rig.baseline * float(view.intrinsics[0]) / depth for depth in (5.0, 20.0, 60.0)
    }
    record["disparity_px"] = {
        f"at_{depth:g}m": {"median": np.nanmedian(d), "lowest": np.nanmin(d), "highest": np.nanmax(d)}
        for depth, (d, _) in predicted(plan).items()
    }
    check = homographies(plan)
    if check is not None:
        record["homography_px"] = {
            "noticeable": NOTICEABLE, "share_above": check.share, "textbook_highest": np.nanmax(check.textbook),
            "fitted_highest": np.nanmax(check.fitted),
        }  # fmt: skip


def _psnr(a: Image, b: Image) -> float:
    if a.shape != b.shape:
        return float("nan")
    error = float(np.mean((a.astype(np.float32) - b) ** 2))
    return float(10 * np.log10(255**2 / error)) if error > 0 else float("inf")
