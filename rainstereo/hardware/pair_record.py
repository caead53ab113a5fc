"""A pair of frames as a record of the log: what its meta says, and its data, the dry frame's bytes before the wet's."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from rainstereo.rig import ROLES, Role

from .codec import decode, encode
from .pair_frame import CameraFrame, PairFrame, PairStatus
from .pixel_format import PIXEL_FORMATS, check_format, is_bayer

LONGEST_SIDE = 16384
DTYPES: dict[str, np.dtype[Any]] = {"uint8": np.dtype(np.uint8), "uint16": np.dtype(np.uint16)}


def pack(pair: PairFrame, codecs: dict[Role, str]) -> tuple[dict[str, Any], bytes, bytes]:
    """The record's meta and the bytes of both frames."""
    meta: dict[str, Any] = {
        "id": pair.id,
        "status": str(pair.status),
        "sync_us": round(pair.sync_us, 3) if math.isfinite(pair.sync_us) else None,
        "regime": pair.regime,
    }
    data = []
    for role in ROLES:
        frame = pair.frame(role)
        check_format(frame.image, frame.pixel_format)
        data.append(encode(frame.image, codecs[role], is_bayer(frame.pixel_format)))
        meta[role] = {
            "id": frame.id,
            "device_ts_ns": frame.device_ts_ns,
            "host_ts_ns": frame.host_ts_ns,
            "format": frame.pixel_format,
            "codec": codecs[role],
            "shape": list(frame.image.shape),
            "dtype": frame.image.dtype.name,
            "bytes": len(data[-1]),
        }
    return meta, data[0], data[1]


def unpack(meta: bytes, data: bytes) -> PairFrame:
    """The pair again. ValueError where meta or data are not what `pack` writes."""
    said = parse(meta)
    frames: dict[str, CameraFrame] = {}
    start = 0
    for role in ROLES:
        own = said[role]
        end = start + own["bytes"]
        if end > len(data):
            raise ValueError(f"the {role} frame ends at byte {end} of {len(data)}; the record is damaged")
        shape, dtype = tuple(own["shape"]), np.dtype(DTYPES[own["dtype"]])
        image = decode(data[start:end], own["codec"], is_bayer(own["format"]), shape, dtype)
        check_format(image, own["format"])
        frames[role] = CameraFrame(image, own["id"], own["device_ts_ns"], own["host_ts_ns"], own["format"])
        start = end
    sync = math.nan if said["sync_us"] is None else float(said["sync_us"])
    status = PairStatus(said["status"])
    return PairFrame(said["id"], frames["dry"], frames["wet"], status, sync, said["regime"])


def parse(meta: bytes) -> dict[str, Any]:
    """What a pair's meta says, checked before anything is allocated. ValueError names what is wrong."""
    try:
        said = json.loads(meta)
        _expect(isinstance(said, dict), "it is no object")
        _expect(_whole(said["id"]), "id")
        _expect(isinstance(said["regime"], str), "regime")
        _expect(said["sync_us"] is None or isinstance(said["sync_us"], int | float), "sync_us")
        _expect(said["status"] in set(PairStatus), "status")
        for role in ROLES:
            own = said[role]
            _expect(_whole(own["id"]), "a frame's id")
            _expect(all(own[key] is None or _whole(own[key]) for key in ("device_ts_ns", "host_ts_ns")), "timestamps")
            _expect(own["format"] in PIXEL_FORMATS, "format")
            _expect(isinstance(own["codec"], str), "codec")
            _expect(own["dtype"] in DTYPES, "dtype")
            _expect(_whole(own["bytes"]) and own["bytes"] >= 0, "bytes")
            shape = own["shape"]
            _expect(isinstance(shape, list) and 2 <= len(shape) <= 3, "shape")
            _expect(all(_whole(n) and 1 <= n <= LONGEST_SIDE for n in shape), "shape")
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"the record's description cannot be understood ({error!r})") from error
    return dict(said)


def _whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _expect(right: bool, what: str) -> None:
    if not right:
        raise ValueError(f"the record's description is wrong: {what}")
