"""Of benchmark stage `cuda`: decoded frames in the computer's memory to such frames, by way of a CUDA device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from rainstereo.apps.bench_harness import Target, Variant, Work
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.networks import TorchNetwork
from rainstereo.model.pixels import to_batch
from rainstereo.model.restore import Restorer
from rainstereo.types import Image

FRAMES = {480: 24, 960: 12}
"""In each run, by height."""
HERTZ = {480: 100.0, 960: 30.0}
"""What the paper's network is to reach, by height."""
BATCH = 4
PAPERS = GeneratorConfig()
"""base_channels 64, 182.4 M parameters."""

Module = Callable[[], Generator]


def works(
    shipped: Module,
    papers: Module,
    frames: Sequence[Image],
    fewer: Sequence[Image],
    device: torch.device,
    promised: bool,
) -> list[Work]:
    """One of the paper's network and one of the package's, on copies of frames of one size.

    shipped, papers: give a network of one's own, since a `TorchNetwork` takes it over. frames: under drops all over;
    fewer: as many under drops on a tenth.
    """
    height, width = frames[0].shape[:2]
    size = f"{width} x {height}"
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
    tell = f"From uint8 frames in the computer's memory to uint8 frames there, on {where}."
    wide = _work(
        f"paper-{width}", f"The paper's network on a GPU, {size}", papers, frames,
        tell + " base_channels 64, 255 GMACs at 640 x 480, random weights; nothing is skipped.", device,
        HERTZ.get(height) if promised else None,
    )  # fmt: skip
    own = _work(
        f"shipped-{width}", f"The package's network on a GPU, {size}", shipped, frames,
        tell + " Nothing is skipped, but in the last row: frames with a tenth under drops, the detector on the GPU.",
        device, None, fewer,
    )  # fmt: skip
    return [wide, own]


def _work(
    name: str, title: str, build: Module, frames: Sequence[Image], what: str, device: torch.device,
    hertz: float | None, fewer: Sequence[Image] = (),
) -> Work:  # fmt: skip
    truth = _true(build(), frames, device)

    def error(found: Sequence[Image]) -> float:
        return max(float(np.abs(a.astype(np.int16) - b).max()) for a, b in zip(found, truth, strict=True))

    half = TorchNetwork(build(), device, "bf16")
    tensor = to_batch(frames[0][None], device)
    tensor = tensor.to(half.kind).contiguous(memory_format=torch.channels_last)
    bare, one, several = (
        "bf16, bare network calls",
        "bf16, Restorer, each frame for itself",
        f"bf16, stream in batches of {BATCH}",
    )
    whole = Restorer(network=half, skip=False)
    variants = [
        Variant(bare, partial(_bare, half, tensor, len(frames)), lambda _: float("nan"), note="the yardstick"),
        Variant(one, partial(_each, whole, frames), error, True),
        Variant("bf16, stream", partial(_stream, whole, frames, 1), error, True),
        Variant(several, partial(_stream, whole, frames, BATCH), error, True),
    ]
    for precision in ("float16", "float32"):
        other = Restorer(network=TorchNetwork(build(), device, precision), skip=False)
        words = f"{precision}, stream in batches of {BATCH}"
        note = "products in TF32" if precision == "float32" else ""
        variants.append(Variant(words, partial(_stream, other, frames, BATCH), error, True, note, every=3))
    if fewer:
        skipping = Restorer(network=half)
        run = partial(_each, skipping, fewer)
        variants.append(Variant("bf16, skipping, each frame for itself", run, lambda _: float("nan"), True))
    limits = () if hertz is None else tuple(Target(v, None, len(frames) / hertz) for v in (one, several))
    return Work(
        name, title, what, tuple(variants), several, "gray levels", "largest difference to float32", len(frames),
        "frames", limits,
    )  # fmt: skip


def paper_network() -> Generator:
    """The paper's network, with random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return PAPERS.build().eval()


def copies(frame: Image) -> list[Image]:
    """As many of a frame as a run takes, shifted, so that no two are one."""
    return [np.ascontiguousarray(np.roll(frame, 8 * i, 1)) for i in range(FRAMES.get(frame.shape[0], BATCH))]


def _bare(network: TorchNetwork, tensor: torch.Tensor, count: int) -> None:
    for _ in range(count):
        network(tensor)
    if network.device.type == "cuda":
        torch.cuda.synchronize(network.device)


def _each(restorer: Restorer, frames: Sequence[Image]) -> list[Image]:
    return [restorer(frame) for frame in frames]


def _stream(restorer: Restorer, frames: Sequence[Image], batch: int) -> list[Image]:
    return list(restorer.stream(frames, batch))


def _true(module: Generator, frames: Sequence[Image], device: torch.device) -> list[Image]:
    """In float32 without TF32, on the same device."""
    restore = Restorer(network=TorchNetwork(module, device, "float32"), skip=False)
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        return [restore(frame) for frame in frames]
    finally:
        torch.backends.cudnn.allow_tf32 = before
