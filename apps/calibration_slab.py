"""What a calibration found out about its panels, for the record and for the page."""

from __future__ import annotations

import math

from rainstereo.apps.calibration_findings import Findings
from rainstereo.apps.report import Report
from rainstereo.calib.hypotheses import Hypothesis
from rainstereo.calib.solve import Solution

LEAST = 1e-12
"""A smaller probability is not spelled out: no model of the noise holds so far."""
UNITS = {"pitch": (180 / math.pi, "degrees"), "yaw": (180 / math.pi, "degrees"), "wedge": (180 / math.pi, "degrees"),
         "thickness": (1000.0, "mm"), "index": (1.0, "")}  # fmt: skip


def slab_results(findings: Findings) -> dict[str, object] | None:
    """What `report.json` says about the panels; SI units."""
    solution = findings.solution
    if solution is None or solution.rig.chamber is None:
        return None
    estimate = solution.estimate
    told: dict[str, object] = {
        "mode": "as described"
        if estimate is None
        else "estimated"
        if estimate.prior is not None
        else "paired captures",
        "hypotheses": findings.hypotheses,
        "nominal": solution.rig.chamber.nominal,
        "moved": solution.moved,
    }
    if estimate is None:
        return told
    return told | {
        "values": dict(zip(estimate.slab.names, estimate.slab.values.tolist(), strict=True)),
        "sigmas": estimate.sigmas,
        "sigma_after_over_before": estimate.gain,
        "pulls": estimate.pulls,
    }


def slab_section(report: Report, solution: Solution, findings: Findings) -> None:
    """The panels: what was found, by how much that improves on the description, and which hypothesis holds."""
    if not findings.hypotheses:
        return
    estimate = solution.estimate
    report.section("The panels", "What the boards say about the acrylic, and what they cannot say.")
    if estimate is not None:
        gain, pulls = estimate.gain, estimate.pulls
        rows = []
        for name, value in zip(estimate.slab.names, estimate.slab.values, strict=True):
            scale, unit = UNITS[name.split()[0]]
            rows.append(
                (
                    name,
                    f"{value * scale:.4f}",
                    f"{estimate.sigmas[name] * scale:.4f}",
                    unit,
                    f"{gain[name]:.2f}" if name in gain else "no prior",
                    f"{pulls[name]:+.1f}" if name in pulls else "-",
                )
            )
        report.table(("parameter", "found", "sigma", "unit", "sigma after / before", "pull, sigmas"), rows)
        kept = ", ".join(estimate.chamber.nominal)
        report.text(
            f"Thickness is the sum over the panels of one index. Kept from the description, because no board can show "
            f"it: {kept}."
        )
    report.table(
        ("hypothesis", "parameters", "chi-squared", "RMS, px", "gain over the one above", "probability", "verdict"),
        [_row(row) for row in findings.hypotheses],
        strong=[i for i, row in enumerate(findings.hypotheses) if row.rejects],
    )
    report.text(
        "Each is solved to its own best on the same corners, without any prior. Where all boards are behind the "
        "chamber the RMS hardly tells them apart; chi-squared does. The probability is that of so large a gain by "
        "chance, were the poorer hypothesis true."
    )


def _row(row: Hypothesis) -> tuple[str | int, ...]:
    if row.problem:
        return row.name, "-", "-", "-", "-", "-", row.problem
    known = row.name, row.parameters, f"{row.chi2:.0f}", f"{row.rms_px:.5f}"
    if row.against is None:
        return *known, "-", "-", "-"
    probability = f"{row.p:.2g}" if row.p >= LEAST else f"< {LEAST:g}"
    verdict = f"{row.against} {'is rejected' if row.rejects else 'will do'}"
    return *known, f"{row.gain:.1f} for {row.freedom}", probability, verdict
