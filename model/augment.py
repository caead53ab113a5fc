"""Adherent rain as an augmentation of kornia's: drops on a pane close before the camera, with real optics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from kornia.augmentation import IntensityAugmentationBase2D
from kornia.augmentation.random_generator.base import RandomGeneratorBase
from torch import Tensor

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber, Panel
from rainstereo.defocus import apparent_distance
from rainstereo.droplet import SphericalCap
from rainstereo.model.cap_table import CapTable
from rainstereo.model.drop_looks import MODELS
from rainstereo.model.rain_layer import RainLayer, render
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import Population
from rainstereo.thin_lens import ThinLens
from rainstereo.types import Array

ACRYLIC = Panel(0.004, 1.49)
CHANNELS = (1, 3)
EMPTY = (0.0, 0.0, 0.0, 1.0, 1.33)
"""What stands in a row of the table for no drop."""

Range = tuple[float, float]


@dataclass
class RainScene:
    """What drops stand on and are seen by: the same for images of one size.

    camera: a focal length in units of the image's width, or a camera, whose size all images must then have.
    chamber: panels in the camera's frame; drops sit on the far face of the first.
    """

    camera: Camera | float
    chamber: Chamber
    population: Population
    lens: ThinLens | None
    last: tuple[tuple[int, int], Camera, Pane] | None = field(default=None, repr=False, compare=False)

    def seen(self, width: int, height: int) -> tuple[Camera, Pane]:
        """The camera for images of a size, and what it sees of the pane, with what reaches in from beside it."""
        if self.last is None or self.last[0] != (width, height):
            camera = self.camera
            if not isinstance(camera, Camera):
                f = camera * width
                camera = Camera.pinhole(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
            elif camera.size != (width, height):
                raise ValueError(
                    f"images have {width} x {height} pixels, but the camera has {camera.width} x {camera.height}; give "
                    "images of its size, or a focal length in units of their width instead of a camera"
                )
            margin = 0.5 * self.population.diameter.largest + (0.0 if self.lens is None else self.lens.aperture)
            self.last = (width, height), camera, Pane.seen(camera, self.chamber, margin=margin)
        return self.last[1:]

    def discs(self, f_numbers: Tensor, camera: Camera) -> Tensor | None:
        """Diameters in pixels, (B,), of what the lens at these F-numbers makes of a point of the pane."""
        if self.lens is None:
            return None
        distance = apparent_distance(SphericalCap((0.0, 0.0), 1e-3, 1.0), self.chamber)
        return self.lens.blur(distance, camera) * self.lens.f_number / f_numbers.double()


class AdherentRainGenerator(RandomGeneratorBase):
    """Draws drops, (B, D, 5): columns as in `CapTable`, radius 0 for none; and F-numbers, (B,), if there is a lens.

    One seed an image comes from torch's generator; drops are drawn from it by the population, on the processor.
    """

    def __init__(self, scene: RainScene, name: str, cover: Range, f_number: Range | None) -> None:
        super().__init__()
        self.scene, self.name, self.cover, self.f_number = scene, name, cover, f_number

    def __repr__(self) -> str:
        return f"population={self.name}, cover={self.cover}, f_number={self.f_number}"

    def make_samplers(self, device: torch.device, dtype: torch.dtype) -> None:
        """Nothing is kept: draws are on the processor in single precision, the same whatever the images are."""

    def forward(self, batch_shape: tuple[int, ...], same_on_batch: bool = False) -> dict[str, Tensor]:
        """Parameters for a batch of images, (B, C, H, W)."""
        count, height, width = batch_shape[0], batch_shape[-2], batch_shape[-1]
        drawn = 1 if same_on_batch and count else count
        share, seeds = torch.rand(2, drawn, device="cpu"), torch.randint(2**62, (drawn,), device="cpu")
        covers = self.cover[0] + (self.cover[1] - self.cover[0]) * share[0]
        tables = []
        if drawn:
            _, pane = self.scene.seen(width, height)
            tables = [self._table(c, s, pane) for c, s in zip(covers.tolist(), seeds.tolist(), strict=True)]
        most = max(map(len, tables), default=0)
        drops = np.full((drawn, most, len(EMPTY)), EMPTY, dtype=np.float32)
        for row, table in zip(drops, tables, strict=True):
            row[: len(table)] = table
        params = {"drops": torch.from_numpy(drops).expand(count, -1, -1), "cover": covers.expand(count)}
        if self.f_number is not None:
            # uniform in its logarithm, as the stops of a lens are
            low, high = (math.log(n) for n in self.f_number)
            params["f_number"] = (low + (high - low) * share[1]).exp().expand(count)
        return params

    def _table(self, cover: float, seed: int, pane: Pane) -> Array:
        law = self.scene.population.with_cover(cover)
        columns = law.columns(seed, pane)
        return np.stack([*columns, np.full_like(columns[0], law.index)], -1, dtype=np.float32)


class RandomAdherentRain(IntensityAugmentationBase2D):
    """Drops of water on a pane close before the camera: a window, a windscreen, a lens's cover.

    Images: (B, C, H, W) or (C, H, W), 1 or 3 channels, values in 0 .. 1, float16, float32 or float64, on any device.
    Pixels that no drop touches keep their value bit by bit. Boxes, masks and key points pass unchanged. After each call
    `layer` holds what is known of it: `opacity`, `mask` and `unknown` (see `RainLayer`).

    population: a `Population`, or the name of one: "paper", "mist", "drops", "large", "streaks".
    cover: from which the wet share of the pane is drawn, uniformly.
    camera: focal length in units of the image's width, or a `Camera`.
    distance: from the camera to a pane of 4 mm acrylic, metres; its far side is wet. chamber: other panels, in the
    camera's frame, of which the first is wet on its far face; takes the place of `distance`.
    depth: of the scene, metres.
    f_number: from which the lens's F-number is drawn, uniformly in its logarithm; None: a pinhole, sharp drops.
    focal_length, focus: of that lens, metres; one that is focused on the scene blurs the drops.
    model: "exact" optics, or "texture", the paper's R B and G B with the surface's slope (`rain_layer.render`).
    rays: along a pixel's side at edges; more are slower and finer (`rain_layer.render`).

    Drops that overlap do not merge; see `rainstereo.rain.metaballs` for drops that do. Not for torch.compile.
    """

    def __init__(
        self,
        population: str | Population = "drops",
        cover: Range = (0.02, 0.2),
        camera: float | Camera = 1.0,
        distance: float = 0.04,
        *,
        chamber: Chamber | None = None,
        depth: float = math.inf,
        f_number: Range | None = None,
        focal_length: float = 4.5e-3,
        focus: float = math.inf,
        model: str = "exact",
        rays: int = 4,
        p: float = 0.5,
        same_on_batch: bool = False,
        keepdim: bool = False,
    ) -> None:
        super().__init__(p=p, same_on_batch=same_on_batch, p_batch=1.0, keepdim=keepdim)
        _check_range("cover", cover, 0, 0.95, "shares of the pane")
        if f_number is not None:
            _check_range("f_number", f_number, 0.5, 1e6, "F-numbers")
        if model not in MODELS:
            raise ValueError(f"model {model!r} is unknown; expected {' or '.join(map(repr, MODELS))}")
        if not isinstance(camera, Camera) and not 0.05 <= camera <= 100:
            raise ValueError(
                f"a focal length of {camera} was given; expected it in units of the image's width, 0.05 to 100"
            )
        law = Population.preset(population) if isinstance(population, str) else population
        lens = None if f_number is None else ThinLens(focal_length, f_number[0], focus)
        panels = Chamber((0, 0, 1), distance, (ACRYLIC,)) if chamber is None else chamber
        self.scene = RainScene(camera, panels, law, lens)
        name = population if isinstance(population, str) else type(population).__name__
        self._param_generator = AdherentRainGenerator(self.scene, name, cover, f_number)
        self.flags = {"model": model, "depth": depth, "rays": rays, "distance": panels.distance}
        self.layer: RainLayer | None = None

    def apply_transform(
        self, images: Tensor, params: Mapping[str, Tensor], flags: Mapping[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """The images with drops; those that the gate skips get none."""
        del transform
        count, channels, height, width = images.shape
        if channels not in CHANNELS:
            raise ValueError(
                f"images have {channels} channels; expected 1 or 3 of colour. Split off others, such as depth or labels"
            )
        camera, _ = self.scene.seen(width, height)
        drops = params["drops"].to(images.device, torch.promote_types(images.dtype, torch.float32))
        if drops.shape != (count, *drops.shape[1:2], len(EMPTY)):
            raise ValueError(
                f"params hold drops {tuple(drops.shape)}; expected ({count}, D, 5), a table for each of {count} images"
            )
        x, y, radius, angle, index = drops.unbind(-1)
        if self.p < 1:  # at p = 1 kornia, too, does not ask the gate
            radius = torch.where((params["batch_prob"] > 0.5).to(images.device).unsqueeze(1), radius, 0.0)
        caps = CapTable(x, y, radius, angle, index)
        discs = self.scene.discs(params["f_number"].to(images.device), camera) if "f_number" in params else None
        layer = render(
            images, caps, camera, self.scene.chamber, flags["depth"], model=flags["model"], discs=discs,
            rays=flags["rays"], clip=(0.0, 1.0),
        )  # fmt: skip
        self.layer = RainLayer(layer.image.detach(), layer.opacity, layer.unknown)
        return layer.image


def _check_range(name: str, given: Range, low: float, high: float, what: str) -> None:
    if not (len(given) == 2 and low <= given[0] <= given[1] <= high):
        raise ValueError(f"{name} {given} was given; expected two {what}, {low:g} <= from <= to <= {high:g}")
