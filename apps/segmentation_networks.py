"""The paper's four conditions: which images a segmentation network learns from, and which it is tested on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rainstereo import imagefile
from rainstereo.apps.rain_frames import stamp
from rainstereo.apps.segmentation_stages import Prepared, Told, digest, kept
from rainstereo.types import Image

if TYPE_CHECKING:
    import torch
    from torch import nn

    from rainstereo.model.segmentation_training import Config, Training


@dataclass(frozen=True)
class Condition:
    """trained, tested: states of the images. ours: whether it is none of the paper's."""

    name: str
    trained: tuple[str, ...]
    tested: str
    ours: bool = False

    @property
    def network(self) -> str:
        """Name of the network that it needs."""
        return "+".join(self.trained)


CONDITIONS = (
    Condition("REFERENCE", ("clear",), "clear"),
    Condition("RAINY", ("clear",), "rainy"),
    Condition("AUGMENTED", ("clear", "rainy"), "rainy"),
    Condition("DERAINED", ("clear", "derained"), "derained"),
    Condition("RESTORED ONLY", ("clear",), "derained", ours=True),
)
NETWORKS = tuple(dict.fromkeys(condition.network for condition in CONDITIONS))


@dataclass(frozen=True)
class Scored:
    """total: scores by name, NaN where there is none. each: the main score of every test image. predicted: files."""

    total: dict[str, float]
    low: float
    high: float
    classes: dict[str, float]
    each: dict[str, float]
    predicted: dict[str, Path]


@dataclass(frozen=True)
class Learner:
    """How a task's networks are trained, in `folder`."""

    task: str
    names: tuple[str, ...]
    config: Config
    training: Training
    folder: Path
    device: torch.device
    cards: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Of the networks that were used."""

    def network(self, name: str, frames: Sequence[Prepared], told: Told) -> nn.Module:
        """Trained on the states in its name; read from its file if it was, on the same images in the same way."""
        from rainstereo.model.segmentation_training import Example, load, train

        examples = [Example(tuple(f.states[s] for s in name.split("+")), f.target) for f in frames]
        stamps = [[stamp(p) for p in (*e.variants, e.target)] for e in examples]
        key = digest(type(self.config).__name__, asdict(self.config), asdict(self.training) | {"keep": 0}, stamps)
        path = self.folder / f"{name}.safetensors"
        try:
            network, card = load(path)
        except (FileNotFoundError, ValueError):
            card = {}
        if card.get("key") != key:
            what = f"{self.task}: {name}"
            train(
                self.config, examples, self.training, path, key, self.device, lambda done, total: told(what, 1, total)
            )
            network, card = load(path)
        self.cards[name] = card
        return network.to(self.device)

    def loaded(self, name: str, folder: Path) -> nn.Module:
        """A network of an earlier run. FileNotFoundError; ValueError where its classes are others."""
        from rainstereo.model.segmentation_training import load

        network, card = load(folder / f"{name}.safetensors")
        if card["config"].get("classes") != self.config.classes:
            raise ValueError(
                f"{folder / name} tells {card['config'].get('classes')} classes apart; expected {self.config.classes} "
                f"for {self.task} on this data set"
            )
        self.cards[name] = card
        return network.to(self.device)


def score(
    condition: Condition,
    network: nn.Module,
    learner: Learner,
    frames: Sequence[Prepared],
    out: Path,
    seed: int,
    told: Told,
) -> Scored:
    """What a condition's network finds on the test images, written to OUT/predicted/CONDITION, and how it fits."""
    from rainstereo.model import segmentation_metrics as metrics
    from rainstereo.model.segmentation_training import predict

    identity = str(learner.cards[condition.network].get("sha256", ""))
    folder = out / "predicted" / condition.name.lower().replace(" ", "-")
    binary = learner.task == "markings"
    main = (lambda matrix: metrics.binary(matrix).iou) if binary else metrics.mean_iou
    matrices, predicted = [], {}

    def found(path: Path) -> Image:
        return predict(network, imagefile.read(path), learner.device)

    for frame in frames:
        source = frame.states[condition.tested]
        path = kept(folder, frame.name, identity, [source], partial(found, source))
        predicted[frame.name] = path
        matrices.append(metrics.confusion(imagefile.read(frame.target), imagefile.read(path), len(learner.names)))
        told(f"{learner.task}: test", 1, len(frames) * len(CONDITIONS))
    whole = sum(matrices[1:], matrices[0])
    total = asdict(metrics.binary(whole)) if binary else {"miou": metrics.mean_iou(whole)}
    low, high = metrics.interval(matrices, main, seed)
    ious = dict(zip(learner.names, metrics.class_ious(whole).tolist(), strict=True))
    each = {frame.name: main(matrix) for frame, matrix in zip(frames, matrices, strict=True)}
    return Scored(total, low, high, ious, each, predicted)


def main_score(task: str, scored: Scored) -> float:
    """IoU of the markings, or mIoU."""
    return scored.total["iou" if task == "markings" else "miou"]
