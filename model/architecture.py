"""Restorers by name, as training configurations and checkpoints' cards call them, and how each is learned as published.

A further one, such as Qian et al.'s attentive GAN (CVPR 2018), needs a frozen dataclass of plain values with `build()`
to a module from (B, 3, H, W) RGB in 0..1 to the same shape, and a line in `ARCHITECTURES` and in `PUBLISHED`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

from rainstereo.model.discriminator import DiscriminatorConfig
from rainstereo.model.eigen import EigenConfig
from rainstereo.model.generator import GeneratorConfig
from rainstereo.model.losses import LossWeights
from rainstereo.model.pix2pix import Pix2PixConfig

Config = GeneratorConfig | EigenConfig | Pix2PixConfig
ARCHITECTURES: dict[str, type[Config]] = {
    "generator": GeneratorConfig,
    "eigen2013": EigenConfig,
    "pix2pix": Pix2PixConfig,
}


@dataclass(frozen=True)
class Recipe:
    """What a restorer is learned by. discriminator: None where there is none. pool: images in the `DerainedPool`."""

    weights: LossWeights
    discriminator: DiscriminatorConfig | None
    pool: int


PUBLISHED = {
    "generator": Recipe(LossWeights(), DiscriminatorConfig(), 50),
    "eigen2013": Recipe(
        LossWeights(lambda_adversarial=0, lambda_perceptual=0, lambda_msadv=0, lambda_squared=1), None, 0
    ),
    "pix2pix": Recipe(
        LossWeights(lambda_perceptual=0, lambda_msadv=0, lambda_pixel=100, adversary="cross_entropy"),
        DiscriminatorConfig(conditional=True),
        0,
    ),
}


def configure(name: str, values: Mapping[str, object]) -> Config:
    """A configuration from its architecture's name and plain values; what is not given has its default.

    ValueError for a name, an option or a value that is unknown.
    """
    if name not in ARCHITECTURES:
        raise ValueError(f"architecture {name!r} is unknown; expected one of {', '.join(map(repr, ARCHITECTURES))}")
    kind = ARCHITECTURES[name]
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ValueError(f"architecture {name!r} has no option {unknown[0]!r}; expected {', '.join(known)}")
    return kind(**values)  # type: ignore[arg-type]


def name_of(config: Config) -> str:
    """The architecture's name."""
    return next(name for name, kind in ARCHITECTURES.items() if type(config) is kind)


def values_of(config: Config) -> dict[str, str | int | float | bool]:
    """The options as plain values: `configure(name_of(c), values_of(c)) == c`."""
    return asdict(config)
