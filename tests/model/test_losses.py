"""The losses against values computed by hand, scikit-image and torch's own, and their gradients."""

import math

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch
from skimage.metrics import structural_similarity
from torch import nn
from torch.nn import functional as nnf

from rainstereo.model.discriminator import DiscriminatorConfig
from rainstereo.model.losses import (
    GeneratorLoss,
    LossWeights,
    adversarial,
    discrimination,
    discriminator_loss,
    dissimilarity,
    feature_distance,
    pixel,
    root_mean_square,
    squared,
)
from rainstereo.model.vgg import VggFeatures


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).view(1, 1, 1, -1)


def images(seed: int, side: int = 24) -> torch.Tensor:
    return torch.rand(2, 3, side, side, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# -- by hand -----------------------------------------------------------------------------------------------------------


def test_adversarial_by_hand() -> None:
    assert adversarial([tensor(1, 1)]).item() == 0
    assert adversarial([tensor(0.5, 2)]).item() == pytest.approx((0.25 + 1) / 2)
    assert adversarial([tensor(0.5, 2), tensor(3)]).item() == pytest.approx((0.625 + 4) / 2)


def test_discrimination_by_hand() -> None:
    assert discrimination([tensor(1, 1)], [tensor(0, 0)]).item() == 0
    assert discrimination([tensor(0.5, 1)], [tensor(0.2, -0.4)]).item() == pytest.approx(0.25 / 2 + (0.04 + 0.16) / 2)


def test_feature_distance_by_hand() -> None:
    """Three layers: weights 1/4, 1/2 and 1."""
    clear = [tensor(1, 2), tensor(0), tensor(-1, 0, 1)]
    derained = [tensor(2, 4), tensor(3), tensor(-1, 0, 4)]
    assert feature_distance(clear, derained).item() == pytest.approx(1.5 / 4 + 3 / 2 + 1)
    assert feature_distance(clear, clear).item() == 0
    with pytest.raises(ValueError, match="features of 3 and 2 layers"):
        feature_distance(clear, derained[:2])


def test_pixel_and_squared_by_hand() -> None:
    assert pixel(tensor(0, 1), tensor(0.5, 0.9)).item() == pytest.approx(0.3)
    assert squared(tensor(0, 1), tensor(0.5, 0.9)).item() == pytest.approx((0.25 + 0.01) / 4)


def test_root_mean_square_by_hand() -> None:
    """Of each image, then the mean over images: 0.3 and 0.1, where the root of all is 0.2236; 0 is the gradient of a
    perfect image."""
    clear = torch.zeros(2, 3, 4, 4, dtype=torch.float64)
    derained = clear.clone()
    derained[0], derained[1] = 0.3, -0.1
    assert root_mean_square(clear, derained).item() == pytest.approx(0.2, abs=1e-5)
    perfect = clear.clone().requires_grad_()
    root_mean_square(clear, perfect).backward()
    assert perfect.grad is not None
    assert perfect.grad.abs().max() == 0


def test_cross_entropy_is_torchs() -> None:
    clear, derained = tensor(0.3, -2, 80), tensor(1, -0.5, -90)
    bce = nnf.binary_cross_entropy_with_logits
    expected = (bce(clear, torch.ones_like(clear)) + bce(derained, torch.zeros_like(derained))) / 2
    torch.testing.assert_close(discrimination([clear], [derained], "cross_entropy"), expected)
    torch.testing.assert_close(adversarial([derained], "cross_entropy"), bce(derained, torch.ones_like(derained)))
    assert adversarial([tensor(0)], "cross_entropy").item() == pytest.approx(math.log(2))


def test_dissimilarity_is_scikit_images() -> None:
    a, b = images(0), (images(0) + 0.2 * images(1)).clamp(0, 1)
    expected = []
    for x, y in zip(a.numpy(), b.numpy(), strict=True):
        _, full = structural_similarity(  # type: ignore[no-untyped-call]
            x,
            y,
            channel_axis=0,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            full=True,
        )
        expected.append(full[:, 5:-5, 5:-5].mean())
    assert dissimilarity(a, b).item() == pytest.approx(1 - np.mean(expected), abs=1e-9)
    assert dissimilarity(a, a).item() == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="24 x 10 are too small"):
        dissimilarity(a[:, :, :10], b[:, :, :10])


# -- the sums ----------------------------------------------------------------------------------------------------------


class Halves(nn.Module):
    """Stands for a discriminator: two layers, x / 2 and 3 w x, of which the last predicts."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, given: torch.Tensor, rainy: torch.Tensor | None = None) -> list[list[torch.Tensor]]:
        del rainy
        return [[given / 2, 3 * self.w * given]]


class Doubled(nn.Module):
    """Stands for features: one layer, 2 x."""

    def forward(self, given: torch.Tensor) -> list[torch.Tensor]:
        return [2 * given]


def test_generators_loss_by_hand() -> None:
    """clear 0.5, derained 0.1 everywhere: adversarial (0.3 - 1)^2; msadv 0.2 / 2 + 1.2; perceptual 0.8; pixel 0.4."""
    clear, derained = torch.full((1, 3, 11, 11), 0.5).double(), torch.full((1, 3, 11, 11), 0.1).double()
    weights = LossWeights(2.0, 3.0, 5.0, 7.0, 11.0, lambda_rms=17.0, lambda_ssim=13.0)
    terms = GeneratorLoss(weights, Doubled())(clear, derained, Halves())
    ssim = (2 * 0.05 + 1e-4) / (0.25 + 0.01 + 1e-4)
    expected = {
        "adversarial": 0.49, "perceptual": 0.8, "msadv": 1.3, "pixel": 0.4, "squared": 0.08,
        "rms": (0.16 + 1e-6) ** 0.5, "ssim": 1 - ssim
    }  # fmt: skip
    expected["total"] = 2 * 0.49 + 3 * 0.8 + 5 * 1.3 + 7 * 0.4 + 11 * 0.08 + 17 * (0.16 + 1e-6) ** 0.5 + 13 * (1 - ssim)
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected)


def test_default_is_the_papers_sum() -> None:
    clear, derained = images(0), images(1)
    terms = GeneratorLoss(LossWeights(), Doubled())(clear, derained, Halves())
    assert set(terms) == {"adversarial", "perceptual", "msadv", "total"}
    torch.testing.assert_close(terms["total"], terms["adversarial"] + terms["perceptual"] + terms["msadv"])


def test_what_weighs_nothing_is_not_computed() -> None:
    weights = LossWeights(lambda_adversarial=0, lambda_perceptual=0, lambda_msadv=0, lambda_pixel=1)
    assert not weights.need_discriminator
    assert LossWeights().need_discriminator
    terms = GeneratorLoss(weights, Doubled())(images(0), images(1))
    assert set(terms) == {"pixel", "total"}


def test_only_derained_learns_from_the_generators_loss() -> None:
    clear, derained = images(0).requires_grad_(), images(1).requires_grad_()
    discriminator = Halves()
    GeneratorLoss(LossWeights(), Doubled())(clear, derained, discriminator)["total"].backward()
    assert derained.grad is not None
    assert clear.grad is None
    assert discriminator.w.grad is None


def test_only_the_discriminator_learns_from_its_loss() -> None:
    derained, discriminator = images(1).requires_grad_(), Halves()
    loss = discriminator_loss(discriminator, images(0), derained)
    torch.testing.assert_close(loss, (3 * images(0) - 1).square().mean() + (3 * derained).square().mean())
    loss.backward()
    assert derained.grad is None
    assert discriminator.w.grad is not None


@pytest.mark.parametrize("adversary", ["least_squares", "cross_entropy"])
def test_gradients(adversary: str) -> None:
    """With the networks that they are used with, small: of the generator's sum, by the derained images."""
    torch.manual_seed(0)
    discriminator = DiscriminatorConfig(base_channels=2, layers=3).build().double()
    weights = LossWeights(
        lambda_perceptual=0, lambda_pixel=1, lambda_squared=1, lambda_rms=1, lambda_ssim=1, adversary=adversary
    )
    losses = GeneratorLoss(weights)
    clear, derained = images(0, 12)[:1], images(1, 12)[:1].requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: losses(clear, x, discriminator)["total"], (derained,), eps=1e-7, atol=1e-4, fast_mode=True
    )


def test_gradients_of_the_perceptual_loss() -> None:
    vgg = VggFeatures().double()
    losses = GeneratorLoss(LossWeights(lambda_adversarial=0, lambda_msadv=0), vgg)
    clear, derained = images(0, 16)[:1], images(1, 16)[:1].requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: losses(clear, x)["total"], (derained,), eps=1e-7, atol=1e-4, fast_mode=True
    )


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"lambda_pixel": -1}, "lambda_pixel -1 was given"),
        ({"lambda_ssim": math.nan}, "lambda_ssim nan"),
        ({"lambda_msadv": math.inf}, "lambda_msadv inf"),
        ({"lambda_msadv": "1"}, "lambda_msadv '1'"),
        ({"lambda_adversarial": 0, "lambda_perceptual": 0, "lambda_msadv": 0}, "all lambdas are 0"),
        ({"adversary": "hinge"}, "adversary 'hinge' is unknown"),
    ],
)
def test_weights_that_are_refused(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        LossWeights(**options)  # type: ignore[arg-type]


def test_calls_that_are_refused() -> None:
    with pytest.raises(ValueError, match="no features were given"):
        GeneratorLoss(LossWeights())
    losses = GeneratorLoss(LossWeights(), Doubled())
    with pytest.raises(ValueError, match="no discriminator was given"):
        losses(images(0), images(1))
    with pytest.raises(ValueError, match="differ in shape"):
        losses(images(0), images(1, 12), Halves())
