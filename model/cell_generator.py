"""A generator that computes some cells of an image only: what lies elsewhere costs nothing, at any of its scales.

Cells are squares of `config.multiple` pixels, one place each at the coarsest scale. Features of the cells asked for are
kept as rows of a matrix; before each convolution every cell gathers what it needs of its neighbours, and finds zeros
where a neighbour is not computed, as at an image's border. Given all cells, this is the generator itself. Sparse
convolutions as in Graham and van der Maaten, "Submanifold sparse convolutional networks" (2017), by blocks as in Ren
et al., "SBNet" (CVPR 2018).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from rainstereo.model.convolution_blocks import ResidualBlock
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.image_batch import RGB
from rainstereo.types import Array, Image, Mask

AS_MATRIX = 3
"""Side of the window, in places, up to which a convolution is one product of matrices, zeros and all: faster there."""


def supported(config: GeneratorConfig) -> bool:
    """Whether a generator can be computed by cells: zeros at borders, and nothing that looks at the whole image."""
    return (
        config.normalisation != "instance" and config.padding == "zeros" and config.stem_kernel <= 2 * config.multiple
    )


class CellGenerator:
    """A generator in eval mode, with weights of this kind, by cells. ValueError where it is not `supported`.

    cell: side of a cell, pixels. border: pixels around a cell that must be given with it. What else a pixel depends on
    is taken from the other cells that are computed, and at the coarsest scale from those that are only looked at: they
    go through the way down alone, a sixth of the work, and stay as they are from there on.
    """

    def __init__(self, generator: Generator, kind: torch.dtype = torch.float32) -> None:
        config = generator.config
        if not supported(config):
            raise ValueError(f"{config} cannot be computed by cells; expected padding zeros and no instance norm")
        self.generator, self.config = generator, config
        self.cell, self.border = config.multiple, config.stem_kernel // 2 * config.patch
        self.kind = kind
        self._matrices: dict[int, tuple[Tensor, Tensor | None]] = {}

    def __call__(self, patches: Tensor, where: Mask, looked: Mask | None = None) -> Tensor:
        """Restored cells, (N, 3, cell, cell) RGB in 0..1.

        where: (rows, columns) of the image's cells, N of them true. looked: M cells, those and others that are looked
        at; None: no others. patches: the cells looked at, row by row, with the border around them,
        (M, 3, cell + 2 border, ...) RGB in 0..1; zeros beyond the image.
        """
        looked = where if looked is None else looked
        count, side = int(looked.sum()), self.cell + 2 * self.border
        if tuple(patches.shape) != (count, RGB, side, side) or not where.any():
            raise ValueError(
                f"patches have shape {tuple(patches.shape)} for {count} cells; expected ({count}, 3, {side}, {side}), "
                "and at least one cell"
            )
        if looked.shape != where.shape or (where & ~looked).any():
            raise ValueError("some cells are to be restored that are not looked at; expected all of them to be")
        with torch.inference_mode():
            return self._restored(patches.to(self.kind), _Found(where, looked, patches.device))

    def _restored(self, patches: Tensor, found: _Found) -> Tensor:
        made, config, places = self.generator, self.config, found.looked
        size = self.cell // config.patch
        seen = functional.pixel_unshuffle(patches, config.patch) if config.patch > 1 else patches
        stem = cast(nn.Conv2d, made.stem[0])
        windows = seen.contiguous(memory_format=torch.channels_last)
        features = _after(made.stem, functional.conv2d(windows, stem.weight, stem.bias))
        skips = []
        for blocks, step in zip(made.encoder_blocks, made.downs, strict=True):
            features = self._blocks(cast(nn.Sequential, blocks), features, places)
            skips.append(found.restored_of(features))
            features = _after(cast(nn.Sequential, step), self._layer(_first(step), features, places))
        features, places = found.restored_of(self._inner_blocks(features, found)), found.restored
        for step, blocks in zip(made.ups, made.decoder_blocks, strict=True):
            raised = self._up(cast(nn.Sequential, step), features, places)
            features = self._blocks(cast(nn.Sequential, blocks), raised + skips.pop(), places)
        drawn = self._layer(made.head, features, places)
        begin = self.border
        images = found.restored_of(patches)[:, :, begin : begin + self.cell, begin : begin + self.cell]
        assert drawn.shape[2:] == (size, size)  # noqa: S101
        return made.drawn_on(images, drawn)[0].float().clamp(0, 1)

    def _blocks(self, blocks: nn.Sequential, features: Tensor, places: _Places) -> Tensor:
        for block in blocks:
            features = features + self._change(cast(ResidualBlock, block), features, places, places)
        return features

    def _inner_blocks(self, features: Tensor, found: _Found) -> Tensor:
        """At the coarsest scale, of cells looked at; those that are not restored stay as they are."""
        if found.rows is None:
            return self._blocks(self.generator.blocks, features, found.restored)
        for block in self.generator.blocks:
            change = self._change(cast(ResidualBlock, block), features, found.between, found.restored)
            features = features.index_add(0, found.rows, change)
        return features

    def _change(self, block: ResidualBlock, features: Tensor, first: _Places, rest: _Places) -> Tensor:
        """first: where its first convolution is computed, of which features; rest: the same for the others."""
        changed, places = features, first
        for layer in block.change:
            if isinstance(layer, nn.Conv2d):
                changed, places = self._layer(layer, changed, places), rest
            else:
                changed = layer(changed)
        return changed

    def _up(self, step: nn.Sequential, features: Tensor, places: _Places) -> Tensor:
        first = step[0]
        if isinstance(first, nn.Upsample):  # repeats a place 2 x 2, and looks one of those around
            windows = functional.interpolate(places.windows(features, 1, 1), scale_factor=2, mode="nearest")
            conv = cast(nn.Conv2d, step[1])
            drawn = functional.conv2d(windows, conv.weight, conv.bias)[:, :, 1:-1, 1:-1]
            return _after(step, drawn, 2)
        if isinstance(first, nn.ConvTranspose2d):
            return _after(step, self._raised(first, features, places))
        drawn = self._layer(first, features, places)
        return _after(step, functional.pixel_shuffle(drawn, 2) if isinstance(step[1], nn.PixelShuffle) else drawn,
                      2 if isinstance(step[1], nn.PixelShuffle) else 1)  # fmt: skip

    def _layer(self, layer: nn.Module, features: Tensor, places: _Places) -> Tensor:
        """A convolution of the cells' features, (N, C, k, k), in which neighbours see each other."""
        conv = cast(nn.Conv2d, layer)
        before = conv.kernel_size[0] // 2
        after, run = before if conv.stride[0] == 1 else 0, _valid(conv)
        windows = places.windows(features, before, after) if before or after or places.fewer else features
        side = windows.shape[2]
        if side > AS_MATRIX or conv.groups > 1:
            return run(windows)
        matrix, bias = self._matrix(conv, run, side, windows)
        flat = windows.permute(0, 2, 3, 1).reshape(len(windows), -1)
        drawn = functional.linear(flat, matrix, bias)
        out = int((len(matrix) // conv.out_channels) ** 0.5)
        return drawn.view(len(windows), out, out, -1).permute(0, 3, 1, 2)

    def _raised(self, layer: nn.ConvTranspose2d, features: Tensor, places: _Places) -> Tensor:
        """A 3 x 3 transposed convolution of stride 2: 2 x 2 places beside each other make the 2 x 2 of the first, the
        n-th of which sees no more than the first n of them."""
        count, channels, size = features.shape[:3]
        matrix, bias = self._matrix(layer, _transposed(layer), 2, features)
        wide = places.windows(features, 0, 1).permute(0, 2, 3, 1)
        four = [wide[:, i : i + size, j : j + size] for i in (0, 1) for j in (0, 1)]
        seen, made = torch.cat(four, 3).view(-1, 4 * channels), layer.out_channels
        found = features.new_empty(count, size, 2, size, 2, made)
        for number in range(4):
            rows, columns = slice(number * made, (number + 1) * made), slice((number + 1) * channels)
            drawn = functional.linear(seen[:, columns], matrix[rows, columns], None if bias is None else bias[rows])
            found[:, :, number // 2, :, number % 2] = drawn.view(count, size, size, made)
        return found.view(count, 2 * size, 2 * size, made).permute(0, 3, 1, 2)

    def _matrix(
        self, layer: nn.Conv2d | nn.ConvTranspose2d, run: Callable[[Tensor], Tensor], side: int, like: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """What a layer does to a window of side x side places, as a matrix: its answers to unit vectors."""
        found = self._matrices.get(id(layer))
        if found is None:
            unit = torch.eye(side * side * like.shape[1], device=like.device, dtype=like.dtype)
            bias = layer.bias
            answers = run(unit.view(len(unit), side, side, -1).permute(0, 3, 1, 2))
            if bias is not None:
                answers = answers - bias[:, None, None]
            places = answers.shape[2] * answers.shape[3]
            matrix = answers.permute(0, 2, 3, 1).reshape(len(unit), -1).T.contiguous()
            found = self._matrices[id(layer)] = matrix, None if bias is None else bias.repeat(places)
        return found


class _Found:
    """Which cells are looked at and which restored, as places.

    between: restored ones among those looked at. rows: of the restored ones, among those looked at; None: they are all.
    """

    def __init__(self, restored: Mask, looked: Mask, device: torch.device) -> None:
        self.looked = _Places(looked, looked, device)
        if np.array_equal(restored, looked):
            self.restored = self.between = self.looked
            self.rows: Tensor | None = None
        else:
            self.restored, self.between = _Places(restored, restored, device), _Places(restored, looked, device)
            self.rows = torch.from_numpy(self.looked.numbers[restored]).to(device)

    def restored_of(self, features: Tensor) -> Tensor:
        """Of the cells looked at, those that are restored."""
        return features if self.rows is None else features.index_select(0, self.rows)


class _Places:
    """Where cells are, and so which rows of features lie around each of them.

    where: of these, windows are made. given: of these there are features. fewer: whether some have features only.
    """

    def __init__(self, where: Mask, given: Mask, device: torch.device) -> None:
        self.rows, self.columns = np.nonzero(where)
        self.count = int(given.sum())
        self.numbers = np.full(given.shape, self.count)  # of what is not given: rows of zeros after all others
        self.numbers[given] = np.arange(self.count)
        self.fewer = len(self.rows) < self.count
        self.device = device
        self._known: dict[tuple[int, int, int], Tensor] = {}
        self._near: dict[int, Array] = {}

    def windows(self, features: Tensor, before: int, after: int) -> Tensor:
        """(N, C, k, k) -> (N, C, before + k + after, ...): each cell with what its neighbours hold beside it, or 0."""
        channels, size = features.shape[1:3]
        flat = features.permute(0, 2, 3, 1).reshape(-1, channels)
        flat = torch.cat([flat, flat.new_zeros(size * size, channels)])
        wide = before + size + after
        found = flat.index_select(0, self._around(size, before, after))
        return found.view(len(self.rows), wide, wide, channels).permute(0, 3, 1, 2)

    def _numbers_around(self, reach: int) -> Array:
        """(N, 2 reach + 1, 2 reach + 1): of the cells around each cell that is given."""
        if reach not in self._near:
            wide, step = np.pad(self.numbers, reach, constant_values=self.count), np.arange(2 * reach + 1)
            rows, columns = self.rows[:, None, None] + step[:, None], self.columns[:, None, None] + step
            self._near[reach] = wide[rows, columns]
        return self._near[reach]

    def _around(self, size: int, before: int, after: int) -> Tensor:
        """Rows of the features of all cells, for each place of each window; after the last where none is."""
        key = (size, before, after)
        if key not in self._known:
            place = np.arange(-before, size + after)
            cells, within = place // size, place % size
            reach = max(-int(cells[0]), int(cells[-1]))
            around = self._numbers_around(reach)[:, cells[:, None] + reach, cells + reach]
            found = around * size**2 + (size * within[:, None] + within)
            self._known[key] = torch.from_numpy(found.reshape(-1)).to(self.device)
        return self._known[key]


def patches(image: Image, where: Mask, cell: int, border: int) -> Image:
    """The cells of an image that are asked for, each with its border: (N, cell + 2 border, cell + 2 border[, 3]).

    Cells that reach over the image's edge see it mirrored, as the generator pads it; zeros follow.
    """
    rows, columns = where.shape
    wide = _mirrored(image, rows * cell - image.shape[0], columns * cell - image.shape[1])
    wide = cv2.copyMakeBorder(wide, *(border,) * 4, cv2.BORDER_CONSTANT)
    found: Image = _squares(cast(Any, wide), cell, cell + 2 * border)[where]
    return found


def _squares(wide: Array, step: int, side: int) -> Array:
    """(rows, columns, side, side, ...) without a copy: squares of a picture, one every `step` places."""
    down, right, *rest = wide.strides
    count = [(length - side) // step + 1 for length in wide.shape[:2]]
    shape, strides = (*count, side, side, *wide.shape[2:]), (step * down, step * right, down, right, *rest)
    return np.lib.stride_tricks.as_strided(wide, shape, strides, writeable=False)


def _mirrored(image: Image, down: int, right: int) -> Image:
    """Longer and wider, as `image_batch.padded` does it."""
    for axis, more in ((1, right), (0, down)):
        if more:
            mode = "reflect" if more < image.shape[axis] else "edge"
            image = np.pad(image, [(0, more if i == axis else 0) for i in range(image.ndim)], mode=mode)  # type: ignore[call-overload]
    return image


def _first(step: nn.Module) -> nn.Module:
    return cast(nn.Sequential, step)[0]


def _after(step: nn.Sequential, features: Tensor, begin: int = 1) -> Tensor:
    """What follows a step's convolution: each place by itself."""
    for layer in list(step)[begin:]:
        features = layer(features)
    return features


def _valid(conv: nn.Conv2d) -> Callable[[Tensor], Tensor]:
    return lambda windows: functional.conv2d(windows, conv.weight, conv.bias, conv.stride, 0, 1, conv.groups)


def _transposed(layer: nn.ConvTranspose2d) -> Callable[[Tensor], Tensor]:
    def run(windows: Tensor) -> Tensor:
        size = 2 * (windows.shape[2] - 1)
        found = functional.conv_transpose2d(windows, layer.weight, layer.bias, 2, 1)
        return found[:, :, :size, :size]

    return run
