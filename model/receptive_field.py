"""How far a generator's output pixel looks: the margin that a tile needs to come out as in the whole image."""

from __future__ import annotations

from rainstereo.model.generator import GeneratorConfig

Span = tuple[int, int]


def halo(config: GeneratorConfig) -> int:
    """Pixels, along a row or column, to the farthest input pixel that an output pixel depends on by convolutions.

    Exact, the worst over the places of a pixel on the grid of `config.multiple`; tiles must begin on that grid.
    Instance normalisation looks at the whole image besides (`config.tiles_equal_frame`).
    """
    worst = 0
    for pixel in range(config.multiple):
        low, high = _seen_by(config, pixel)
        worst = max(worst, pixel - low, high - pixel)
    return worst


def receptive_field(config: GeneratorConfig) -> int:
    """Side of the square around an output pixel, in pixels, that holds all that it depends on by convolutions."""
    return 2 * halo(config) + 1


def _seen_by(config: GeneratorConfig, pixel: int) -> Span:
    """First and last input pixel that an output pixel depends on, walking back from the output."""
    per_block = config.block_kernel // 2 * (2 if config.block == "dense" else 1)
    stem = config.stem_kernel // 2
    level = config.level_blocks * per_block
    span = (pixel // config.patch, pixel // config.patch)
    span = _wider(span, stem)
    for _ in range(config.downs):
        span = _before_up(_wider(span, level), config.up_sampling)
    span = _wider(span, config.blocks * per_block)
    for _ in range(config.downs):
        span = _wider((2 * span[0] - 1, 2 * span[1] + 1), level)
    low, high = _wider(span, stem)
    return low * config.patch, high * config.patch + config.patch - 1


def _wider(span: Span, by: int) -> Span:
    return span[0] - by, span[1] + by


def _before_up(span: Span, up_sampling: str) -> Span:
    low, high = span
    if up_sampling == "transposed":  # output 2 i - 1 + k for k = 0, 1, 2
        return -((1 - low) // 2), (high + 1) // 2
    if up_sampling == "nearest":
        return (low - 1) // 2, (high + 1) // 2
    return low // 2 - 1, high // 2 + 1
