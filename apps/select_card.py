"""The card that lies beside a data set: what it is, how it came about, and under which terms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rainstereo.apps.run_record import jsonable, versions, write_atomically, write_json
from rainstereo.apps.select_manifest import Row
from rainstereo.selection.choose import Selection, Settings
from rainstereo.selection.rejection import REASONS

SPLIT_ORDER = ("train", "val", "test")
RIG_FILES = ("dry.cameramodel", "wet.cameramodel", "chamber.toml")
MOST_BYTES = 1 << 20


def card(
    rows: Sequence[Row], selection: Selection, settings: Settings, total: int, sources: Sequence[str],
    licence: str, rig: Path | None, notes: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Everything in plain types, for card.json."""
    reasons = Counter(reason for reason, _ in selection.rejected.values())
    found: dict[str, Any] = {
        "pairs": len(rows),
        "of": total,
        "splits": {split: sum(row["split"] == split for row in rows) for split in SPLIT_ORDER},
        "reserved_for_labels": sum(bool(row["reserved"]) for row in rows),
        "rejected": {reason: reasons[reason] for reason in REASONS if reasons[reason]},
        "split_by": selection.split_by,
        "nearest_across_splits_bits": selection.nearest_across,
        "near_duplicate_bits": settings.near,
        "drives": _by_split(rows, "drive"),
        "regimes": _by_split(rows, "regime"),
        "cover": _spread([row["cover"] for row in rows]),
        "brightness": _spread([row["brightness"] for row in rows]),
        "settings": asdict(settings),
        "seed": settings.seed,
        "licence": licence or "not stated",
        "rig": rig_files(rig),
        "sources": list(sources),
        "notes": list(notes),
        "versions": versions(),
    }
    plain: dict[str, Any] = jsonable(found)
    return plain


def write_card(out: Path, found: Mapping[str, Any]) -> list[Path]:
    """OUT/card.json and OUT/CARD.md."""
    return [write_json(out / "card.json", found), write_atomically(out / "CARD.md", as_markdown(found).encode())]


def rig_files(rig: Path | None) -> dict[str, str]:
    """The texts of a rig folder; FileNotFoundError where it is none."""
    if rig is None:
        return {}
    texts = {}
    for name in RIG_FILES:
        path = rig / name
        if path.is_file():
            if path.stat().st_size > MOST_BYTES:
                raise ValueError(f"{path} is larger than {MOST_BYTES >> 20} MiB; that is no rig's file")
            texts[name] = path.read_text(encoding="utf-8")
    if not texts:
        raise FileNotFoundError(f"{rig} is no rig folder; expected {', '.join(RIG_FILES)} in it")
    return texts


def as_markdown(found: Mapping[str, Any]) -> str:
    """The card to be read."""
    splits, total = found["splits"], found["of"]
    lines = [
        "# Data set card", "",
        f"{found['pairs']} aligned pairs, one image through drops (wet) and one without (dry), of {total} recorded.",
        "Files, splits and measures: `manifest.csv`. What is not here, and why: `rejected.csv`. The same in numbers: "
        "`card.json`.", "",
        "## Terms", "", str(found["licence"]), "",
        "## Splits", "", "| split | pairs |", "|---|---|",
        *(f"| {split} | {count} |" for split, count in splits.items()), "",
        f"Split by {found['split_by']}; {found['reserved_for_labels']} test pairs are reserved for labels. "
        f"{_nearest(found)}", "",
        "## Drives and regimes", "", *_table(found["drives"], "drive"), "", *_table(found["regimes"], "regime"), "",
        "## What it looks like", "",
        "| measure | 10 % | median | 90 % |", "|---|---|---|---|",
        *(f"| {name} | {' | '.join('-' if v is None else f'{v:.3g}' for v in found[key].values())} |"
          for name, key in (("drop cover, share", "cover"), ("mean brightness, gray levels", "brightness"))), "",
        "Drop cover is estimated from the pair: drops that show what they hide are not seen.", "",
        "## Not taken", "", "| reason | pairs | what it means |", "|---|---|---|",
        *(f"| {reason} | {count} | {REASONS[reason]} |" for reason, count in found["rejected"].items()), "",
        "## How it was made", "",
        f"Seed {found['seed']}. " + ", ".join(f"{k} {v}" for k, v in found["versions"].items()) + ".", "",
        "Settings: " + ", ".join(f"{k} {v}" for k, v in found["settings"].items()) + ".", "",
        "Sources:", "", *(f"- {source}" for source in found["sources"]), "",
        *(["Rig: " + ", ".join(found["rig"]) + " (texts in `card.json`).", ""] if found["rig"] else
          ["Rig: not given.", ""]),
        *(["Notes:", "", *(f"- {note}" for note in found["notes"]), ""] if found["notes"] else []),
    ]  # fmt: skip
    return "\n".join(lines)


def _nearest(found: Mapping[str, Any]) -> str:
    bits, limit = found["nearest_across_splits_bits"], found["near_duplicate_bits"]
    if bits is None:
        return "Only one split holds pairs."
    return (
        f"The two most alike images of different splits differ in {bits:.0f} of 256 hash bits (limit: above {limit})."
    )


def _by_split(rows: Sequence[Row], column: str) -> dict[str, dict[str, int]]:
    names = sorted({row[column] for row in rows})
    return {
        name or "not known": {s: sum(r[column] == name and r["split"] == s for r in rows) for s in SPLIT_ORDER}
        for name in names
    }


def _table(counts: Mapping[str, Mapping[str, int]], what: str) -> list[str]:
    head = [f"| {what} | {' | '.join(SPLIT_ORDER)} |", "|---" * (len(SPLIT_ORDER) + 1) + "|"]
    return head + [f"| {name} | {' | '.join(str(each[s]) for s in SPLIT_ORDER)} |" for name, each in counts.items()]


def _spread(values: Sequence[float]) -> dict[str, float]:
    array = np.asarray(values, dtype=np.float64)
    array = array[np.isfinite(array)]
    found = np.quantile(array, (0.1, 0.5, 0.9)) if array.size else np.full(3, np.nan)
    return dict(zip(("low", "median", "high"), map(float, found), strict=True))
