"""Confusion matrices and scores against loops, sets and scikit-image."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import contingency_table

from rainstereo.model.segmentation_metrics import VOID, binary, class_ious, confusion, interval, mean_iou


def labels(seed: int, classes: int, shape: tuple[int, int] = (17, 23), void: float = 0.2) -> np.ndarray:
    rng = np.random.default_rng(seed)
    found = rng.integers(0, classes, shape).astype(np.uint8)
    found[rng.random(shape) < void] = VOID
    return found


@given(seed=st.integers(0, 10_000), classes=st.integers(1, 6))
def test_confusion_as_counted_pixel_by_pixel(seed: int, classes: int) -> None:
    truth, found = labels(seed, classes), labels(seed + 1, classes, void=0)
    matrix = confusion(truth, found, classes)
    by_loop = np.zeros((classes, classes), np.int64)
    for a, b in zip(truth.ravel().tolist(), found.ravel().tolist(), strict=True):
        if a != VOID:
            by_loop[a, b] += 1
    assert np.array_equal(matrix, by_loop)
    assert matrix.sum() == np.count_nonzero(truth != VOID)


def test_confusion_as_scikit_image_counts_it() -> None:
    truth, found = labels(1, 4, void=0.3), labels(2, 4, void=0)
    theirs = contingency_table(truth, found, ignore_labels=[VOID]).toarray()
    assert np.array_equal(confusion(truth, found, 4), theirs[:4, :4])


@given(seed=st.integers(0, 10_000))
def test_binary_scores_as_sets_of_pixels(seed: int) -> None:
    truth, found = labels(seed, 2), labels(seed + 1, 2, void=0)
    true = {i for i, v in enumerate(truth.ravel()) if v == 1}
    known = {i for i, v in enumerate(truth.ravel()) if v != VOID}
    positive = {i for i, v in enumerate(found.ravel()) if v == 1} & known
    score = binary(confusion(truth, found, 2))
    assert score.precision == pytest.approx(len(true & positive) / len(positive))
    assert score.recall == pytest.approx(len(true & positive) / len(true))
    assert score.iou == pytest.approx(len(true & positive) / len(true | positive))
    assert score.f1 == pytest.approx(2 / (1 / score.precision + 1 / score.recall))
    assert score.iou == pytest.approx(score.f1 / (2 - score.f1))


def test_scores_at_their_limits() -> None:
    same = labels(3, 5)
    assert mean_iou(confusion(same, np.where(same == VOID, 0, same), 5)) == 1
    nothing = binary(np.array([[10, 0], [0, 0]]))
    assert all(math.isnan(v) for v in (nothing.precision, nothing.recall, nothing.f1, nothing.iou))
    missed = binary(np.array([[10, 0], [5, 0]]))
    assert (math.isnan(missed.precision), missed.recall, missed.iou) == (True, 0, 0)
    # class 2 is neither there nor found, and does not count; class 1 is found where it is not, and does
    matrix = np.array([[6, 2, 0], [0, 0, 0], [0, 0, 0]])
    assert class_ious(matrix)[:2].tolist() == [0.75, 0]
    assert math.isnan(class_ious(matrix)[2])
    assert mean_iou(matrix) == 0.375
    assert math.isnan(mean_iou(np.zeros((3, 3), np.int64)))


def test_interval_of_independent_images() -> None:
    rng = np.random.default_rng(0)
    share = rng.uniform(0.3, 0.7, 300)
    matrices = [np.array([[0, 0], [round(1000 * (1 - s)), round(1000 * s)]]) for s in share]
    low, high = interval(matrices, lambda m: binary(m).iou)
    assert low < share.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * share.std() / math.sqrt(300), rel=0.15)
    assert all(map(math.isnan, interval(matrices[:1], lambda m: binary(m).iou)))


def test_labels_that_do_not_fit_are_refused() -> None:
    truth = np.zeros((3, 4), np.uint8)
    with pytest.raises(ValueError, match="expected one shape"):
        confusion(truth, truth[:2], 2)
    with pytest.raises(ValueError, match="what was found holds labels 0 to 2; expected 0 to 1"):
        confusion(truth, np.arange(12).reshape(3, 4) % 3, 2)
    with pytest.raises(ValueError, match="truth holds labels 3"):
        confusion(truth + 3, truth, 2)
    with pytest.raises(ValueError, match=r"expected \(2, 2\)"):
        binary(np.zeros((3, 3), np.int64))
