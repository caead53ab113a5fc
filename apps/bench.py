"""`rainstereo bench`: time and error of each way to do the same work, as numbers, pictures and words."""

from __future__ import annotations

import dataclasses
import importlib
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from rainstereo.apps import bench_page
from rainstereo.apps.bench_harness import SINGLE_THREAD, Outcome, Stage, machine, measure, steps
from rainstereo.apps.run_record import Record, write_atomically

STAGES: dict[str, str] = {
    "refraction": "rainstereo.apps.bench_refraction",
    "warp": "rainstereo.apps.bench_warp",
    "calibration": "rainstereo.apps.bench_calibration",
    "cavity": "rainstereo.apps.bench_cavity",
    "guidance": "rainstereo.apps.bench_guidance",
    "slab": "rainstereo.apps.bench_slab",
    "slab-images": "rainstereo.apps.bench_slab_images",
    "drops": "rainstereo.apps.bench_drops",
    "rain": "rainstereo.apps.bench_rain",
    "align": "rainstereo.apps.bench_align",
    "record": "rainstereo.apps.bench_record",
    "select": "rainstereo.apps.bench_select",
    "train": "rainstereo.apps.bench_train",
    "derain": "rainstereo.apps.bench_derain",
    "cuda": "rainstereo.apps.bench_cuda",
}
"""Stage -> module with `build(seed, quick) -> Stage`."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Measure every way to do the same work: run time beside error, interleaved repeats, median and spread.

    For each stage it writes OUT/STAGE/report.json (all samples), report.html, a Markdown table and a plot of error
    against time; OUT/report.json sums up.
    """

    stage: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="STAGE")]
    """What: refraction, warp, calibration, slab, slab-images, cavity, guidance, drops, rain, align, record, select,
    train, derain, cuda (where there is a GPU), or all."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/bench")
    """Folder for the results."""
    repeats: int = 15
    """Rounds in which every variant runs once (slow ones run in fewer)."""
    seed: int = 0
    """Seed of everything that is drawn at random."""
    quick: bool = False
    """Little work and at most 3 rounds: does it run, rather than how fast."""
    cavity: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Images for stage cavity: OpenPTV's set, cam1.png to cam4.png with its .ori files. `all` skips it without."""
    images: Path | None = None
    """Photographs, of which none taught the weights, for the stage derain; one of scikit-image's without it."""
    only: tuple[str, ...] = ()
    """Only these works of the stage, by the names that their pictures have (rain-still.svg: still)."""
    docs: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write STAGE.md and its pictures into this folder, as in docs/benchmarks."""


def run(options: Options) -> int:
    """Run the stages that are asked for. Returns 0, whether or not targets are met: figures are no failure."""
    names = [options.stage]
    if options.stage == "all":
        left = {"cavity"} if options.cavity is None else set()
        left |= set() if _has_cuda() else {"cuda"}
        names = [name for name in STAGES if name not in left]
    for name in names:
        if name not in STAGES:
            raise ValueError(f"there is no stage {name!r}; expected one of {', '.join(STAGES)}, or all")
    if options.images is not None and "derain" not in names:
        raise ValueError(f"--images is for the stage derain; {options.stage} measures without any")
    if options.only and options.stage == "all":
        raise ValueError(f"--only {' '.join(options.only)} names works of one stage; all stages were asked for")
    if options.repeats < 1:
        raise ValueError(f"--repeats is {options.repeats}; expected 1 or more")
    if any(os.environ.get(name) != value for name, value in SINGLE_THREAD.items()):
        return _run_on_one_thread(options)
    record = Record("bench", options)
    summary = {name: _run_stage(name, options) for name in names}
    record["stages"] = summary
    record["machine"] = machine()
    record.write(options.out / "report.json")
    return 0


def _has_cuda() -> bool:
    from rainstereo.apps import bench_cuda  # which needs torch

    return bench_cuda.is_there()


def command(options: Options, stage: str) -> str:
    """The command line that repeats a stage."""
    return shlex.join(["rainstereo", *_arguments(options, stage)])


def _arguments(options: Options, stage: str) -> list[str]:
    words = ["bench", stage, "--repeats", str(options.repeats), "--seed", str(options.seed)]
    words += ["--quick"] if options.quick else []
    words += ["--cavity", str(options.cavity)] if options.cavity is not None else []
    words += ["--images", str(options.images)] if options.images else []
    words += ["--only", *options.only] if options.only else []
    words += ["--out", str(options.out)]
    return words if options.docs is None else [*words, "--docs", str(options.docs)]


def _run_on_one_thread(options: Options) -> int:
    """Numerical libraries read their thread settings when they are loaded, so the work goes to a fresh process."""
    arguments = [sys.executable, "-m", "rainstereo.apps.cli", *_arguments(options, options.stage)]
    return subprocess.run(arguments, env={**os.environ, **SINGLE_THREAD}, check=False).returncode


def _some(stage: Stage, names: tuple[str, ...]) -> Stage:
    """The stage with these works only; all if none is named."""
    known = [work.name for work in stage.works]
    if set(names) - set(known):
        raise ValueError(f"--only is {' '.join(names)}; the works of {stage.name} are {', '.join(known)}")
    some = tuple(work for work in stage.works if not names or work.name in names)
    return dataclasses.replace(stage, works=some)


def _run_stage(name: str, options: Options) -> dict[str, object]:
    record = Record("bench", options)
    before = machine()
    build = importlib.import_module(STAGES[name]).build
    given = {"cavity": options.cavity, "derain": options.images}.get(name)
    stage: Stage = _some(build(options.seed, options.quick, *([] if given is None else [given])), options.only)
    outcomes = _measure_all(stage, min(options.repeats, 3) if options.quick else options.repeats)
    for key, value in bench_page.figures(stage, outcomes, before).items():
        record[key] = value
    folder = options.out / name
    record.write(folder / "report.json")
    bench_page.page(stage, outcomes, before, record).write(folder / "report.html")
    text = bench_page.markdown(stage, outcomes, before, command(options, name))
    for place, file in ((folder, f"{name}.md"), (options.docs, f"{name}.md")):
        if place is not None:
            bench_page.write_pictures(stage, outcomes, place)
            write_atomically(place / file, text.encode())
    promises = list(bench_page.judged(outcomes))
    for outcome in outcomes:
        print(bench_page.plain_table(outcome), end="\n\n")
    for _, target, measured, met in promises:
        print(f"{'met   ' if met else 'MISSED'}  {target.words}: {bench_page.short_words(target, measured)}")
    print(f"see {folder / 'report.html'}")
    return {"targets": len(promises), "met": sum(met for *_, met in promises), "elapsed_s": round(record.elapsed, 1)}


def _measure_all(stage: Stage, repeats: int) -> tuple[Outcome, ...]:
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(stage.title, total=sum(steps(work, repeats) for work in stage.works))
        return tuple(
            measure(work, repeats, lambda words: progress.update(task, advance=1, description=words))
            for work in stage.works
        )
