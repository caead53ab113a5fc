"""The losses of "I Can See Clearly Now" (Porav, Bruls, Newman, ICRA 2019), section IV, and those of the baselines.

    L_adv   = (D(G(rainy)) - 1)^2
    L_disc  = (D(clear) - 1)^2 + D(derained)^2, derained from the pool
    L_perc  = sum_i 1/w_i |VGG(clear)_i - VGG(G(rainy))_i|_1,  w_i = 2^(n - i), i = 1 .. n
    L_msadv = the same over the discriminator's n layers
    L_gen   = sum of lambda x loss

A square and a norm are averaged over what they are taken of (patches, elements of a layer), as in Pix2PixHD, so that
the balance does not depend on the image's size; of several discriminators at several scales the mean is taken, too.

Pix2Pix (Isola et al., CVPR 2017, equations 1 to 4) has the cross-entropy in place of the squares, and L1. There, and
here, the generator minimises -log D(G(rainy)), and the discriminator half of its objective.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from kornia.metrics import ssim
from torch import Tensor, nn
from torch.nn.functional import softplus

from rainstereo.model.discriminator import Activations, frozen

SSIM_WINDOW = 11
RMS_FLOOR = 1e-6
"""Added to mean squares, so that a perfect image has a gradient."""
ADVERSARIES = ("least_squares", "cross_entropy")


@dataclass(frozen=True)
class LossWeights:
    """The lambdas of L_gen; the defaults are the paper's. A loss of weight 0 is not computed.

    adversarial: L_adv. perceptual: L_perc. msadv: L_msadv. pixel: mean absolute difference. squared: half of the mean
    squared difference, as Eigen et al. 2013. rms: root of an image's mean squared difference. ssim: 1 - SSIM.
    adversary: "least_squares" or "cross_entropy" (Pix2Pix).
    """

    lambda_adversarial: float = 1.0
    lambda_perceptual: float = 1.0
    lambda_msadv: float = 1.0
    lambda_pixel: float = 0.0
    lambda_squared: float = 0.0
    lambda_rms: float = 0.0
    lambda_ssim: float = 0.0
    adversary: str = "least_squares"

    def __post_init__(self) -> None:
        if self.adversary not in ADVERSARIES:
            expected = " or ".join(map(repr, ADVERSARIES))
            raise ValueError(f"adversary {self.adversary!r} is unknown; expected {expected}")
        lambdas = [field.name for field in fields(self) if field.name.startswith("lambda_")]
        values = {name: getattr(self, name) for name in lambdas}
        for name, value in values.items():
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < math.inf:
                raise ValueError(f"{name} {value!r} was given; expected a finite number of at least 0")
        if not any(values.values()):
            raise ValueError("all lambdas are 0, so there is nothing to learn from; give one of them a weight")

    @property
    def need_discriminator(self) -> bool:
        """Whether there is any use in training one."""
        return self.lambda_adversarial > 0 or self.lambda_msadv > 0


def adversarial(predictions: Sequence[Tensor], adversary: str = "least_squares") -> Tensor:
    """L_adv of the discriminators' predictions for derained images, one a scale."""
    if adversary == "cross_entropy":
        return _mean([softplus(-p).mean() for p in predictions])
    return _mean([(p - 1).square().mean() for p in predictions])


def discrimination(clear: Sequence[Tensor], derained: Sequence[Tensor], adversary: str = "least_squares") -> Tensor:
    """L_disc of the predictions for clear images, and for derained ones from the pool, one a scale."""
    pairs = list(zip(clear, derained, strict=True))
    if adversary == "cross_entropy":
        return _mean([(softplus(-c).mean() + softplus(d).mean()) / 2 for c, d in pairs])
    return _mean([(c - 1).square().mean() + d.square().mean() for c, d in pairs])


def feature_distance(clear: Sequence[Tensor], derained: Sequence[Tensor]) -> Tensor:
    """L_perc, or L_msadv at one scale, of the features of n layers, the first first. The clear ones are constants."""
    if len(clear) != len(derained) or not clear:
        raise ValueError(f"features of {len(clear)} and {len(derained)} layers; expected as many, and at least one")
    n = len(clear)
    terms = (
        (c.detach() - d).abs().mean() / 2 ** (n - i) for i, (c, d) in enumerate(zip(clear, derained, strict=True), 1)
    )
    return torch.stack(list(terms)).sum()


def pixel(clear: Tensor, derained: Tensor) -> Tensor:
    """Mean absolute difference."""
    return (clear - derained).abs().mean()


def squared(clear: Tensor, derained: Tensor) -> Tensor:
    """Half of the mean squared difference."""
    return (clear - derained).square().mean() / 2


def root_mean_square(clear: Tensor, derained: Tensor) -> Tensor:
    """Root of each image's mean squared difference, mean over images: what PSNR counts, and no image counts for many.

    With a gate on the output, means of absolute differences can close the gate for good; this does not.
    """
    return ((clear - derained).square().mean((1, 2, 3)) + RMS_FLOOR).sqrt().mean()


def dissimilarity(clear: Tensor, derained: Tensor) -> Tensor:
    """1 - SSIM (Z. Wang et al. 2004), mean over windows inside: Gaussian, 11 x 11, sigma 1.5; values in 0..1."""
    if min(clear.shape[2:]) < SSIM_WINDOW:
        raise ValueError(
            f"images of {clear.shape[3]} x {clear.shape[2]} are too small for SSIM's window of {SSIM_WINDOW} pixels; "
            "train on larger crops or set lambda_ssim to 0"
        )
    return 1 - ssim(clear, derained, SSIM_WINDOW, 1.0, eps=0.0, padding="valid").mean()


def discriminator_loss(
    discriminator: nn.Module,
    clear: Tensor,
    derained: Tensor,
    rainy: Tensor | None = None,
    adversary: str = "least_squares",
) -> Tensor:
    """L_disc. derained: from the pool; no gradient reaches what made it. rainy: for a conditional discriminator, which
    needs a pool of size 0: images from it are not of the same scene."""
    seen = _predictions(discriminator(clear, rainy)), _predictions(discriminator(derained.detach(), rainy))
    return discrimination(*seen, adversary)


class GeneratorLoss(nn.Module):
    """L_gen and its terms. features: images to a list of layers' features, such as `vgg.VggFeatures`."""

    def __init__(self, weights: LossWeights, features: nn.Module | None = None) -> None:
        super().__init__()
        if weights.lambda_perceptual and features is None:
            raise ValueError("lambda_perceptual is not 0, but no features were given; pass a vgg.VggFeatures")
        self.weights = weights
        self.features = features if weights.lambda_perceptual else None

    def forward(
        self,
        clear: Tensor,
        derained: Tensor,
        discriminator: nn.Module | None = None,
        rainy: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """Each loss of a weight above 0 by its name, unweighted, and "total", weighted.

        The discriminator's parameters get no gradient. rainy: for a conditional one.
        """
        if clear.shape != derained.shape:
            raise ValueError(f"clear images {tuple(clear.shape)} and derained {tuple(derained.shape)} differ in shape")
        weights = self.weights
        terms: dict[str, Tensor] = {}
        if weights.need_discriminator:
            if discriminator is None:
                raise ValueError("lambda_adversarial or lambda_msadv is not 0, but no discriminator was given")
            with frozen(discriminator):
                seen = discriminator(derained, rainy)
                if weights.lambda_adversarial:
                    terms["adversarial"] = adversarial(_predictions(seen), weights.adversary)
                if weights.lambda_msadv:
                    with torch.no_grad():
                        expected = discriminator(clear, rainy)
                    scales = zip(expected, seen, strict=True)
                    terms["msadv"] = _mean([feature_distance(c, d) for c, d in scales])
        if self.features is not None:
            with torch.no_grad():
                wanted = self.features(clear)
            terms["perceptual"] = feature_distance(wanted, self.features(derained))
        if weights.lambda_pixel:
            terms["pixel"] = pixel(clear, derained)
        if weights.lambda_rms:
            terms["rms"] = root_mean_square(clear, derained)
        if weights.lambda_squared:
            terms["squared"] = squared(clear, derained)
        if weights.lambda_ssim:
            terms["ssim"] = dissimilarity(clear, derained)
        weighted = [getattr(weights, f"lambda_{name}") * term for name, term in terms.items()]
        return terms | {"total": torch.stack(weighted).sum()}


def _predictions(scales: Sequence[Activations]) -> list[Tensor]:
    return [activations[-1] for activations in scales]


def _mean(terms: Sequence[Tensor]) -> Tensor:
    return torch.stack(list(terms)).mean()
