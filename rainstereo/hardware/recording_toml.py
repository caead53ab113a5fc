"""`recording.toml`: what a recording is, as text that people read and the log repeats."""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

NAME = "recording.toml"
FORMAT = 1


def read_about(path: Path) -> dict[str, Any]:
    """The table in a recording.toml. ValueError where it is none, or of a format that this version does not read."""
    try:
        about = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no {NAME} ({error}); run rainstereo record repair {path.parent}") from error
    if about.get("format") != FORMAT:
        raise ValueError(f"{path} has the format {about.get('format')!r}; this version reads {FORMAT}")
    return about


def write_about(path: Path, about: Mapping[str, Any]) -> None:
    """Write the table, whole or not at all, and durably."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("w", encoding="utf-8") as file:
            file.write(toml(about))
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def toml(table: Mapping[str, Any], name: str = "") -> str:
    """A table of strings, numbers, truth values, lists of those and tables, as TOML. None is left out."""
    plain = {key: value for key, value in table.items() if value is not None and not isinstance(value, Mapping)}
    lines = [f"{_key(key)} = {_value(value)}\n" for key, value in plain.items()]
    if name and (lines or not table):
        lines.insert(0, f"\n[{name}]\n")
    for key, value in table.items():
        if isinstance(value, Mapping):
            lines.append(toml(value, f"{name}.{_key(key)}" if name else _key(key)))
    return "".join(lines)


def _key(key: str) -> str:
    plain = key and all(c.isascii() and (c.isalnum() or c in "-_") for c in key)
    return key if plain else json.dumps(key)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value).replace("\x7f", "\\u007f")  # a JSON string is a TOML string, but for this
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    raise ValueError(f"a {type(value).__name__} was given; TOML here holds strings, numbers, lists and tables")
