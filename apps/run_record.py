"""What a command did, as numbers: `report.json`, written whole or not at all.

Every command leaves one. Its results stand at the top level of the object, beside a few keys that all records share
(`command`, `status`, `options`, `seed`, `versions`, `argv`, `started`, `elapsed_s`).
"""

from __future__ import annotations

import dataclasses
import datetime
import enum
import importlib.metadata
import json
import math
import os
import platform
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

RESERVED = ("command", "status", "options", "seed", "versions", "argv", "started", "elapsed_s")


class Record:
    """Collects what a command found out and writes it as `report.json`.

    `record["rms_px"] = 0.147` notes a number; `record.status` is "ok" until somebody says otherwise. Values may be
    whatever `jsonable` understands. Keys in `RESERVED` belong to the record itself.
    """

    def __init__(self, command: str, options: object = None, seed: int | None = None) -> None:
        self.command = command
        self.status = "ok"
        self.options = options
        self.seed = seed if seed is not None else getattr(options, "seed", None)
        self.results: dict[str, object] = {}
        self._started = datetime.datetime.now(datetime.UTC)
        self._clock = time.perf_counter()

    def __setitem__(self, key: str, value: object) -> None:
        """Note a result. A reserved key raises ValueError: it would hide what the record says about itself."""
        if key in RESERVED:
            raise ValueError(f"result {key!r} would hide the record's own key of that name; choose another name")
        self.results[key] = value

    def __getitem__(self, key: str) -> object:
        return self.results[key]

    @property
    def elapsed(self) -> float:
        """Seconds since the record was opened."""
        return time.perf_counter() - self._clock

    def as_dict(self) -> dict[str, Any]:
        """The whole record in plain JSON types, in the order in which a reader would want it."""
        own = {
            "options": self.options,
            "seed": self.seed,
            "versions": versions(),
            "argv": sys.argv,
            "started": self._started.isoformat(timespec="seconds"),
            "elapsed_s": round(self.elapsed, 3),
        }
        plain = jsonable({"command": self.command, "status": self.status, **self.results, **own})
        if not isinstance(plain, dict):
            raise TypeError("a record is an object")
        return plain

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the record to `path` (atomically) and return the path."""
        return write_json(path, self.as_dict())


def jsonable(value: object, where: str = "$") -> Any:
    """`value` in types that strict JSON has.

    Dataclasses and mappings become objects, sequences, sets and numpy arrays lists, numpy scalars numbers, paths
    strings, enums their names. NaN and the infinities become null: JSON has neither, and no number may stand for "no
    answer". Anything else raises TypeError naming the place.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name), f"{where}.{f.name}") for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): jsonable(v, f"{where}.{k}") for k, v in value.items()}
    if isinstance(value, (set, frozenset)):
        return [jsonable(v, f"{where}{{}}") for v in sorted(value, key=str)]
    if isinstance(value, (list, tuple)):
        return [jsonable(v, f"{where}[{i}]") for i, v in enumerate(value)]
    if hasattr(value, "tolist") and hasattr(value, "dtype"):  # numpy, without importing it
        return jsonable(value.tolist(), where)
    raise TypeError(f"{where} is a {type(value).__name__}, which JSON cannot hold; convert it first")


def write_json(path: str | os.PathLike[str], value: object) -> Path:
    """Write `value` as indented strict JSON (NaN -> null), atomically."""
    text = json.dumps(jsonable(value), indent=1, allow_nan=False, ensure_ascii=False)
    return write_atomically(path, (text + "\n").encode())


def write_atomically(path: str | os.PathLike[str], data: bytes) -> Path:
    """Write `data` to `path` so that a reader, or a crash, finds the old file or the new one and never a half.

    Missing parent folders are made. The temporary file lies beside the target and is gone afterwards either way.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def versions() -> dict[str, str]:
    """Versions of what numbers depend on, for packages that are installed."""
    found = {"rainstereo": _installed("rainstereo") or "unknown", "python": platform.python_version()}
    for name, distributions in _PACKAGES.items():
        version = next(filter(None, map(_installed, distributions)), None)
        if version is not None:
            found[name] = version
    if "mrcal" not in found:
        mrcal = _mrcal_version()
        if mrcal is not None:
            found["mrcal"] = mrcal
    found["platform"] = f"{platform.system()} {platform.machine()}"
    return found


_PACKAGES = {
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "opencv": ("opencv-contrib-python-headless", "opencv-contrib-python", "opencv-python-headless", "opencv-python"),
    "mrcal": ("mrcal",),
    "torch": ("torch",),
    "numba": ("numba",),
}


def _installed(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _mrcal_version() -> str | None:
    """Debian's mrcal has no package metadata; the one module that touches mrcal knows its version."""
    try:
        from rainstereo.calib import mrcal_versions

        return mrcal_versions.version()
    except ImportError:
        return None
