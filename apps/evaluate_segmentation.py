"""`rainstereo evaluate segmentation`: what rain costs those who segment, and what de-raining gives back."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.evaluation_sets import RenderedRain
from rainstereo.apps.progress_bar import progress_bar
from rainstereo.apps.run_record import Record, versions
from rainstereo.apps.segmentation_networks import CONDITIONS, NETWORKS, Learner, score
from rainstereo.apps.segmentation_page import SetResult, plain_table, segmentation_page
from rainstereo.apps.segmentation_stages import Prepared, Stages, Told, digest

if TYPE_CHECKING:
    from rainstereo.model.restore import Restorer
    from rainstereo.model.segmentation import LabelledSet, Task
    from rainstereo.model.segmentation_training import Training


@dataclass(frozen=True)
class Options:
    """Segmentation under the paper's four conditions: REFERENCE, trained and tested on clear images; RAINY, trained on
    clear, tested on rainy ones; AUGMENTED, trained on clear and rainy, tested on rainy; DERAINED, trained on clear and
    derained, tested on derained.

    Rain is rendered on images with labels, and derained; a U-Net learns road markings, a DeepLab v3+ semantic classes.
    All that is made stays in OUT/SET; a run that was interrupted goes on, in the middle of a training, too.
    """

    sets: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK:FOLDER")]
    """markings:FOLDER or semantic:FOLDER. Folders: CamVid with 11 classes (train, trainannot, val, valannot; semantic
    only), CamVid or CamSeq with 32 (images, labels), Cityscapes (leftImg8bit, gtFine; semantic only)."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/segmentation")
    """Folder to write: OUT/report.html, OUT/report.json, OUT/SET/{rainy,derained,targets,networks,predicted}."""
    checkpoint: Path | None = None
    """De-raining weights in place of those of the package."""
    networks: Path | None = None
    """OUT of an earlier run, whose segmentation networks are used as they are; nothing is trained."""
    device: str = "auto"
    """auto, cpu, cuda."""
    precision: Literal["auto", "float32", "bf16", "float16"] = "auto"
    """Of de-raining; auto takes what the device multiplies fastest."""
    skip: bool = True
    """Whether cells without drops are left as they are, as rainstereo derain does it."""
    preset: str = "camvid"
    """Rain that is rendered: see rainstereo rain."""
    psnr: float = 16.9
    """Its severity, dB, met on every image: the paper's raw CamVid set has 16.89."""
    seed: int = 0
    """Decides the rain, the networks' first weights, what they see when, and what the bootstrap draws."""
    limit: int = 0
    """Images that teach, and images that test, at most, evenly over each set; 0: all."""
    width: int = 0
    """Scale wider images down to this many pixels across, before rain falls; 0: leave them."""
    steps: int = 4000
    """Of each of the three trainings."""
    batch: int = 8
    """Windows a step."""
    crop: int = 320
    """Pixels along a window's side; 0: whole images, which must then have one size."""
    base_channels: int = 32
    """Width of both networks at their finest scale."""
    rate: float = 1e-3
    """Learning rate at the start."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""


def run(options: Options) -> int:
    """Evaluate; 0, or 1 if an image could not be used."""
    record = Record("evaluate segmentation", options)
    if options.limit < 0 or options.width < 0 or 0 < options.width < 32:
        raise ValueError(
            f"--limit {options.limit} --width {options.width} were given; expected a limit of 0 or more, and a width "
            "of 0 or at least 32"
        )
    rain = RenderedRain(options.preset, options.psnr, options.seed)
    rain.renderer()  # says what is wrong with it
    from rainstereo.model.networks import pick_device
    from rainstereo.model.restore import Restorer, leaves_out, opened
    from rainstereo.model.segmentation_training import Training

    training = Training(options.steps, options.batch, options.crop, rate=options.rate, seed=options.seed)
    sets = _sets(options)
    pick_device(options.device)
    restorer = Restorer(options.checkpoint, options.device, options.precision, skip=options.skip)
    weights = opened(options.checkpoint)
    used = [v for k, v in versions().items() if k in ("rainstereo", "torch", "opencv")]
    identity = digest(weights.card.get("sha256"), restorer.network.name, leaves_out() if options.skip else "", used)
    console = Console(stderr=True)
    with progress_bar(console) as told:
        results = [
            _evaluate(options, name, task, found, rain, training, restorer, identity, told)
            for name, task, found in sets
        ]
    record["derainer"] = {
        "checkpoint": weights.path.name,
        "sha256": weights.card.get("sha256"),
        "on": restorer.network.name,
    }
    record["sets"] = {one.name: one.as_dict() for one in results}
    wrong = [(one.name, name, reason) for one in results for name, reason in one.failed.items()]
    record.status = "incomplete" if wrong else "ok"
    page = segmentation_page(results, record, f"{weights.path.name}, {restorer.network.name}")
    page.write(options.out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures)
    record.write(options.out / "report.json")
    print(plain_table(results))
    for where, name, reason in wrong:
        console.print(f"not used: {where}/{name}: {reason}", soft_wrap=True, highlight=False)
    console.print(f"see {options.out / 'report.html'}", soft_wrap=True)
    return FAILED if wrong else DONE


def _sets(options: Options) -> list[tuple[str, Task, LabelledSet]]:
    """(name, task, images with labels) of each that is asked for."""
    from rainstereo.model.segmentation import TASKS, classes, find

    found: list[tuple[str, Task, LabelledSet]] = []
    if not options.sets:
        raise ValueError("no set was given; name one, such as markings:FOLDER or semantic:FOLDER")
    for text in options.sets:
        given, colon, folder = text.partition(":")
        task = next((task for task in TASKS if task == given and colon), None)
        if task is None or not folder:
            raise ValueError(f"{text} was given; expected {' or '.join(f'{task}:FOLDER' for task in TASKS)}")
        one = find(Path(folder), options.limit)
        classes(task, one.layout)  # says what is wrong with it
        slug = f"{task}-" + (re.sub(r"[^A-Za-z0-9_.-]+", "-", Path(folder).resolve().name).strip(".-") or "set")
        if any(slug == name for name, _, _ in found):
            raise ValueError(
                f"{text} would be written to {slug}, as another set is; rename its folder, or give it once"
            )
        found.append((slug, task, one))
    return found


def _evaluate(
    options: Options, name: str, task: Task, found: LabelledSet, rain: RenderedRain, training: Training,
    restorer: Restorer, identity: str, told: Told,
) -> SetResult:  # fmt: skip
    from rainstereo.model.deeplab import DeepLabConfig
    from rainstereo.model.segmentation import classes, target
    from rainstereo.model.unet import UNetConfig

    out = options.out / name
    stages = Stages(
        out,
        options.width,
        rain,
        restorer,
        identity,
        lambda labels: target(labels, task, found.layout),
        f"{task} {found.layout}",
    )
    names = classes(task, found.layout)
    config: Any = (
        UNetConfig(1, options.base_channels) if task == "markings" else DeepLabConfig(len(names), options.base_channels)
    )
    learner = Learner(task, names, config, training, out / "networks", restorer.network.device)
    test, failed = stages.prepare(found.test, told, f"{task}: images that test")
    train: list[Prepared] = []
    if options.networks is None:
        train, more = stages.prepare(found.train, told, f"{task}: images that teach")
        failed |= more
    if not test or not (train or options.networks):
        reason = next(iter(failed.values()), "there are none")
        raise RuntimeError(f"no image of {name} could be used to {'learn from' if test else 'test on'}: {reason}")
    result = SetResult(name, task, found.layout, names, train, test, failed)
    for network_name in NETWORKS:
        if options.networks is None:
            network = learner.network(network_name, train, told)
        else:
            network = learner.loaded(network_name, _earlier(options.networks, task))
        for condition in CONDITIONS:
            if condition.network == network_name:
                result.scored[condition.name] = score(condition, network, learner, test, out, options.seed, told)
    return replace(result, cards=learner.cards)


def _earlier(folder: Path, task: str) -> Path:
    places = sorted(folder.glob(f"{task}-*/networks"))
    if len(places) != 1:
        raise ValueError(
            f"--networks {folder} holds {len(places)} folders {task}-*/networks; expected one: the OUT of a run on one "
            f"{task} set"
        )
    return places[0]
