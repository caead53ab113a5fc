"""Which file of the dry camera belongs to which of the wet one: folders or globs in, pairs by name out."""

from __future__ import annotations

import glob
import re
from dataclasses import dataclass
from pathlib import Path

from .imagefile import SUFFIXES

_ROLE = re.compile(r"(?<![a-z])(left|right|dry|wet|rainy|clear|cam(?:era)?_?[01]|l|r)(?![a-z])", re.IGNORECASE)
_SIDES = {
    "dry": re.compile(r"(?<![a-z])dry(?![a-z])", re.IGNORECASE),
    "wet": re.compile(r"(?<![a-z])wet(?![a-z])", re.IGNORECASE),
}


@dataclass(frozen=True)
class Pair:
    """Two files of one moment. `name` is what their names share, unique among the pairs."""

    name: str
    dry: Path
    wet: Path


@dataclass(frozen=True)
class Pairing:
    """Pairs in the order of their names, and files that have no partner, with the reason."""

    pairs: tuple[Pair, ...]
    unpaired: tuple[tuple[Path, str], ...]


def list_images(source: str) -> list[Path]:
    """Image files of a folder or a glob, sorted. FileNotFoundError if there is no such folder or no match."""
    folder = Path(source)
    if folder.is_dir():
        found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and not path.name.startswith(".")]
        if not found:
            raise FileNotFoundError(f"{source} holds no image; expected {', '.join(sorted(SUFFIXES))} files")
    else:
        found = [Path(name) for name in glob.glob(source) if Path(name).suffix.lower() in SUFFIXES]  # noqa: PTH207  may be absolute
        if not found:
            raise FileNotFoundError(f"{source} is no folder and matches no image; give a folder or a quoted glob")
    return sorted(found)


def match(dry: str, wet: str) -> Pairing:
    """Pairs of two folders or globs, matched by what is left of each name without the word for its role.

    `left01.jpg` goes with `right01.jpg`, `0007.png` with `0007.png`. ValueError where the folders' names say that
    the roles are swapped, or a name is not unique in its role.
    """
    if _says(dry, "wet") and not _says(dry, "dry") and _says(wet, "dry") and not _says(wet, "wet"):
        raise ValueError(
            f"the cameras are swapped: --dry {dry} and --wet {wet} were given. Give each folder to its own role"
        )
    files = {"dry": _by_key(dry), "wet": _by_key(wet)}
    shared = sorted(files["dry"].keys() & files["wet"].keys())
    unpaired = [
        (path, f"no {other} image of this name")
        for role, other in (("dry", "wet"), ("wet", "dry"))
        for key, path in sorted(files[role].items())
        if key not in files[other]
    ]
    return Pairing(tuple(Pair(key, files["dry"][key], files["wet"][key]) for key in shared), tuple(unpaired))


def _says(source: str, role: str) -> bool:
    return bool(_SIDES[role].search(source))


def _by_key(source: str) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for path in list_images(source):
        key = _ROLE.sub("", path.stem).strip("_-. ") or path.stem
        if key in files:
            raise ValueError(
                f"{files[key]} and {path} have the same name apart from their role; give one role's images at a time, "
                "for instance with a glob like 'boards/left*.png'"
            )
        files[key] = path
    return files
