"""Which rainy image belongs to which clear one: the layouts of pair folders, known by what they hold.

| layout | known by |
|---|---|
| manifest of `rainstereo select` | `manifest.csv` with name, dry, wet, split |
| aligned folder of `rainstereo align` | `dry/` and `wet/` |
| Qian et al. 2018 | `data/` and `gt/` with K_rain, K_clean; or such names in one folder |
| RobotCar-rainy | left_T (rainy), right_T (clear), mask_T (road markings, unused here) |
| clear images only (CamVid and others) | anything else: rain is rendered |
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from rainstereo.imagefile import SUFFIXES
from rainstereo.model.recipe import Source
from rainstereo.pairs import Pairing, match

MOST = 10_000_000
"""Images of a run."""


@dataclass(frozen=True)
class Item:
    """A clear image and rainy versions of it. rainy empty: rain is rendered. masks: where drops are, one for each
    rainy."""

    name: str
    clear: Path
    rainy: tuple[Path, ...] = ()
    masks: tuple[Path, ...] = ()


def find(sources: Iterable[Source]) -> list[Item]:
    """The items of all sources, in order, each as often as its source repeats.

    FileNotFoundError where there is nothing; ValueError where a source says both or neither of folder and clear, or
    where rainy and clear images do not pair up.
    """
    items: list[Item] = []
    for source in sources:
        found = _of(source)
        if source.limit:
            count = min(source.limit, len(found))
            found = [found[i * len(found) // count] for i in range(count)]
        items += found * source.repeat
        if len(items) > MOST:
            raise ValueError(f"more than {MOST} images; lower repeat")
    return items


def _of(source: Source) -> list[Item]:
    if bool(source.folder) == bool(source.clear):
        raise ValueError(f"a source has folder {source.folder!r} and clear {source.clear!r}; give one of them")
    if source.repeat < 1 or source.limit < 0:
        raise ValueError(f"repeat {source.repeat} and limit {source.limit}; expected 1 or more, and 0 or more")
    if source.clear:
        return _banks(Path(source.clear), tuple(map(Path, source.rainy)))
    folder = Path(source.folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; give one of pairs, or of clear images")
    if (folder / "manifest.csv").is_file():
        return _manifest(folder / "manifest.csv", source.split)
    if source.split:
        raise ValueError(f"{folder} has no manifest.csv, so no split {source.split!r}; run rainstereo select on it")
    if (folder / "dry").is_dir() and (folder / "wet").is_dir():
        return _paired(match(folder / "dry", folder / "wet"), folder)
    if (folder / "data").is_dir() and (folder / "gt").is_dir():
        return _by_words([*_images(folder / "data"), *_images(folder / "gt")], "clean", "rain", folder)
    files = _images(folder)
    for clear, rainy in (("clean", "rain"), ("right", "left")):
        if {word for path in files if (word := _word(path, (clear, rainy)))} == {clear, rainy}:
            return _by_words(files, clear, rainy, folder)
    return _banks(folder, ())


def _banks(clear: Path, banks: tuple[Path, ...]) -> list[Item]:
    """Clear images, with versions in each of the banks."""
    items = {path.stem: Item(path.stem, path) for path in _images(clear)}
    if not items:
        raise FileNotFoundError(f"there is no image in {clear}; looked for {', '.join(sorted(SUFFIXES))}")
    for bank in banks:
        versions = {path.stem: path for path in _images(bank)}
        lacking = [name for name in items if name not in versions]
        if lacking:
            raise ValueError(
                f"{bank} has no version of {len(lacking)} of {len(items)} images of {clear}, such as {lacking[0]}; "
                "render it again, images are found by name"
            )
        for name, item in items.items():
            mask = bank / "masks" / f"{name}.png"
            masks = (*item.masks, mask) if mask.is_file() else ()
            items[name] = replace(item, rainy=(*item.rainy, versions[name]), masks=masks)
    complete = (replace(i, masks=i.masks if len(i.masks) == len(i.rainy) else ()) for i in items.values())
    return list(complete)


def _paired(pairing: Pairing, folder: Path) -> list[Item]:
    if not pairing.pairs:
        raise ValueError(f"no image of {folder}/dry has a partner in {folder}/wet; partners have one name")
    return [Item(pair.name, pair.dry, (pair.wet,)) for pair in pairing.pairs]


def _manifest(path: Path, split: str) -> list[Item]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.DictReader(file)
        columns = ["name", "dry", "wet", "split"]
        if (rows.fieldnames or [])[:4] != columns:
            raise ValueError(f"{path} begins with {rows.fieldnames}; expected the columns {', '.join(columns)}")
        items = [
            Item(row["name"], path.parent / row["dry"], (path.parent / row["wet"],))
            for row in rows
            if not split or row["split"] == split
        ]
    if not items:
        raise ValueError(f"{path} has no pair in split {split!r}; expected train, val or test")
    missing = next((p for item in items for p in (item.clear, *item.rainy) if not p.is_file()), None)
    if missing is not None:
        raise FileNotFoundError(f"{path} names {missing}, which does not exist; run rainstereo select again")
    return items


def _word(path: Path, words: tuple[str, ...]) -> str:
    parts = re.split(r"[^a-z]+", path.stem.casefold())
    return next((word for word in words if word in parts), "")


def _by_words(files: list[Path], clear: str, rainy: str, folder: Path) -> list[Item]:
    """Pairs whose names differ only in a word."""
    sides: dict[str, dict[str, Path]] = {clear: {}, rainy: {}}
    for path in files:
        word = _word(path, (clear, rainy))
        if word:
            sides[word][path.stem.casefold().replace(word, "").strip("_- ")] = path
    keys = sides[clear].keys() & sides[rainy].keys()
    if not keys:
        raise ValueError(f"{folder}: no *{rainy}* image has a *{clear}* partner of the same number")
    order = sorted(keys, key=lambda key: (len(key), key))
    return [Item(key, sides[clear][key], (sides[rainy][key],)) for key in order]


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder")
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
