"""A trained generator as something to call: torch on any device in any precision, or ONNX Runtime."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Protocol, cast

import torch
from torch import Tensor, nn

from rainstereo.model.cell_generator import CellGenerator, supported
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.image_batch import padded
from rainstereo.model.receptive_field import halo

PRECISIONS = {"float32": torch.float32, "bf16": torch.bfloat16, "float16": torch.float16}
MOST_SHAPES = 256
"""Of images, that are remembered."""
WITHOUT_A_CARD = 512
"""Halo of a network that does not say how far it looks, in pixels."""


class Network(Protocol):
    """Restores (B, 3, H, W) RGB in 0..1, to the same shape in float32.

    device: where it wants its input. multiple: sides that it computes on are multiples of this; tiles must begin on
    one. halo: pixels to the farthest that an output depends on. local: whether nothing else matters, so that a tile
    with its halo comes out as in the whole image. name: for reports. cells: computes some cells of an image alone,
    where that can be done.
    """

    device: torch.device
    multiple: int
    halo: int
    local: bool
    name: str
    cells: CellGenerator | None

    def __call__(self, images: Tensor) -> Tensor:
        """The restored images."""


class TorchNetwork:
    """By torch, which takes the module over: it is moved and converted.

    precision: "float32", "bf16", "float16" or "auto", which takes what pays on the device.
    """

    def __init__(self, module: nn.Module, device: str | torch.device = "auto", precision: str = "auto") -> None:
        self.device = pick_device(device)
        self.precision = pick_precision(precision, self.device)
        self.multiple, self.halo, self.local = reach(module)
        kind = PRECISIONS[self.precision]
        # `.to(memory_format)` of a module has no types
        self.module = cast(Any, module.eval().to(self.device, kind)).to(memory_format=torch.channels_last)
        self.kind, self.name = kind, f"torch {self.precision} on {self.device}"
        able = isinstance(module, Generator) and supported(module.config)
        self.cells = CellGenerator(self.module, kind) if able else None
        self._before: set[tuple[int, ...]] = set()

    def __call__(self, images: Tensor) -> Tensor:
        """The restored images, on the same device."""
        with torch.inference_mode(), self._choosing(tuple(images.shape)):
            given = images.to(self.device, self.kind).contiguous(memory_format=torch.channels_last)
            return cast(Tensor, self.module(given)).float()

    def _choosing(self, shape: tuple[int, ...]) -> AbstractContextManager[None]:
        """On a CUDA device, cuDNN tries its ways to convolve, once, for a shape that comes again: a stream's frames."""
        if self.device.type != "cuda":
            return nullcontext()
        again = shape in self._before
        if len(self._before) < MOST_SHAPES:
            self._before.add(shape)
        return cudnn_chooses() if again else nullcontext()


class OnnxNetwork:
    """By ONNX Runtime, from a file that `rainstereo.model.export` wrote: it holds what a tile must know."""

    def __init__(self, path: Path, threads: int = 0) -> None:
        import onnxruntime

        if not path.is_file():
            raise FileNotFoundError(f"there is no ONNX file {path}; make one with rainstereo export")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or torch.get_num_threads()
        options.log_severity_level = 3
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its own exceptions have no common base
            raise ValueError(f"{path} is no network that ONNX Runtime can run ({error})") from error
        told = self.session.get_modelmeta().custom_metadata_map
        inputs = self.session.get_inputs()
        if told.get("kind") != "rainstereo derain" or len(inputs) != 1 or len(inputs[0].shape) != 4:
            raise ValueError(f"{path} is not a de-rainer that rainstereo exported; make one with rainstereo export")
        self.device, self.name = torch.device("cpu"), f"onnxruntime {onnxruntime.__version__}, {path.name}"
        self.multiple, self.halo, self.local = int(told["multiple"]), int(told["halo"]), told["local"] == "yes"
        self.cells: CellGenerator | None = None
        self.smallest, self.input = int(told["smallest_side"]), inputs[0].name

    def __call__(self, images: Tensor) -> Tensor:
        """The restored images."""
        height, width = images.shape[2:]
        given = padded(images, self.multiple, self.smallest)
        found = self.session.run(None, {self.input: given.contiguous().numpy()})[0]
        return torch.from_numpy(found[:, :, :height, :width])


@contextmanager
def cudnn_chooses() -> Iterator[None]:
    """Within it, cuDNN measures its algorithms for each new shape and keeps to the fastest."""
    backend: Any = torch.backends.cudnn  # whose settings have no types
    before = backend.benchmark
    backend.benchmark = True
    try:
        yield
    finally:
        backend.benchmark = before


def reach(module: nn.Module) -> tuple[int, int, bool]:
    """(multiple, halo, whether tiles equal the frame) of a network, from its configuration."""
    config = getattr(module, "config", None)
    if isinstance(config, GeneratorConfig):
        return config.multiple, halo(config), config.tiles_equal_frame
    own = getattr(module, "reach", None)  # networks other than the generator may say so themselves
    return own if isinstance(own, tuple) else (16, WITHOUT_A_CARD, False)


def pick_device(device: str | torch.device) -> torch.device:
    """ "auto": a CUDA device where there is one. ValueError for one that is not there."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"device {device!r} is unknown; expected auto, cpu, cuda or cuda:1") from error
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device {device!r} was asked for, but torch finds no CUDA device; leave it out, or give cpu")
    return found


def pick_precision(precision: str, device: torch.device) -> str:
    """ "auto": bf16 where the processor or the card multiplies it in hardware, else float16 on a card, else float32."""
    if precision == "auto":
        if device.type == "cuda":
            return "bf16" if torch.cuda.is_bf16_supported() else "float16"
        return "bf16" if multiplies_bf16() else "float32"
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r} is unknown; expected auto, {', '.join(PRECISIONS)}")
    return precision


def multiplies_bf16() -> bool:
    """Whether the processor has AVX512-BF16 or AMX; others emulate bf16, several times slower than float32."""
    probes = [getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")]
    return any(bool(probe()) for probe in probes if probe is not None)
