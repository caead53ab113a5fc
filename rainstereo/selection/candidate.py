"""An aligned pair as it comes from a recording, and what is measured of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Candidate:
    """A pair of files, and what is known of the moment. wet None: the partner is missing.

    timestamp_us: None where unknown; `time` then comes from the frame's number. time: seconds, comparable within a
    drive. regime: of the pump, "" unknown. sync_us: from one camera's exposure to the other's, NaN unknown.
    photometric: how the wet image's gray levels were mapped (`Photometric.text`), "" not.
    """

    name: str
    dry: Path | None
    wet: Path | None
    drive: str
    time: float
    timestamp_us: int | None = None
    regime: str = ""
    sync_us: float = math.nan
    photometric: str = ""


@dataclass(frozen=True)
class Measures:
    """Of one pair; NaN: not measured. problem: why there is nothing, such as a truncated file, else "".

    brightness: mean luma of the dry image, gray levels. clipped, dark: shares of it at 250 and above, at 8 and below.
    blur_px: of the dry image's edges (`edge_blur`). cover: `drop_cover` of the wet one. moved: share of the width by
    which the scene moved since the pair before. dirt: covered share of the dry side, of the run of pairs that this one
    is in. hash: of the dry image, as text.
    """

    problem: str = ""
    brightness: float = math.nan
    clipped: float = math.nan
    dark: float = math.nan
    blur_px: float = math.nan
    cover: float = math.nan
    moved: float = math.nan
    dirt: float = math.nan
    hash: str = ""
