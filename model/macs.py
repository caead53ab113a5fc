"""Counts of parameters and of multiply-accumulates (MACs), the figures by which networks are compared.

A MAC is one multiplication and addition of a convolution's or linear layer's weights; biases, normalisations and
activations are not counted, and products with padding are, as is usual.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn


class Buildable(Protocol):
    """A network's configuration."""

    def build(self) -> nn.Module:
        """The module."""


def parameters(module: nn.Module) -> int:
    """How many numbers training adjusts."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def macs(module: nn.Module, *inputs: Tensor) -> int:
    """Of one call of the module. On the meta device nothing is computed, only counted."""
    total = 0

    def count(layer: nn.Module, given: tuple[Tensor, ...], made: Tensor) -> None:
        nonlocal total
        if isinstance(layer, nn.ConvTranspose2d):  # every input value is spread by the whole kernel
            total += given[0].numel() * layer.weight[0].numel()
        elif isinstance(layer, nn.Conv2d):  # every output value gathers through the whole kernel
            total += made.numel() * layer.weight[0].numel()
        elif isinstance(layer, nn.Linear):
            total += made.numel() * layer.in_features

    kinds = (nn.Conv2d, nn.ConvTranspose2d, nn.Linear)
    hooks = [layer.register_forward_hook(count) for layer in module.modules() if isinstance(layer, kinds)]
    try:
        with torch.no_grad():
            module(*inputs)
    finally:
        for hook in hooks:
            hook.remove()
    return total


def size_of(config: Buildable, width: int = 640, height: int = 480) -> tuple[int, int]:
    """Parameters, and MACs for one RGB image of a size, without computing or storing anything."""
    with torch.device("meta"):
        module = config.build().eval()
        return parameters(module), macs(module, torch.empty(1, 3, height, width))
