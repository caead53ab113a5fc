"""A training run: steps, checkpoints, validation and the record of both, from a recipe; it goes on where it stopped."""

from __future__ import annotations

import csv
import dataclasses
import gc
import math
import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from rainstereo.model import checkpoint
from rainstereo.model.augmentation import Augmentation
from rainstereo.model.dataset import WHOLE, Batch, Rain, Sample, Steps, Windows, loader, whole
from rainstereo.model.image_batch import INPUT
from rainstereo.model.misalignment import misaligned
from rainstereo.model.pair_folders import Item, find
from rainstereo.model.recipe import Recipe, parse, plain
from rainstereo.model.train_step import Stepped, Trainer

STATES, LOSSES, VALIDATION = "checkpoints", "losses.csv", "validation.csv"
MOST_SKIPPED = 100
"""Batches in a row from which nothing could be learnt."""
FREE = ("steps", "minutes", "name", "notes", "keep", "data.workers", "data.align", "data.val", "compute.threads")
"""Keys of a recipe that may change when a run goes on."""


class Listener(Protocol):
    """Who is told how a run goes."""

    def began(self, run: Run) -> None:
        """All is ready; the first step comes next."""

    def stepped(self, run: Run, found: Stepped) -> None:
        """After each step."""

    def validated(self, run: Run, found: Mapping[str, float], samples: list[tuple[Sample, Tensor]]) -> None:
        """After each validation: means, and some images with what the generator made of them."""

    def said(self, words: str) -> None:
        """Something that the user should know."""


@dataclass
class Run:
    """A run as it stands."""

    recipe: Recipe
    out: Path
    trainer: Trainer
    items: list[Item]
    validation: list[Item]
    elapsed: float = 0.0
    """Seconds of training, earlier parts among them; validation and what is written count, too."""
    waited: float = 0.0
    """Seconds of them in which a step waited for data, since the last start."""
    begun_at: int = 0
    """Steps that had been done at the last start."""
    begun_share: float = 0.0
    """`progress` then."""
    best: float = -math.inf
    """PSNR of the best validation."""
    latest: dict[str, float] = field(default_factory=dict)
    """Of the latest validation."""
    unlearnt: dict[str, int] = field(default_factory=dict)
    """Names of images whose batches were skipped, and how often."""

    @property
    def progress(self) -> float:
        """Share of the run that is over."""
        share = self.trainer.done / self.recipe.steps
        return max(share, self.elapsed / (60 * self.recipe.minutes)) if self.recipe.minutes else share


def fit(recipe: Recipe, out: Path, listener: Listener) -> Run:
    """Train until the recipe's end; goes on from the latest whole checkpoint in `out`.

    Under torchrun each process takes its share of every batch. Writes, in `out`: checkpoints/, model.safetensors
    (latest), best.safetensors (of the best validation), losses.csv, validation.csv.
    ValueError where the recipe and what is in `out` do not fit; RuntimeError where nothing can be learnt.
    """
    with processes() as (rank, world, device):
        return _fit(recipe, out, listener, rank, world, _device(recipe, device))


def _fit(recipe: Recipe, out: Path, listener: Listener, rank: int, world: int, device: torch.device) -> Run:
    if recipe.compute.threads:
        torch.set_num_threads(recipe.compute.threads)
    items, validation = find(recipe.data.train), find(recipe.data.val)
    if recipe.data.align != "skip" and rank == 0:
        _look_for_shifts(recipe, [*items, *validation], listener)
    on_device = device.type != "cpu"
    windows = Windows(items, recipe.data, recipe.rain, None if on_device else recipe.augment, recipe.seed)
    augmentation = Augmentation(recipe.augment) if on_device else None
    run = Run(recipe, out, Trainer(recipe, device, rank, world), items, validation)
    _resume(run, listener)
    run.begun_at, run.begun_share = run.trainer.done, run.progress
    log = _Table(out / LOSSES, rank == 0)
    log.cut(run.trainer.done)
    validator = _Validator(run, listener, rank == 0, windows)
    listener.began(run)
    steps = Steps(run.trainer.done, recipe.steps, recipe.optimizer.batch, rank, world)
    batches = iter(loader(windows, steps, recipe.data.workers, pin=device.type == "cuda"))
    clock, in_a_row = time.monotonic(), 0
    before = run.elapsed
    while not _over(run, device):
        waiting = time.monotonic()
        batch: Batch = next(batches)
        run.waited += time.monotonic() - waiting
        if augmentation is not None:
            batch = augmented(batch, augmentation, device)
        found = run.trainer.step(batch, run.progress)
        run.elapsed = before + time.monotonic() - clock
        done = run.trainer.done
        in_a_row = in_a_row + 1 if found.skipped else 0
        if found.skipped:
            _count_skipped(run, batch, found, in_a_row)
        if _due(done, recipe.keep.log) or done == recipe.steps:
            now = {"step": done, "elapsed_s": round(run.elapsed, 3), "rate": run.trainer.rate(run.progress)}
            log.add({**now, **found.losses})
        listener.stepped(run, found)
        if _due(done, recipe.keep.validate):
            validator.look()
        if _due(done, recipe.keep.checkpoint):
            keep(run, rank)
    if not _due(run.trainer.done, recipe.keep.validate) and run.trainer.done > run.begun_at:
        validator.look()
    keep(run, rank)
    return run


def keep(run: Run, rank: int = 0) -> None:
    """Write a checkpoint to go on from, and the generator as it stands."""
    tensors, values = run.trainer.state()
    if rank:
        return
    # paths in full, for whoever goes on
    card = card_of(run) | {"state": values, "recipe": _without_none(plain(run.recipe))}
    folder = run.out / STATES
    checkpoint.save(checkpoint.numbered(folder, run.trainer.done), tensors, card)
    checkpoint.rotate(folder, run.recipe.keep.keep)
    _write_model(run, "model")


def card_of(run: Run) -> dict[str, Any]:
    """What a checkpoint's card says of the run."""
    recipe, trainer = run.recipe, run.trainer
    return {
        "name": recipe.name or run.out.name,
        "notes": recipe.notes or None,
        "architecture": recipe.architecture,
        "config": dataclasses.asdict(trainer.config),
        "input": INPUT,
        "steps": trainer.done,
        "batch": recipe.optimizer.batch,
        "elapsed_s": round(run.elapsed, 3),
        "skipped": trainer.skipped,
        "seed": recipe.seed,
        "device": str(trainer.device),
        "processes": trainer.world,
        "perceptual_features": trainer.features,
        "training_images": len({item.clear for item in run.items}),
        "metrics": {"best_psnr": run.best if math.isfinite(run.best) else None, **run.latest},
        "recipe": _without_none(_by_name(plain(recipe))),
    }


def augmented(batch: Batch, augmentation: Augmentation, device: torch.device) -> Batch:
    """The batch on the device, its windows augmented there, each from its own seed."""
    tensors = (t.to(device, non_blocking=True) for t in (batch.rainy, batch.clear, batch.mask))
    parts = [augmentation(a, b, c, seed) for a, b, c, seed in zip(*tensors, batch.seeds, strict=True)]
    rainy, clear, mask = map(torch.stack, zip(*parts, strict=True))
    return dataclasses.replace(batch, rainy=rainy, clear=clear, mask=mask)


@contextmanager
def processes() -> Iterator[tuple[int, int, str]]:
    """This process's rank, how many there are, and its device, where torchrun has set it; joined while it lasts."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield 0, 1, "cuda" if torch.cuda.is_available() else "cpu"
        return
    rank, local = int(os.environ["RANK"]), int(os.environ.get("LOCAL_RANK", "0"))
    device = f"cuda:{local}" if torch.cuda.is_available() else "cpu"
    torch.distributed.init_process_group("nccl" if device != "cpu" else "gloo")
    try:
        yield rank, world, device
        torch.distributed.barrier()  # they leave together
    finally:
        gc.collect()  # wrapped networks: a process that ends with one may be aborted (`terminate called`, torch 2.13)
        torch.distributed.destroy_process_group()


# -- parts of a run ----------------------------------------------------------------------------------------------------


def _look_for_shifts(recipe: Recipe, items: list[Item], listener: Listener) -> None:
    shifted = misaligned(items)
    if not shifted:
        return
    worst = max(shifted, key=lambda s: s.pixels)
    words = (
        f"{len(shifted)} of the pairs that were looked at are shifted, such as {worst.rainy} by {worst.dx:+.1f}, "
        f"{worst.dy:+.1f} pixels against {worst.clear}"
    )
    if recipe.data.align == "refuse":
        raise ValueError(f'{words}; align them (rainstereo align), or set data.align = "warn"')
    listener.said(words)


def _device(recipe: Recipe, found: str) -> torch.device:
    name = found if recipe.compute.device == "auto" else recipe.compute.device
    try:
        device = torch.empty(1, device=name).device  # by its number, also where none was given
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"compute.device {name!r} cannot be used here: {error}; try 'auto' or 'cpu'") from error
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device


def _over(run: Run, device: torch.device) -> bool:
    """Whether all processes are to stop: the first one's clock counts."""
    if run.trainer.done >= run.recipe.steps:
        return True
    minutes, enough = run.recipe.minutes, run.recipe.keep.enough
    if not minutes and not enough:
        return False
    over = bool(minutes and run.elapsed >= 60 * minutes) or bool(enough and run.best >= enough)
    if run.trainer.world > 1:
        flag = torch.tensor([int(over)], device=device)
        torch.distributed.broadcast(flag, 0)
        over = bool(flag.item())
    return over


def _resume(run: Run, listener: Listener) -> None:
    for step, found in checkpoint.latest(run.out / STATES):
        if isinstance(found, checkpoint.DamagedCheckpointError):
            listener.said(f"not used: {found}")
            continue
        _same_recipe(run.recipe, found, run.out)
        run.trainer.restore(found.tensors, found.card["state"])
        run.elapsed = float(found.card["elapsed_s"])
        metrics = dict(found.card.get("metrics", {}))
        run.best = float(metrics.pop("best_psnr", -math.inf))
        run.latest = metrics
        listener.said(f"goes on after step {step}, from {found.path}")
        return


def _same_recipe(recipe: Recipe, found: checkpoint.Checkpoint, out: Path) -> None:
    """ValueError where a run was begun by a recipe that differs in what matters."""
    earlier = _flat(plain(parse(found.card["recipe"])))
    now = _flat(plain(recipe))
    other = [
        key for key in sorted(earlier.keys() | now.keys())
        if earlier.get(key) != now.get(key) and not any(key == free or key.startswith(f"{free}.") for free in FREE)
    ]  # fmt: skip
    if other:
        key = other[0]
        raise ValueError(
            f"{out} holds a run whose recipe differs in {', '.join(other)} ({key} was {earlier.get(key)!r}, is "
            f"{now.get(key)!r}); give another --out, or the same recipe"
        )


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found


def _by_name(recipe: dict[str, Any]) -> dict[str, Any]:
    """Without the folders that only this machine has."""

    def short(path: str) -> str:
        return "/".join(Path(path).parts[-2:]) if path else ""

    data = dict(recipe["data"])
    for split in ("train", "val"):
        data[split] = [
            {**s, "folder": short(s["folder"]), "clear": short(s["clear"]), "rainy": [short(p) for p in s["rainy"]]}
            for s in data[split]
        ]
    return {**recipe, "data": data, "start": short(recipe["start"]), "vgg": Path(recipe["vgg"]).name}


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    """TOML has no null; the recipe's reader takes "none"."""
    return {
        key: _without_none(value) if isinstance(value, Mapping) else "none" if value is None else value
        for key, value in table.items()
    }


def _due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _count_skipped(run: Run, batch: Batch, found: Stepped, in_a_row: int) -> None:
    for name in batch.names:
        run.unlearnt[name] = run.unlearnt.get(name, 0) + 1
    where = f"step {run.trainer.done}: {found.skipped} from {', '.join(batch.names)}"
    if run.recipe.keep.not_finite == "stop":
        raise RuntimeError(f'{where}; keep.not_finite = "skip" would go on without such batches')
    if in_a_row >= MOST_SKIPPED:
        raise RuntimeError(f"{where}, as from the {in_a_row - 1} batches before; lower optimizer.rate, or look at them")


def _write_model(run: Run, name: str) -> None:
    storage = torch.float16 if run.recipe.keep.storage == "float16" else None
    checkpoint.save(run.out / f"{name}{checkpoint.SUFFIX}", run.trainer.best, card_of(run), storage=storage)


class _Table:
    """A CSV file that grows by rows, whose first column is the step."""

    def __init__(self, path: Path, writes: bool) -> None:
        self.path, self.writes = path, writes

    def cut(self, step: int) -> None:
        """Forget rows after a step: they will come again."""
        if not self.writes or not self.path.is_file():
            return
        lines = self.path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line in lines[1:] if line.endswith("\n") and int(line.split(",", 1)[0]) <= step]
        partial = self.path.with_name(f".{self.path.name}.partial")
        partial.write_text("".join([*lines[:1], *kept]), encoding="utf-8")
        partial.replace(self.path)

    def add(self, row: Mapping[str, Any]) -> None:
        """A row; numbers in full."""
        if not self.writes:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        columns = list(row)
        fresh = not self.path.is_file() or self.path.stat().st_size == 0
        if not fresh:
            with self.path.open(encoding="utf-8", newline="") as file:
                columns = next(csv.reader(file))
        with self.path.open("a", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore", lineterminator="\n")
            if fresh:
                writer.writeheader()
            writer.writerow({key: repr(value) if isinstance(value, float) else value for key, value in row.items()})


class _Validator:
    """Looks at held-out pairs, the same each time."""

    def __init__(self, run: Run, listener: Listener, looks: bool, windows: Windows) -> None:
        self.run, self.listener, self.looks = run, listener, looks
        self.windows = windows if run.recipe.data.only else None
        recipe, count = run.recipe, len(run.validation)
        most = min(recipe.keep.val_limit or count, count)
        self.items = [run.validation[i * count // most] for i in range(most)] if most else []
        self.rain = Rain(recipe.rain) if any(not item.rainy for item in self.items) else None
        self.samples: list[Sample] = []
        self.table = _Table(run.out / VALIDATION, looks)
        self.table.cut(run.trainer.done)

    def look(self) -> None:
        """Validate, and keep the generator if it is the best so far."""
        run = self.run
        if not self.looks or not (self.items or self.windows):
            return
        if not self.samples and self.windows is not None:
            self.samples = [self.windows[i] for i in range(run.recipe.data.only)]
        elif not self.samples:
            self.samples = [
                whole(item, self.rain, _seed(run.recipe.seed, i), run.recipe.keep.val_crop)
                for i, item in enumerate(self.items)
            ]
        generator = run.trainer.best
        restored = [derain(generator, sample.rainy, run.trainer.device) for sample in self.samples]
        raw = [psnr(s.rainy, s.clear) for s in self.samples]
        psnrs = [psnr(image, s.clear) for image, s in zip(restored, self.samples, strict=True)]
        found = {"psnr": float(np.mean(psnrs)), "psnr_raw": float(np.mean(raw)), "images": len(psnrs)}
        run.latest = found
        self.table.add({"step": run.trainer.done, "elapsed_s": round(run.elapsed, 3)} | found)
        if found["psnr"] > run.best:
            run.best = found["psnr"]
            _write_model(run, "best")
        self.listener.validated(run, found, list(zip(self.samples, restored, strict=True)))


def _seed(seed: int, index: int) -> int:
    return int(np.random.SeedSequence([seed, WHOLE, index]).generate_state(1, np.uint32)[0])


@torch.no_grad()
def derain(generator: nn.Module, rainy: Tensor, device: torch.device) -> Tensor:
    """(3, H, W) of an image, by a generator in eval mode, on the processor; its mode stays as it was."""
    training = generator.training
    generator.eval()
    try:
        found: Tensor = generator(rainy[None].to(device))[0].float().cpu().clamp(0, 1)
    finally:
        generator.train(training)
    return found


def psnr(image: Tensor, truth: Tensor) -> float:
    """dB over RGB, after rounding to 8 bits; 99 where they agree."""
    squares = ((image.mul(255).round() - truth.mul(255).round()) ** 2).double().mean()
    return float(10 * torch.log10(255**2 / squares)) if squares > 0 else 99.0
