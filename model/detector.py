"""Where are drops on this image? A small network's answer, by cells of 16 pixels, in milliseconds.

The image is first averaged down (by 2 at 640 x 480), since a drop that matters is wider than a few pixels; dilated
convolutions then look far enough around each cell to know a drop's rim and the upside-down scene in it.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from rainstereo.types import Array, Image, Mask

CELL = 16
"""Pixels along a cell's side; a multiple of every network's own cell, and of the generator's stride."""
UNIT = 2 * CELL
"""Side, at least, of the squares of an image in which one cell that is worth computing has others restored with it."""
OWN = 4
"""Pixels of the averaged image along the side of a cell of the network's."""
FACTORS = (1, 2, 4)
ROWS = 180
"""Rows that the averaged image has at least, if the image has them."""
THRESHOLD, CERTAIN = 0.1, 0.6
"""From the curve of `rainstereo bench derain`, over the time that each takes and what it leaves in the rain."""
MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class DetectorConfig:
    """What the network is built from. channels: of its inner layers. dilations: of these layers, one each."""

    channels: int = 32
    dilations: tuple[int, ...] = (1, 2, 4, 8)

    def __post_init__(self) -> None:
        dilations = 0 < len(self.dilations) <= 8 and all(1 <= dilation <= 64 for dilation in self.dilations)
        if not 1 <= self.channels <= 128 or not dilations:
            raise ValueError(f"{self} is no detector; expected 1 to 128 channels and 1 to 8 dilations up to 64")

    def build(self) -> DropDetector:
        """The network, with weights from torch's generator."""
        return DropDetector(self)


class DropDetector(nn.Module):
    """(B, 3, H, W) RGB in 0..1, averaged down -> (B, 1, ceil(H / 4), ceil(W / 4)): logits of the harm in a cell."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        wide = config.channels
        layers: list[nn.Module] = [
            nn.Conv2d(3, wide // 2, 3, 2, 1), nn.BatchNorm2d(wide // 2), nn.ReLU(),
            nn.Conv2d(wide // 2, wide, 3, 2, 1), nn.BatchNorm2d(wide), nn.ReLU(),
        ]  # fmt: skip
        for dilation in config.dilations:
            layers += [nn.Conv2d(wide, wide, 3, 1, dilation, dilation), nn.BatchNorm2d(wide), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(wide, 1, 1))

    def forward(self, images: Tensor) -> Tensor:
        """Logits."""
        return cast(Tensor, self.layers(images - 0.5))


class Detector:
    """Cells of an image that hold drops, or may; `Detector.shipped()` has the package's weights.

    certain: harm to be expected of a cell from which on it is worth computing. threshold: of a cell from which on it is
    restored, too, where it is computed anyway.
    """

    def __init__(
        self, network: DropDetector, device: str | torch.device = "cpu", threshold: float = THRESHOLD,
        certain: float = CERTAIN,
    ) -> None:  # fmt: skip
        if not 0 <= threshold <= 1 or not 0 <= certain <= 1:
            raise ValueError(f"thresholds of {threshold} and {certain} were given; expected shares of harm, 0 to 1")
        self.device, self.threshold, self.certain = torch.device(device), threshold, max(certain, threshold)
        fast = _fused(network.eval()).to(self.device)
        self.network = cast(Any, fast).to(memory_format=torch.channels_last)  # which has no types for modules

    @classmethod
    def load(
        cls, path: Path, device: str | torch.device = "cpu", threshold: float = THRESHOLD, certain: float = CERTAIN
    ) -> Detector:
        """From NAME.safetensors; ValueError where that is no detector's weights, or damaged."""
        return cls(load(path), device, threshold, certain)

    @classmethod
    def shipped(
        cls, device: str | torch.device = "cpu", threshold: float = THRESHOLD, certain: float = CERTAIN
    ) -> Detector:
        """With the weights in the package."""
        return cls.load(shipped(), device, threshold, certain)

    def harm(self, image: Image, factor: int | None = None) -> Array:
        """To be expected in each cell, (ceil(H / CELL), ceil(W / CELL)), in 0..1: the most in the network's own cells.

        1 is a change by 24 gray levels, RMS, or more; less counts by its square.

        image: uint8 or uint16, gray or BGR. factor: by which it is averaged down first, 1, 2 or 4; None: by its size.
        """
        factor = factor_for(image.shape[0], image.shape[1]) if factor is None else factor
        small = _small(image, factor)
        with torch.inference_mode():
            tensor = torch.from_numpy(small).to(self.device).permute(2, 0, 1).flip(0).unsqueeze(0)
            found = self.network(tensor.to(memory_format=torch.channels_last) - 0.5).sigmoid()
            found = nn.functional.max_pool2d(found, CELL // (OWN * factor), ceil_mode=True)
        rows, columns = -(-image.shape[0] // CELL), -(-image.shape[1] // CELL)
        return cast(Array, found[0, 0, :rows, :columns].cpu().numpy())

    def cells(self, image: Image, factor: int | None = None, unit: int = UNIT) -> Mask:
        """(ceil(H / CELL), ceil(W / CELL)): which cells are restored. unit: pixels along a side of the squares of the
        image, a multiple of CELL, that are computed or not."""
        return near_certain(self.harm(image, factor), self.threshold, self.certain, unit // CELL)


def near_certain(harm: Array, low: float, high: float, many: int) -> Mask:
    """Cells of at least low, in squares of many x many cells of which one has at least high."""
    rows, columns = harm.shape
    sure = np.pad(harm >= high, ((0, -rows % many), (0, -columns % many)))
    squares = sure.reshape(sure.shape[0] // many, many, -1, many).any((1, 3))
    found: Mask = np.repeat(np.repeat(squares, many, 0), many, 1)[:rows, :columns] & (harm >= low)
    return found


def _fused(network: DropDetector) -> nn.Sequential:
    """The layers with each normalisation, a constant once trained, taken into the convolution before it: half the time.

    They want images from which a half is taken already.
    """
    layers: list[nn.Module] = []
    for layer in network.layers:
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        else:
            layers.append(nn.ReLU(inplace=True) if isinstance(layer, nn.ReLU) else layer)
    return nn.Sequential(*layers).eval()


def factor_for(height: int, width: int) -> int:
    """By how much an image of that size is averaged down: as far as 180 rows (or columns) are left, 4 at most."""
    return max((f for f in FACTORS if min(height, width) >= ROWS * f), default=1)


def _small(image: Image, factor: int) -> Array:
    """(ceil(H / f), ceil(W / f), 3) float32 in 0..1, BGR; a multiple of what the cells need."""
    height, width = image.shape[:2]
    bottom, right = -height % CELL, -width % CELL
    if bottom or right:
        image = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    if factor > 1:
        size = image.shape[1] // factor, image.shape[0] // factor
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    return cast(Array, np.multiply(image, np.float32(1 / np.iinfo(image.dtype).max), dtype=np.float32))


# -- files -------------------------------------------------------------------------------------------------------------


def shipped() -> Path:
    """Where the package's weights are. FileNotFoundError where they are not."""
    path = Path(__file__).resolve().parent / "weights" / "detector.safetensors"
    if not path.is_file():
        raise FileNotFoundError(
            f"the drop detector's weights {path} are missing; make them with rainstereo detector, or give --no-skip"
        )
    return path


def packed(network: DropDetector) -> bytes:
    """The network in half precision and what it is built from, in the safetensors format."""
    tensors = {
        name: tensor.detach().half().contiguous() if tensor.is_floating_point() else tensor.detach().contiguous()
        for name, tensor in network.state_dict().items()
    }
    return save(tensors, {"kind": "drop detector", "config": json.dumps(asdict(network.config))})


def load(path: Path) -> DropDetector:
    """The network of a file that `packed` made; ValueError says what is wrong with it."""
    if not path.is_file():
        raise FileNotFoundError(f"there are no detector weights at {path}")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path} has {path.stat().st_size} bytes; a drop detector's weights have {MOST_BYTES} at most")
    try:
        with safe_open(path, "pt") as file:
            told = dict(file.metadata() or {})
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is no safetensors file, or a damaged one ({error})") from error
    if told.get("kind") != "drop detector":
        raise ValueError(f"{path} holds {told.get('kind', 'something unnamed')}; expected a drop detector's weights")
    try:
        config = json.loads(told["config"])
        network = DetectorConfig(int(config["channels"]), tuple(map(int, config["dilations"]))).build()
        network.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in tensors.items()})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path} does not fit the detector it names ({error})") from error
    return network.eval()


def card(path: Path) -> dict[str, object]:
    """What stands beside the weights: NAME.toml, or nothing."""
    beside = path.with_suffix(".toml")
    return tomllib.loads(beside.read_text(encoding="utf-8")) if beside.is_file() else {}
