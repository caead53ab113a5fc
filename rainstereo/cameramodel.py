"""The `.cameramodel` file: mrcal's text format for one camera, read and written without mrcal.

The file is a Python dictionary literal. It is parsed as data (`ast.literal_eval`, never executed), its size is
bounded, and what mrcal keeps in it for its own tools (`optimization_inputs`) is carried through untouched.
"""

import ast
from pathlib import Path
from typing import Any

import numpy as np

MAX_BYTES = 256 << 20
REQUIRED = ("lensmodel", "intrinsics", "extrinsics", "imagersize")
RENAMED = {"lens_model": "lensmodel", "distortion_model": "lensmodel",
           "icam_intrinsics_optimization_inputs": "icam_intrinsics"}  # fmt: skip


def read(path: Path) -> dict[str, Any]:
    """The dictionary in a `.cameramodel` file. ValueError names the file and what is wrong with it."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; expected a .cameramodel file")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size} bytes; a .cameramodel of at most {MAX_BYTES} was expected")
    try:
        model = ast.literal_eval(path.read_text(encoding="utf-8"))
    except (ValueError, SyntaxError, MemoryError, RecursionError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{path} is no .cameramodel file ({type(error).__name__}: {error}); "
            "expected a dictionary as mrcal or `rainstereo calibrate` writes it"
        ) from error
    if not isinstance(model, dict):
        raise ValueError(f"{path} holds a {type(model).__name__}; expected a dictionary as mrcal writes it")
    model = {RENAMED.get(key, key): value for key, value in model.items()}
    if missing := [key for key in REQUIRED if key not in model]:
        raise ValueError(f"{path} lacks {', '.join(missing)}; a .cameramodel needs {', '.join(REQUIRED)}")
    model["lensmodel"] = str(model["lensmodel"]).replace("DISTORTION_", "LENSMODEL_")
    for key, length in (("intrinsics", None), ("extrinsics", 6), ("imagersize", 2)):
        try:
            values = np.asarray(model[key], dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: {key} must be numbers, not {model[key]!r:.80}") from error
        if values.ndim != 1 or (length and len(values) != length) or not np.isfinite(values).all():
            raise ValueError(f"{path}: {key} must be {length or 'some'} finite numbers, not {model[key]!r:.80}")
    return model


def text(model: dict[str, Any]) -> str:
    """A `.cameramodel` file's text; numbers in full precision, so that a round trip changes no bit."""
    lines = ["{"]
    lines += [f"    {key!r}: {_literal(value)},\n" for key, value in model.items() if value is not None]
    return "\n".join([*lines, "}", ""])


def _literal(value: Any) -> str:
    return repr(value.tolist() if isinstance(value, np.ndarray) else value)
