"""The one module that talks to mrcal, and the only one that knows that its releases differ.

mrcal 2.2 (Debian 12) to 2.5 are served. What changed between them: 2.5 renamed `extrinsics_rt_fromref` to `rt_cam_ref`
and `frames_rt_toref` to `rt_ref_frame` (its `optimize` accepts the old names and ignores them); statistics lost
and changed keys, so none are read here: residuals come from the callback; 2.2 has no `__version__`. Model files are
written with the old names, which every release reads.

mrcal's C code prints to file descriptor 2 even when it is not verbose; `quiet` keeps that text off the terminal
and puts it into the error when a call fails.
"""

from __future__ import annotations

import base64
import importlib.metadata
import io
import os
import sys
import tempfile
import types
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse

from rainstereo.types import Array

HOW_TO_GET = (
    "calibration needs mrcal. On Debian 12 or Ubuntu with the system's Python: sudo apt-get install python3-mrcal "
    "(and let the environment see it, see README). With Python 3.12 or newer: pip install --no-deps mrcal numpysane"
)
LEGACY = {"rt_cam_ref": "extrinsics_rt_fromref", "rt_ref_frame": "frames_rt_toref"}
"""What mrcal called these before 2.5."""


class SolveError(RuntimeError):
    """mrcal could not do what was asked; the text carries what its C code printed."""


@lru_cache(maxsize=1)
def load() -> types.ModuleType:
    """The mrcal module. ImportError says how to get it."""
    try:
        with quiet():
            import mrcal
    except ImportError as error:
        hint = ""
        if "numpy" in str(error) or "_ARRAY_API" in str(error):
            hint = "; this build of mrcal was made for numpy 1: pip install 'numpy<2' 'opencv-python-headless<4.12'"
        raise ImportError(f"{HOW_TO_GET}{hint} (the import said: {error})") from error
    module: types.ModuleType = mrcal
    return module


@lru_cache(maxsize=1)
def renamed() -> bool:
    """True where mrcal uses the names of 2.5."""
    return hasattr(load().cameramodel, "rt_cam_ref")


def version() -> str:
    """Release of mrcal for reports; "2.2" and "2.4" can only be told by what they offer."""
    mrcal = load()
    try:
        return importlib.metadata.version("mrcal")
    except importlib.metadata.PackageNotFoundError:
        if renamed():
            return ">=2.5"
        return "2.4" if hasattr(mrcal, "residuals_board") else "2.2"


@dataclass
class Captured:
    """What was printed to file descriptor 2 within `quiet`."""

    text: str = ""


@contextmanager
def quiet() -> Iterator[Captured]:
    """Keep what C code prints to file descriptor 2 off the terminal; the text is there afterwards.

    The descriptor belongs to the whole process: other threads are silenced for that time too.
    """
    captured = Captured()
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # descriptor 2 is closed: nothing can be printed
        yield captured
        return
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield captured
        finally:
            sys.stderr.flush()
            os.dup2(kept, 2)
            os.close(kept)
            sink.seek(0)
            captured.text = sink.read(1 << 16).decode("utf-8", "replace")


@dataclass(frozen=True)
class Free:
    """Which parts of the state an optimisation may change."""

    core: bool = False
    distortions: bool = False
    extrinsics: bool = True
    frames: bool = True
    warp: bool = False


@dataclass
class Problem:
    """A calibration problem: boards seen by cameras of which the first is the reference frame.

    lensmodel: mrcal's name; all cameras share it.
    intrinsics: (cameras, k). rt_cam_ref: (cameras - 1, 6). rt_ref_board: (frames, 6). warp: (2,) or None, mrcal's
    `calobject_warp`, metres. observations: (M, rows, columns, 3): x, y in pixels and weight, 0 or less = ignored.
    indices: (M, 3): frame, camera, camera - 1; sorted. sizes: (cameras, 2) width, height. spacing: metres.
    lattice: where columns and rows stand, (columns,) and (rows,) metres, if not at steps of `spacing`; mrcal knows only
    such steps, `unequal_steps` does the rest.
    `optimize` changes all state in place and marks outliers by a negative weight.
    """

    lensmodel: str
    intrinsics: Array
    rt_cam_ref: Array
    rt_ref_board: Array
    observations: Array
    indices: np.ndarray[Any, np.dtype[np.int32]]
    sizes: np.ndarray[Any, np.dtype[np.int32]]
    spacing: float
    warp: Array | None = None
    free: Free = field(default_factory=Free)
    regularization: bool = True
    lattice: tuple[Array, Array] | None = None

    def copy(self, **changes: Any) -> Problem:
        """An independent copy; no array is shared. Keyword arguments replace fields."""
        own: dict[str, Any] = {
            name: np.array(getattr(self, name))
            for name in ("intrinsics", "rt_cam_ref", "rt_ref_board", "observations", "indices", "sizes")
        }
        own["warp"] = None if self.warp is None else np.array(self.warp)
        return replace(self, **{**own, **changes})

    def board(self, warp: Array | None = None) -> Array:
        """Corners of the board in its own frame, (rows, columns, 3) metres, flat unless a warp is given."""
        rows, columns = self.observations.shape[1:3]
        if self.lattice is None:
            return board_points(rows, columns, self.spacing, warp)
        x, y = self.lattice
        points = np.zeros((rows, columns, 3))
        points[..., 0], points[..., 1] = x, y[:, None]
        if warp is not None:
            u, v = (2 * along / along[-1] - 1 for along in (x, y))
            points[..., 2] = warp[0] * (1 - u**2) + warp[1] * (1 - v[:, None] ** 2)
        return points

    def arguments(self, legacy: bool | None = None) -> dict[str, Any]:
        """Keyword arguments for mrcal's functions, in its names; arrays are ours, so that mrcal changes them.

        legacy: names from before 2.5; by default whatever this mrcal wants.
        """
        names = LEGACY if (not renamed() if legacy is None else legacy) else {}
        for name, dtype in (("intrinsics", float), ("rt_cam_ref", float), ("rt_ref_board", float),
                            ("observations", float), ("indices", np.int32), ("sizes", np.int32)):  # fmt: skip
            array = getattr(self, name)
            if array.dtype != dtype or not array.flags.c_contiguous:
                setattr(self, name, np.ascontiguousarray(array, dtype=dtype))
        return {
            "lensmodel": self.lensmodel,
            "intrinsics": self.intrinsics,
            names.get("rt_cam_ref", "rt_cam_ref"): self.rt_cam_ref,
            names.get("rt_ref_frame", "rt_ref_frame"): self.rt_ref_board,
            "points": None,
            "observations_board": self.observations,
            "indices_frame_camintrinsics_camextrinsics": self.indices,
            "observations_point": None,
            "indices_point_camintrinsics_camextrinsics": None,
            "calobject_warp": self.warp,
            "imagersizes": self.sizes,
            "calibration_object_spacing": float(self.spacing),
            "verbose": False,
            "do_optimize_intrinsics_core": self.free.core,
            "do_optimize_intrinsics_distortions": self.free.distortions,
            "do_optimize_extrinsics": self.free.extrinsics and len(self.rt_cam_ref) > 0,
            "do_optimize_frames": self.free.frames,
            "do_optimize_calobject_warp": self.free.warp and self.warp is not None,
            "do_apply_regularization": self.regularization,
        }


@dataclass(frozen=True)
class Linearization:
    """Residuals and their derivatives at one state, in mrcal's packed (scaled, unitless) state.

    residuals: (rows,), weighted pixels; those of boards come first, in order of the observations, x before y;
    regularization follows. jacobian: (rows, states) sparse, with respect to the packed state.
    scale: (states,): state = scale * packed state.
    boards: how many leading rows belong to boards.
    """

    packed: Array
    residuals: Array
    jacobian: scipy.sparse.csr_matrix
    scale: Array
    boards: int


@dataclass(frozen=True)
class Layout:
    """Where things stand in the state vector; an empty slice for what is not optimised.

    slab: the parameters of the panels (`slab.Slab.names` in this order), which follow mrcal's state; mrcal's own
    functions know nothing of them. size counts them.
    """

    size: int
    intrinsics: tuple[slice, ...]
    intrinsics_columns: slice
    extrinsics: slice
    frames: slice
    warp: slice
    slab: slice = field(default_factory=lambda: slice(0, 0))

    def with_slab(self, count: int) -> Layout:
        """The same with `count` parameters of the panels behind mrcal's state, in place of those there were."""
        size = self.size - (self.slab.stop - self.slab.start)
        return replace(self, size=size + count, slab=slice(size, size + count) if count else slice(0, 0))


def optimize(problem: Problem, *, outliers: bool = False) -> None:
    """Solve in place. `outliers`: mark them (negative weights). SolveError where mrcal fails or diverges."""
    if problem.lattice is not None:
        if outliers:
            raise ValueError("mrcal's own rejection of outliers is for boards with equal steps only")
        from rainstereo.calib import unequal_steps

        unequal_steps.optimize(problem)
        _require_sane(problem)
        return
    mrcal = load()
    arguments = problem.arguments()
    printed = Captured()
    try:
        with quiet() as printed:
            mrcal.optimize(**arguments, do_apply_outlier_rejection=outliers)
    except Exception as error:  # mrcal raises bare RuntimeError and Exception
        raise SolveError(f"mrcal's optimisation failed: {error} {_tail(printed.text)}".strip()) from error
    _require_sane(problem, printed.text)


def _require_sane(problem: Problem, printed: str = "") -> None:
    state = [problem.intrinsics, problem.rt_cam_ref, problem.rt_ref_board]
    if not all(np.isfinite(part).all() for part in state) or not (problem.intrinsics[:, :2] > 0).all():
        raise SolveError(f"the optimisation diverged {_tail(printed)}".strip())


def residuals(problem: Problem) -> Array:
    """Projected minus observed corners, (M, rows, columns, 2) unweighted pixels; NaN where weight <= 0."""
    if problem.lattice is not None:
        from rainstereo.calib import unequal_steps

        return np.where(problem.observations[..., 2:] > 0, unequal_steps.off_by(problem), np.nan)
    with quiet():
        x = load().optimizer_callback(**problem.arguments(), no_jacobian=True, no_factorization=True)[1]
    shape = problem.observations.shape[:-1]
    board = np.array(x[: 2 * int(np.prod(shape))]).reshape(*shape, 2)
    weight = problem.observations[..., 2:]
    return np.divide(board, weight, out=np.full_like(board, np.nan), where=weight > 0)


def regularization(problem: Problem) -> Array:
    """Residuals of mrcal's regularization at the problem's state, (n,); empty without it."""
    mrcal, arguments = load(), problem.arguments()
    with quiet():
        x = mrcal.optimizer_callback(**arguments, no_jacobian=True, no_factorization=True)[1]
        boards = mrcal.num_measurements_boards(**arguments)
    return np.array(x[int(boards) :], dtype=np.float64)


def linearize(problem: Problem) -> Linearization:
    """Residuals and Jacobian at the problem's state."""
    mrcal, arguments = load(), problem.arguments()
    with quiet():
        packed, x, jacobian, _ = mrcal.optimizer_callback(**arguments, no_factorization=True)
        scale = np.ones_like(packed)
        mrcal.unpack_state(scale, **arguments)
        boards = mrcal.num_measurements_boards(**arguments)
    at = Linearization(np.array(packed), np.array(x), jacobian, scale, int(boards))
    if problem.lattice is None:
        return at
    from rainstereo.calib import unequal_steps

    off, by_state = unequal_steps.rows(problem, layout(problem), scale)
    rest = at.boards
    return replace(
        at,
        residuals=np.concatenate([off, at.residuals[rest:]]),
        jacobian=scipy.sparse.vstack([by_state, at.jacobian[rest:]], format="csr"),
    )


def ingest(problem: Problem, packed: Array) -> None:
    """Put a packed state into the problem's arrays.

    mrcal's own `ingest_packed_state` (2.2 to 2.5) leaves the intrinsics out where only their core or only their
    distortions are optimised, as with every splined model; hence this.
    """
    state, where = np.array(packed, dtype=np.float64), layout(problem)
    with quiet():
        load().unpack_state(state, **problem.arguments())
    for intrinsics, span in zip(problem.intrinsics, where.intrinsics, strict=True):
        if span.stop:
            intrinsics[where.intrinsics_columns] = state[span]
    if where.extrinsics.stop:
        problem.rt_cam_ref = state[where.extrinsics].reshape(-1, 6).copy()
    if where.frames.stop:
        problem.rt_ref_board = state[where.frames].reshape(-1, 6).copy()
    if where.warp.stop:
        problem.warp = state[where.warp].copy()


def layout(problem: Problem) -> Layout:
    """Where the cameras, frames and the warp stand in the state of `linearize`."""
    mrcal, arguments = load(), problem.arguments()
    cameras, parameters = problem.intrinsics.shape

    def span(what: str, *which: int, count: int | None = None) -> slice:
        total = int(getattr(mrcal, f"num_states_{what}")(**arguments))
        if not total:
            return slice(0, 0)
        start = int(getattr(mrcal, f"state_index_{what}")(*which, **arguments))
        return slice(start, start + (total if count is None else count))

    free = problem.free
    core = 4 if has_core(problem.lensmodel) else 0
    columns = slice(0 if free.core else core, parameters if free.distortions else core)
    per_camera = columns.stop - columns.start
    return Layout(
        size=int(mrcal.num_states(**arguments)),
        intrinsics=tuple(span("intrinsics", i, count=per_camera) for i in range(cameras)),
        intrinsics_columns=columns,
        extrinsics=span("extrinsics", 0),
        frames=span("frames", 0),
        warp=span("calobject_warp"),
    )


def parameters(lensmodel: str) -> int:
    """Number of intrinsics of a lens model. ValueError if mrcal does not know it."""
    mrcal = load()
    try:
        with quiet():
            return int(mrcal.lensmodel_num_params(lensmodel))
    except Exception as error:
        known = ", ".join(name for name in mrcal.supported_lensmodels() if "OPENCV" in name or "SPLINED" in name)
        raise ValueError(f"lens model {lensmodel!r} is unknown to mrcal; expected one of {known}") from error


def has_core(lensmodel: str) -> bool:
    """Whether the first four intrinsics are fx, fy, cx, cy."""
    return bool(load().lensmodel_metadata_and_config(lensmodel)["has_core"])


def project(points: Array, lensmodel: str, intrinsics: Array) -> Array:
    """Pixels, (..., 2), of points, (..., 3), in the camera's frame. Intrinsics broadcast."""
    return np.asarray(load().project(np.ascontiguousarray(points), lensmodel, np.ascontiguousarray(intrinsics)))


def project_gradients(points: Array, lensmodel: str, intrinsics: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2), and their derivatives by the point (..., 2, 3) and by the intrinsics (..., 2, k)."""
    pixels, by_point, by_intrinsics = load().project(
        np.ascontiguousarray(points), lensmodel, np.ascontiguousarray(intrinsics), get_gradients=True
    )
    return np.asarray(pixels), np.asarray(by_point), np.asarray(by_intrinsics)


def board_points(rows: int, columns: int, spacing: float, warp: Array | None = None) -> Array:
    """Corners of a board, (rows, columns, 3) metres, with mrcal's two-parameter warp."""
    points = load().ref_calibration_object(columns, rows, spacing, calobject_warp=warp)
    return np.asarray(points, dtype=np.float64)


def unproject(pixels: Array, lensmodel: str, intrinsics: Array) -> Array:
    """Unit rays, (..., 3), of pixels, (..., 2)."""
    return np.asarray(load().unproject(np.ascontiguousarray(pixels), lensmodel, intrinsics, normalize=True))


def carried(problem: Problem) -> list[dict[str, Any]]:
    """What mrcal's own tools want to find in each camera's model file: the whole problem, compressed.

    A board with unequal steps becomes a finer regular one, mostly unseen; if that is too fine, nothing is carried.

    Written in the names from before 2.5, which every release reads. Plain arrays only, no pickle.
    """
    cameras = range(len(problem.intrinsics))
    if problem.lattice is not None:
        from rainstereo.calib import unequal_steps

        regular = unequal_steps.as_regular(problem)
        if regular is None:
            return [{} for _ in cameras]
        problem = regular
    stream = io.BytesIO()
    inputs = {**problem.arguments(legacy=True), "do_apply_outlier_rejection": False}
    # mrcal has no None in these files; it reads an empty string as None
    inputs = {name: "" if value is None else value for name, value in inputs.items()}
    np.savez_compressed(stream, **inputs)
    packed = base64.b85encode(stream.getvalue())
    return [{"icam_intrinsics": camera, "optimization_inputs": packed} for camera in cameras]


def _tail(text: str, length: int = 300) -> str:
    text = " ".join(text.split())
    return f"(it printed: ...{text[-length:]})" if text else ""
