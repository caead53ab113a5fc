"""A training run as a TOML file: frozen dataclasses whose defaults are the paper's, and nothing unknown gets
through."""

from __future__ import annotations

import dataclasses
import difflib
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rainstereo.model.architecture import PUBLISHED
from rainstereo.model.discriminator import DiscriminatorConfig
from rainstereo.model.losses import LossWeights

SHIPPED = "shipped"
"""As a path of weights: those in the package."""


@dataclass(frozen=True)
class Source:
    """Where images come from. Paths are relative to the recipe's file.

    folder: pairs in a layout that is known by what it holds (`pair_folders`). Or clear: a folder of clear images, and
    rainy: folders of rainy versions of each, named alike; without rainy, rain is rendered while training. split: of a
    manifest. repeat: how often each image comes in an epoch. limit: at most so many of its images, evenly spread.
    """

    folder: str = ""
    clear: str = ""
    rainy: tuple[str, ...] = ()
    split: str = ""
    repeat: int = 1
    limit: int = 0


@dataclass(frozen=True)
class DataOptions:
    """Images, and what is cut from them.

    crop: side of the square windows, pixels; 0: whole images, which then must be of one size if batch > 1. crop_drops:
    share of the windows that must hold drops. clear: share of windows that come without rain. only: train
    on the first so many windows, again and again, and validate on them: can it learn at all? 0: on all. workers:
    processes that read and augment. align: what to do about pairs that are shifted: "refuse", "warn" or "skip" the
    test.
    """

    train: tuple[Source, ...] = ()
    val: tuple[Source, ...] = ()
    crop: int = 256
    crop_drops: float = 1.0
    clear: float = 0.0
    only: int = 0
    workers: int = 1
    align: Literal["refuse", "warn", "skip"] = "refuse"


@dataclass(frozen=True)
class RainOptions:
    """Rain that is rendered on clear images (`augment.RandomAdherentRain`): its arguments, by their names there."""

    populations: tuple[str, ...] = ("drops",)
    cover: tuple[float, float] = (0.02, 0.2)
    focal: float = 0.9
    distance: float = 0.057
    f_number: tuple[float, float] | None = (2.0, 16.0)
    model: Literal["exact", "texture"] = "exact"
    rays: int = 2


@dataclass(frozen=True)
class AugmentOptions:
    """Augmentation by kornia. Geometric: the same for image, truth and mask. Photometric: the same for image and truth.

    flip: probability of mirroring left to right. rotate: degrees, at most. scale: smallest and largest. brightness,
    contrast, saturation, hue: as in `kornia.augmentation.ColorJiggle`. noise: standard deviation of what is added to
    the rainy image alone, of 1.
    """

    flip: float = 0.5
    rotate: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)
    brightness: float = 0.0
    contrast: float = 0.0
    saturation: float = 0.0
    hue: float = 0.0
    noise: float = 0.0


@dataclass(frozen=True)
class OptimizerOptions:
    """Adam, for both networks.

    schedule: of the rate: "constant", or "cosine" from `rate` to `final` x `rate` at the last step (with `minutes`,
    when the time is up). warmup: steps over which the rate rises from 0. batch: windows a step, over all processes.
    accumulate: parts that a process takes its share of the batch in. clip: largest norm of the gradient; 0: any. ema:
    decay of the running mean of the weights, which then is what is validated and kept; 0: none. pool: earlier derained
    images that the discriminator sees.
    """

    rate: float = 2e-4
    beta1: float = 0.5
    beta2: float = 0.999
    schedule: Literal["constant", "cosine"] = "constant"
    final: float = 0.01
    warmup: int = 0
    batch: int = 1
    accumulate: int = 1
    clip: float = 0.0
    ema: float = 0.0
    pool: int = 50


@dataclass(frozen=True)
class ComputeOptions:
    """How it is computed. device: "auto" takes a GPU if there is one.

    precision: "bf16" and "fp16" are autocast. channels_last: where it is right, see
    `train_step.instance_norm_differentiates`. compile: torch.compile of the generator. threads: of this process; 0:
    torch's choice.
    """

    device: str = "auto"
    precision: Literal["float32", "bf16", "fp16"] = "float32"
    channels_last: bool = True
    compile: bool = False
    threads: int = 0


@dataclass(frozen=True)
class KeepOptions:
    """What is written how often, in steps; 0: never. keep: checkpoints that stay. val_limit, val_crop: validation
    looks at so many pairs, and at the middle of them. sheet: pictures of the first of them, at validations that many
    steps apart. enough: PSNR of a validation at which the run ends; 0: none. storage: of the final weights.
    not_finite: what to do about batches with values or gradients that are not finite.
    """

    log: int = 50
    checkpoint: int = 500
    keep: int = 3
    validate: int = 1000
    val_limit: int = 20
    val_crop: int = 0
    sheet: int = 1000
    enough: float = 0.0
    storage: Literal["float16", "float32"] = "float32"
    not_finite: Literal["skip", "stop"] = "skip"


@dataclass(frozen=True)
class Recipe:
    """A run: it ends after `steps`, or, if that comes first, after so many `minutes` (0: no limit).

    architecture, network: the generator's name in `architecture` and its options. losses: lambdas, see `losses`; the
    discriminator is trained only where they need it. start: weights that the generator starts from, a checkpoint or
    "shipped", whose network it then is unless `network` says so itself; empty: random ones. vgg: file of VGG-19 weights
    for the perceptual loss; without it features are random, and labelled so. name, notes: for the card.
    """

    seed: int = 0
    steps: int = 200_000
    minutes: float = 0.0
    architecture: str = "generator"
    data: DataOptions = field(default_factory=DataOptions)
    rain: RainOptions = field(default_factory=RainOptions)
    augment: AugmentOptions = field(default_factory=AugmentOptions)
    network: Mapping[str, Any] = field(default_factory=dict)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    losses: LossWeights = field(default_factory=LossWeights)
    start: str = ""
    vgg: str = ""
    optimizer: OptimizerOptions = field(default_factory=OptimizerOptions)
    compute: ComputeOptions = field(default_factory=ComputeOptions)
    keep: KeepOptions = field(default_factory=KeepOptions)
    name: str = ""
    notes: str = ""

    def __post_init__(self) -> None:
        """Ranges that no run can have are refused, by key."""
        o, d, k = self.optimizer, self.data, self.keep
        _within("seed", self.seed, 0, 2**31 - 1)
        _within("steps", self.steps, 1, 10**9)
        _within("minutes", self.minutes, 0, 1e6)
        _within("data.crop", d.crop, 0, 1 << 14)
        _within("data.crop_drops", d.crop_drops, 0, 1)
        _within("data.clear", d.clear, 0, 1)
        _within("data.only", d.only, 0, 4096)
        _within("keep.enough", k.enough, 0, 100)
        _within("data.workers", d.workers, 0, 64)
        _within("optimizer.rate", o.rate, 0, 10)
        _within("optimizer.beta1", o.beta1, 0, 0.9999)
        _within("optimizer.beta2", o.beta2, 0, 0.999999)
        _within("optimizer.final", o.final, 0, 1)
        _within("optimizer.warmup", o.warmup, 0, 10**9)
        _within("optimizer.batch", o.batch, 1, 4096)
        _within("optimizer.accumulate", o.accumulate, 1, 4096)
        _within("optimizer.clip", o.clip, 0, 1e9)
        _within("optimizer.ema", o.ema, 0, 0.99999)
        _within("optimizer.pool", o.pool, 0, 4096)
        _within("keep.keep", k.keep, 2, 10**6)
        for name in ("log", "checkpoint", "validate", "sheet", "val_limit", "val_crop"):
            _within(f"keep.{name}", getattr(k, name), 0, 10**9)
        if self.discriminator.conditional and o.pool:
            raise ValueError(
                f"optimizer.pool is {o.pool}, but discriminator.conditional shows a derained image with the rainy one "
                "that it was made from; set optimizer.pool to 0"
            )
        _within("compute.threads", self.compute.threads, 0, 1024)


def read(path: Path) -> Recipe:
    """The recipe in a TOML file. Its paths are made absolute, from the file's folder.

    ValueError for a key that is unknown (with the nearest that is known) or of the wrong type.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML file: {error}") from error
    try:
        recipe = parse(table)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return located(recipe, path.parent)


def parse(table: Mapping[str, Any]) -> Recipe:
    """The recipe in a table of plain values, as `plain` gives it.

    Where it does not speak of losses, discriminator or pool, they are those with which the architecture was published.
    """
    published = PUBLISHED.get(str(table.get("architecture", "generator")))
    if published is not None:
        optimizer = table.get("optimizer", {})
        pool = {"pool": published.pool} if isinstance(optimizer, Mapping) else {}
        table = {
            "losses": dataclasses.asdict(published.weights),
            "discriminator": dataclasses.asdict(published.discriminator or DiscriminatorConfig()),
            **table,
            "optimizer": {**pool, **optimizer} if pool else optimizer,
        }
    found = _parse(Recipe, table, "")
    assert isinstance(found, Recipe)  # noqa: S101 - for the type checker
    return found


def plain(recipe: Recipe) -> dict[str, Any]:
    """The recipe as tables of plain values, for a card or a report."""
    return dataclasses.asdict(recipe)


def located(recipe: Recipe, folder: Path) -> Recipe:
    """The recipe with paths relative to a folder made absolute."""

    def at(text: str) -> str:
        return str((folder / text).resolve()) if text else ""

    def source(s: Source) -> Source:
        return dataclasses.replace(s, folder=at(s.folder), clear=at(s.clear), rainy=tuple(map(at, s.rainy)))

    data = dataclasses.replace(
        recipe.data, train=tuple(map(source, recipe.data.train)), val=tuple(map(source, recipe.data.val))
    )
    start = recipe.start if recipe.start == SHIPPED else at(recipe.start)
    return dataclasses.replace(recipe, data=data, start=start, vgg=at(recipe.vgg))


# -- reading -----------------------------------------------------------------------------------------------------------


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:  # NaN, too
        raise ValueError(f"{name} is {value}; expected {low:g} to {high:g}")


def _parse(kind: Any, value: object, where: str) -> Any:
    """`value` as the type `kind` of a field asks for it."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} is {value!r}; expected a table [{where}]")
        hints = typing.get_type_hints(kind)
        for key in value:
            if key not in hints:
                raise ValueError(_unknown(key, where, list(hints)))
        return kind(
            **{key: _parse(hints[key], inner, f"{where}.{key}" if where else key) for key, inner in value.items()}
        )
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is types.UnionType:
        return None if value in (None, "none", []) else _parse(inner[0], value, where)
    if origin is Literal:
        if value not in inner:
            raise ValueError(f"{where} is {value!r}; expected {' or '.join(map(repr, inner))}")
        return value
    if origin is tuple:
        if isinstance(value, str) or not isinstance(value, (list, tuple)):
            raise ValueError(f"{where} is {value!r}; expected a list [...]")
        kinds = [inner[0]] * len(value) if inner[-1] is Ellipsis else list(inner)
        if len(kinds) != len(value):
            raise ValueError(f"{where} has {len(value)} values; expected {len(kinds)}")
        return tuple(_parse(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
    if origin is not None:  # a free table
        if not isinstance(value, Mapping):
            raise ValueError(f"{where} is {value!r}; expected a table [{where}]")
        return dict(value)
    return _scalar(kind, value, where)


def _scalar(kind: Any, value: object, where: str) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind or (isinstance(value, float) and math.isnan(value)):
        names = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}
        raise ValueError(f"{where} is {value!r}; expected {names[kind]}")
    return value


def _unknown(key: str, where: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
    guess = f" Did you mean {near[0]!r}?" if near else ""
    return f"{where or 'the recipe'} has no key {key!r}.{guess} The keys: {', '.join(known)}"
