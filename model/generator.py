"""The de-raining generator: rainy image in, clear image out, of any size.

The network of Porav, Bruls and Newman, "I Can See Clearly Now" (ICRA 2019), section IV: Pix2PixHD's global generator
(Wang et al., CVPR 2018) with 4 down convolutions of stride 2, 9 residual blocks and 4 up convolutions, and additive
skip connections from the way down to the way up. `GeneratorConfig()` is that network; its options shrink it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from torch import Tensor, cat, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from rainstereo.model.convolution_blocks import (
    ACTIVATIONS,
    BLOCK_KINDS,
    NORMALISATIONS,
    PADDINGS,
    UP_SAMPLINGS,
    Padding,
    ResidualBlock,
    convolution,
    down,
    normalisation,
    up,
)
from rainstereo.model.image_batch import RGB, check, padded

NAMED = {
    "normalisation": NORMALISATIONS,
    "up_sampling": UP_SAMPLINGS,
    "padding": PADDINGS,
    "block": BLOCK_KINDS,
    "activation": tuple(ACTIVATIONS),
}
COUNTED = {
    "base_channels": (1, 1024),
    "max_channels": (1, 16384),
    "downs": (0, 6),
    "blocks": (0, 64),
    "level_blocks": (0, 16),
    "expansion": (1, 16),
    "patch": (1, 16),
}
ODD = {"stem_kernel": (1, 15), "block_kernel": (1, 15)}


@dataclass(frozen=True)
class GeneratorConfig:
    """A generator's shape. The defaults are the paper's: 182.4 M parameters, 255 GMACs at 640x480.

    base_channels: at the finest scale; each step down doubles them, up to max_channels.
    downs: steps down, and as many up, each by 2. blocks: residual blocks at the coarsest scale. level_blocks: further
    ones at every other scale, on the way down and again on the way up.
    block, block_kernel, expansion: what a residual block is, see `ResidualBlock`.
    normalisation: "instance", "batch", "channel" or "none", see `convolution_blocks.normalisation`. All but "instance"
    let a tile of an image, with a margin of `receptive_field.halo`, come out as in the whole image.
    up_sampling: "transposed", "nearest" or "pixel_shuffle", see `convolution_blocks.up`.
    padding: at borders of the stride-1 convolutions: "reflect", "replicate" or "zeros".
    activation: "relu", "gelu" or "silu". stem_kernel: side of the first and the last convolution.
    patch: p x p pixels become channels before the first convolution, and pixels again after the last: p^2 times fewer
    places to compute at.
    output_residual: output = input + tanh(...), which is the input before training; otherwise (tanh(...) + 1) / 2.
    output_gate: the change is multiplied by one map in 0..1 that the network draws, too; needs output_residual.
    """

    base_channels: int = 64
    max_channels: int = 1024
    downs: int = 4
    blocks: int = 9
    level_blocks: int = 0
    block: str = "dense"
    block_kernel: int = 3
    expansion: int = 1
    normalisation: str = "instance"
    up_sampling: str = "transposed"
    padding: Padding = "reflect"
    activation: str = "relu"
    stem_kernel: int = 7
    patch: int = 1
    output_residual: bool = False
    output_gate: bool = False

    def __post_init__(self) -> None:
        for name, choices in NAMED.items():
            value = getattr(self, name)
            if value not in choices:
                raise ValueError(f"{name} {value!r} is unknown; expected one of {', '.join(map(repr, choices))}")
        for name, (low, high) in (COUNTED | ODD).items():
            value = getattr(self, name)
            odd = name in ODD
            if type(value) is not int or not low <= value <= high or (odd and value % 2 == 0):
                raise ValueError(
                    f"{name} {value!r} was given; expected {'an odd' if odd else 'a'} number in {low}..{high}"
                )
        for name in ("output_residual", "output_gate"):
            if type(getattr(self, name)) is not bool:
                raise ValueError(f"{name} {getattr(self, name)!r} was given; expected true or false")
        if self.output_gate and not self.output_residual:
            raise ValueError(
                "output_gate needs output_residual: there is no change to gate in an image made from nothing"
            )

    @property
    def multiple(self) -> int:
        """Sides are padded to multiples of this inside."""
        return self.patch << self.downs

    @property
    def smallest_side(self) -> int:
        """To which shorter sides are padded inside, so that normalisation and mirrored borders have what they need."""
        coarse = max(2, self.block_kernel // 2 + 1, -(-(self.stem_kernel // 2 + 1) // (1 << self.downs)))
        return coarse * self.multiple

    @property
    def tiles_equal_frame(self) -> bool:
        """Whether, in eval mode, a tile with `receptive_field.halo` pixels around it comes out as in the image."""
        return self.normalisation != "instance"

    def channels(self, level: int) -> int:
        """After so many steps down."""
        return min(self.base_channels << level, max(self.base_channels, self.max_channels))

    def build(self) -> Generator:
        """The module, with random weights from torch's generator."""
        return Generator(self)


class Generator(nn.Module):
    """(B, 3, H, W) RGB in 0..1 to the same shape, any H, W >= 1; the output is clamped to 0..1 in eval mode only."""

    def __init__(self, config: GeneratorConfig) -> None:
        super().__init__()
        self.config = config
        norm, act, padding = config.normalisation, config.activation, config.padding
        levels = [config.channels(level) for level in range(config.downs + 1)]

        def residual(channels: int, count: int) -> nn.Sequential:
            kind, kernel = config.block, config.block_kernel
            blocks = (ResidualBlock(kind, channels, kernel, config.expansion, norm, act, padding) for _ in range(count))
            return nn.Sequential(*blocks)

        seen = config.patch**2
        self.stem = nn.Sequential(
            convolution(RGB * seen, levels[0], config.stem_kernel, padding),
            normalisation(norm, levels[0]),
            ACTIVATIONS[act](),
        )
        steps = list(pairwise(levels))
        self.encoder_blocks = nn.ModuleList(residual(fine, config.level_blocks) for fine, _ in steps)
        self.downs = nn.ModuleList(down(fine, coarse, norm, act) for fine, coarse in steps)
        self.blocks = residual(levels[-1], config.blocks)
        self.ups = nn.ModuleList(
            up(coarse, fine, config.up_sampling, norm, act, padding) for fine, coarse in reversed(steps)
        )
        self.decoder_blocks = nn.ModuleList(residual(fine, config.level_blocks) for fine, _ in reversed(steps))
        self.head = convolution(levels[0], (RGB + config.output_gate) * seen, config.stem_kernel, padding)
        self._initialise()

    def _initialise(self) -> None:
        """Pix2PixHD's N(0, 0.02) before normalisations; without them, weights that keep the variance, and blocks that
        start close to the identity; what is drawn starts where tanh is not yet saturated."""
        free = self.config.normalisation == "none"
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
                if free:
                    nn.init.normal_(module.weight, 0.0, math.sqrt(2 / _gathered(module)))
                else:
                    nn.init.normal_(module.weight, 0.0, 0.02)
                assert module.bias is not None  # noqa: S101
                nn.init.zeros_(module.bias)
            elif isinstance(module, nn.BatchNorm2d):
                nn.init.normal_(module.weight, 1.0, 0.02)
        if free:
            for module in self.modules():
                if isinstance(module, ResidualBlock):
                    last = [part for part in module.change if isinstance(part, nn.Conv2d)][-1]
                    last.weight.data *= 0.1
            self.head.weight.data *= 0.1
        if self.config.output_residual:
            nn.init.zeros_(self.head.weight)

    def forward(self, images: Tensor) -> Tensor:
        """The derained images."""
        check(images)
        return self.drawn_on(images, self.drawn(padded(images, self.config.multiple, self.config.smallest_side)))[0]

    def with_gate(self, images: Tensor) -> tuple[Tensor, Tensor | None]:
        """The derained images, and what gated the change, (B, 1, H, W) in 0..1, where the network draws it."""
        check(images)
        drawn = self.drawn(padded(images, self.config.multiple, self.config.smallest_side))
        derained, opened = self.drawn_on(images, drawn)
        height, width = images.shape[2:]
        return derained, None if opened is None else self._pixels(opened)[:, :, :height, :width]

    def drawn_on(self, images: Tensor, drawn: Tensor) -> tuple[Tensor, Tensor | None]:
        """The derained images, and what gated the change, (B, patch^2, H / patch, W / patch), from what the head drew,
        which is at least as large as the images.

        Everything that is bounded is so before channels become pixels: in that order a processor is thrice as fast.
        """
        height, width = images.shape[2:]
        seen = RGB * self.config.patch**2
        change, opened = drawn[:, :seen].tanh(), None
        if self.config.output_gate:
            opened = drawn[:, seen:].sigmoid()
            change = change * cat([opened] * RGB, 1)  # repeat takes six times as long
        change = self._pixels(change)[:, :, :height, :width]
        derained = images + change if self.config.output_residual else (change + 1) / 2
        return (derained if self.training else derained.clamp(0, 1)), opened

    def _pixels(self, features: Tensor) -> Tensor:
        return pixel_shuffle(features, self.config.patch) if self.config.patch > 1 else features

    def network(self, images: Tensor) -> Tensor:
        """What the head draws, unbounded: (B, 3 or 4, H, W). Sides must be multiples of `config.multiple`."""
        return self._pixels(self.drawn(images))

    def drawn(self, images: Tensor) -> Tensor:
        """The same before its channels become pixels: (B, 3 or 4 times patch^2, H / patch, W / patch)."""
        if self.config.patch > 1:
            images = pixel_unshuffle(images, self.config.patch)
        features = self.stem(images)
        skips = []
        for blocks, step in zip(self.encoder_blocks, self.downs, strict=True):
            features = blocks(features)
            skips.append(features)
            features = step(features)
        features = self.blocks(features)
        for step, blocks in zip(self.ups, self.decoder_blocks, strict=True):
            features = blocks(step(features) + skips.pop())
        drawn: Tensor = self.head(features)
        return drawn


def _gathered(layer: nn.Conv2d | nn.ConvTranspose2d) -> float:
    """How many weighted values a value of the layer's output is the sum of."""
    if isinstance(layer, nn.ConvTranspose2d):  # of its kernel's values, one in stride^2 meets a pixel
        return layer.weight[:, 0].numel() / (layer.stride[0] * layer.stride[1])
    return layer.weight[0].numel()
