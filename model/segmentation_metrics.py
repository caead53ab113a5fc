"""How well a segmentation fits: confusion matrices, and what is read off them.

A set's score is that of the sum of its images' matrices, as in Cityscapes and PASCAL VOC, not the mean of scores.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

VOID = 255
"""Label of pixels that do not count."""
Labels = npt.NDArray[np.integer[Any]]
Confusion = npt.NDArray[np.int64]


def confusion(truth: Labels, found: Labels, classes: int, void: int = VOID) -> Confusion:
    """(classes, classes) counts of pixels, truth down and found across; pixels whose truth is `void` do not count.

    ValueError where the shapes differ, or a label is none of 0 .. classes - 1.
    """
    if truth.shape != found.shape:
        raise ValueError(f"truth has shape {truth.shape} and what was found {found.shape}; expected one shape")
    counted = truth != void
    a, b = truth[counted].astype(np.int64), found[counted].astype(np.int64)
    for name, labels in (("truth", a), ("what was found", b)):
        if labels.size and not 0 <= labels.min() <= labels.max() < classes:
            raise ValueError(
                f"{name} holds labels {labels.min()} to {labels.max()}; expected 0 to {classes - 1}, or {void} where "
                "the truth is unknown"
            )
    return np.bincount(a * classes + b, minlength=classes * classes).reshape(classes, classes)


@dataclass(frozen=True)
class Binary:
    """Of the class 1 against 0. NaN where nothing is there to divide by: no such pixel was found, or is true."""

    precision: float
    recall: float
    f1: float
    iou: float


def binary(matrix: Confusion) -> Binary:
    """Scores of a (2, 2) confusion matrix."""
    if matrix.shape != (2, 2):
        raise ValueError(f"the confusion matrix has shape {matrix.shape}; expected (2, 2)")
    (_, wrong), (missed, right) = matrix.tolist()
    return Binary(
        _share(right, right + wrong), _share(right, right + missed), _share(2 * right, 2 * right + wrong + missed),
        _share(right, right + wrong + missed),
    )  # fmt: skip


def class_ious(matrix: Confusion) -> npt.NDArray[np.float64]:
    """(classes,) intersection over union; NaN for a class that is neither there nor found."""
    right = np.diagonal(matrix).astype(np.float64)
    union = matrix.sum(0) + matrix.sum(1) - right
    return np.divide(right, union, out=np.full(len(right), np.nan), where=union > 0)


def mean_iou(matrix: Confusion) -> float:
    """mIoU: the mean over the classes that are there or were found; NaN where there is none."""
    ious = class_ious(matrix)
    known = ious[np.isfinite(ious)]
    return float(known.mean()) if len(known) else float("nan")


def interval(
    matrices: list[Confusion], score: Callable[[Confusion], float], seed: int = 0, draws: int = 1000
) -> tuple[float, float]:
    """Ends of the 95 % interval of a set's score by the bootstrap over its images; NaN for fewer than two.

    It tells how much the choice of test images matters, taken as independent, and nothing of the training.
    """
    if len(matrices) < 2:
        return float("nan"), float("nan")
    stack = np.stack(matrices)
    chosen = np.random.default_rng(seed).integers(len(stack), size=(draws, len(stack)))
    values = np.array([score(stack[row].sum(0)) for row in chosen])
    values = values[np.isfinite(values)]
    if not len(values):
        return float("nan"), float("nan")
    low, high = np.quantile(values, (0.025, 0.975))
    return float(low), float(high)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
