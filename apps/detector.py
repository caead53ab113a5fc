"""`rainstereo detector`: trains the network that says where drops are, so that the rest can be skipped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tyro
from rich.console import Console

from rainstereo import imagefile
from rainstereo.apps.cli import DONE
from rainstereo.apps.progress_bar import progress_bar
from rainstereo.apps.rain_presets import ADHERENT
from rainstereo.apps.rain_sources import find
from rainstereo.apps.run_record import Record, versions, write_atomically
from rainstereo.types import Image

if TYPE_CHECKING:
    from rainstereo.model.augment import RandomAdherentRain
    from rainstereo.model.detector_training import Rained

MOST_BYTES = 200_000


@dataclass(frozen=True)
class Options:
    """Train the drop detector of `rainstereo derain` on clear images, on which drops are rendered.

    Writes NAME.safetensors and its card NAME.toml. About 25 minutes on a processor's core for the defaults. The same
    seed gives the same weights on one machine.
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """Clear images: files, folders or quoted globs; larger than 256 x 192 pixels."""
    banks: tuple[Path, ...] = ()
    """Folders that rainstereo rain made of these images, to learn from in place of rain on crops of them."""
    restored: tuple[Path, ...] = ()
    """Folders that rainstereo derain --no-skip made of the banks, in the same order: what can be mended is then what
    the detector looks for. Without them, all that the rain changed."""
    out: Path = Path("detector.safetensors")
    """File to write."""
    start: Path | None = None
    """Weights of an earlier run to go on with, in place of random ones."""
    steps: int = 4500
    """Training steps."""
    batch: int = 8
    """Crops in a step."""
    pool: int = 1300
    """Images, or parts of them, under rain that are kept in memory."""
    rate: float = 2e-3
    """Learning rate at most; less to go on with weights that know something."""
    seed: int = 0
    """Decides everything that is drawn at random."""


def run(options: Options) -> int:
    """Train; 0."""
    record = Record("detector", options)
    if not 0 < options.rate < 1:
        raise ValueError(f"--rate {options.rate:g} was given; expected more than 0, and less than 1")
    if options.out.suffix != ".safetensors":
        raise ValueError(f"--out {options.out} was given; expected a name that ends in .safetensors")
    for name, low in (("steps", 10), ("batch", 2), ("pool", 2), ("seed", 0)):
        if getattr(options, name) < low:
            raise ValueError(f"--{name} {getattr(options, name)} was given; expected {low} or more")
    from rainstereo.model import detector, detector_training
    from rainstereo.model.card import to_toml

    start = None if options.start is None else detector.load(options.start)
    named = {source.name: imagefile.read(source.path) for source in find(options.images) if not source.is_video}
    named = {name: image for name, image in named.items() if image.ndim == 3 and image.dtype == "uint8"}
    images = list(named.values())
    console, last = Console(stderr=True), {"rendering": 0, "reading": 0, "training": 0}
    with progress_bar(console) as told:

        def progress(what: str, done: int, total: int) -> None:
            told(what, done - last[what], total)
            last[what] = done

        rain: Callable[[int], Rained] | Sequence[RandomAdherentRain] = rains()
        pool = options.pool
        if options.banks:
            rain, many = banked(named, options.banks, options.restored, options.seed)
            pool = min(pool, many)
        recipe = detector_training.Recipe(options.steps, options.batch, pool, rate=options.rate, seed=options.seed)
        made = detector_training.train(images, rain, recipe, told=progress, start=start)
    data = detector.packed(made.network)
    if len(data) > MOST_BYTES:
        raise ValueError(f"the weights have {len(data)} bytes; expected {MOST_BYTES} at most")
    write_atomically(options.out, data)
    found = {"loss": made.loss, "gain_found": made.found, "cells_marked_falsely": made.false}
    card = {
        "name": "drop detector", "bytes": len(data), "training_images": len(images), "recipe": asdict(recipe),
        "rain": _rain(options), "worth": _worth(options, detector_training.MUCH),
        "held_out": found, "versions": {k: v for k, v in versions().items() if k in ("rainstereo", "torch")},
    }  # fmt: skip
    write_atomically(options.out.with_suffix(".toml"), to_toml(card).encode())
    record["held_out"], record["bytes"] = found, len(data)
    record.write(options.out.with_name(f"{options.out.stem}.report.json"))
    console.print(
        f"{options.out}: {len(data)} bytes; of what can be gained in held-out crops {100 * made.found:.0f} % is in "
        f"marked cells, of the cells without any {100 * made.false:.1f} % are marked",
        soft_wrap=True,
    )
    return DONE


def banked(
    named: dict[str, Image], banks: Sequence[Path], restored: Sequence[Path], seed: int
) -> tuple[Callable[[int], Rained], int]:
    """Images under rain, from folders of `rainstereo rain`, and the same restored, of `derain`, if any; and how many:
    each is met once before any is met again."""
    from rainstereo.model.detector_training import Rained

    if restored and len(restored) != len(banks):
        raise ValueError(f"--restored names {len(restored)} folders, --banks {len(banks)}; expected one for each")
    found = []
    for number, bank in enumerate(banks):
        rainy = {path.stem: path for path in sorted(bank.glob("*.png"))}
        both = [(name, rainy[name], number) for name in sorted(named.keys() & rainy.keys())]
        found += both
        if not both:
            raise ValueError(
                f"{bank} holds none of these images under rain; make them with rainstereo rain IMAGES --out {bank}"
            )
    order = np.random.default_rng(seed).permutation(len(found))

    def rained(number: int) -> Rained:
        name, rainy, bank = found[order[number % len(found)]]
        better = imagefile.read(restored[bank] / rainy.name) if restored else None
        given = Rained(named[name], imagefile.read(rainy), better)
        for path, image in ((rainy, given.rainy), (rainy.name, better)):
            if image is not None and image.shape != given.clear.shape:
                raise ValueError(f"{path} has not the size of the clear image {name}; make it again")
        return given

    return rained, len(found)


def _worth(options: Options, much: float) -> str:
    fall = "fall of the squared error by restoring" if options.restored else "squared change by rain"
    return f"{fall}, over {much:g} levels squared, at most 1"


def _rain(options: Options) -> str:
    if options.banks:
        return f"{len(options.banks)} folders of rainstereo rain: {', '.join(bank.name for bank in options.banks)}"
    return "RandomAdherentRain: adherent, drops, large; F/1.4 to F/12"


def rains() -> list[RandomAdherentRain]:
    """The rain that is trained on: drops from specks to a centimetre, sharp and blurred, few and many."""
    from rainstereo.model.augment import RandomAdherentRain

    return [
        RandomAdherentRain(ADHERENT, (0.02, 0.6), 0.9, 0.057, f_number=(2.0, 12.0), rays=2, p=1.0),
        RandomAdherentRain("drops", (0.02, 0.3), 0.9, 0.057, f_number=(2.0, 12.0), rays=2, p=1.0),
        RandomAdherentRain("large", (0.02, 0.4), 0.9, 0.057, f_number=(1.4, 8.0), rays=2, p=1.0),
    ]
