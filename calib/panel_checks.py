"""What a user should know about the panels: units that cannot be, descriptions that corners contradict, a wedge."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rainstereo.calib.checks import Finding
from rainstereo.calib.hypotheses import BY_CORNERS, ESTIMATED, KNOWN, WEDGE, Hypothesis
from rainstereo.calib.joint import BLIND_TILT
from rainstereo.calib.prior import Prior
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.chamber import Chamber

THIN, THICK = 2e-4, 0.03
LOW_INDEX, HIGH_INDEX = 1.25, 1.95
STEEP = math.radians(70)
FAR = 1.0
CERTAIN_TILT, CERTAIN_THICKNESS = math.radians(0.01), 1e-7
"""Standard deviations below which nobody measures; 0 says on purpose that something is exact."""
CONTRADICTION = 3.0
"""A description that corners pull away by more sigmas than this is questioned."""


def questions(chamber: Chamber) -> list[Finding]:
    """What in a description can be, but is hardly meant."""
    found = []
    for i, panel in enumerate(chamber.panels):
        if not THIN <= panel.thickness <= THICK and panel.thickness != math.inf:
            text = f"panel {i + 1} is described as {panel.thickness * 1000:g} mm thick"
            found.append(Finding("doubtful", text, "thickness_mm is in millimetres: 4.0 for 4 mm"))
        if not LOW_INDEX <= panel.index <= HIGH_INDEX:
            text = f"panel {i + 1} is described with a refractive index of {panel.index:g}"
            found.append(Finding("doubtful", text, "acrylic has 1.49, glass 1.52, water 1.333"))
    if chamber.tilt > STEEP:
        text = f"the panels are described as tilted by {math.degrees(chamber.tilt):.0f} degrees"
        found.append(Finding("doubtful", text, "normal points from the cameras to the scene; x right, y down, z ahead"))
    sd = chamber.uncertainty
    if sd is not None and 0 < sd.tilt < CERTAIN_TILT:
        text = f"the tilt is described as known to {math.degrees(sd.tilt):.2g} degrees"
        found.append(Finding("doubtful", text, "tilt_sd_deg is in degrees, not radians: 0.5 for a protractor"))
    for i, each in enumerate(() if sd is None else sd.thickness):
        if 0 < each < CERTAIN_THICKNESS:
            text = f"the thickness of panel {i + 1} is described as known to {each * 1000:.2g} mm"
            found.append(Finding("doubtful", text, "thickness_sd_mm is in millimetres: 0.02 for a caliper"))
    if chamber.distance > FAR:
        text = f"the panels are described as {chamber.distance * 1000:g} mm away"
        found.append(Finding("doubtful", text, "distance_mm is in millimetres"))
    return found


def panels(solution: Solution, described: Chamber, table: Sequence[Hypothesis] = ()) -> list[Finding]:
    """Findings about the panels of a solution that was found through them."""
    found = questions(described)
    if solution.moved:
        text = "board or rig moved while the panels were put in: these do not share a pose with their partners"
        found.append(
            Finding("note", text, "leave board and rig where they are between the two captures", solution.moved)
        )
    found += _contradictions(solution)
    found += _unknown(solution)
    found += _wedge(solution, table)
    found += _tests(solution, table)
    return found


def _contradictions(solution: Solution) -> list[Finding]:
    estimate, found = solution.estimate, []
    if estimate is None:
        return []
    for name, pull in estimate.pulls.items():
        if abs(pull) > CONTRADICTION:
            text = f"the corners contradict the description of the panels: {name} is pulled by {pull:+.1f} sigmas"
            remedy = (
                "measure it again, or check that the board is flat: a twist of 0.2 mm looks like degrees of tilt; "
                "paired captures tell"
            )
            found.append(Finding("doubtful", text, remedy))
    return found


def _unknown(solution: Solution) -> list[Finding]:
    """What was not measured and keeps the described value; what was sought and not found."""
    estimate, chamber = solution.estimate, solution.rig.chamber
    if estimate is None or chamber is None:
        return []
    text = f"kept from the description, since boards cannot show it: {', '.join(chamber.nominal)}"
    if "index" in chamber.nominal:
        T = sum(panel.thickness for panel in chamber.panels if np.isfinite(panel.thickness))
        n = max((panel.index for panel in chamber.panels), default=1.49)
        if n > 1:
            each = 1e6 * T * 0.001 / (n * (n - 1))
            text += f" (if the index is 0.001 higher the thickness found is {each:.0f} um less in all)"
    found = [Finding("note", text)]
    for name in ("pitch", "yaw"):
        if estimate.sigmas.get(name, 0.0) > BLIND_TILT:
            degrees = math.degrees(estimate.sigmas[name])
            text = f"the tilt ({name}) was not found: " + (
                f"{degrees:.0f} degrees uncertain" if degrees < 90 else "nothing that the corners show depends on it"
            )
            found.append(Finding("doubtful", text, "describe it in chamber.toml, or show the board nearer and tilted"))
    low, _ = estimate.slab.limited()
    for name, end in zip(estimate.slab.names, low, strict=True):
        if end:
            text = f"{name} came out at the end of what can be; the corners show no panel"
            found.append(Finding("doubtful", text, "check that the panels were in front of the cameras"))
    return found


def _wedge(solution: Solution, table: Sequence[Hypothesis]) -> list[Finding]:
    estimate = solution.estimate
    if estimate is not None and "wedge" in estimate.slab.free:
        wedge = float(np.linalg.norm(estimate.slab.wedge))
        sigma = max(estimate.sigmas["wedge pitch"], estimate.sigmas["wedge yaw"])
        return [_wedged(solution, wedge, sigma, estimate.slab)]
    for row in table:
        if row.name == WEDGE and row.rejects and solution.rig.chamber is not None:
            wedge = math.hypot(row.values["wedge pitch"], row.values["wedge yaw"])
            sigma = max(row.sigmas["wedge pitch"], row.sigmas["wedge yaw"])
            return [_wedged(solution, wedge, sigma, Slab(solution.rig.chamber))]
    return []


def _wedged(solution: Solution, wedge: float, sigma: float, slab: Slab) -> Finding:
    pixels = (slab.chamber.panels[0].index - 1) * wedge * float(solution.rig.dry.intrinsics[0])
    text = (
        f"the panels' faces are not parallel: a wedge of {math.degrees(wedge):.3f} +- {math.degrees(sigma):.3f} "
        f"degrees in all turns far directions by {pixels:.2f} px, alike for both cameras; the rig has no wedge in it"
    )
    return Finding("doubtful", text, "use cast sheets of even thickness; where only the pairs matter it may stay")


def _tests(solution: Solution, table: Sequence[Hypothesis]) -> list[Finding]:
    rows: dict[str, Hypothesis] = {row.name: row for row in table}
    found: list[Finding] = []
    found += [Finding("note", f"{row.name}: {row.problem}") for row in table if row.problem]
    known = rows.get(KNOWN)
    if known is not None and not known.problem and known.gain < 0:
        text = (
            f"the corners fit better without any panels than with those described (chi-squared {-known.gain:.0f} less)"
        )
        found.append(Finding("doubtful", text, "check that these images were taken through the panels"))
    better = rows.get(ESTIMATED)
    if better is not None and better.rejects and solution.estimate is None and solution.rig.chamber is not None:
        apart = _apart(better, solution.rig.chamber)
        text = (
            f"the corners prefer other panels than those described (chi-squared {better.gain:.0f} for "
            f"{better.freedom}, p {better.p:.1g}), by up to {apart:.1f} sigmas of both"
        )
        if apart > CONTRADICTION:
            found.append(
                Finding("doubtful", text, "measure the panels again, use --slab estimated, or paired captures")
            )
        else:
            found.append(Finding("note", text, "a board that is not flat does the same; paired captures tell"))
    return found


def _apart(row: Hypothesis, described: Chamber) -> float:
    """By how many standard deviations, of description and corners together, an estimate is off, at most."""
    slab = Slab(described, BY_CORNERS)
    before, values = Prior(described).sigmas(slab), slab.values
    off = [
        abs(row.values[name] - value) / math.hypot(row.sigmas[name], sd)
        for name, value, sd in zip(slab.names, values.tolist(), before.tolist(), strict=True)
    ]
    return float(max(off, default=0.0))
