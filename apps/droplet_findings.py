"""All that `rainstereo droplets` found out, and the same as numbers for `report.json`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rainstereo.apps.droplet_bench import Bench
from rainstereo.apps.droplet_checks import Check
from rainstereo.apps.droplet_pictures import Defocus, Gallery, Rim
from rainstereo.apps.droplet_tradeoff import Timing
from rainstereo.apps.droplet_verdict import Verdict
from rainstereo.apps.regime_maps import TIERS, Misuse, RegimeMap, Sag
from rainstereo.droplet import SphericalCap


@dataclass(frozen=True, eq=False)
class Findings:
    """All that a run found out. field: the drop's, 0 in the middle of the image to 1 in its corner."""

    bench: Bench
    drop: SphericalCap
    field: float
    quick: bool
    checks: list[Check]
    verdict: Verdict
    sharp: Gallery
    blurred: Gallery | None
    defocus: Defocus
    rim: Rim
    maps: list[RegimeMap]
    misuses: list[Misuse]
    sag: Sag
    timings: list[Timing]

    @property
    def sound(self) -> bool:
        """Whether every self-check passed."""
        return all(check.passed for check in self.checks)

    @property
    def sentence(self) -> str:
        """The verdict, or that there is none."""
        failed = [check.words for check in self.checks if not check.passed]
        if failed:
            return (
                f"{len(failed)} of {len(self.checks)} self-checks failed, so nothing here counts: {'; '.join(failed)}."
            )
        return self.verdict.sentence


def figures(found: Findings) -> dict[str, Any]:
    """Everything for `report.json`. Angles in degrees, lengths in the unit of their names."""
    bench, drop = found.bench, found.drop
    return {
        "verdict": {
            "sentence": found.sentence,
            "tolerance_px": found.verdict.tolerance_px,
            "tolerance_gray": found.verdict.tolerance_gray,
            "slope_texture_to_deg": found.verdict.steepest_deg,
            "answers": [_plain(answer) for answer in found.verdict.answers],
        },
        "checks": [{**_plain(check), "passed": check.passed} for check in found.checks],
        "setup": {
            "camera": {"model": bench.camera.model, "size": bench.camera.size, "intrinsics": bench.camera.intrinsics},
            "chamber": bench.chamber,
            "panel": bench.panel,
            "face": bench.face,
            "face_distance_mm": bench.distance * 1000,
            "lens": bench.lens,
            "depth_m": bench.depth,
        },
        "drop": {
            "radius_mm": drop.radius * 1000,
            "contact_angle_deg": math.degrees(drop.contact_angle),
            "height_mm": drop.top * 1000,
            "volume_ul": drop.volume * 1e9,
            "centre_mm": [c * 1000 for c in drop.centre],
            "share_of_pixels": found.rim.shares,
        },
        "tiers_sharp": _gallery_numbers(found.sharp),
        "tiers_blurred": _gallery_numbers(found.blurred) if found.blurred else None,
        "defocus": [
            {"f_number": number, "disc_px": disc, "change_gray": change}
            for number, disc, change in zip(
                found.defocus.f_numbers, found.defocus.discs_px, found.defocus.change, strict=True
            )
        ],
        "regime_maps": [
            {
                "varied": m.sweep.name, "unit": m.sweep.unit, "values": m.sweep.names or m.sweep.values,
                "contact_angles_deg": m.angles_deg, "tiers": [tier.name for tier in TIERS],
                "error_px": m.pixels, "lost_share": m.lost, "error_gray": m.gray,
            }
            for m in found.maps
        ],
        "texture_reused": [_plain(misuse) for misuse in found.misuses],
        "gravity": {
            "contact_angles_deg": found.sag.angles_deg, "diameters_mm": found.sag.diameters_mm,
            "bond_number": found.sag.bond, "cap_error_px": found.sag.pixels, "cap_error_gray": found.sag.gray,
        },
        "time_against_error": [
            {
                "tier": t.tier.name, "us_per_pixel": t.median, "quartiles_us_per_pixel": [t.low, t.high],
                "us_per_pixel_moved": t.moved, "error_gray": t.error,
            }
            for t in found.timings
        ],
    }  # fmt: skip


def _plain(value: Any) -> dict[str, Any]:
    """A dataclass as a dictionary, tiers by their names."""
    return {key: getattr(item, "name", item) for key, item in vars(value).items()}


def _gallery_numbers(gallery: Gallery) -> list[dict[str, Any]]:
    return [{"tier": s.tier.name, "rms_gray": s.error, "rms_px": s.pixels} for s in gallery.shown]
