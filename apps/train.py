"""`rainstereo train`: a de-raining network from a recipe, on this machine's processor or GPUs; it goes on after any
end."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from rainstereo import imagefile
from rainstereo.apps import train_pictures
from rainstereo.apps.canvas import to_png
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.report import Report, Tile
from rainstereo.apps.run_record import Record, write_atomically
from rainstereo.types import Image

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

    from rainstereo.model.dataset import Sample
    from rainstereo.model.recipe import Recipe
    from rainstereo.model.train import Run
    from rainstereo.model.train_step import Stepped


WINDOWS, ENOUGH = 4, 35.0
"""What --overfit learns, and to how many dB."""


@dataclass(frozen=True)
class Options:
    """Train a de-raining network as a recipe says. What the recipe leaves out is as in the paper.

    A run that was interrupted, even by kill -9, goes on from its latest checkpoint when it is repeated, and finds the
    same losses as if nothing had happened. On several GPUs: torchrun --nproc-per-node 4 -m rainstereo.apps.cli train
    RECIPE. See docs/training.md.
    """

    recipe: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECIPE.toml")]
    """TOML file; [[data.train]] is all that it must have."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the run; default: out/train/NAME, as the recipe's file is named."""
    overfit: bool = False
    """Check first whether it can learn at all: train on 4 windows only, without augmentation, until it derains them to
    35 dB (status 0) or the recipe's steps are over (status 1). Goes to OUT/overfit."""


def run(options: Options) -> int:
    """Train; 0 when the recipe's end was reached."""
    from rainstereo.model.recipe import read
    from rainstereo.model.train import fit

    recipe = read(options.recipe)
    out = Path("out/train") / options.recipe.stem if options.out is None else options.out
    if options.overfit:
        recipe, out = overfitting(recipe), out / "overfit"
    first = int(os.environ.get("RANK", "0")) == 0
    record = Record("train", options, seed=recipe.seed)
    watcher = Watcher(Console(stderr=True, quiet=not first), out, first)
    with watcher:
        done = fit(recipe, out, watcher)
    learnt = not options.overfit or done.best >= ENOUGH
    if first:
        note(record, done, watcher)
        record.status = "ok" if learnt else "failed"
        watcher.page(done, record).write(out / "report.html")
        record.write(out / "report.json")
        words = f", {done.latest['psnr']:.2f} dB from {done.latest['psnr_raw']:.2f}" if done.latest else ""
        watcher.console.print(f"{done.trainer.done} steps{words}: {out / 'model.safetensors'}", soft_wrap=True)
        if not learnt:
            watcher.console.print(
                f"4 windows were not learnt to {ENOUGH:g} dB; see {out / 'report.html'}", soft_wrap=True
            )
    return DONE if learnt else FAILED


def overfitting(recipe: Recipe) -> Recipe:
    """The recipe for 4 windows, always the same."""
    from rainstereo.model.recipe import AugmentOptions

    data = replace(recipe.data, only=WINDOWS, clear=0.0)
    optimizer = replace(recipe.optimizer, ema=0.0, schedule="constant")
    keep = replace(recipe.keep, enough=ENOUGH, validate=50, log=min(recipe.keep.log or 10, 10))
    return replace(recipe, data=data, optimizer=optimizer, keep=keep, augment=AugmentOptions(flip=0.0))


def note(record: Record, done: Run, watcher: Watcher) -> None:
    """What a run did, for its report."""
    steps = done.trainer.done - done.begun_at
    record["steps"] = done.trainer.done
    record["steps_before"] = done.begun_at
    record["training_s"] = done.elapsed
    record["images_per_s"] = watcher.images_per_second
    record["waited_for_data_s"] = done.waited
    record["waited_for_data_share"] = done.waited / watcher.seconds if steps and watcher.seconds else None
    record["skipped"] = done.trainer.skipped
    record["skipped_images"] = done.unlearnt
    record["losses"] = watcher.losses
    record["validation"] = done.latest
    record["best_psnr"] = done.best
    record["parameters"] = sum(p.numel() for p in done.trainer.generator.parameters())
    record["perceptual_features"] = done.trainer.features


class Watcher:
    """Shows how a run goes: losses, images a second, time left."""

    def __init__(self, console: Console, out: Path, writes: bool = True) -> None:
        self.console, self.out, self.writes = console, out, writes
        self._board: Any = None
        self._sheet_at = -1
        self._sheet: Image | None = None
        columns = (
            TextColumn("train"), BarColumn(),
            MofNCompleteColumn(), TextColumn("{task.fields[words]}"), TimeElapsedColumn(),
        )  # fmt: skip
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task: TaskID | None = None
        self._started = self._told = time.monotonic()
        self._images = 0
        self.losses: dict[str, float] = {}
        """Running means over some 50 steps."""
        self.seconds = 0.0

    def __enter__(self) -> Watcher:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        if self._board is not None:
            self._board.close()

    @property
    def images_per_second(self) -> float:
        """Windows learnt from, over the time since the first step began."""
        return self._images / self.seconds if self.seconds else 0.0

    def began(self, run: Run) -> None:
        """Say what it is that begins."""
        recipe, trainer = run.recipe, run.trainer
        count = sum(p.numel() for p in trainer.generator.parameters())
        self.console.print(
            f"{recipe.architecture}, {count / 1e6:.2f} M parameters, on {trainer.device}"
            f"{f' x {trainer.world}' if trainer.world > 1 else ''}; {len(run.items)} training images, "
            f"{len(run.validation)} for validation",
            highlight=False,
        )
        if recipe.losses.lambda_perceptual:
            self.console.print(f"perceptual loss: {trainer.features}", highlight=False)
        if self.writes:
            from tensorboardX import SummaryWriter

            # what an earlier process wrote of steps that come again is forgotten
            self._board = SummaryWriter(str(self.out / "tensorboard"), purge_step=trainer.done + 1, write_to_disk=True)
        self._task = self._bar.add_task("train", total=recipe.steps, completed=trainer.done, words="")
        self._started = self._told = time.monotonic()

    def stepped(self, run: Run, found: Stepped) -> None:
        """Move the bar; where there is no terminal, a line now and then."""
        now = time.monotonic()
        self._images += run.recipe.optimizer.batch
        self.seconds = now - self._started
        for name, value in found.losses.items():
            self.losses[name] = value if name not in self.losses else 0.98 * self.losses[name] + 0.02 * value
        if self._board is not None and recipe_due(run.recipe.keep.log, run.trainer.done):
            for name, value in found.losses.items():
                self._board.add_scalar(f"loss/{name}", value, run.trainer.done)
            self._board.add_scalar("images_per_s", self.images_per_second, run.trainer.done)
        if found.skipped:
            self.console.print(f"step {run.trainer.done} skipped: {found.skipped}", highlight=False)
        words = self.words(run)
        if self._task is not None:
            self._bar.update(self._task, completed=run.trainer.done, words=words)
        if not self.console.is_terminal and now - self._told >= 30:
            self._told = now
            self.console.print(f"step {run.trainer.done}/{run.recipe.steps}  {words}", highlight=False, soft_wrap=True)

    def words(self, run: Run) -> str:
        """Losses, speed and time left."""
        losses = "  ".join(f"{name} {value:.4f}" for name, value in self.losses.items() if name != "total")
        share, begun = run.progress, run.begun_share
        left = self.seconds * (1 - share) / (share - begun) if share > begun else float("nan")
        if run.recipe.minutes:
            left = min(left, 60 * run.recipe.minutes - run.elapsed)
        return f"{losses}  {self.images_per_second:.2f} images/s  {clock(left)} left"

    def validated(self, run: Run, found: Mapping[str, float], samples: list[tuple[Sample, Tensor]]) -> None:
        """A line, a sheet of samples, and curves."""
        step, every = run.trainer.done, run.recipe.keep.sheet
        self.console.print(
            f"step {step}: {found['psnr']:.2f} dB from {found['psnr_raw']:.2f}, mean of {found['images']:.0f} "
            f"images{', the best so far' if found['psnr'] >= run.best else ''}",
            highlight=False,
        )
        self._sheet = train_pictures.samples([(s.rainy, derained, s.clear) for s, derained in samples])
        if every and (self._sheet_at < 0 or step - self._sheet_at >= every):
            self._sheet_at = step
            (self.out / "sheets").mkdir(parents=True, exist_ok=True)
            imagefile.write(self.out / "sheets" / f"step-{step:09d}.png", self._sheet)
        if self._board is not None:
            self._board.add_scalar("psnr/derained", found["psnr"], step)
            self._board.add_scalar("psnr/rainy", found["psnr_raw"], step)
            self._board.add_image("samples", self._sheet[..., ::-1], step, dataformats="HWC")
        write_atomically(self.out / "curves.png", to_png(self._curves()))

    def page(self, run: Run, record: Record) -> Report:
        """What there is to see of a run that is over."""
        recipe = run.recipe
        report = Report("Training", f"{run.out.name}: {recipe.architecture}, {len(run.items)} images")
        psnr, raw = run.latest.get("psnr", float("nan")), run.latest.get("psnr_raw", float("nan"))
        if record.status != "ok":
            report.verdict(
                "bad", f"{WINDOWS} windows were not learnt to {ENOUGH:g} dB: {psnr:.2f} dB.", "Does not learn."
            )
        elif run.latest:
            gain = psnr - raw
            where = "the windows it was trained on" if recipe.data.only else "held-out images"
            words = f"{psnr:.2f} dB on {where}, {gain:+.2f} dB against the rainy ones."
            report.verdict("good" if gain > 0 else "warn", words)
        tiles = [
            Tile("steps", run.trainer.done),
            Tile("images/s", f"{self.images_per_second:.2f}", "", f"batch {recipe.optimizer.batch}"),
            Tile("waited for data", f"{100 * run.waited / max(self.seconds, 1e-9):.1f}", "%"),
            Tile("skipped", run.trainer.skipped, "batches"),
        ]
        report.tiles(*tiles)
        if recipe.losses.lambda_perceptual:
            report.text(f"Perceptual loss: {run.trainer.features}.")
        report.section("Curves")
        report.figure(self._curves(), "Losses of single steps, faint, and smoothed; PSNR of validations.")
        if self._sheet is not None:
            report.section("Images", "Rainy, derained, clear.")
            report.image(self._sheet, "Of the last validation.")
        return report

    def _curves(self) -> Figure:
        tables = (train_pictures.read_table(self.out / name) for name in ("losses.csv", "validation.csv"))
        return train_pictures.curves(*tables)

    def said(self, words: str) -> None:
        """A line."""
        self.console.print(words, highlight=False, soft_wrap=True)


def recipe_due(every: int, step: int) -> bool:
    """Whether something that comes every so many steps comes now."""
    return every > 0 and step % every == 0


def clock(seconds: float) -> str:
    """H:MM:SS."""
    if not seconds >= 0:
        return "-:--:--"
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
