"""Some cells of an image, computed alone: all of them are the generator; some of them, the generator with zeros."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from rainstereo.model.cell_generator import CellGenerator, patches, supported
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.pixels import to_batch, to_rgb
from rainstereo.types import Image, Mask
from tests.model.small_restorer import picture

PLAIN = GeneratorConfig(
    base_channels=4, downs=2, blocks=2, normalisation="none", padding="zeros", stem_kernel=3, output_residual=True
)
SHIPPED = replace(PLAIN, patch=4, downs=3, output_gate=True)
CONFIGS = {
    "shipped": SHIPPED,
    "no residual": replace(PLAIN, output_residual=False, stem_kernel=7),
    "channel norm": replace(PLAIN, normalisation="channel", level_blocks=1, up_sampling="nearest"),
    "separable": replace(PLAIN, block="separable", block_kernel=7, expansion=2, up_sampling="pixel_shuffle"),
    "batch norm": replace(SHIPPED, normalisation="batch", activation="silu", level_blocks=1),
    "one scale": replace(PLAIN, downs=0, patch=4),
}


def made(config: GeneratorConfig) -> Generator:
    torch.manual_seed(5)
    found = config.build()
    for module in found.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(module.weight, 0, 0.1)
            nn.init.normal_(module.bias, 0, 0.1)  # type: ignore[arg-type]
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, 0, 0.1)  # type: ignore[arg-type]
    return found.eval().double()


def by_cells(generator: Generator, image: Image, where: Mask, looked: Mask | None = None) -> Tensor:
    """(1, 3, H, W), zeros where nothing was computed."""
    cells = CellGenerator(generator, torch.float64)
    given = patches(image, where if looked is None else looked, cells.cell, cells.border)
    found = cells(to_batch(given, torch.device("cpu")), where, looked)
    out = torch.zeros(1, 3, where.shape[0] * cells.cell, where.shape[1] * cells.cell)
    for cell, row, column in zip(found, *np.nonzero(where), strict=True):
        out[0, :, row * cells.cell :, column * cells.cell :][:, : cells.cell, : cells.cell] = cell
    return out[:, :, : image.shape[0], : image.shape[1]]


def with_zeros(generator: Generator, image: Image, where: Mask, looked: Mask | None = None) -> Tensor:
    """The definition: every convolution but the first sees zeros outside the cells; on the way down, and first in each
    block at the coarsest scale, outside those looked at, which blocks leave as they are."""
    mask = torch.from_numpy(where.astype(float))[None, None]
    wide_mask = mask if looked is None else torch.from_numpy(looked.astype(float))[None, None]

    def sees(cells: Tensor) -> Any:
        def hook(_: nn.Module, given: tuple[Any, ...]) -> tuple[Any, ...]:
            return (given[0] * interpolate(cells, size=given[0].shape[2:], mode="nearest"),)

        return hook

    def leaves(_: nn.Module, given: tuple[Any, ...], changed: Tensor) -> Tensor:
        return torch.as_tensor(given[0] + mask * (changed - given[0]))

    hooks = []
    for name, module in generator.named_modules():
        early = name.startswith(("encoder_blocks", "downs")) or re.fullmatch(r"blocks\.\d+\.change\.0", name)
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d) and not name.startswith("stem"):
            hooks.append(module.register_forward_pre_hook(sees(wide_mask if early else mask)))
        elif re.fullmatch(r"blocks\.\d+", name):
            hooks.append(module.register_forward_hook(leaves))
    step = generator.config.multiple
    rgb = to_rgb(image, torch.device("cpu")).double()
    more = where.shape[0] * step - image.shape[0], where.shape[1] * step - image.shape[1]
    with torch.no_grad():
        found = generator(pad(rgb, (0, more[1], 0, more[0]), mode="reflect"))
    for handle in hooks:
        handle.remove()
    wide = interpolate(mask, scale_factor=float(step), mode="nearest")
    return (found * wide)[:, :, : image.shape[0], : image.shape[1]]


@pytest.mark.parametrize("name", CONFIGS)
def test_all_cells_are_the_generator(name: str) -> None:
    generator, image = made(CONFIGS[name]), picture(2, (75, 141))
    step = generator.config.multiple
    where = np.ones((-(-75 // step), -(-141 // step)), bool)
    with torch.no_grad():
        whole = generator(to_rgb(image, torch.device("cpu")).double())
    found = by_cells(generator, image, where)
    assert (whole - to_rgb(image, torch.device("cpu"))).abs().mean() > 0.01
    assert (found - whole).abs().max() < 1e-7


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("name", CONFIGS)
def test_some_cells_see_zeros_elsewhere(name: str, share: float) -> None:
    generator, image = made(CONFIGS[name]), picture(3, (75, 141))
    step = generator.config.multiple
    where = np.random.default_rng(int(10 * share)).random((-(-75 // step), -(-141 // step))) < share
    where[0, 0] = where[-1, -1] = True
    assert (by_cells(generator, image, where) - with_zeros(generator, image, where)).abs().max() < 1e-7


@pytest.mark.parametrize("name", CONFIGS)
def test_cells_that_are_looked_at_stay_as_they_are(name: str) -> None:
    generator, image = made(CONFIGS[name]), picture(3, (75, 141))
    step = generator.config.multiple
    draws = np.random.default_rng(4).random((-(-75 // step), -(-141 // step)))
    draws[0, 0], draws[-1, -1] = 0.0, 0.5
    where, looked = draws < 0.3, draws < 0.7
    found = by_cells(generator, image, where, looked)
    assert (found - with_zeros(generator, image, where, looked)).abs().max() < 1e-7
    if generator.config.downs:  # with one scale there is nothing on the way down
        assert (found - by_cells(generator, image, where)).abs().max() > 1e-4


def test_a_cell_depends_on_nothing_far_away() -> None:
    generator, image = made(SHIPPED), picture(4, (128, 128))
    where = np.zeros((4, 4), bool)
    where[1, 1] = True
    other = picture(9, (128, 128))
    other[28:68, 28:68] = image[28:68, 28:68]  # the cell and its border of 4 pixels
    assert torch.equal(by_cells(generator, image, where), by_cells(generator, other, where))


def test_half_precision_is_close() -> None:
    generator, image = made(SHIPPED), picture(4, (64, 96))
    where = np.array([[True, False, True], [True, True, False]])
    given = to_batch(patches(image, where, 32, 4), torch.device("cpu"))
    full = CellGenerator(generator, torch.float64)(given, where)
    half = CellGenerator(made(SHIPPED).bfloat16(), torch.bfloat16)(given, where)
    assert full.dtype == half.dtype == torch.float32
    assert 0 < (full - half).abs().max() < 0.03


def test_what_cannot_be_computed_by_cells_is_refused() -> None:
    for config in (replace(PLAIN, padding="reflect"), replace(PLAIN, normalisation="instance")):
        assert not supported(config)
        with pytest.raises(ValueError, match="cannot be computed by cells"):
            CellGenerator(config.build())
    cells = CellGenerator(made(SHIPPED))
    for given, where in (
        (torch.zeros(1, 3, 32, 32), np.ones((1, 1), bool)),
        (torch.zeros(0, 3, 40, 40), np.zeros((1, 1), bool)),
    ):
        with pytest.raises(ValueError, match="expected"):
            cells(given, where)
    with pytest.raises(ValueError, match="not looked at"):
        cells(torch.zeros(1, 3, 40, 40), np.ones((1, 2), bool), np.array([[True, False]]))
