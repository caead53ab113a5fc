"""A tiny generator whose output is not its input, as a checkpoint; and a detector that sees what is painted red."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import torch

from rainstereo.model import checkpoint
from rainstereo.model.detector import CELL, Detector, DetectorConfig
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.networks import TorchNetwork
from rainstereo.types import Image, Mask

CONFIG = GeneratorConfig(base_channels=4, downs=2, blocks=1, normalisation="channel", output_residual=True)


def generator(config: GeneratorConfig = CONFIG) -> Generator:
    torch.manual_seed(1)
    made = config.build()
    torch.nn.init.normal_(made.head.weight, 0, 0.05)
    return made.eval()


def network(config: GeneratorConfig = CONFIG) -> TorchNetwork:
    return TorchNetwork(generator(config), "cpu", "float32")


def saved(path: Path, **more: object) -> Path:
    return checkpoint.save(path, generator(), {"architecture": "generator", "config": asdict(CONFIG), **more})


class RedDetector(Detector):
    """Cells with a pure red pixel."""

    def __init__(self) -> None:
        super().__init__(DetectorConfig(2, (1,)).build())
        self.looks = 0

    def cells(self, image: Image, factor: int | None = None, unit: int = CELL) -> Mask:
        self.looks += 1
        top = np.iinfo(image.dtype).max
        red = (image == (0, 0, top)).all(-1) if image.ndim == 3 else image == top
        rows, columns = -(-image.shape[0] // CELL), -(-image.shape[1] // CELL)
        wide = np.zeros((rows * CELL, columns * CELL), bool)
        wide[: image.shape[0], : image.shape[1]] = red
        return np.asarray(wide.reshape(rows, CELL, columns, CELL).any((1, 3)))


def picture(seed: int = 0, size: tuple[int, int] = (96, 128), texture: bool = True) -> Image:
    if not texture:
        return np.full((*size, 3), (90, 120, 40), np.uint8)
    noise = np.random.default_rng(seed).integers(0, 250, (*size, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2))


def with_drop(image: Image, row: int, column: int) -> Image:
    found = image.copy()
    found[row, column] = (0, 0, 255) if image.ndim == 3 else 255
    return found
