"""`rainstereo detector`: trains the network that says where drops are, so that the rest can be skipped."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console

from rainstereo import imagefile
from rainstereo.apps.cli import DONE
from rainstereo.apps.progress_bar import progress_bar
from rainstereo.apps.rain_presets import ADHERENT
from rainstereo.apps.rain_sources import find
from rainstereo.apps.run_record import Record, versions, write_atomically

if TYPE_CHECKING:
    from rainstereo.model.augment import RandomAdherentRain

MOST_BYTES = 200_000


@dataclass(frozen=True)
class Options:
    """Train the drop detector of `rainstereo derain` on clear images, on which drops are rendered.

    Writes NAME.safetensors and its card NAME.toml. About 20 minutes on a processor's core for the defaults. The same
    seed gives the same weights on one machine.
    """

    images: tyro.conf.Positional[tuple[str, ...]]
    """Clear images: files, folders or quoted globs; larger than 256 x 192 pixels."""
    out: Path = Path("detector.safetensors")
    """File to write."""
    steps: int = 4500
    """Training steps."""
    batch: int = 8
    """Crops in a step."""
    pool: int = 1300
    """Crops on which rain is rendered, once."""
    seed: int = 0
    """Decides everything that is drawn at random."""


def run(options: Options) -> int:
    """Train; 0."""
    record = Record("detector", options)
    if options.out.suffix != ".safetensors":
        raise ValueError(f"--out {options.out} was given; expected a name that ends in .safetensors")
    for name, low in (("steps", 10), ("batch", 2), ("pool", 2), ("seed", 0)):
        if getattr(options, name) < low:
            raise ValueError(f"--{name} {getattr(options, name)} was given; expected {low} or more")
    images = [imagefile.read(source.path) for source in find(options.images) if not source.is_video]
    images = [image for image in images if image.ndim == 3 and image.dtype == "uint8"]
    from rainstereo.model import detector, detector_training
    from rainstereo.model.card import to_toml

    recipe = detector_training.Recipe(options.steps, options.batch, options.pool, seed=options.seed)
    console, last = Console(stderr=True), {"rendering": 0, "training": 0}
    with progress_bar(console) as told:

        def progress(what: str, done: int, total: int) -> None:
            told(what, done - last[what], total)
            last[what] = done

        made = detector_training.train(images, rains(), recipe, told=progress)
    data = detector.packed(made.network)
    if len(data) > MOST_BYTES:
        raise ValueError(f"the weights have {len(data)} bytes; expected {MOST_BYTES} at most")
    write_atomically(options.out, data)
    found = {"loss": made.loss, "cells_found": made.found, "cells_marked_falsely": made.false}
    card = {
        "name": "drop detector", "bytes": len(data), "training_images": len(images), "recipe": asdict(recipe),
        "rain": "RandomAdherentRain: adherent, drops, large; F/1.4 to F/12; masks of the renderer, opacity above "
        f"{detector_training.VISIBLE:g}",
        "held_out": found, "versions": {k: v for k, v in versions().items() if k in ("rainstereo", "torch")},
    }  # fmt: skip
    write_atomically(options.out.with_suffix(".toml"), to_toml(card).encode())
    record["held_out"], record["bytes"] = found, len(data)
    record.write(options.out.with_name(f"{options.out.stem}.report.json"))
    console.print(
        f"{options.out}: {len(data)} bytes; of held-out cells with a drop {100 * made.found:.0f} % are found, of those "
        f"without one {100 * made.false:.1f} % marked",
        soft_wrap=True,
    )
    return DONE


def rains() -> list[RandomAdherentRain]:
    """The rain that is trained on: drops from specks to a centimetre, sharp and blurred, few and many."""
    from rainstereo.model.augment import RandomAdherentRain

    return [
        RandomAdherentRain(ADHERENT, (0.02, 0.6), 0.9, 0.057, f_number=(2.0, 12.0), rays=2, p=1.0),
        RandomAdherentRain("drops", (0.02, 0.3), 0.9, 0.057, f_number=(2.0, 12.0), rays=2, p=1.0),
        RandomAdherentRain("large", (0.02, 0.4), 0.9, 0.057, f_number=(1.4, 8.0), rays=2, p=1.0),
    ]
