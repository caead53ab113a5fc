"""Where are drops on this image? A small network's answer, by cells of 16 pixels, in milliseconds.

The image is first averaged down (by 2 at 640 x 480), since a drop that matters is wider than a few pixels; dilated
convolutions then look far enough around each cell to know a drop's rim and the upside-down scene in it.
"""

from __future__ import annotations

import copy
import json
import tomllib
from dataclasses import asdict, dataclass
from itertools import pairwise
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
OWN = 8
"""Pixels of the averaged image along the side of a cell of the network's."""
FACTORS = (1, 2, 4)
ROWS = 180
"""Rows that the averaged image has at least, if the image has them."""
THRESHOLD, CERTAIN, EVIDENT = 0.03, 0.2, 0.8
"""See `Detector`. Chosen on frames that nothing was trained on, for the time that they take and what they leave in the
rain; `rainstereo bench derain` compares them with others."""
SQUARE = 4
"""What a square of 2 x 2 cells is worth at most."""
MOST = 255
"""Level of what is brightest."""
MOST_BYTES = 1 << 20


@dataclass(frozen=True)
class DetectorConfig:
    """What the network is built from. channels: of its inner layers; the first has half as many. dilations: of the
    inner layers after the steps down, one each."""

    channels: int = 32
    dilations: tuple[int, ...] = (1, 2, 4)

    def __post_init__(self) -> None:
        dilations = 0 < len(self.dilations) <= 8 and all(1 <= dilation <= 64 for dilation in self.dilations)
        if not 1 <= self.channels <= 128 or not dilations:
            raise ValueError(f"{self} is no detector; expected 1 to 128 channels and 1 to 8 dilations up to 64")

    def build(self) -> DropDetector:
        """The network, with weights from torch's generator."""
        return DropDetector(self)


class DropDetector(nn.Module):
    """(B, 3, H, W) RGB in 0..1, averaged down -> (B, 1, ceil(H / 8), ceil(W / 8)): logits of what a cell is worth."""

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        wide = config.channels
        layers: list[nn.Module] = []
        steps = (3, -(-wide // 2), wide, wide)
        for before, after in pairwise(steps):
            layers += [nn.Conv2d(before, after, 3, 2, 1), nn.BatchNorm2d(after), nn.ReLU()]
        for dilation in config.dilations:
            layers += [nn.Conv2d(wide, wide, 3, 1, dilation, dilation), nn.BatchNorm2d(wide), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Conv2d(wide, 1, 1))

    def forward(self, images: Tensor) -> Tensor:
        """Logits."""
        return cast(Tensor, self.layers(images - 0.5))


class Detector:
    """Cells of an image that hold drops, or may; `Detector.shipped()` has the package's weights.

    threshold: worth of a cell from which on it is restored, where it is computed. certain: worth of the cells of a
    square, those below the threshold left out, from which on it is computed. evident: what one square of an image must
    have for anything of it to be computed: a drop seldom comes alone, and what looks a little like one does.
    """

    def __init__(
        self, network: DropDetector, device: str | torch.device = "cpu", threshold: float = THRESHOLD,
        certain: float = CERTAIN, evident: float = EVIDENT,
    ) -> None:  # fmt: skip
        if not 0 <= threshold <= 1 or not 0 <= min(certain, evident) <= max(certain, evident) <= SQUARE:
            raise ValueError(
                f"threshold {threshold}, certain {certain}, evident {evident} were given; expected what a cell is "
                f"worth, 0 to 1, and what squares are, 0 to {SQUARE}"
            )
        self.device, self.threshold, self.certain, self.evident = torch.device(device), threshold, certain, evident
        fast = _fused(network.eval()).to(self.device)
        self.network = cast(Any, fast).to(memory_format=torch.channels_last)  # which has no types for modules

    @classmethod
    def load(
        cls, path: Path, device: str | torch.device = "cpu", threshold: float = THRESHOLD, certain: float = CERTAIN,
        evident: float = EVIDENT,
    ) -> Detector:  # fmt: skip
        """From NAME.safetensors; ValueError where that is no detector's weights, or damaged."""
        return cls(load(path), device, threshold, certain, evident)

    @classmethod
    def shipped(
        cls, device: str | torch.device = "cpu", threshold: float = THRESHOLD, certain: float = CERTAIN,
        evident: float = EVIDENT,
    ) -> Detector:  # fmt: skip
        """With the weights in the package."""
        return cls.load(shipped(), device, threshold, certain, evident)

    def worth(self, image: Image, factor: int | None = None) -> Array:
        """Of restoring each cell, (ceil(H / CELL), ceil(W / CELL)), in 0..1: the most in the network's own cells.

        It is the fall of the mean square error to be expected, over that of 24 gray levels.

        image: uint8 or uint16, gray or BGR. factor: by which it is averaged down first, 1, 2 or 4; None: by its size.
        """
        factor = factor_for(image.shape[0], image.shape[1]) if factor is None else factor
        small = torch.from_numpy(_small(image, factor)).to(self.device)
        with torch.inference_mode():
            centred = small.permute(2, 0, 1).unsqueeze(0).float().sub_(MOST / 2)  # channels last
            found = self.network(centred).sigmoid()
            found = of_cells(found, OWN * factor)
        rows, columns = -(-image.shape[0] // CELL), -(-image.shape[1] // CELL)
        return cast(Array, found[0, 0, :rows, :columns].cpu().numpy())

    def cells(self, image: Image, factor: int | None = None, unit: int = UNIT) -> Mask:
        """(ceil(H / CELL), ceil(W / CELL)): which cells are restored. unit: pixels along a side of the squares of the
        image, a multiple of CELL, that are computed or not."""
        return worth_computing(self.worth(image, factor), self.threshold, self.certain, self.evident, unit // CELL)


def worth_computing(worth: Array, threshold: float, certain: float, evident: float, many: int) -> Mask:
    """Cells of at least the threshold, in squares of many x many cells in which these have at least `certain`; none
    where no square has at least `evident`."""
    rows, columns = worth.shape
    found: Mask = worth >= threshold
    counted = np.pad(np.where(found, worth, 0), ((0, -rows % many), (0, -columns % many)))
    sums = counted.reshape(counted.shape[0] // many, many, -1, many).sum((1, 3))
    squares = (sums >= certain) & (sums.max() >= evident)
    found &= np.repeat(np.repeat(squares, many, 0), many, 1)[:rows, :columns]
    return found


def _fused(network: DropDetector) -> nn.Sequential:
    """The layers with each normalisation, a constant once trained, taken into the convolution before it: half the time.

    They want BGR images in levels of 8 bits from which half of the most is taken already.
    """
    layers: list[nn.Module] = []
    for layer in network.layers:
        if isinstance(layer, nn.BatchNorm2d) and isinstance(layers[-1], nn.Conv2d):
            layers[-1] = fuse_conv_bn_eval(layers[-1], layer)
        else:
            layers.append(nn.ReLU(inplace=True) if isinstance(layer, nn.ReLU) else layer)
    first = copy.deepcopy(cast(nn.Conv2d, layers[0]))
    first.weight = nn.Parameter(first.weight.detach().flip(1) / MOST)
    return nn.Sequential(first, *layers[1:]).eval()


def of_cells(found: Tensor, own: int) -> Tensor:
    """For each cell the most in the network's own ones, `own` pixels wide, or what the one it lies in has."""
    if own >= CELL:
        return found.repeat_interleave(own // CELL, 2).repeat_interleave(own // CELL, 3)
    return nn.functional.max_pool2d(found, CELL // own, ceil_mode=True)


def factor_for(height: int, width: int) -> int:
    """By how much an image of that size is averaged down: as far as 180 rows (or columns) are left, 4 at most."""
    return max((f for f in FACTORS if min(height, width) >= ROWS * f), default=1)


def _small(image: Image, factor: int) -> Array:
    """(ceil(H / f), ceil(W / f), 3) BGR, uint8, or float32 of the same range; a multiple of what the cells need."""
    height, width = image.shape[:2]
    bottom, right = -height % CELL, -width % CELL
    if bottom or right:
        image = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    if factor > 1:
        size = image.shape[1] // factor, image.shape[0] // factor
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if image.dtype != np.uint8:
        return cast(Array, np.multiply(image, np.float32(MOST / np.iinfo(image.dtype).max), dtype=np.float32))
    return image if image.flags.c_contiguous and image.flags.writeable else image.copy()


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
