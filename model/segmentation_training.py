"""Training of a segmentation network, resumable to the bit, and its use on whole images.

A step's images, windows and changes of light follow from the seed and the step's number alone. So networks that differ
only in what they are shown (clear, rainy, derained) begin with the same weights and see the same windows of the same
frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rainstereo import imagefile
from rainstereo.model import checkpoint
from rainstereo.model.card import Card
from rainstereo.model.deeplab import DeepLabConfig
from rainstereo.model.pixels import check, to_rgb
from rainstereo.model.segmentation import LabelImage
from rainstereo.model.segmentation_metrics import VOID
from rainstereo.model.unet import UNetConfig
from rainstereo.types import Image

Config = UNetConfig | DeepLabConfig
ARCHITECTURES: dict[str, type[Config]] = {"unet": UNetConfig, "deeplab": DeepLabConfig}
ROLE = "segmentation"
CURVE = 200
"""Points of the loss curve that a card keeps, about."""


@dataclass(frozen=True)
class Example:
    """variants: files of the same view, such as clear and rainy, of which each step takes one. target: labels, PNG."""

    variants: tuple[Path, ...]
    target: Path


@dataclass(frozen=True)
class Training:
    """steps of `batch` windows of `crop` x `crop` pixels (0: whole images), zoomed by up to `zoom`, mirrored half
    of the time, lightness and contrast changed by up to `light`. AdamW from `rate` down a half cosine to 0. keep: steps
    between states from which a run goes on."""

    steps: int = 4000
    batch: int = 8
    crop: int = 320
    zoom: float = 1.5
    light: float = 0.2
    rate: float = 1e-3
    weight_decay: float = 1e-4
    seed: int = 0
    keep: int = 100

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.keep) < 1 or not (self.crop == 0 or self.crop >= 32) or self.seed < 0:
            raise ValueError(
                f"{self}: expected steps, batch and keep of 1 or more, a seed of 0 or more, and a crop of 32 or more"
            )
        if not (1 <= self.zoom <= 4 and 0 <= self.light < 1 and 0 < self.rate < 1 and self.weight_decay >= 0):
            raise ValueError(
                f"{self}: expected a zoom of 1 to 4, light below 1, a rate between 0 and 1, a decay of 0 or more"
            )


def train(
    config: Config, examples: Sequence[Example], training: Training, path: Path, key: str, device: torch.device,
    told: Callable[[int, int], None] = lambda done, total: None,
) -> nn.Module:  # fmt: skip
    """The trained network, in eval mode; also in `path` (NAME.safetensors), from where `load` has it.

    key: of whatever the network depends on. While it is trained, its state lies beside `path`; a run that was
    interrupted goes on from there if the key is the same. told: steps done, of how many.
    RuntimeError where the loss is no number; ValueError where images and labels do not fit.
    """
    if not examples:
        raise ValueError("there is nothing to learn from; expected one example or more")
    state = path.with_name(f"{path.stem}-unfinished{checkpoint.SUFFIX}")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.seed)
        network = config.build().to(device).train()
    optimizer = torch.optim.AdamW(network.parameters(), training.rate, weight_decay=training.weight_decay)
    done, curve = _resume(state, key, network, optimizer)
    windows = Windows(examples, training)
    for step in range(done, training.steps):
        for group in optimizer.param_groups:
            group["lr"] = training.rate * 0.5 * (1 + np.cos(np.pi * step / training.steps))
        images, targets = windows.batch(step)
        loss = loss_of(network(images.to(device)), targets.to(device))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        value = float(loss.detach())
        if not np.isfinite(value):
            raise RuntimeError(
                f"the loss of {path.stem} is {value} at step {step}; try a smaller rate than {training.rate}"
            )
        if step % max(1, training.steps // CURVE) == 0:
            curve.append(value)
        if (step + 1) % training.keep == 0 and step + 1 < training.steps:
            _keep(state, key, network, optimizer, step + 1, curve)
        told(step + 1, training.steps)
    save(path, network, key, training, curve)
    for left in (state, state.with_suffix(".toml")):
        left.unlink(missing_ok=True)
    return network.eval()


def loss_of(scores: Tensor, targets: Tensor) -> Tensor:
    """One channel: binary cross entropy and soft Dice, which few positive pixels do not drown in; more: cross entropy.

    scores (B, C, H, W), targets (B, H, W) integers; pixels of `VOID` do not count.
    """
    known = targets != VOID
    if scores.shape[1] > 1:
        total = functional.cross_entropy(scores, targets.long(), ignore_index=VOID, reduction="sum")
        return total / known.sum().clamp(min=1)
    wanted = (targets == 1).float()
    each = functional.binary_cross_entropy_with_logits(scores[:, 0], wanted, reduction="none")
    share = scores[:, 0].sigmoid() * known
    both = (share * wanted).sum()
    dice = 1 - (2 * both + 1) / (share.sum() + wanted.sum() + 1)
    return (each * known).sum() / known.sum().clamp(min=1) + dice


@torch.no_grad()
def predict(network: nn.Module, image: Image, device: torch.device) -> LabelImage:
    """(H, W) labels of a whole image, uint8 or uint16, gray or BGR."""
    check(image)
    scores = network(to_rgb(image, device))[0]
    found = scores[0] > 0 if len(scores) == 1 else scores.argmax(0)
    return np.asarray(found.to(torch.uint8).cpu().numpy())


# -- windows -----------------------------------------------------------------------------------------------------------


class Windows:
    """What each step learns from; a function of the seed and the step."""

    def __init__(self, examples: Sequence[Example], training: Training) -> None:
        self.examples, self.training = examples, training

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        """(B, 3, h, w) RGB and (B, h, w) labels. Each frame comes once before one comes again."""
        count, t = len(self.examples), self.training
        pairs = []
        for place in range(step * t.batch, (step + 1) * t.batch):
            order = np.random.default_rng([t.seed, 1, place // count]).permutation(count)
            rng = np.random.default_rng([t.seed, 2, place])
            pairs.append(self._window(self.examples[int(order[place % count])], rng))
        side = min(image.shape[0] for image, _ in pairs), min(image.shape[1] for image, _ in pairs)
        images = torch.cat([to_rgb(image[: side[0], : side[1]], torch.device("cpu")) for image, _ in pairs])
        light = np.random.default_rng([t.seed, 3, step]).uniform(-t.light, t.light, (2, len(pairs), 1, 1, 1))
        shift, contrast = torch.from_numpy(light.astype(np.float32))
        images = ((images - 0.5) * (1 + contrast) + 0.5 + shift).clamp(0, 1)
        return images, torch.from_numpy(np.stack([target[: side[0], : side[1]] for _, target in pairs]))

    def _window(self, example: Example, rng: np.random.Generator) -> tuple[Image, LabelImage]:
        draw = rng.random(5)  # always as many, whatever the number of variants
        image = imagefile.read(example.variants[int(draw[0] * len(example.variants))])
        labels = imagefile.read(example.target)
        if image.shape[:2] != labels.shape:
            raise ValueError(
                f"{example.variants[0]} has {image.shape[:2]} pixels, its labels {labels.shape}; expected as many"
            )
        height, width = labels.shape
        if self.training.crop:
            zoom = self.training.zoom ** (2 * draw[1] - 1)
            own = math.ceil(self.training.crop / zoom)
            h, w = min(height, own), min(width, own)
            top, left = int(draw[2] * (height - h + 1)), int(draw[3] * (width - w + 1))
            image, labels = (a[top : top + h, left : left + w] for a in (image, labels))
            size = min(self.training.crop, round(w * zoom)), min(self.training.crop, round(h * zoom))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))
            labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST_EXACT))
        step = -1 if draw[4] < 0.5 else 1
        return np.ascontiguousarray(image[:, ::step]), np.ascontiguousarray(labels[:, ::step])


# -- files -------------------------------------------------------------------------------------------------------------


def save(path: Path, network: nn.Module, key: str, training: Training, curve: Sequence[float]) -> None:
    """Write a network with its card."""
    checkpoint.save(path, network, _card(network, key) | {"training": asdict(training), "losses": list(curve)})


def load(path: Path) -> tuple[nn.Module, Card]:
    """A network in eval mode and its card. FileNotFoundError; ValueError for what is no segmentation network."""
    found = checkpoint.load(path)
    kind = ARCHITECTURES.get(found.architecture)
    if found.card.get("role") != ROLE or kind is None:
        raise ValueError(
            f"{found.path} holds a {found.architecture or 'network without a name'}; expected one that segments"
        )
    try:
        network = kind(**found.card["config"]).build()
        network.load_state_dict(dict(found.tensors))
    except (TypeError, KeyError, RuntimeError) as error:
        raise checkpoint.DamagedCheckpointError(
            f"{found.path}: the card describes another network than the file holds"
        ) from error
    return network.eval(), found.card


def _card(network: nn.Module, key: str) -> dict[str, object]:
    config = network.config
    name = next(name for name, kind in ARCHITECTURES.items() if isinstance(config, kind))
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in vars(config).items()}
    return {"architecture": name, "role": ROLE, "config": values, "key": key}


def _keep(
    path: Path, key: str, network: nn.Module, optimizer: torch.optim.Optimizer, step: int, curve: Sequence[float]
) -> None:
    tensors = {f"network.{name}": tensor for name, tensor in network.state_dict().items()}
    for i, values in optimizer.state_dict()["state"].items():
        tensors |= {f"optimizer.{i}.{name}": value for name, value in values.items()}
    checkpoint.save(path, tensors, _card(network, key) | {"step": step, "losses": list(curve)})


def _resume(path: Path, key: str, network: nn.Module, optimizer: torch.optim.Optimizer) -> tuple[int, list[float]]:
    """Steps done and the loss curve so far; (0, []) where there is no whole state of this key."""
    try:
        found = checkpoint.load(path)
    except (FileNotFoundError, checkpoint.DamagedCheckpointError):
        return 0, []
    if found.card.get("key") != key:
        return 0, []
    network.load_state_dict(_below(found.tensors, "network."))
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in _below(found.tensors, "optimizer.").items():
        number, _, what = name.partition(".")
        state.setdefault(int(number), {})[what] = tensor
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})
    return int(found.card["step"]), [float(v) for v in found.card["losses"]]


def _below(tensors: Mapping[str, Tensor], start: str) -> dict[str, Tensor]:
    return {name.removeprefix(start): tensor for name, tensor in tensors.items() if name.startswith(start)}
