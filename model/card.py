"""Cards: small TOML texts that say what a file of weights is. Read by tomllib, written here, since Python only
reads."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from typing import Any, TypeAlias

Card: TypeAlias = dict[str, Any]
"""Strings, numbers, booleans, lists of them, and tables of such."""

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def to_toml(card: Mapping[str, Any]) -> str:
    """TOML text of nested mappings; None is left out. ValueError for what TOML cannot say, naming the key."""
    lines: list[str] = []
    _table(card, "", lines)
    return "\n".join(lines).strip() + "\n"


def from_toml(text: str) -> Card:
    """The card in a text; ValueError if it is none."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML: {error}") from error


def _table(table: Mapping[str, Any], prefix: str, lines: list[str]) -> None:
    plain = {key: value for key, value in table.items() if not isinstance(value, Mapping) and value is not None}
    if prefix and (plain or not table):
        lines += ["", f"[{prefix}]"]
    lines += [f"{_key(key)} = {_value(value, key)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, Mapping):
            _table(value, f"{prefix}.{_key(key)}" if prefix else _key(key), lines)


def _key(key: str) -> str:
    return key if _BARE.fullmatch(key) else _text(key)


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _value(value: object, key: str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else {math.inf: "inf", -math.inf: "-inf"}.get(value, "nan")
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_value(item, key) for item in value)}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v, k)}" for k, v in value.items()) + " }" if value else "{}"
    raise ValueError(f"{key} is a {type(value).__name__}, which a card cannot hold; give text, numbers, lists, tables")
