"""Rows of tensors, by their numbers."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rows_at(table: Tensor, at: Tensor) -> Tensor:
    """table[at], rows of a table by an index, (M,); gradients reach the table.

    A GPU takes as long for a row of two numbers as for one of a hundred: there short rows are taken number by number.
    """
    return table[at] if table.device.type == "cpu" else number_by_number(table, at)


def number_by_number(table: Tensor, at: Tensor) -> Tensor:
    """The same, on any device."""
    width = math.prod(table.shape[1:])
    places = at.unsqueeze(1) * width + torch.arange(width, device=at.device)
    return table.reshape(-1).index_select(0, places.reshape(-1)).reshape(len(at), *table.shape[1:])
