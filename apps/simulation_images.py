"""Renders the images of a simulation into its folder: in threads, resumably, the same bytes in any order.

Each view (a camera, with or without the chamber) is traced once and serves all its images. Threads suffice: nearly
all the time is spent in numpy and OpenCV, which let other threads run.
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Callable
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rainstereo.apps.board_views import render_board, room
from rainstereo.apps.run_record import write_atomically
from rainstereo.apps.simulation import Simulation
from rainstereo.pose import compose
from rainstereo.rig import ROLES, Role
from rainstereo.scene import render
from rainstereo.types import Array, Image
from rainstereo.view import View

MOST_WORKERS = 256
PNG = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # noise does not compress, so more effort only costs time


@dataclass(frozen=True, eq=False)
class Job:
    """One image: the files that it becomes, relative to the recording, and what makes their bytes."""

    files: tuple[str, ...]
    make: Callable[[View, Image], list[bytes]]

    def done(self, folder: Path) -> bool:
        """Whether its files are there; a file that is there is whole."""
        return all((folder / name).is_file() for name in self.files)


def write_images(
    simulation: Simulation, folder: Path, *, workers: int = 0, progress: Callable[[int], None] | None = None
) -> tuple[int, int]:
    """Render what is not in the folder yet; how many images were made, how many were there.

    workers: threads, 0 = one a processor. progress: called with a number of finished images. When interrupted, images
    that are finished stay, and a later call goes on from there.
    """
    if not 0 <= workers <= MOST_WORKERS:
        raise ValueError(f"{workers} workers were asked for; expected 0 (one a processor) to {MOST_WORKERS}")
    made = kept = 0
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # the images are parallel already
    pool = ThreadPoolExecutor(workers or os.cpu_count() or 1)
    try:
        for through in (True, False):
            every = {role: jobs(simulation, role, through) for role in ROLES}
            waiting = {role: [job for job in every[role] if not job.done(folder)] for role in ROLES}
            there = sum(len(every[role]) - len(waiting[role]) for role in ROLES)
            kept += there
            if progress is not None and there:
                progress(there)
            views = {role: pool.submit(_prepare, simulation, role, through) for role in ROLES if waiting[role]}
            images: list[Future[None]] = []
            for role, view in views.items():
                images += [pool.submit(_write, job, *view.result(), folder, progress) for job in waiting[role]]
            made += _finish(images)
    finally:
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(threads)
    return made, kept


def jobs(simulation: Simulation, role: Role, through: bool) -> list[Job]:
    """The images that a camera takes without or with the chamber."""
    found = []
    captures = [capture for capture in simulation.captures if capture.through == through]
    for capture in captures:
        for i, pose in enumerate(capture.poses):
            name = f"{capture.folder}/{role}/{i:03d}"
            found.append(Job((f"{name}.png",), _board_image(simulation, capture.board.spec, pose, name)))
    if through:
        for i, pose in enumerate(simulation.drive):
            depth = (f"drive/depth/{i:03d}.npz",) if role == "dry" else ()
            name = f"drive/{role}/{i:03d}"
            found.append(Job((f"{name}.png", *depth), _drive_image(simulation, pose, name, bool(depth))))
    return found


def _board_image(simulation: Simulation, spec: str, pose: Array, name: str) -> Callable[[View, Image], list[bytes]]:
    def make(view: View, background: Image) -> list[bytes]:
        drawing, rt_cam_board = simulation.drawings[spec], compose(view.camera.rt_cam_ref, pose)
        rng = _rng(simulation, name)
        image = render_board(view, drawing, rt_cam_board, simulation.sensor, rng, background, simulation.supersampling)
        return [_png(image)]

    return make


def _drive_image(simulation: Simulation, pose: Array, name: str, depth: bool) -> Callable[[View, Image], list[bytes]]:
    def make(view: View, _: Image) -> list[bytes]:
        seen = render(view, simulation.scene, compose(view.camera.rt_cam_ref, pose), simulation.sensor.blur)
        files = [_png(simulation.sensor.expose(seen.image, view.cosine, _rng(simulation, name)))]
        if depth:
            stream = io.BytesIO()
            np.savez_compressed(stream, depth=seen.depth.astype(np.float32))
            files.append(stream.getvalue())
        return files

    return make


def _prepare(simulation: Simulation, role: Role, through: bool) -> tuple[View, Image]:
    """The traced view and the room behind its boards."""
    chamber = simulation.rig.chamber_in(role) if through else None
    view = View.trace(simulation.rig.camera(role), chamber)
    farthest = max((float(capture.poses[:, 5].max(initial=1.0)) for capture in simulation.captures), default=1.0)
    return view, room(view, 1.5 * farthest + 1.0, simulation.sensor.blur)


def _write(job: Job, view: View, background: Image, folder: Path, progress: Callable[[int], None] | None) -> None:
    for name, data in zip(job.files, job.make(view, background), strict=True):
        write_atomically(folder / name, data)
    if progress is not None:
        progress(1)


def _finish(images: list[Future[None]]) -> int:
    """Wait for all; the first failure stops the rest and is raised."""
    done, waiting = wait(images, return_when=FIRST_EXCEPTION)
    for image in waiting:
        image.cancel()
    for image in done:
        image.result()
    return len(images)


def _rng(simulation: Simulation, name: str) -> np.random.Generator:
    return np.random.default_rng([simulation.seed, zlib.crc32(name.encode())])


def _png(image: Image) -> bytes:
    done, data = cv2.imencode(".png", image, PNG)
    if not done:
        raise RuntimeError(f"OpenCV could not encode an image of shape {image.shape}")
    return data.tobytes()
