"""Networks by name: what a configuration or a checkpoint's card calls them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from torch import nn

from rainstereo.model.generator import GeneratorConfig

CONFIGS: dict[str, Any] = {"derain": GeneratorConfig}
"""Name -> frozen dataclass of plain values with `.build() -> nn.Module`."""


def config_of(name: str, values: Mapping[str, Any]) -> Any:
    """The configuration of a network; ValueError for a name or a key that is unknown, with those that there are."""
    if name not in CONFIGS:
        raise ValueError(f"architecture {name!r} is unknown; there are {', '.join(sorted(CONFIGS))}")
    known = {field.name for field in fields(CONFIGS[name])}
    for key in values:
        if key not in known:
            raise ValueError(f"{name} has no option {key!r}; it has {', '.join(sorted(known))}")
    plain = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return CONFIGS[name](**plain)


def build(name: str, values: Mapping[str, Any]) -> nn.Module:
    """The network, with initial weights from torch's generator."""
    module: nn.Module = config_of(name, values).build()
    return module
