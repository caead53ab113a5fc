"""Baselines as published: Eigen et al. 2013 and Pix2Pix; and restorers by name."""

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as nnf

from rainstereo.model.architecture import ARCHITECTURES, PUBLISHED, Config, configure, name_of, values_of
from rainstereo.model.dataset import Batch
from rainstereo.model.discriminator import DiscriminatorConfig
from rainstereo.model.eigen import EigenConfig
from rainstereo.model.losses import LossWeights
from rainstereo.model.macs import size_of
from rainstereo.model.pix2pix import Pix2PixConfig
from rainstereo.model.recipe import OptimizerOptions, Recipe
from rainstereo.model.train_step import Trainer

SMALL: dict[str, Mapping[str, object]] = {
    "generator": {"base_channels": 2, "downs": 2, "blocks": 1},
    "eigen2013": {"units": 4},
    "pix2pix": {"base_channels": 2, "downs": 5},
}


def images(height: int, width: int) -> torch.Tensor:
    draws = torch.Generator().manual_seed(0)
    return torch.rand(1, 3, height, width, generator=draws, dtype=torch.float64)


# -- Eigen et al. 2013 -------------------------------------------------------------------------------------------------


def test_eigens_parameters() -> None:
    assert size_of(EigenConfig())[0] == 16 * 16 * 3 * 512 + 512 + 512 * 512 + 512 + 8 * 8 * 512 * 3 + 3 == 754_691


def test_eigen_is_overlapping_patches() -> None:
    """As the paper tells it: each 16x16 patch predicts an 8x8 patch about its centre, and what overlaps is summed."""
    torch.manual_seed(0)
    network = EigenConfig(units=5).build().double()
    first, _, second, _, third = network.network
    given = images(40, 38)
    x = given[0] - 0.5
    total = torch.zeros_like(x)
    for top in range(40 - 15):
        for left in range(38 - 15):
            patch = x[:, top : top + 16, left : left + 16]
            hidden = torch.tanh((first.weight * patch).sum((1, 2, 3)) + first.bias)
            hidden = torch.tanh(second.weight[:, :, 0, 0] @ hidden + second.bias)
            # a convolution gathers; what it gathers at one place is spread from the other, mirrored
            made = torch.einsum("chij,h->cij", third.weight.flip(2, 3), hidden)
            total[:, top + 4 : top + 12, left + 4 : left + 12] += made
    expected = total + third.bias[:, None, None] + 0.5
    inside = (slice(None), slice(11, -11), slice(11, -11))
    torch.testing.assert_close(network(given)[0][inside], expected[inside], rtol=0, atol=1e-10)


def test_eigen_sees_23_pixels() -> None:
    network = EigenConfig(units=2).build().double()
    given = images(60, 60).requires_grad_()
    network(given)[0, 0, 30, 30].backward()
    assert given.grad is not None
    seen = given.grad[0].abs().sum((0, 1)).nonzero()
    assert (int(seen.min()), int(seen.max())) == (30 - 11, 30 + 11)
    assert network.reach == (1, 11, True)


# -- Pix2Pix -----------------------------------------------------------------------------------------------------------


def test_pix2pixs_parameters() -> None:
    """Down: C64-C128-C256-C512 x 5, up: C512 x 4-C256-C128-C64 and RGB, twice the channels in; scale and offset of each
    normalisation, which neither the first, the coarsest nor the last layer has."""
    down = [3, 64, 128, 256, 512, 512, 512, 512, 512]
    up_in, up_out = [512, 1024, 1024, 1024, 1024, 512, 256, 128], [512, 512, 512, 512, 256, 128, 64, 3]
    weights = sum(16 * a * b for a, b in pairwise(down))
    weights += sum(16 * a * b for a, b in zip(up_in, up_out, strict=True)) + 3
    weights += 2 * (sum(down[2:-1]) + sum(up_out[:-1]))
    assert size_of(Pix2PixConfig())[0] == weights == 54_413_955


def test_pix2pix_written_out() -> None:
    torch.manual_seed(0)
    network = Pix2PixConfig(base_channels=2, downs=3).build().double().eval()
    w = dict(network.named_parameters())
    for name, value in w.items():
        if name.endswith("2.bias"):
            torch.nn.init.normal_(value)

    def normal(x: torch.Tensor, name: str) -> torch.Tensor:
        centred = x - x.mean((2, 3), keepdim=True)
        x = centred / (centred.square().mean((2, 3), keepdim=True) + 1e-5).sqrt()
        return x * w[f"{name}.weight"][:, None, None] + w[f"{name}.bias"][:, None, None]

    def leaky(x: torch.Tensor) -> torch.Tensor:
        return torch.maximum(x, 0.2 * x)

    a = nnf.conv2d(2 * images(16, 24) - 1, w["downs.0.1.weight"], None, 2, 1)
    b = normal(nnf.conv2d(leaky(a), w["downs.1.1.weight"], None, 2, 1), "downs.1.2")
    c = nnf.conv2d(leaky(b), w["downs.2.1.weight"], None, 2, 1)
    c = normal(nnf.conv_transpose2d(c.clamp(min=0), w["ups.0.1.weight"], None, 2, 1), "ups.0.2")
    b = torch.cat([b, c], 1).clamp(min=0)
    b = normal(nnf.conv_transpose2d(b, w["ups.1.1.weight"], None, 2, 1), "ups.1.2")
    a = torch.cat([a, b], 1).clamp(min=0)
    expected = nnf.conv_transpose2d(a, w["ups.2.1.weight"], w["ups.2.1.bias"], 2, 1).tanh() / 2 + 0.5
    torch.testing.assert_close(network(images(16, 24)), expected, rtol=0, atol=1e-12)


def test_dropout_is_for_training() -> None:
    torch.manual_seed(0)
    network = Pix2PixConfig(base_channels=2, downs=5).build().double()
    given = images(32, 32)
    assert not torch.equal(network(given), network(given))
    network.eval()
    assert torch.equal(network(given), network(given))
    dropping = [isinstance(step[-1], torch.nn.Dropout) for step in Pix2PixConfig(base_channels=1).build().ups]
    assert dropping == [True, True, True, False, False, False, False, False]


# -- by name -----------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 50), width=st.integers(1, 50), name=st.sampled_from(sorted(SMALL)))
def test_any_size_goes_in_and_comes_out(height: int, width: int, name: str) -> None:
    network = configure(name, SMALL[name]).build().double().eval()
    with torch.no_grad():
        derained = network(images(height, width))
    assert derained.shape == (1, 3, height, width)
    assert ((derained >= 0) & (derained <= 1)).all()


@pytest.mark.parametrize("name", sorted(ARCHITECTURES))
def test_gradients(name: str) -> None:
    torch.manual_seed(0)
    network = configure(name, SMALL[name]).build().double()
    torch.nn.Module.eval(network)
    given = (0.3 + 0.4 * images(4, 5)).requires_grad_()
    assert torch.autograd.gradcheck(network, (given,), eps=1e-8, atol=1e-4, rtol=1e-2, fast_mode=True)


@pytest.mark.parametrize("config", [kind() for kind in ARCHITECTURES.values()] + [EigenConfig(7)])
def test_names_and_values_give_the_configuration_back(config: Config) -> None:
    assert configure(name_of(config), values_of(config)) == config
    assert all(type(value) in (str, int, float, bool) for value in values_of(config).values())


def test_every_architecture_has_its_recipe() -> None:
    assert set(PUBLISHED) == set(ARCHITECTURES)
    assert PUBLISHED["generator"].weights == LossWeights()
    for recipe in PUBLISHED.values():
        assert (recipe.discriminator is not None) == recipe.weights.need_discriminator
        if recipe.discriminator is not None and recipe.discriminator.conditional:
            assert recipe.pool == 0


@pytest.mark.parametrize("name", sorted(ARCHITECTURES))
def test_published_recipe_trains(name: str) -> None:
    """One step of the trainer's by each restorer's own losses. The verdict of Pix2Pix's untrained discriminator costs
    log 2, the cross-entropy of even odds."""
    published = PUBLISHED[name]
    recipe = Recipe(
        architecture=name,
        network=SMALL[name],
        discriminator=replace(published.discriminator or DiscriminatorConfig(), base_channels=2),
        losses=replace(published.weights, lambda_perceptual=0),
        optimizer=OptimizerOptions(pool=published.pool),
    )
    trainer = Trainer(recipe, torch.device("cpu"))
    before = [p.detach().clone() for p in trainer.generator.parameters()]
    rainy = images(32, 32).float()
    batch = Batch(rainy, rainy.flip(3), torch.zeros(1, 1, 32, 32), (0,), ("image",))
    stepped = trainer.step(batch, 0.0)
    assert not stepped.skipped
    assert any(not torch.equal(a, b) for a, b in zip(before, trainer.generator.parameters(), strict=True))
    assert ("discriminator" in stepped.losses) == published.weights.need_discriminator
    if name == "pix2pix":
        assert stepped.losses["discriminator"] == pytest.approx(math.log(2), abs=0.1)
        with pytest.raises(ValueError, match=r"set optimizer\.pool to 0"):
            replace(recipe, optimizer=OptimizerOptions(pool=50))


@pytest.mark.parametrize(
    ("name", "values", "complaint"),
    [
        ("unet", {}, "architecture 'unet' is unknown; expected one of 'generator'"),
        ("eigen2013", {"layers": 3}, "'eigen2013' has no option 'layers'; expected units"),
        ("eigen2013", {"units": 0}, "units 0"),
        ("pix2pix", {"downs": 1}, "downs 1"),
        ("pix2pix", {"dropout": 1.0}, "dropout 1.0"),
    ],
)
def test_what_is_refused(name: str, values: Mapping[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        configure(name, values)
