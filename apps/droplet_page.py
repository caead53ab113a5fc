"""The report page of `rainstereo droplets`."""

from __future__ import annotations

import math

import cv2
import numpy as np
from matplotlib.figure import Figure

from rainstereo.apps.droplet_findings import Findings, figures
from rainstereo.apps.droplet_pictures import (
    APERTURE,
    FULL,
    QUICK_APERTURE,
    SAMPLES,
    Shown,
    rim_maps,
)
from rainstereo.apps.droplet_tradeoff import NEARER, plot
from rainstereo.apps.figures import image_grid
from rainstereo.apps.regime_figures import choice_maps, error_maps, sag_plot
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.types import Image

WIDE = 640  # pixels across the picture of the whole scene


def page(found: Findings, record: Record) -> Report:
    """The page: verdict, pictures, maps, time, checks."""
    report = Report("Can this drop model be trusted?", _described(found), "rainstereo droplets")
    if not found.sound:
        report.verdict("bad", found.sentence)
    else:
        missed = any(not answer.met for answer in found.verdict.answers)
        report.verdict("warn" if missed else "good", found.sentence, "Verdict.")
    _tiles(report, found)
    _sharp(report, found)
    _rim(report, found)
    _blurred(report, found)
    _maps(report, found)
    _choices(report, found)
    _gravity(report, found)
    _tradeoff(report, found)
    _checks(report, found)
    report.section("What the words mean")
    report.bullets(MEANINGS)
    report.details("Set-up", figures(found)["setup"])
    report.record(record)
    return report


def _described(found: Findings) -> str:
    bench, drop = found.bench, found.drop
    where = "in the middle of the image" if found.field == 0 else f"{found.field:.0%} of the way to the image's corner"
    depth = "infinity" if math.isinf(bench.depth) else f"{bench.depth:g} m"
    return (
        f"A drop of {drop.radius * 1000:g} mm radius and {math.degrees(drop.contact_angle):g} degrees contact angle, "
        f"{where}, on the {bench.face} face of panel {bench.panel}, {bench.distance * 1000:.0f} mm away; "
        f"scene at {depth}; {bench.camera.width} x {bench.camera.height} pixels"
    )


def _tiles(report: Report, found: Findings) -> None:
    by_name = {shown.tier.name: shown for shown in found.sharp.shown}
    slope, exact = by_name.get("slope texture"), by_name["exact, 4 x 4"]
    passed = sum(check.passed for check in found.checks)
    tiles = [Tile("self-checks", f"{passed} of {len(found.checks)}", "", "passed in this run")]
    if slope is not None:
        tiles.append(Tile("slope texture", quantity(slope.pixels, digits=2), "px", "RMS against exact tracing"))
    tiles.append(Tile("dark rim", f"{found.rim.shares['TOTAL_REFLECTION']:.0%}", "", "of the drop: total reflection"))
    tiles.append(Tile("looks beyond the image", f"{found.rim.shares['outside']:.0%}", "", "of what shows the scene"))
    tiles.append(Tile("exact, 4 x 4 samples", quantity(exact.error, digits=2), "", "gray levels RMS, sharp"))
    if found.blurred is not None:
        layer = next(s for s in found.blurred.shown if s.tier.name == "defocused layer")
        tiles.append(Tile("defocused layer", quantity(layer.error, digits=2), "", "gray levels RMS, blurred"))
    report.tiles(*tiles)


def _sharp(report: Report, found: Findings) -> None:
    gallery = found.sharp
    report.section(
        "One drop, every tier",
        "Through a pinhole, so perfectly sharp. The texture models place pixels wrongly and know no dark rim; exact "
        "tracing with one sample a pixel is right in every pixel's middle, and aliases: a whole scene is squeezed into "
        "a few pixels.",
    )
    report.image(_context(found), "The scene, with the drop where the frame is.", quality=92)
    report.figure(
        _grid(
            [gallery.reference, *(s.picture for s in gallery.shown)],
            [f"the truth: exact, {SAMPLES} x {SAMPLES}", *(_caption(s) for s in gallery.shown)],
        ),
        f"Enlarged {gallery.scale:.3g} times; px and gray levels are RMS. Beneath the truth: what the drop changes of "
        f"the clear view, full colour at {FULL:g} gray levels. Beneath each tier: its difference to the truth, red too "
        f"bright, blue too dark, full colour at {FULL / gallery.gain:g}.",
    )
    report.text(
        "Pixels: where the drop's pixels look, against exact tracing of the same points, between the whole pixels too. "
        "Gray levels: what is shown, against the truth, over all pixels that the drop touches."
    )


def _grid(pictures: list[Image], captions: list[str]) -> Figure:
    return image_grid(pictures, captions, columns=4, width=9.6)


def _caption(shown: Shown) -> str:
    gray = f"{quantity(shown.error, digits=2)} gray levels"
    return f"{shown.tier.name}\n" + (
        f"{quantity(shown.pixels, 'px', 2)}, {gray}" if math.isfinite(shown.pixels) else gray
    )


def _context(found: Findings) -> Image:
    """The scene with a frame around the drop's window."""
    image = found.bench.image.copy()
    scale = WIDE / image.shape[1]
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    rows, columns = found.sharp.window
    low, high = ((round(x * min(scale, 1)), round(y * min(scale, 1)))
                 for x, y in ((columns.start, rows.start), (columns.stop, rows.stop)))  # fmt: skip
    for colour, width in (((0, 0, 0), 4), ((60, 220, 255), 2)):
        cv2.rectangle(image, low, high, colour, width)
    return image


def _rim(report: Report, found: Findings) -> None:
    shares = found.rim.shares
    report.section(
        "Inside the drop",
        "Light that meets the far surface too obliquely is reflected back: the dark rim. What passes is dimmed by "
        "Fresnel's law and comes from hundreds of pixels away.",
    )
    report.figure(
        rim_maps(found.rim),
        f"{shares['THROUGH']:.1%} of the drop shows the scene, {shares['TOTAL_REFLECTION']:.1%} reflects it totally; "
        f"{shares['outside']:.1%} of what it shows lies beyond the image's edge. Arrows point to where a pixel looks.",
    )


def _blurred(report: Report, found: Findings) -> None:
    bench, defocus = found.bench, found.defocus
    focal = f"{bench.lens.focal_length * 1000:g} mm"
    focus = "infinity" if math.isinf(bench.lens.focus) else f"{bench.lens.focus:g} m"
    report.section(
        "Out of focus",
        f"A {focal} lens focused at {focus} turns each point of the drop into a disc. What is left of the drop is "
        "smooth, and one blurred layer shows it.",
    )
    report.figure(
        _grid(
            list(defocus.pictures),
            [f"F/{number:g}: disc of {quantity(size, 'px', 2)}\nchanges {quantity(change, digits=2)} gray levels"
             for number, size, change in zip(defocus.f_numbers, defocus.discs_px, defocus.change, strict=True)],
        ),
        f"The drop as one blurred layer. Beneath each: what it changes of the clear view, full colour at "
        f"{FULL / defocus.gain:g} gray levels; in numbers, RMS over this window.",
    )  # fmt: skip
    if found.blurred is not None:
        samples = QUICK_APERTURE if found.quick else APERTURE
        gallery = found.blurred
        report.figure(
            _grid(
                [gallery.reference, *(s.picture for s in gallery.shown)],
                [f"the truth at F/{bench.lens.f_number:g}:\n{samples} aperture samples",
                 *(_caption(s) for s in gallery.shown)],
            ),
            f"Beneath the truth: what the drop changes, full colour at {FULL:g} gray levels. Beneath each tier: its "
            f"difference to the truth, full colour at {FULL / gallery.gain:g}. Nothing is as wrong as a sharp drop "
            "where the lens sees a blurred one.",
        )  # fmt: skip


def _maps(report: Report, found: Findings) -> None:
    drop = found.drop
    report.section(
        "Where each model is good",
        "Error against exact tracing by contact angle and one other quantity at a time; the rest as in the heading of "
        "this page. Below the line 1 a model is good to a pixel, above 100 it shows another part of the scene.",
    )
    report.figure(
        error_maps(found.maps, "px"),
        "RMS displacement in pixels, over the drop's pixels that show something of the image. Gray: no such drop, or "
        "nothing of it is in the image. Panel 0 is the nearest.",
    )
    report.figure(
        error_maps(found.maps, "gray levels"),
        "The same in gray levels of this scene, over all of the drop's pixels: a dark rim that a texture leaves bright "
        "counts, too, and so does that its mask ends at whole pixels, and that a wet panel reflects some 2 % less than "
        "a bare one, which only the traced tiers and baked textures know.",
    )
    report.table(
        ("a baked texture where it was not made for", "RMS error, px"),
        [(m.words, m.pixels) for m in found.misuses],
        f"Radius {drop.radius * 1000:g} mm, {math.degrees(drop.contact_angle):g} degrees. A texture belongs to one "
        "drop in one place; with the part in 1/Z it serves every depth.",
        numbers=[1],
    )


def _choices(report: Report, found: Findings) -> None:
    verdict, lens = found.verdict, found.bench.lens
    report.section(
        "Which tier is chosen",
        "What `choose_tier` answers, drop by drop: the cheapest tier whose error bound keeps the tolerance.",
    )
    blurred = "pinhole" if math.isinf(lens.f_number) else f"F/{lens.f_number:g}"
    titles = {
        "pixels": f"places to {verdict.tolerance_px:g} px",
        "gray": f"{blurred}, to {verdict.tolerance_gray:g} gray levels",
    }
    report.figure(
        choice_maps(verdict.answers, titles),
        "Green: textures, violet: height maps, blue: exact tracing, orange: blurred. Beneath each name the bound on "
        "its error, which is larger than the error; * the tolerance is missed, this one comes closest.",
    )


def _gravity(report: Report, found: Findings) -> None:
    known = found.sag.pixels[np.isfinite(found.sag.pixels)]
    if not known.size:
        return
    report.section(
        "When a drop is no cap",
        "Gravity pulls a drop on an upright pane out of shape. The spherical cap of its volume and contact circle, "
        "traced exactly, against the shape of Young and Laplace.",
    )
    report.figure(
        sag_plot(found.sag, found.verdict.tolerance_px),
        "The error grows with the Bond number rho g a^2 / gamma. Where a line ends, no drop of that weight stays put.",
    )


def _tradeoff(report: Report, found: Findings) -> None:
    report.section(
        "Run time against error",
        "The same drop, drawn by the code that renders frames, timed in this run. Everything is made anew: textures "
        "baked, rays traced, scene looked up.",
    )
    report.figure(
        plot(found.timings),
        f"Sharp tiers against {SAMPLES} x {SAMPLES} exact samples a pixel, blurred ones against those of the aperture. "
        "Gray: a plan that is kept and moved to another depth by slope and offset, without tracing.",
    )
    report.table(
        ("tier", "made anew, us a pixel", "quartiles", "moved in depth, us a pixel", "error, gray levels"),
        [(t.tier.name, quantity(t.median), f"{quantity(t.low)}–{quantity(t.high)}", quantity(t.moved),
          quantity(t.error)) for t in found.timings],
        f"Microseconds for each pixel that the drop touches. Moved: the same rays for a scene at {NEARER:g} times the "
        "depth, and the scene looked up again.",
        numbers=[1, 2, 3, 4],
    )  # fmt: skip


def _checks(report: Report, found: Findings) -> None:
    report.section("Self-checks", "Made in this run: laws that the tracer must obey and formulas that it does not use.")
    report.table(
        ("law", "found", "allowed", "passed", "detail"),
        [(c.words, quantity(c.found, c.unit, 2) if math.isfinite(c.found) else "no answer",
          quantity(c.limit, c.unit, 2), "yes" if c.passed else "NO", c.detail or "–") for c in found.checks],
        numbers=[1, 2],
    )  # fmt: skip


MEANINGS = (
    "Displacement: a pixel of a drop shows what the clear image has elsewhere; the displacement leads there.",
    "Literal texture: the model x = u + R*B, y = v + G*B by the word of its paper. R, G: components of the surface's "
    "normal; B: thickness, times the one scale that suits the drop best.",
    "Slope texture: R, G from the surface's slope by first-order optics, B without a fit.",
    "Baked texture: R, G and B such that the model reproduces the exact trace at each pixel, for one drop and place.",
    "Height map: Snell's law at each pixel with the normal that a few parallax steps find.",
    "Exact: Snell's law and Fresnel's through all panels and the drop's two surfaces, with true intersections.",
    "Gray levels: of 255. An error in pixels costs few gray levels on a plain wall and many on a hedge.",
)
