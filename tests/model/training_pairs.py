"""Small pairs and recipes for tests of training."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.model import recipe as recipes
from rainstereo.model.recipe import Recipe
from rainstereo.model.train import Run, fit

SIZE = (80, 64)


def scene(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """A smooth picture in colour."""
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), size, interpolation=cv2.INTER_CUBIC)


def write_pairs(root: Path, count: int = 4) -> Path:
    """Pairs in the layout of `rainstereo align`: half of each image is blurred and dark in one place."""
    for side in ("dry", "wet"):
        (root / side).mkdir(parents=True)
    for i in range(count):
        clear = scene(i)
        rainy = clear.copy()
        rainy[20:40, 20:50] = cv2.GaussianBlur(clear, (0, 0), 6)[20:40, 20:50] // 2
        imagefile.write(root / "dry" / f"{i}.png", clear)
        imagefile.write(root / "wet" / f"{i}.png", rainy)
    return root


def tables(folder: Path, **changes: Any) -> dict[str, Any]:
    """A recipe of the smallest networks and all of the paper's losses; tables in `changes` are merged into it."""
    table: dict[str, Any] = {
        "steps": 4,
        "data": {"crop": 32, "workers": 0, "train": [{"folder": str(folder)}]},
        "network": {"base_channels": 4, "downs": 2, "blocks": 1},
        "discriminator": {"base_channels": 4},
        "losses": {"lambda_perceptual": 0.0},
        "optimizer": {"batch": 2, "ema": 0.9, "pool": 4},
        "keep": {"log": 1, "checkpoint": 2, "validate": 0},
    }
    for key, value in changes.items():
        table[key] = {**table[key], **value} if isinstance(table.get(key), dict) else value
    return table


def small(folder: Path, **changes: Any) -> Recipe:
    """The same, parsed."""
    return recipes.parse(tables(folder, **changes))


class Listener:
    """Notes what it hears."""

    def __init__(self) -> None:
        self.losses: list[dict[str, float]] = []
        self.skipped: list[str] = []
        self.words: list[str] = []
        self.validations: list[dict[str, float]] = []

    def began(self, run: Run) -> None:
        """Nothing to note."""

    def stepped(self, run: Run, found: Any) -> None:
        """Notes losses."""
        self.losses.append(dict(found.losses))
        self.skipped += [found.skipped] if found.skipped else []

    def validated(self, run: Run, found: Any, samples: Any) -> None:
        """Notes figures."""
        self.validations.append(dict(found))

    def said(self, words: str) -> None:
        """Notes words."""
        self.words.append(words)


def train(recipe: Recipe, out: Path) -> tuple[Run, Listener]:
    """Run it."""
    listener = Listener()
    return fit(recipe, out, listener), listener
