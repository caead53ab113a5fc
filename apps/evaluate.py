"""`rainstereo evaluate`: how much restoring helps, as the paper's tables, on a user's own data."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.evaluation_page import evaluation_page, plain_table
from rainstereo.apps.evaluation_scores import Note, score_set, totals
from rainstereo.apps.evaluation_sets import RenderedRain, find
from rainstereo.apps.progress_bar import progress_bar
from rainstereo.apps.run_record import Record, versions


@dataclass(frozen=True)
class Options:
    """PSNR and SSIM of rainy images before and after de-raining, per image and in total, in RGB and in luma.

    Sets are folders in the layout of Qian et al. (data/ and gt/), of RobotCar-rainy (left_T, right_T), aligned pairs of
    this toolkit (dry/ and wet/, or manifest.csv), or clear images, such as CamVid's, on which rain is rendered at a
    PSNR. Intermediate images stay in OUT/SET; a run that was interrupted goes on.
    """

    what: Annotated[tyro.conf.Positional[Literal["restoration"]], tyro.conf.arg(metavar="restoration")]
    """What to evaluate. Segmentation has options of its own: see rainstereo evaluate segmentation --help."""
    sets: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="SET")]
    """FOLDER, or LAYOUT:FOLDER with qian, robotcar, pairs or camvid."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/evaluation")
    """Folder to write: OUT/report.html, OUT/report.json, OUT/SET/rainy, OUT/SET/derained."""
    checkpoint: Path | None = None
    """Weights in place of those of the package."""
    device: str = "auto"
    """auto, cpu, cuda."""
    precision: Literal["auto", "float32", "bf16", "float16"] = "auto"
    """auto takes what the device multiplies fastest."""
    backend: Literal["torch", "onnx"] = "torch"
    """What runs the network."""
    skip: bool = True
    """Whether cells without drops are left as they are, as rainstereo derain does it."""
    preset: str = "camvid"
    """Rain that is rendered on clear images: see rainstereo rain."""
    psnr: float = 16.9
    """Its severity, dB: the paper's raw CamVid set has 16.89."""
    seed: int = 0
    """Decides the rendered rain, and what the bootstrap draws."""
    limit: int = 0
    """Images of each set, evenly over it; 0: all."""
    worst: int = 4
    """Images with the least gain that the report shows, of each set."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""


def run(options: Options) -> int:
    """Evaluate; 0, or 1 if an image could not be scored."""
    record = Record("evaluate", options)
    if options.limit < 0 or options.worst < 0:
        raise ValueError(f"--limit {options.limit} --worst {options.worst} were given; expected 0 or more")
    sets = find(options.sets, options.limit)
    rain = RenderedRain(options.preset, options.psnr, options.seed)
    rain.renderer()  # says what is wrong with it
    from rainstereo.model.metrics import PROTOCOL
    from rainstereo.model.restore import Restorer, leaves_out, opened

    made = Restorer(options.checkpoint, options.device, options.precision, skip=options.skip, backend=options.backend)
    name, weights = _weights(options) if options.backend == "onnx" else _identity(opened(options.checkpoint))
    made_with = [v for k, v in versions().items() if k in ("rainstereo", "torch", "opencv")]
    skipped = leaves_out() if options.skip else ""
    key = hashlib.sha256(repr((weights, made.network.name, skipped, rain, made_with)).encode()).hexdigest()[:16]
    console = Console(stderr=True)
    notes: dict[str, list[Note]] = {}
    with progress_bar(console) as told:
        for one in sets:
            notes[one.name] = score_set(one, made, rain, options.out, key, told)
    means = {one.name: totals(notes[one.name], options.seed) for one in sets}
    record["protocol"], record["network"], record["checkpoint"] = PROTOCOL, made.network.name, name
    record["sets"] = {
        one.name: {"layout": one.layout, "images": len(one.samples), "total": means[one.name], "each": notes[one.name]}
        for one in sets
    }
    wrong = [(one.name, note) for one in sets for note in notes[one.name] if note["status"] != "ok"]
    record.status = "incomplete" if wrong else "ok"
    page = evaluation_page(sets, notes, means, record, PROTOCOL, f"{name}, {made.network.name}", options.worst)
    page.write(options.out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures)
    record.write(options.out / "report.json")
    print(plain_table(sets, means))
    print(PROTOCOL)
    for where, note in wrong:
        console.print(f"not scored: {where}/{note['name']}: {note['reason']}", soft_wrap=True, highlight=False)
    console.print(f"see {options.out / 'report.html'}", soft_wrap=True)
    return FAILED if wrong else DONE


def _identity(found: object) -> tuple[str, str]:
    path, card = getattr(found, "path", Path()), getattr(found, "card", {})
    return path.name, str(card.get("sha256", ""))


def _weights(options: Options) -> tuple[str, str]:
    path = options.checkpoint or Path()
    return path.name, hashlib.sha256(path.read_bytes()).hexdigest()
