"""Patch discriminators: published figures, what their layers give, and who learns when."""

import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch
from torch.nn import functional as nnf

from rainstereo.model.discriminator import Discriminator, DiscriminatorConfig, frozen
from rainstereo.model.generator import GeneratorConfig
from rainstereo.model.losses import GeneratorLoss, LossWeights, discriminator_loss
from rainstereo.model.macs import size_of

SMALL = DiscriminatorConfig(base_channels=4)


def built(config: DiscriminatorConfig) -> Discriminator:
    torch.manual_seed(0)
    return config.build()


def images(height: int, width: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_parameters_are_the_papers() -> None:
    layers = [(3, 64), (64, 128), (128, 256), (256, 512), (512, 1)]
    one = sum(16 * a * b + b for a, b in layers)
    assert one == 2_764_737
    assert size_of(DiscriminatorConfig())[0] == one
    assert size_of(DiscriminatorConfig(scales=3))[0] == 3 * one


def test_layers_written_out() -> None:
    discriminator = built(SMALL).double()
    weights = dict(discriminator.named_parameters())
    x = 2 * images(40, 56) - 1
    expected = []
    for i, stride in enumerate((2, 2, 2, 1, 1)):
        name = f"scales.0.layers.{i}.0"
        x = nnf.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], stride=stride, padding=2)
        if 0 < i < 4:
            centred = x - x.mean((2, 3), keepdim=True)
            x = centred / (centred.square().mean((2, 3), keepdim=True) + 1e-5).sqrt()
        x = torch.where(x > 0, x, 0.2 * x) if i < 4 else x
        expected.append(x)
    (found,) = discriminator(images(40, 56))
    assert [a.shape[1] for a in found] == [4, 8, 16, 32, 1]
    assert found[-1].shape == (1, 1, 8, 10)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


def test_a_patch_has_70_pixels() -> None:
    """1 + 3 + 3 pixels at an eighth of the size, 7 x 8, and 14 more of the first three layers."""
    discriminator = built(DiscriminatorConfig(base_channels=2, normalisation="none")).double()
    given = images(160, 160).requires_grad_()
    discriminator(given)[0][-1][0, 0, 10, 10].backward()
    assert given.grad is not None
    seen = given.grad[0].abs().sum((0, 1)).nonzero()
    assert int(seen.max() - seen.min()) + 1 == 70


def test_each_scale_sees_half_the_image_before() -> None:
    discriminator = built(DiscriminatorConfig(base_channels=4, scales=3)).double()
    given = images(33, 48)
    found = discriminator(given)
    assert len(found) == 3
    half = nnf.avg_pool2d(given, 3, 2, 1, count_include_pad=False)
    quarter = nnf.avg_pool2d(half, 3, 2, 1, count_include_pad=False)
    for i, scaled in enumerate((given, half, quarter)):
        for a, b in zip(found[i], discriminator.scales[i](2 * scaled - 1), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_smallest_side(scales: int) -> None:
    discriminator = built(DiscriminatorConfig(base_channels=2, scales=scales)).double()
    least = discriminator.config.smallest_side
    assert torch.isfinite(discriminator(images(least, least))[-1][-1]).all()
    with pytest.raises(ValueError, match=f"at least {least}"):
        discriminator(images(least, least - 1))


def test_conditional_sees_the_rainy_image() -> None:
    discriminator = built(DiscriminatorConfig(base_channels=4, conditional=True)).double()
    a, b = images(16, 16), images(16, 16, seed=1)
    assert not torch.equal(discriminator(a, a)[0][-1], discriminator(a, b)[0][-1])
    with pytest.raises(ValueError, match="needs rainy images"):
        discriminator(a)
    with pytest.raises(ValueError, match=r"got \(1, 3, 16, 8\)"):
        discriminator(a, b[:, :, :, :8])


def test_gradients() -> None:
    discriminator = built(DiscriminatorConfig(base_channels=2, layers=4, scales=2)).double()
    given = images(6, 7).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: discriminator(x)[1][-1], (given,), eps=1e-7, atol=1e-4)


def test_frozen_passes_gradients_and_gives_the_parameters_back() -> None:
    discriminator = built(SMALL).double()
    discriminator.scales[0].layers[0][0].bias.requires_grad_(False)
    before = [p.requires_grad for p in discriminator.parameters()]
    given = images(16, 16).requires_grad_()
    with frozen(discriminator):
        discriminator(given)[0][-1].sum().backward()
    assert given.grad is not None
    assert given.grad.abs().max() > 0
    assert all(p.grad is None for p in discriminator.parameters())
    assert [p.requires_grad for p in discriminator.parameters()] == before
    with pytest.raises(ValueError, match="images have shape"), frozen(discriminator):
        discriminator(given[0])
    assert [p.requires_grad for p in discriminator.parameters()] == before


def test_each_update_touches_only_its_own_parameters() -> None:
    """Both optimisers step in turn, as in training; what the other one holds stays bit for bit."""
    torch.manual_seed(0)
    generator = GeneratorConfig(base_channels=2, downs=1, blocks=1).build().double()
    discriminator = DiscriminatorConfig(base_channels=2, scales=2).build().double()
    losses = GeneratorLoss(LossWeights(lambda_perceptual=0))
    adam_g = torch.optim.Adam(generator.parameters(), 2e-4)
    adam_d = torch.optim.Adam(discriminator.parameters(), 2e-4)

    def values(module: torch.nn.Module) -> list[torch.Tensor]:
        return [p.detach().clone() for p in module.parameters()]

    def same(module: torch.nn.Module, earlier: list[torch.Tensor]) -> bool:
        return all(torch.equal(a, b) for a, b in zip(module.parameters(), earlier, strict=True))

    rainy, clear = images(16, 16), images(16, 16, seed=1)
    for _ in range(2):
        derained = generator(rainy)
        g, d = values(generator), values(discriminator)
        adam_d.zero_grad()
        discriminator_loss(discriminator, clear, derained).backward()
        assert all(p.grad is None for p in generator.parameters())
        adam_d.step()
        assert same(generator, g)
        assert not same(discriminator, d)
        d = values(discriminator)
        gradients = [p.grad.clone() for p in discriminator.parameters() if p.grad is not None]
        losses(clear, derained, discriminator)["total"].backward()
        assert all(
            torch.equal(p.grad, before)
            for p, before in zip(discriminator.parameters(), gradients, strict=True)
            if p.grad is not None
        )
        adam_g.step()
        adam_g.zero_grad()
        assert same(discriminator, d)
        assert not same(generator, g)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"layers": 2}, "layers 2 was given; expected a whole number in 3..8"),
        ({"scales": 0}, "scales 0"),
        ({"base_channels": "64"}, "base_channels '64'"),
        ({"normalisation": "batch"}, "expected 'instance' or 'none'"),
        ({"conditional": "yes"}, "conditional 'yes'"),
    ],
)
def test_options_that_are_refused(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        DiscriminatorConfig(**options)  # type: ignore[arg-type]
