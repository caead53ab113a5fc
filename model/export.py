"""A trained generator for other programs: ONNX, and torch.export's program, both for images of any size and number.

The exported graph wants sides that are multiples of `multiple`, at least `smallest_side`, as its metadata say;
`image_batch.padded` makes such images, as the generator does inside.
"""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from rainstereo.model.generator import Generator
from rainstereo.model.receptive_field import halo

OPSET = 18
KIND = "rainstereo derain"


class Padded(nn.Module):
    """The generator for images that are padded already."""

    def __init__(self, generator: Generator) -> None:
        super().__init__()
        self.generator = generator

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) to the same, in 0..1."""
        drawn = self.generator.network(images)
        change = drawn[:, :3].tanh()
        if self.generator.config.output_gate:
            change = change * drawn[:, 3:].sigmoid()
        derained = images + change if self.generator.config.output_residual else (change + 1) / 2
        return derained.clamp(0, 1)


def program(generator: Generator) -> torch.export.ExportedProgram:
    """torch.export's program of `Padded`, for any number of images whose sides are multiples."""
    step, least = generator.config.multiple, generator.config.smallest_side // generator.config.multiple
    example = torch.zeros(2, 3, step * (least + 1), step * (least + 2))
    rows, columns = (torch.export.Dim(name, min=least, max=1 << 14) for name in ("rows", "columns"))
    shapes = {"images": {0: torch.export.Dim("batch", min=1, max=1 << 10), 2: step * rows, 3: step * columns}}
    with _quiet():
        return torch.export.export(Padded(generator.float().cpu().eval()), (example,), dynamic_shapes=shapes)


def to_onnx(generator: Generator, more: dict[str, str] | None = None) -> bytes:
    """The ONNX file: opset 18, float32, input "images" and output "derained", (B, 3, H, W) in 0..1.

    Its metadata say what `OnnxNetwork` needs. more: further metadata.
    """
    import onnx

    with _quiet():
        made = torch.onnx.export(program(generator), opset_version=OPSET, input_names=["images"],
                                 output_names=["derained"], verbose=False)  # fmt: skip
    if made is None:
        raise RuntimeError("torch.onnx.export returned no program")
    proto = made.model_proto
    config = generator.config
    told = {
        "kind": KIND, "multiple": str(config.multiple), "smallest_side": str(config.smallest_side),
        "halo": str(halo(config)), "local": "yes" if config.tiles_equal_frame else "no", **(more or {}),
    }  # fmt: skip
    onnx.helper.set_model_props(proto, told)
    onnx.checker.check_model(proto)
    return cast(bytes, proto.SerializeToString())


def to_program(generator: Generator) -> bytes:
    """torch.export's program as a .pt2 file, for `torch.export.load`."""
    stream = io.BytesIO()
    with _quiet():
        torch.export.save(program(generator), stream)
    return stream.getvalue()


def difference(generator: Generator, path: Path, sizes: tuple[tuple[int, int], ...], seed: int = 0) -> float:
    """Largest difference between the ONNX file in ONNX Runtime and the generator, on random images, both in float32."""
    from rainstereo.model.networks import OnnxNetwork

    network, worst = OnnxNetwork(path), 0.0
    source = torch.Generator().manual_seed(seed)
    for height, width in sizes:
        images = torch.rand(1, 3, height, width, generator=source)
        with torch.inference_mode():
            worst = max(worst, float((network(images) - generator(images)).abs().max()))
    return worst


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporters warn about their own insides."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)
