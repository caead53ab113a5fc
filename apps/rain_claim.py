"""An output folder belongs to the settings that fill it: so a run can go on, and never mixes two kinds of rain."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rainstereo.apps.rain_frames import NOTES, stamp
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.rain_sources import Source
from rainstereo.apps.run_record import versions, write_json


def key_of(rain: Rain, *others: Any) -> str:
    """Changes when any byte of the output might, the images being the same."""
    seen = None
    if rain.seen is not None:
        camera, chamber = rain.seen
        seen = camera.model, camera.intrinsics.tolist(), camera.size, repr(chamber)
    numbers = rain.seed, rain.depth, rain.tolerance, rain.border, rain.linear_light, rain.psnr, rain.psnr_tolerance
    merge = (*(("merge",) if rain.merge else ()), *(("quick",) if rain.quick else ()))
    made_with = [v for k, v in versions().items() if k in ("rainstereo", "numpy", "scipy", "opencv", "platform")]
    everything = repr((rain.setup, numbers, rain.share, seen, rain.listed, *merge, others, made_with))
    return hashlib.sha256(everything.encode()).hexdigest()[:16]


def claim(folder: Path, key: str, overwrite: bool) -> None:
    """Make the folder ours, or go on in it. ValueError where it holds the rain of other settings."""
    settings = folder / NOTES / "settings.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be written ({error.strerror}); name another folder as --out") from error
    found = _read(settings)
    if found.get("key") == key:
        return
    if found and not overwrite:
        raise ValueError(
            f"{folder} holds rain that other settings, versions or images made; name another --out, or replace it with "
            "--overwrite"
        )
    if found:
        shutil.rmtree(folder / NOTES / "notes", ignore_errors=True)
    write_json(settings, {"key": key})


def set_key(key: str, sources: Sequence[Source]) -> str:
    """Changes when the settings, or any image of a set, do."""
    listed = [(source.name, stamp(source.path)) for source in sources]
    return hashlib.sha256(repr((key, listed)).encode()).hexdigest()[:16]


def known_share(folder: Path, key: str) -> dict[str, Any] | None:
    """What was found for a set before: share, psnr, trials."""
    found = _read(folder / NOTES / "severity.json")
    return found if found.get("key") == key else None


def note_share(folder: Path, key: str, found: dict[str, Any]) -> None:
    """Keep it for later runs and other shards."""
    write_json(folder / NOTES / "severity.json", {"key": key, **found})


def _read(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except ValueError:
        return {"key": "unreadable"}
    return found if isinstance(found, dict) else {"key": "unreadable"}
