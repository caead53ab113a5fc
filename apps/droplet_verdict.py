"""Which tier does a set-up need for the drops that rain makes? The answers of `choose_tier`, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby, product

from rainstereo import tiers
from rainstereo.apps.droplet_bench import Bench
from rainstereo.apps.regime_maps import has_room, steepest
from rainstereo.apps.report import quantity
from rainstereo.fidelity import Bound, Choice, choose_tier
from rainstereo.tiers import LADDER, Method, Tier

RADII_MM = (0.25, 0.5, 1.0, 2.0, 4.0)
ANGLES_DEG = (20.0, 35.0, 50.0, 65.0, 80.0)
FIELDS = (0.0, 1.0)
FEW_RADII_MM, FEW_ANGLES_DEG = RADII_MM[::2], ANGLES_DEG[::2]
"""Those that are asked about in gray levels, which takes longer."""
WIDE = 3.0  # pixels across the disc, from which on no sharp tier is worth judging
BLURRED = tuple(tier for tier in LADDER if tier.is_defocused)
THREADS = 2


@dataclass(frozen=True)
class Answer:
    """What `choose_tier` says of one drop. unit: "pixels" (a pinhole) or "gray" (the lens, or a pinhole without one).

    error: the bound on the chosen tier's error in that unit. tried: tiers that were looked at and were not enough.
    """

    radius_mm: float
    angle_deg: float
    field: float
    unit: str
    tier: Tier
    met: bool
    error: float
    cost: float
    tried: tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """All answers, and what they come to.

    steepest_deg: contact angle up to which the slope texture places a drop of `radius_mm` in the middle of the image
    to the tolerance.
    """

    answers: tuple[Answer, ...]
    tolerance_px: float
    tolerance_gray: float
    radius_mm: float
    steepest_deg: float
    sentence: str

    def of(self, unit: str) -> list[Answer]:
        """Those in one unit."""
        return [answer for answer in self.answers if answer.unit == unit]


def verdict(
    bench: Bench, radius: float, tolerance_px: float, tolerance_gray: float, subject: str, quick: bool
) -> Verdict:
    """Ask `choose_tier` about every drop of the range that the face has room for and the camera sees.

    radius: metres, of the drop for which the slope texture's limit is sought.
    """

    def answer(question: tuple[str, float, float, float]) -> Answer:
        unit, r, angle, field = question
        tolerance = tolerance_gray if unit == "gray" else tolerance_px
        choice = choice_for(bench, r / 1000, math.radians(angle), field, unit, tolerance)
        bound = choice.bound
        tried = tuple(b.tier.name for b in choice.bounds if b is not bound and not b.reason)
        return Answer(r, angle, field, unit, bound.tier, choice.met, _error(bound, unit), bound.cost, tried)

    with ThreadPoolExecutor(THREADS) as pool:
        answers = tuple(pool.map(answer, _questions(bench, quick)))
    flat = steepest(bench, Tier(Method.SLOPES), radius, 0.0, tolerance_px)
    limits = Verdict(answers, tolerance_px, tolerance_gray, radius * 1000, flat, "")
    return replace(limits, sentence=words(limits, subject, bench.lens.f_number))


def _questions(bench: Bench, quick: bool) -> list[tuple[str, float, float, float]]:
    """Unit, radius in mm, angle in degrees and place in the field of all drops that there is room for."""
    sparse = list(product(("gray",), FEW_RADII_MM, FEW_ANGLES_DEG, FIELDS))
    dense = list(product(("pixels",), RADII_MM, ANGLES_DEG, FIELDS))
    if quick:
        dense = [("pixels", *question[1:]) for question in sparse]
        sparse = [question for question in sparse if question[2:] == (ANGLES_DEG[2], FIELDS[0])]
    return [q for q in dense + sparse if has_room(bench, bench.cap(q[1] / 1000, math.radians(q[2]), q[3]))]


def choice_for(bench: Bench, radius: float, angle: float, field: float, unit: str, tolerance: float) -> Choice:
    """`choose_tier` for a cap, metres and radians; in pixels for a pinhole, in gray levels for the lens."""
    drop = bench.cap(radius, angle, field)
    lens = bench.lens if unit == "gray" and math.isfinite(bench.lens.f_number) else None
    ladder: Sequence[Tier] = LADDER
    if lens is not None and tiers.disc(lens, drop, bench.camera, bench.chamber) > WIDE:
        ladder = BLURRED
    return choose_tier(
        drop, bench.camera, bench.chamber, bench.depth, tolerance,
        unit=unit, lens=lens, scene=bench.statistics, ladder=ladder,
    )  # fmt: skip


def _error(bound: Bound, unit: str) -> float:
    return bound.gray if unit == "gray" else bound.pixels


def words(verdict: Verdict, subject: str, f_number: float) -> str:
    """One sentence: what the drops need in pixels, by contact angle, and in gray levels through the lens."""
    sharp, blurred = verdict.of("pixels"), verdict.of("gray")
    if not sharp:
        return f"{subject} has no room for a drop on that face."
    lens = "through a pinhole" if math.isinf(f_number) else f"through the lens at F/{f_number:g}"
    radii = [answer.radius_mm for answer in sharp]
    return (
        f"{subject} needs {_by_angle(sharp)} to place what drops of {min(radii):g} to {max(radii):g} mm radius show, "
        f"from the middle of the image to its corner, to {verdict.tolerance_px:g} px "
        f"({_flat(verdict)}); {lens}, {_shares(blurred, verdict.tolerance_gray)}."
    )


def _by_angle(answers: Sequence[Answer]) -> str:
    """The dearest tier that each contact angle calls for, runs of alike joined."""
    angles = sorted({answer.angle_deg for answer in answers})
    needed = [max((a for a in answers if a.angle_deg == angle), key=lambda a: a.cost).tier for angle in angles]
    runs = [list(run) for _, run in groupby(zip(angles, needed, strict=True), key=lambda pair: pair[1])]
    last = _called(runs[-1][0][1])
    if len(runs) == 1:
        return f"{last} for drops of {angles[0]:g} to {angles[-1]:g} degrees"
    parts = [f"{_called(run[0][1])} up to {run[-1][0]:g} degrees" for run in runs[:-1]]
    return f"{', '.join(parts)} and {last} for steeper drops"


def _flat(verdict: Verdict) -> str:
    """Up to where the slope texture would do."""
    drop = f"a {verdict.radius_mm:g} mm drop in the middle"
    if math.isnan(verdict.steepest_deg):
        return f"the slope texture never does for {drop}"
    if verdict.steepest_deg >= 90:
        return f"the slope texture always does for {drop}"
    return f"the slope texture does for {drop} up to {quantity(verdict.steepest_deg, digits=2)} degrees"


def _shares(answers: Sequence[Answer], tolerance: float) -> str:
    """How many drops each tier keeps a tolerance in gray levels for, the cheapest tier first."""
    tiers_met = sorted({a.tier for a in answers if a.met}, key=lambda t: min(a.cost for a in answers if a.tier == t))
    missed = [a for a in answers if not a.met]
    if not tiers_met:
        return f"no tier keeps {tolerance:g} gray levels for any of {len(answers)} drops ({_closest(missed)})"
    counts = [(_called(t), sum(a.met and a.tier == t for a in answers)) for t in tiers_met]
    if counts[0][1] == len(answers):
        worst = quantity(max(a.error for a in answers), digits=2)
        return f"{counts[0][0]} keeps {tolerance:g} gray levels for all drops (worst bound {worst})"
    first = f"{counts[0][0]} keeps {tolerance:g} gray levels for {counts[0][1]} of {len(answers)} drops"
    rest = [f"{name} for {count} more" for name, count in counts[1:]]
    if missed:
        rest.append(f"none for {len(missed)} ({_closest(missed)})")
    return ", ".join([first, *rest])


def _closest(missed: Sequence[Answer]) -> str:
    """The worst of those that missed."""
    worst = max(missed, key=lambda a: a.error)
    return f"{_called(worst.tier)} comes closest: {quantity(worst.error, digits=2)}"


def _called(tier: Tier) -> str:
    if tier.method is Method.EXACT:
        return "exact tracing" + (f" of {tier.count} x {tier.count} samples a pixel" if tier.count > 1 else "")
    article = {Method.LAYER: "one ", Method.APERTURE: ""}.get(tier.method, "the ")
    return article + tier.name
