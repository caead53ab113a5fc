"""Which file of the dry camera belongs to which of the wet one: folders or globs in, pairs by name out."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from glob import glob, has_magic
from pathlib import Path
from typing import TypeAlias

from .imagefile import SUFFIXES
from .rig import ROLES, Role

Source: TypeAlias = str | Path | Sequence[str | Path]
"""A folder, a glob such as `data/left*.jpg`, or a list of files."""

_SIDE_WORDS = re.compile(r"(?<![a-z])(left|right|l|r|dry|wet)(?![a-z])")
_CAMERA_WORDS = re.compile(r"(?<![a-z])(cam|camera)[ _-]?([0-9]{1,2}|[ab])(?![0-9a-z])")


@dataclass(frozen=True)
class Pair:
    """Two files of one moment. `name` is what their names share, unique among the pairs."""

    name: str
    dry: Path
    wet: Path

    def path(self, role: Role) -> Path:
        """The file of that camera."""
        return self.dry if role == "dry" else self.wet


@dataclass(frozen=True)
class Unpaired:
    """A file without a partner, and why."""

    path: Path
    role: Role
    reason: str


@dataclass(frozen=True)
class Pairing:
    """Pairs in the order of the dry camera's files, and the files that are left over."""

    pairs: tuple[Pair, ...]
    unpaired: tuple[Unpaired, ...]


def list_images(source: Source, role: Role) -> list[Path]:
    """Image files of a folder or a glob, sorted, or a list as it is. FileNotFoundError if there is none."""
    if not isinstance(source, str | Path):
        return [Path(path) for path in source]
    text = str(source)
    if Path(text).is_dir():
        paths = [path for path in Path(text).iterdir() if path.suffix.lower() in SUFFIXES]
    elif has_magic(text):
        paths = [Path(found) for found in glob(text, recursive=True)]  # noqa: PTH207 - Path.glob refuses absolute ones
    else:
        paths = [Path(text)]
        if not paths[0].exists():
            raise FileNotFoundError(f"{text}, given for the {role} images, does not exist; give a folder or a glob")
    paths = sorted(path for path in paths if not path.is_dir() and not path.name.startswith("."))
    if not paths:
        raise FileNotFoundError(f"there is no {role} image at {text}; looked for {', '.join(sorted(SUFFIXES))}")
    return paths


def match(dry: Source, wet: Source) -> Pairing:
    """Pair the images of two folders or globs by name: alike, or alike but for left/right, dry/wet, cam0/cam1.

    Of four rules, from equal names to equal last numbers, the strictest under which most files find a partner. A
    name that several files of one camera share pairs none of them. ValueError where both sources are the same
    files, or where their paths say that the cameras are swapped; FileNotFoundError where there is no image.
    """
    _refuse_swapped(dry, wet)
    files = {role: list_images(source, role) for role, source in zip(ROLES, (dry, wet), strict=True)}
    if set(files["dry"]) & set(files["wet"]):
        raise ValueError(
            f"the same images were given for both cameras ({dry} and {wet}); "
            "give two folders, or two globs such as 'data/left*.png' and 'data/right*.png'"
        )
    best: tuple[dict[str, Path], dict[str, Path]] = ({}, {})
    for level in range(4):
        sides = _by_key(files["dry"], level), _by_key(files["wet"], level)
        if len(sides[0].keys() & sides[1].keys()) > len(best[0].keys() & best[1].keys()):
            best = sides
    pairs = tuple(Pair(key or path.stem, path, best[1][key]) for key, path in best[0].items() if key in best[1])
    used = {pair.path(role) for pair in pairs for role in ROLES}
    unpaired = tuple(
        Unpaired(path, role, f"has no partner among the {len(files[other])} {other} images")
        for role, other in zip(ROLES, ROLES[::-1], strict=True)
        for path in files[role]
        if path not in used
    )
    return Pairing(pairs, unpaired)


def _keys(path: Path) -> tuple[str, str, str, str]:
    """Names by which an image may find its partner, strictest first."""
    stem = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path.stem).casefold()
    sideless = _SIDE_WORDS.sub("_", stem)
    cameraless = _CAMERA_WORDS.sub("_", sideless)
    numbers = re.findall(r"[0-9]+", stem)
    tidy = [re.sub(r"[^a-z0-9]+", "_", key).strip("_") for key in (sideless, cameraless)]
    return path.stem, tidy[0], tidy[1], numbers[-1] if numbers else stem


def _by_key(paths: list[Path], level: int) -> dict[str, Path]:
    keys = [_keys(path)[level] for path in paths]
    count = Counter(keys)
    return {key: path for key, path in zip(keys, paths, strict=True) if count[key] == 1}


def _refuse_swapped(dry: Source, wet: Source) -> None:
    """ValueError if the dry images' path speaks of wet and the wet images' of dry."""
    if not (isinstance(dry, str | Path) and isinstance(wet, str | Path)):
        return
    dry_parts, wet_parts = Path(dry).parts, Path(wet).parts
    shared = next((i for i, (a, b) in enumerate(zip(dry_parts, wet_parts, strict=False)) if a != b), 0)
    words = [set(re.findall(r"[a-z]+", " ".join(parts[shared:]).casefold())) for parts in (dry_parts, wet_parts)]
    if "wet" in words[0] - words[1] and "dry" in words[1] - words[0]:
        raise ValueError(
            f"the cameras look swapped: the dry images were given as {dry} and the wet ones as {wet}; "
            "exchange --dry and --wet"
        )
