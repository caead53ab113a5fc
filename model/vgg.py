"""Features of VGG-19 (Simonyan and Zisserman, ICLR 2015) for the perceptual loss.

Trained weights cannot be shipped. Who has them gives a file in torchvision's naming: `features.0.weight` and so on, as
`.safetensors` or `.pth`. torchvision's is https://download.pytorch.org/models/vgg19-dcbb9e9d.pth (548 MB), also written
by `torch.save(torchvision.models.vgg19(weights="IMAGENET1K_V1").state_dict(), "vgg19.pth")`; the digits in its name are
the first of its SHA-256, which `label` shows. Without a file the weights are random, and `label` says so: such features
still compare structure at several scales, but are not those of the paper.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

CHANNELS = (64, 128, 256, 512, 512)
CONVOLUTIONS = (2, 2, 4, 4, 4)
SMALLEST_SIDE = 16
LARGEST_FILE = 2**30
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's RGB, as torchvision's weights were trained."""


def plan() -> Iterator[tuple[int, int, int, bool]]:
    """Convolutions as far as they are needed, up to relu5_1: index in torchvision's `features`, channels in and out,
    and whether it opens a scale; the activation of one that does is a feature."""
    index, before = 0, 3
    for scale, (width, count) in enumerate(zip(CHANNELS, CONVOLUTIONS, strict=True)):
        for i in range(count):
            yield index, before, width, i == 0
            if i == 0 and scale == len(CHANNELS) - 1:
                return
            index, before = index + 2, width  # a convolution and its activation
        index += 1  # pooling


class VggFeatures(nn.Module):
    """(B, 3, H, W) RGB in 0..1, sides of at least 16, to relu1_1, relu2_1, relu3_1, relu4_1, relu5_1.

    Its weights never change, and it stays in eval mode; gradients pass to the images. label: where weights are from.
    """

    def __init__(self, weights: str | Path | None = None, seed: int = 0) -> None:
        """weights: a file, see above; None: random ones from the seed. ValueError for a file that lacks them."""
        super().__init__()
        self.features = nn.ModuleDict({str(i): nn.Conv2d(given, made, 3, padding=1) for i, given, made, _ in plan()})
        self.openings = frozenset(str(i) for i, _, _, opens in plan() if opens)
        self.register_buffer("mean", torch.tensor(MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("deviation", torch.tensor(DEVIATION).view(1, 3, 1, 1), persistent=False)
        if weights is None:
            self.label = f"RANDOM features of VGG-19's shape, seed {seed}: no file of trained weights was given"
            self._randomise(seed)
        else:
            path = Path(weights)
            self._load(path)
            self.label = f"VGG-19 weights from {path.name}, SHA-256 {_digest(path)[:8]}"
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> VggFeatures:
        """Stays in eval mode."""
        del mode
        return super().train(False)

    def forward(self, images: Tensor) -> list[Tensor]:
        """The features."""
        if images.ndim != 4 or images.shape[1] != 3 or min(images.shape[2:]) < SMALLEST_SIDE:
            raise ValueError(
                f"images have shape {tuple(images.shape)}; expected (batch, 3, height, width) with sides of at "
                f"least {SMALLEST_SIDE}: train on larger crops or set lambda_perceptual to 0"
            )
        mean, deviation = self.get_buffer("mean"), self.get_buffer("deviation")
        values = (images - mean) / deviation
        found: list[Tensor] = []
        for name, convolution in self.features.items():
            if name in self.openings and found:
                values = max_pool2d(values, 2)
            values = relu(convolution(values))
            if name in self.openings:
                found.append(values)
        return found

    def _randomise(self, seed: int) -> None:
        """Weights that keep the size of what passes: normal, of variance 2 / (values gathered)."""
        draws = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for convolution in self.features.values():
                assert isinstance(convolution, nn.Conv2d)  # noqa: S101
                shape = convolution.weight.shape
                drawn = torch.randn(shape, generator=draws) * math.sqrt(2 / math.prod(shape[1:]))
                convolution.weight.copy_(drawn)
                nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]

    def _load(self, path: Path) -> None:
        given = _read(path)
        wanted = {f"features.{name}": p for name, p in self.features.named_parameters()}
        missing = [name for name in wanted if name not in given]
        if missing:
            raise ValueError(
                f"{path} lacks {', '.join(missing[:3])}{' ...' if missing[3:] else ''}; expected the state dict of "
                "torchvision's vgg19 (`features.0.weight`, ...)"
            )
        with torch.no_grad():
            for name, parameter in wanted.items():
                value = given[name]
                if value.shape != parameter.shape or not value.is_floating_point() or not value.isfinite().all():
                    raise ValueError(
                        f"{path}: {name} is {value.dtype} {tuple(value.shape)}; expected finite floats "
                        f"{tuple(parameter.shape)} as in VGG-19"
                    )
                parameter.copy_(value)


def _read(path: Path) -> dict[str, Tensor]:
    """Tensors by name; nothing in the file is executed."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file of VGG-19 weights; see docs/model.md for where to get it, or give none")
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"{path} has {path.stat().st_size / 2**20:.0f} MiB; VGG-19's weights have 548")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        given = torch.load(path, map_location="cpu", weights_only=True)
    except (SafetensorError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as weights: {error}") from error
    except Exception as error:  # the unpickler's refusals have types of their own
        raise ValueError(f"{path} holds more than tensors or is damaged: {type(error).__name__}") from error
    if not isinstance(given, dict) or not all(isinstance(value, Tensor) for value in given.values()):
        raise ValueError(f"{path} holds something else than named tensors; expected a state dict")
    return given


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
