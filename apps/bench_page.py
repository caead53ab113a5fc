"""What a benchmark shows: table, plot, and in words where rainstereo wins and where it loses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from rainstereo.apps.bench_harness import Measurement, Outcome, Spread, Stage, Target
from rainstereo.apps.canvas import to_svg
from rainstereo.apps.report import Cell, Report, Tile, quantity
from rainstereo.apps.run_record import Record, versions, write_atomically
from rainstereo.apps.tradeoff import error_against_time, times_alone


@dataclass(frozen=True)
class Comparison:
    """Our champion against a peer: `time` is ours over theirs, `error` likewise (NaN where either has none)."""

    champion: Measurement
    peer: Measurement
    time: Spread
    error: float
    unit: str

    @property
    def faster(self) -> bool | None:
        """True, False, or None where the quartiles of the ratio lie on both sides of 1."""
        return None if self.time.low <= 1 <= self.time.high else self.time.median < 1

    @property
    def closer(self) -> bool | None:
        """Whether we are more exact; None where errors are alike within 10 % or not comparable."""
        return None if not math.isfinite(self.error) or 0.9 < self.error < 1.1 else self.error < 1

    @property
    def verdict(self) -> str:
        """`wins`, `loses`, `trades` or `ties`: nothing is called a win that costs accuracy, nor one that costs time."""
        views = {self.faster, self.closer} - {None}
        if not views:
            return "ties"
        return "trades" if len(views) == 2 else ("wins" if True in views else "loses")

    @property
    def words(self) -> str:
        """The comparison in one sentence."""
        pace = {
            None: "is as fast as",
            True: f"is {1 / self.time.median:.3g} x as fast as",
            False: f"takes {self.time.median:.3g} x the time of",
        }[self.faster]
        ours, theirs = (quantity(m.error, self.unit, 2) for m in (self.champion, self.peer))
        closeness = {
            None: "with the same error" if math.isfinite(self.error) else "errors are not comparable",
            True: "more exact",
            False: "less exact",
        }[self.closer]
        return f"`{self.champion.name}` {pace} `{self.peer.name}`, {closeness} ({ours} against {theirs})."


def comparisons(outcome: Outcome) -> list[Comparison]:
    """Our champion against every peer of a work."""
    champion = outcome[outcome.work.champion]
    return [
        Comparison(champion, m, outcome.ratio(champion.name, m.name), _over(champion.error, m.error), outcome.work.unit)
        for m in outcome.measurements
        if not m.ours
    ]


def header(outcome: Outcome) -> tuple[str, ...]:
    """Names of the columns of `rows`. There is no rate for a single thing."""
    rate = () if outcome.work.items == 1 else ("rate",)
    return ("variant", "time, ms", "quartiles, ms", *rate, "cores", "error", *outcome.measurements[0].also, "note")


def rows(outcome: Outcome) -> list[tuple[str, ...]]:
    """The table of a work, cells as text, in the order of `header`."""
    work = outcome.work
    table: list[tuple[str, ...]] = []
    for m in outcome.measurements:
        spread = m.seconds
        rate = () if work.items == 1 else (_rate(work.items / spread.median, work.item),)
        quartiles = f"{_ms(spread.low)}–{_ms(spread.high)}"
        error = quantity(m.error, work.unit, 2)
        also = (quantity(value, digits=2) for value in m.also.values())
        table.append((m.name, _ms(spread.median), quartiles, *rate, f"{m.cores:.1f}", error, *also, m.note or "–"))
    return table


def plot(outcome: Outcome) -> Figure:
    """Error against time, in milliseconds; times alone where no variant has an error, or none is wrong at all."""
    names, seconds = [m.name for m in outcome.measurements], [m.seconds for m in outcome.measurements]
    ours = [m.ours for m in outcome.measurements]
    times, low, high = (
        [1e3 * value for value in each] for each in zip(*((s.median, s.low, s.high) for s in seconds), strict=True)
    )
    if not _errs(outcome):
        return times_alone(names, times, low, high, ours, time_unit="ms")
    errors = [m.error for m in outcome.measurements]
    return error_against_time(names, times, errors, low, high, ours, unit=outcome.work.unit, time_unit="ms")


def _errs(outcome: Outcome) -> bool:
    """Whether any variant is known to be wrong by anything."""
    return any(math.isfinite(m.error) and m.error > 0 for m in outcome.measurements)


def judged(outcomes: tuple[Outcome, ...]) -> Iterator[tuple[Outcome, Target, Spread, bool]]:
    """Every target with what was measured and whether it was met."""
    for outcome in outcomes:
        for target in outcome.work.targets:
            yield outcome, target, outcome.measured(target), outcome.met(target)


def figures(stage: Stage, outcomes: tuple[Outcome, ...], machine: Mapping[str, object]) -> dict[str, Any]:
    """All numbers of a stage, for `report.json`."""
    works = {
        o.work.name: {
            "what": o.work.what,
            "unit": o.work.unit,
            "error_name": o.work.error_name,
            "items": o.work.items,
            "opencv_threads": o.work.threads,
            "variants": {
                m.name: {
                    "ours": m.ours,
                    "seconds": m.seconds,
                    "samples": list(m.rounds.values()),
                    "cores": m.cores,
                    "error": m.error,
                    "also": m.also,
                    "note": m.note,
                }
                for m in o.measurements
            },
            "verdicts": {c.peer.name: {"verdict": c.verdict, "time_ratio": c.time} for c in comparisons(o)},
            "targets": [{"words": t.words, "limit": t.limit, "ratio": r, "met": met} for _, t, r, met in judged((o,))],
        }
        for o in outcomes
    }
    return {"stage": stage.name, "setting": stage.setting, "machine": machine, "works": works, "notes": stage.notes}


def page(stage: Stage, outcomes: tuple[Outcome, ...], machine: Mapping[str, object], record: Record) -> Report:
    """The stage as a report page."""
    report = Report(f"Benchmark: {stage.title}", stage.lead, "rainstereo bench")
    promises = list(judged(outcomes))
    missed = [target.words for _, target, _, met in promises if not met]
    if missed:
        report.verdict(
            "warn", f"{len(missed)} of {len(promises)} targets missed: {'; '.join(missed)}.", "Not there yet."
        )
    elif promises:
        report.verdict("good", f"all {len(promises)} targets met on this machine, in this run.", "On target:")
    report.tiles(*(_target_tile(target, ratio, met) for _, target, ratio, met in promises))
    for outcome in outcomes:
        work = outcome.work
        report.section(work.title, work.what)
        what = "Error against time" if _errs(outcome) else "Times"
        report.figure(plot(outcome), f"{what}. Blue: rainstereo; gray: others. Error: {work.error_name}.")
        strong = [i for i, m in enumerate(outcome.measurements) if m.name == work.champion]
        table: list[tuple[Cell, ...]] = [tuple(row) for row in rows(outcome)]
        columns = header(outcome)
        report.table(columns, table, _rounds_words(outcome), strong, numbers=range(1, len(columns) - 1))
    for picture in stage.pictures:
        report.figure(picture.draw(), picture.caption)
    report.section("Where rainstereo wins, and where it loses")
    for heading, sentences in _judgements(outcomes):
        report.text(f"{heading}:")
        report.bullets(sentences)
    notes = [*_busy(outcomes, machine), *stage.notes]
    if notes:
        report.section("Before you quote these figures")
        report.bullets(notes)
    report.details("Machine", machine)
    report.details("Setting", stage.setting)
    report.record(record)
    return report


def markdown(stage: Stage, outcomes: tuple[Outcome, ...], machine: Mapping[str, object], command: str) -> str:
    """The stage as a page of documentation; pictures lie beside it under the names of `write_pictures`."""
    lines = [f"# Benchmark: {stage.title}", "", stage.lead, ""]
    promises = list(judged(outcomes))
    if promises:
        lines += ["| target | measured (median; quartiles) | |", "| --- | --- | --- |"]
        lines += [
            f"| {t.words} | {_ratio_words(t, r)} | {'met' if met else '**missed**'} |" for _, t, r, met in promises
        ]
        lines.append("")
    for outcome in outcomes:
        work = outcome.work
        shown = "error against time" if _errs(outcome) else "times"
        lines += [f"## {work.title}", "", work.what, "", f"![{shown}]({picture_name(stage, outcome)})", ""]
        columns = header(outcome)
        lines += [f"| {' | '.join(columns)} |", f"| --- |{' ---: |' * (len(columns) - 2)} --- |"]
        lines += [f"| {' | '.join(_cell(cell) for cell in row)} |" for row in rows(outcome)]
        lines += ["", _rounds_words(outcome), ""]
    for picture in stage.pictures:
        lines += [f"![{picture.name}]({stage.name}-{picture.name}.svg)", "", picture.caption, ""]
    for heading, sentences in _judgements(outcomes):
        lines += [f"## {heading}", "", *(f"- {sentence}" for sentence in sentences), ""]
    lines += [
        "## Before you quote these figures",
        "",
        *(f"- {note}" for note in (*_busy(outcomes, machine), *stage.notes)),
        "",
    ]
    setting = "; ".join(f"{name}: {value}" for name, value in stage.setting.items())
    packages = ", ".join(f"{name} {version}" for name, version in versions().items())
    lines += ["## How to repeat it", "", "```", command, "```", ""]
    lines += [
        f"- {setting}",
        f"- {machine['processor']}, {machine['cores']} cores, {machine['system']}",
        f"- {packages}",
    ]
    return "\n".join(lines) + "\n"


def picture_name(stage: Stage, outcome: Outcome) -> str:
    """File name of the plot of a work."""
    return f"{stage.name}-{outcome.work.name}.svg"


def write_pictures(stage: Stage, outcomes: tuple[Outcome, ...], folder: Path) -> list[Path]:
    """Write the plot of each work, and the stage's own pictures, into `folder`."""
    drawn = [(picture_name(stage, o), plot(o)) for o in outcomes]
    drawn += [(f"{stage.name}-{picture.name}.svg", picture.draw()) for picture in stage.pictures]
    return [write_atomically(folder / name, to_svg(figure).encode()) for name, figure in drawn]


def plain_table(outcome: Outcome) -> str:
    """The table of a work for a terminal."""
    table = [header(outcome)[:-1], *(row[:-1] for row in rows(outcome))]
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = [
        "  ".join(c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True)))
        for row in table
    ]
    return "\n".join([outcome.work.title, *lines])


def _judgements(outcomes: tuple[Outcome, ...]) -> Iterator[tuple[str, list[str]]]:
    every = [(outcome, comparison) for outcome in outcomes for comparison in comparisons(outcome)]
    several = len(outcomes) > 1
    headings = {
        "wins": "Where rainstereo wins",
        "ties": "Where it makes no difference",
        "trades": "Where it is time against error",
        "loses": "Where rainstereo loses",
    }
    for verdict, heading in headings.items():
        found = [f"{o.work.title}: {c.words}" if several else c.words for o, c in every if c.verdict == verdict]
        if found or verdict in ("wins", "loses"):
            yield heading, found or ["Against none of the variants measured here."]


def _target_tile(target: Target, ratio: Spread, met: bool) -> Tile:
    return Tile(target.words, short_words(target, ratio), "", "met" if met else "missed")


def short_words(target: Target, measured: Spread) -> str:
    """The median of what a target is about."""
    if target.against is None:
        return quantity(measured.median, "s")
    return f"{1 / measured.median:.3g} x as fast" if target.limit < 1 else f"{measured.median:.3g} x the time"


def _ratio_words(target: Target, ratio: Spread) -> str:
    if target.against is None:
        return f"{quantity(ratio.median)} s ({quantity(ratio.low)}–{quantity(ratio.high)})"
    if target.limit < 1:
        return f"{1 / ratio.median:.3g} x as fast ({1 / ratio.high:.3g}–{1 / ratio.low:.3g})"
    return f"{ratio.median:.3g} x the time ({ratio.low:.3g}–{ratio.high:.3g})"


def _rounds_words(outcome: Outcome) -> str:
    counts = sorted({len(m.rounds) for m in outcome.measurements}, reverse=True)
    some = f" (slow variants: {', '.join(map(str, counts[1:]))})" if counts[1:] else ""
    return f"Medians of {counts[0]} interleaved rounds{some}. Error: {outcome.work.error_name}."


def _rate(per_second: float, item: str) -> str:
    for prefix, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if per_second >= size:
            return f"{quantity(per_second / size)} {prefix} {item}/s"
    return quantity(per_second, f"{item}/s")


def _busy(outcomes: tuple[Outcome, ...], machine: Mapping[str, object]) -> list[str]:
    """A warning where others used the machine too: by its load before, or by the share of a core that we were given."""
    load, cores = machine.get("load"), machine.get("cores")
    share = min((m.cores for outcome in outcomes for m in outcome.measurements), default=1.0)
    loaded = isinstance(load, float) and isinstance(cores, int) and load > 0.6 * cores
    if not loaded and share > 0.9:
        return []
    return [
        f"The machine was busy with other things (load {load} on {cores} cores before, and down to {share:.1f} of a "
        "core for us): trust the ratios, not the times."
    ]


def _over(ours: float, theirs: float) -> float:
    if not (math.isfinite(ours) and math.isfinite(theirs)):
        return math.nan
    if theirs == 0:
        return 1.0 if ours == 0 else math.inf
    return ours / theirs


def _ms(seconds: float) -> str:
    return quantity(1e3 * seconds)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
