"""Our rain beside real rain: same scene, exposure, cover, size and blur; then everything else is compared, not fitted.

Measures are made of pictures alone and alike of both; see `realism_measures` and `rainstereo.rain.appearance`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rainstereo.apps.rain_presets import Setup, preset
from rainstereo.apps.realism_figures import enlarged, histograms, overlay
from rainstereo.apps.realism_fit import Fit, Scene, fit
from rainstereo.apps.realism_measures import FITTED, Look, look
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.defocus import apparent_distance
from rainstereo.rain.rendered import Rendered
from rainstereo.types import Array, Image

SEEDS = 9
"""Renderings of the same rain, seed after seed. One more would lie outside of the range of n in 2 of n + 1 cases."""

WORDS: dict[str, tuple[str, str, str]] = {
    "cover": ("share that looks different", "", ""),
    "size": ("typical diameter, px", "larger", "smaller"),
    "blur": ("blur disc of the drops' edges, px", "more blurred", "sharper"),
    "variety": ("large over small diameters", "of more varied size", "of less varied size"),
    "opacity": ("structure that is missing", "more opaque", "less opaque"),
    "brightness": ("brightness inside less expected, gray levels", "brighter", "darker"),
    "rim_up": ("upper rims less the inside, gray levels", "brighter at the upper rim", "darker at the upper rim"),
    "rim_down": ("lower rims less the inside, gray levels", "brighter at the lower rim", "darker at the lower rim"),
    "below": ("lower half less upper half, gray levels", "more bottom-lit", "less bottom-lit"),
    "contrast": ("contrast inside over what is hidden", "richer in contrast", "poorer in contrast"),
    "elongation": ("height over width", "taller", "wider"),
}
"""Of each measure: what it is, and what real drops are where it is larger, or smaller, than ours."""

LIMITS = (
    "Cover is the share of pixels that look different, not what water covers: a drop that shows white sky before white "
    "sky is not seen, and a sharp dark one looks wider by some pixels, in the photograph and in ours.",
    "The photographs differ by more than drops: two cameras some way apart, things that moved, noise. Ours differ from "
    "the clear image by the drops alone. So the real figures hold a part that is not rain.",
    "The opacity measured is structure that is missing, where there is some to be missed; what a drop shows may "
    "resemble what it hides. Where a picture is blurred for another reason that counts as well.",
    "The displacement inside a real drop cannot be measured from a pair; only ours is shown.",
    "Cover, size and blur were fitted to each picture, so that they agree says nothing. Everything else follows from "
    "the preset and the optics.",
    "Ours show what the clear image holds, mirrored at its edge; real drops also show sky and road beyond it.",
    "Drops that veil much of a scene lower its contrast, and the gain found beside them.",
    "The camera's field, the pane and the scene's distance are the preset's, not the photographs'.",
    "A few photographs of one camera each cannot stand for rain: no claim is made beyond what is shown.",
)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A real pair and its rendering. ours: of several seeds, the fit's first. rendered: with that first seed."""

    scene: Scene
    fit: Fit
    rendered: Rendered
    ours: tuple[Look, ...]

    @classmethod
    def of(cls, scene: Scene, setup: Setup, seed: int) -> Comparison:
        """Fit the setup to the scene and measure what comes out."""
        fitted = fit(scene, setup, seed)
        frames = [fitted.rendered(scene, each) for each in range(seed, seed + SEEDS)]
        return cls(scene, fitted, frames[0], tuple(look(frame.image, scene.exposed) for frame in frames))

    def range_of(self, name: str) -> tuple[float, float]:
        """Smallest and largest of ours; NaN where none has it."""
        values = [value for each in self.ours if math.isfinite(value := each.numbers[name])]
        return (min(values), max(values)) if values else (math.nan, math.nan)

    @property
    def differences(self) -> dict[str, int]:
        """Compared measures in which the real picture lies outside of ours: 1 above, -1 below."""
        found = {}
        for name, value in self.scene.look.numbers.items():
            low, high = self.range_of(name)
            if name not in FITTED and (value > high or value < low):
                found[name] = 1 if value > high else -1
        return found

    @property
    def truth(self) -> dict[str, float]:
        """What is known of the rendering: share more than half hidden, median opacity there, median disc."""
        rendered, setup = self.rendered, self.fit.setup
        hidden = rendered.opacity > 0.5
        lens, camera = setup.lens, self.scene.camera(setup)
        discs = [lens.blur(apparent_distance(d, setup.chamber), camera) for d in rendered.drops] if lens else [0.0]
        return {
            "cover": float(hidden.mean()),
            "opacity": float(np.median(rendered.opacity[hidden])) if hidden.any() else math.nan,
            "blur": float(np.median(discs)) if discs else math.nan,
        }

    @property
    def displacement(self) -> Array:
        """Pixels, (P,), where our drops show something."""
        moved = np.linalg.norm(self.rendered.displacement[self.rendered.opacity > 0.5].astype(np.float64), axis=-1)
        return np.asarray(moved[np.isfinite(moved)])

    @property
    def summary(self) -> dict[str, Any]:
        """Everything in numbers."""
        scene, moved = self.scene, self.displacement
        spread = np.percentile(moved, [10, 50, 90]).tolist() if moved.size else None
        return {
            "name": scene.name,
            "shift_px": scene.shift,
            "exposure": {"gain": scene.exposure.gain, "offset": scene.exposure.offset},
            "fit": {"cover": self.fit.cover, "scale": self.fit.scale, "f_number": self.fit.f_number,
                    "error": self.fit.error, "renderings": self.fit.renderings},
            "real": scene.look.numbers,
            "ours": {name: self.range_of(name) for name in scene.look.numbers},
            "truth_of_ours": self.truth,
            "displacement_px_10_50_90": spread,
            "real_outside_ours": self.differences,
        }  # fmt: skip


def realism_sheet(
    pairs: Sequence[tuple[Image, Image]], names: Sequence[str], setup: Setup | str, seed: int, out: Path
) -> dict[str, Any]:
    """Write OUT/realism.html, our rain beside real pairs (rainy, clear), and return its numbers for `report.json`.

    pairs: uint8 images of one scene, the two of a pair of one size, not aligned if they differ by a shift.
    setup: of `rain_presets`, or its name; its cover, sizes and F-number are where fits start. seed: of the drops.
    """
    if not pairs or len(pairs) != len(names):
        raise ValueError(f"{len(pairs)} pairs and {len(names)} names were given; expected as many, at least one")
    start = preset(setup) if isinstance(setup, str) else setup
    compared = [
        Comparison.of(Scene.of(wet, clear, name), start, seed) for (wet, clear), name in zip(pairs, names, strict=True)
    ]
    page(compared).write(out / "realism.html")
    return {"pairs": [each.summary for each in compared], "seeds": SEEDS, "findings": findings(compared)}


def findings(compared: Sequence[Comparison]) -> list[str]:
    """In which measures real drops lie outside of ours, most often first: sentences with the pairs that say so."""
    lines = []
    for name, (what, above, below) in WORDS.items():
        for sign, word in ((1, above), (-1, below)):
            where = [each for each in compared if each.differences.get(name) == sign]
            if where:
                values = "; ".join(_against(each, name) for each in where)
                often = f"{len(where)} of {len(compared)} pairs"
                lines.append((len(where), f"Real drops are {word} than ours in {often} ({what}: {values})."))
    return [line for _, line in sorted(lines, key=lambda line: -line[0])]


def _against(each: Comparison, name: str) -> str:
    low, high = each.range_of(name)
    return f"{quantity(each.scene.look.numbers[name])} against {quantity(low)} to {quantity(high)}"


# -- the page ----------------------------------------------------------------------------------------------------------


def page(compared: Sequence[Comparison]) -> Report:
    """The sheet."""
    report = Report("Real rain and ours", f"{len(compared)} real pairs; ours rendered on their clear images")
    apart, total = (sum(counts) for counts in zip(*(_counts(each) for each in compared), strict=True))
    sentence = (
        f"Of {total} measures that were not fitted, {total - apart} of the real pictures lie within what {SEEDS} "
        f"seeds of ours give, and {apart} outside, where chance alone would leave about {total * 2 / (SEEDS + 1):.0f}. "
        "No claim beyond what is shown."
    )
    report.verdict("warn" if apart else "good", sentence, "Compared.")
    worst = max((each.fit.worst for each in compared if math.isfinite(each.fit.worst)), default=math.nan)
    report.tiles(
        Tile("pairs", len(compared), "", "a rainy and a clear photograph"),
        Tile("fitted", quantity(100 * worst, digits=2), "%", "worst error of cover, size or blur"),
        Tile("compared", total, "", "measures that were not fitted"),
        Tile("outside ours", apart, "", f"of the range of {SEEDS} seeds"),
    )
    report.section("Where ours differs", "Computed: the real picture lies outside of all our renderings.")
    report.bullets(findings(compared) or ["Nowhere, by these measures."])
    for each in compared:
        _pair(report, each)
    report.section("What these figures cannot say", "")
    report.bullets(LIMITS)
    return report


def _counts(each: Comparison) -> tuple[int, int]:
    known = [n for n, v in each.scene.look.numbers.items() if n not in FITTED and math.isfinite(v)]
    return len(each.differences), len(known)


def _pair(report: Report, each: Comparison) -> None:
    scene, ours, fitted = each.scene, each.rendered.image, each.fit
    gain, offset = (" ".join(f"{v:.3g}" for v in values) for values in (scene.exposure.gain, scene.exposure.offset))
    report.section(scene.name, "Real, ours, and the clear image in the same exposure.")
    report.images([scene.wet, ours, scene.exposed], ["real", "ours, rendered on the clear image", "clear"])
    report.compare(scene.wet, ours, ("real", "ours"), "Left of the cut real rain, right of it ours.")
    report.text(
        f"Aligned by a shift of {scene.shift[0]}, {scene.shift[1]} px; exposure by a curve a channel, about gain "
        f"{gain} and offset {offset} gray levels. Fitted in {fitted.renderings} renderings: cover {fitted.cover:.3g}, "
        f"diameters times {fitted.scale:.3g}, F/{fitted.f_number:.3g}."
    )
    rows = np.concatenate([enlarged(scene.wet, scene.look.mask), enlarged(ours, each.ours[0].mask)], axis=0)
    report.image(rows, "Places with the largest discs inside what looks different, enlarged: above real, below ours.")
    report.images(
        [overlay(scene.wet, scene.look.mask), overlay(ours, each.ours[0].mask)],
        ["what looks different: real", "what looks different: ours"],
    )
    report.figure(
        histograms(scene.look, list(each.ours), each.displacement), "Real against ours; shares of what looks different."
    )
    _table(report, each)


def _table(report: Report, each: Comparison) -> None:
    truth, rows, strong = each.truth, [], []
    for i, (name, value) in enumerate(each.scene.look.numbers.items()):
        low, high = each.range_of(name)
        fitted = name in FITTED and math.isfinite(each.fit.error[name])
        verdict = "fitted" if fitted else "not seen" if not math.isfinite(value) else "within"
        if name in each.differences:
            verdict = "above ours" if each.differences[name] > 0 else "below ours"
            strong.append(i)
        rows.append((WORDS[name][0], value, each.ours[0].numbers[name], low, high, truth.get(name), verdict))
    report.table(
        ("measure", "real", "ours", "least", "most", "true of ours", "real is"), rows,
        f"Least and most of {SEEDS} seeds. True: what the renderer knows (more than half hidden; the lens's disc), to "
        "show how well the measure finds it.", strong, numbers=range(1, 6),
    )  # fmt: skip


__all__ = ["Comparison", "findings", "page", "realism_sheet"]
