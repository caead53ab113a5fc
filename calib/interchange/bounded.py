"""Text files from others, as data: bounded in size and depth, parsed into dictionaries, lists, numbers and strings.

YAML goes through PyYAML's safe loader with aliases refused (a few lines of them can stand for gigabytes). OpenCV's
files go through cv2.FileStorage, whose parser overruns the stack, and takes the process along, on a file that nests
deeply: such files never reach it. A matrix is read number by number, so that no size written in a file is allocated.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import yaml

MAX_BYTES = 1 << 20
MAX_DEPTH = 24
MAX_NUMBERS = 20000
HYPHENS = re.compile(r"^[ \t]*(?:-[ \t\r\n]+){8}", re.MULTILINE)
TAG = re.compile(r"<(/?)[A-Za-z_]")


def text_of(path: Path) -> str:
    """The text of a file of bounded size and depth; ValueError names the file and says why not."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected a calibration file")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size} bytes; a calibration of at most {MAX_BYTES} was expected")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text ({error.reason} at byte {error.start}); expected a calibration") from error
    if "\0" in text:
        raise ValueError(f"{path} holds zero bytes, so that it is no text; expected a calibration")
    if _depth(text) > MAX_DEPTH or HYPHENS.search(text) or re.search(rf"^ {{{8 * MAX_DEPTH}}}", text, re.MULTILINE):
        raise ValueError(f"{path} is nested more than {MAX_DEPTH} deep, which no calibration is; refused")
    return text


def yaml_of(text: str, path: Path) -> dict[str, Any]:
    """The mapping in a YAML text."""
    try:
        table = yaml.load(text, _Plain)  # noqa: S506 (it derives from SafeLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())[:300]}") from error
    if not isinstance(table, dict):
        raise ValueError(f"{path} holds {_kind(table)}; expected `key: value` lines that describe cameras")
    return {str(key): value for key, value in table.items()}


class _Plain(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML is untyped
    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("it repeats a part by an alias (*), which calibrations do not; write that part out")
        return super().compose_node(parent, index)


_Plain.add_implicit_resolver(  # 1e-05, which YAML 1.1 takes for a word
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?[0-9]+(?:\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def row(values: Iterable[float]) -> str:
    """Numbers in full precision as YAML 1.1 reads them: it takes 1e-05 for a word."""
    written = (repr(float(value)) for value in values)
    return f"[{', '.join(v if '.' in v or 'e' not in v else v.replace('e', '.0e') for v in written)}]"


def word(text: str) -> str:
    """A text as YAML reads it, on one line."""
    return str(yaml.safe_dump(text, width=MAX_BYTES)).splitlines()[0]


def opencv_of(text: str, path: Path) -> dict[str, Any]:
    """The mapping in an OpenCV FileStorage text (YAML, XML or JSON); a matrix becomes {rows, cols, data}."""
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
    except (cv2.error, SystemError) as error:
        told = " ".join(str(error).split())[:300]
        raise ValueError(f"{path} is no FileStorage file that OpenCV reads ({told}); write it with cv2.FileStorage") \
            from error  # fmt: skip
    try:
        table = _plain(root, path, [MAX_NUMBERS])
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged: {' '.join(str(error).split())[:300]}") from error
    finally:
        storage.release()
    if not isinstance(table, dict):
        raise ValueError(f"{path} holds {_kind(table)}; expected named nodes such as K1, D1, R, T")
    return table


def _plain(node: Any, path: Path, left: list[int]) -> Any:
    left[0] -= 1
    if left[0] < 0:
        raise ValueError(f"{path} holds more than {MAX_NUMBERS} values; a calibration of a few matrices was expected")
    if node.isMap():
        return {key: _plain(node.getNode(key), path, left) for key in node.keys()}  # noqa: SIM118 (no mapping)
    if node.isSeq():
        return [_plain(node.at(i), path, left) for i in range(node.size())]
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def _depth(text: str) -> int:
    """No bracket or tag is nested deeper than this; what stands in strings and comments counts, too."""
    deepest = depth = 0
    for character in re.findall(r"[\[\]{}]", text):
        depth = depth + 1 if character in "[{" else max(depth - 1, 0)
        deepest = max(deepest, depth)
    depth = 0
    for closing in TAG.findall(text):
        depth = max(depth - 1, 0) if closing else depth + 1
        deepest = max(deepest, depth)
    return deepest


def _kind(value: Any) -> str:
    return "nothing" if value is None else f"a {type(value).__name__}"
