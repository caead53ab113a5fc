"""Patch discriminators: how much each patch of an image looks like a clear one, and what they saw on the way.

The discriminators of Pix2PixHD (Wang et al., CVPR 2018): 5 convolutions of 4x4, of which the first three halve the
size, on the image alone; and the same again, with weights of its own, on the image at half the size, for each further
scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rainstereo.model.convolution_blocks import normalisation
from rainstereo.model.image_batch import RGB

KERNEL = 4
SLOPE = 0.2
WIDEST = 8
RANGES = {"base_channels": (1, 1024), "layers": (3, 8), "scales": (1, 5)}
NORMALISATIONS = ("instance", "none")

Activations = list[Tensor]
"""What each layer of a patch discriminator gave, the first first; the last is the prediction, (B, 1, h, w)."""


@dataclass(frozen=True)
class DiscriminatorConfig:
    """Discriminators' shape; the defaults are the paper's: one, of 5 layers, 2.76 M parameters.

    base_channels: of the first layer; doubled with each layer, up to 8 times. layers: convolutions, all but the last
    two of stride 2. scales: discriminators, each on images of half the size of the one before it.
    normalisation: "instance" or "none", of all layers but the first and the last.
    conditional: it sees the rainy image besides, as in Pix2Pix.
    """

    base_channels: int = 64
    layers: int = 5
    scales: int = 1
    normalisation: str = "instance"
    conditional: bool = False

    def __post_init__(self) -> None:
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            if type(value) is not int or not low <= value <= high:
                raise ValueError(f"{name} {value!r} was given; expected a whole number in {low}..{high}")
        if self.normalisation not in NORMALISATIONS:
            raise ValueError(f"normalisation {self.normalisation!r} is unknown; expected 'instance' or 'none'")
        if type(self.conditional) is not bool:
            raise ValueError(f"conditional {self.conditional!r} was given; expected true or false")

    @property
    def smallest_side(self) -> int:
        """Of an image: what is left of it at the coarsest scale has two pixels."""
        return (1 << (self.scales - 1)) + 1

    def build(self) -> Discriminator:
        """The module, with random weights from torch's generator."""
        return Discriminator(self)


class PatchDiscriminator(nn.Module):
    """(B, 3 or 6, H, W) to the activations of its layers."""

    def __init__(self, config: DiscriminatorConfig) -> None:
        super().__init__()
        widths = [config.base_channels * min(1 << i, WIDEST) for i in range(config.layers - 1)]
        layers = []
        before = 2 * RGB if config.conditional else RGB
        for i, width in enumerate(widths):
            last_but_one = i == len(widths) - 1
            layers.append(
                nn.Sequential(
                    nn.Conv2d(before, width, KERNEL, stride=1 if last_but_one else 2, padding=2),
                    normalisation(config.normalisation if i else "none", width),
                    nn.LeakyReLU(SLOPE),
                )
            )
            before = width
        layers.append(nn.Sequential(nn.Conv2d(before, 1, KERNEL, padding=2)))
        self.layers = nn.ModuleList(layers)

    def forward(self, images: Tensor) -> Activations:
        """The activations."""
        activations = []
        for layer in self.layers:
            images = layer(images)
            activations.append(images)
        return activations


class Discriminator(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to a list of activations for each scale, the finest first."""

    def __init__(self, config: DiscriminatorConfig) -> None:
        super().__init__()
        self.config = config
        self.scales = nn.ModuleList(PatchDiscriminator(config) for _ in range(config.scales))
        self.halve = nn.AvgPool2d(3, stride=2, padding=1, count_include_pad=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, 0.0, 0.02)

    def forward(self, images: Tensor, rainy: Tensor | None = None) -> list[Activations]:
        """The activations. rainy: what the images were made from, for a conditional one; others do not look at it."""
        least = self.config.smallest_side
        if images.ndim != 4 or images.shape[1] != RGB or min(images.shape[2:]) < least:
            raise ValueError(
                f"images have shape {tuple(images.shape)}; expected (batch, 3, height, width) with sides of at least "
                f"{least} for {self.config.scales} scales"
            )
        if self.config.conditional:
            if rainy is None or rainy.shape != images.shape:
                given = "none" if rainy is None else tuple(rainy.shape)
                raise ValueError(f"a conditional discriminator needs rainy images {tuple(images.shape)}; got {given}")
            images = torch.cat([images, rainy], 1)
        images = 2 * images - 1
        found = []
        for i, discriminator in enumerate(self.scales):
            images = self.halve(images) if i else images
            found.append(discriminator(images))
        return found


@contextmanager
def frozen(module: nn.Module) -> Iterator[None]:
    """Inside, gradients pass through the module, but not to its parameters: those of the discriminator, while the
    generator learns."""
    learning = [p for p in module.parameters() if p.requires_grad]
    for p in learning:
        p.requires_grad_(False)
    try:
        yield
    finally:
        for p in learning:
            p.requires_grad_(True)
