"""The restorer: what comes back untouched, what is computed, and that parts equal the whole."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.model import checkpoint
from rainstereo.model.frame_sequence import FrameSequence
from rainstereo.model.pixels import from_rgb, to_rgb
from rainstereo.model.restore import Restorer
from rainstereo.model.tiles import Grid, Rect, coarser, covering, mixed, ramped, strips
from rainstereo.types import Image
from tests.model.small_restorer import CONFIG, RedDetector, generator, network, picture, saved, with_drop


def restorer(**more: object) -> Restorer:
    return Restorer(network=network(), **{"skip": False, **more})  # type: ignore[arg-type]


def skipping(**more: object) -> Restorer:
    return Restorer(network=network(), detector=RedDetector(), **more)  # type: ignore[arg-type]


def by_hand(image: Image) -> Image:
    """The definition: red first, divided, through the module in double, rounded."""
    wide = np.repeat(image[..., None], 3, -1) if image.ndim == 2 else image[..., ::-1]
    top = np.iinfo(image.dtype).max
    given = torch.from_numpy((wide / top).transpose(2, 0, 1)[None].copy())
    with torch.no_grad():
        out = generator().double()(given)[0].numpy().transpose(1, 2, 0) * top
    return np.rint(out.mean(-1) if image.ndim == 2 else out[..., ::-1]).astype(image.dtype)


@pytest.mark.parametrize("kind", ["colour", "gray", "deep", "one pixel", "one row", "flat"])
def test_an_image_comes_back_as_the_generator_draws_it(kind: str) -> None:
    image = picture()
    image = {
        "colour": image, "gray": image[..., 0], "deep": image.astype(np.uint16) * 257, "one pixel": image[:1, :1],
        "one row": image[:1], "flat": picture(texture=False),
    }[kind]  # fmt: skip
    before = image.copy()
    found = restorer()(image)
    assert (found.shape, found.dtype) == (image.shape, image.dtype)
    assert np.array_equal(image, before)
    assert np.abs(found.astype(int) - by_hand(image)).max() <= (1 if image.dtype == np.uint8 else 4)
    assert np.abs(found.astype(int) - image).mean() > 1


@settings(max_examples=20, deadline=None)
@given(st.sampled_from([np.uint8, np.uint16]), st.booleans(), st.integers(1, 9), st.integers(1, 9), st.integers(0, 99))
def test_pixels_survive_the_way_to_the_network_and_back(
    kind: type, gray: bool, height: int, width: int, seed: int
) -> None:
    shape = (height, width) if gray else (height, width, 3)
    image = np.random.default_rng(seed).integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    rgb = to_rgb(image, torch.device("cpu"))
    assert rgb.shape == (1, 3, height, width)
    assert 0 <= rgb.min() <= rgb.max() <= 1
    assert np.array_equal(from_rgb(rgb[0], image), image)


@pytest.mark.parametrize("texture", [True, False])
@pytest.mark.parametrize("size", [(300, 333), (271, 512)])
def test_tiles_equal_the_frame_without_seams(size: tuple[int, int], texture: bool) -> None:
    image = picture(3, size, texture)
    whole, tiled = restorer(), restorer(tile=96, max_pixels=1 << 16)
    assert tiled.grid(size).count > 9
    difference = np.abs(tiled(image).astype(int) - whole(image))
    assert difference.max() <= 1
    assert difference.mean() < 0.02
    streamed = np.concatenate(list(tiled.rows(lambda a, b: image[a:b], size)))
    assert np.array_equal(streamed, tiled(image))


def test_a_halo_that_is_too_small_shows() -> None:
    image, made = picture(3, (300, 300)), restorer(tile=96, max_pixels=1 << 16)
    made.network.halo = 0
    assert np.abs(made(image).astype(int) - restorer()(image)).max() > 3


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 700), st.integers(64, 200), st.sampled_from([0, 16, 32]), st.integers(0, 1))
def test_weights_of_tiles_add_up_to_one(length: int, side: int, overlap: int, axis: int) -> None:
    size = (length, 40) if axis == 0 else (40, length)
    grid, total = Grid(size, side, 16, overlap), np.zeros(length)
    for i, (start, end) in enumerate(grid.spans(axis)):
        assert 0 < end - start <= side
        total[start:end] += grid.weights(axis, i)
    assert total == pytest.approx(1)
    image = np.random.default_rng(length).integers(0, 65536, size, dtype=np.uint16)
    assert np.array_equal(np.concatenate(list(strips(lambda a, b: image[a:b], grid, np.copy))), image)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.floats(0, 0.3), st.sampled_from([0, 16, 32]))
def test_rectangles_hold_every_marked_cell_and_its_halo(seed: int, share: float, halo: int) -> None:
    size = (205, 333)
    marked = np.random.default_rng(seed).random((13, 21)) < share
    parts = covering(marked, 16, halo, 16, size, 8192)
    held = np.zeros(size, bool)
    for part in parts:
        assert part.top % 16 == part.left % 16 == 0
        held[part.slices] = True
    for row, column in np.argwhere(marked):
        cell = Rect(row * 16, column * 16, min(205, row * 16 + 16), min(333, column * 16 + 16))
        assert any(
            p.top <= (c := cell.grown(halo, size)).top
            and p.left <= c.left
            and p.bottom >= c.bottom
            and p.right >= c.right
            for p in parts
        )
        assert held[cell.slices].all()
    assert sum(p.area for p in parts) + 8192 * len(parts) <= size[0] * size[1] + 8192 * max(1, len(parts)) * 9


def test_clear_images_pass_bit_for_bit_and_cost_no_network() -> None:
    made = skipping()
    made.network = None  # type: ignore[assignment]
    found = made.restored(picture())
    assert np.array_equal(found.image, picture())
    assert (found.marked, found.computed) == (0, 0)


def test_clear_cells_pass_and_marked_ones_are_restored() -> None:
    image = with_drop(with_drop(picture(5, (320, 480)), 40, 40), 250, 400)
    whole, made = restorer()(image), skipping(halo=48)
    found = made.restored(image)
    marked = np.kron(RedDetector().cells(image), np.ones((16, 16))).astype(bool)
    assert marked.sum() == 512
    assert np.array_equal(found.image[~marked], image[~marked])
    assert np.array_equal(found.image[40, 40], whole[40, 40])  # beyond the ramp, inside the halo
    assert 0 < found.computed < 0.5
    assert found.marked == pytest.approx(2 / (20 * 30))
    assert skipping(skip=False, halo=48)(image).tolist() == whole.tolist()


ZEROS = replace(CONFIG, padding="zeros", normalisation="none", patch=4)  # which can be computed by cells, of 16 pixels


def by_cells(**more: object) -> Restorer:
    return Restorer(network=network(ZEROS), detector=RedDetector(), **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["colour", "gray", "deep"])
def test_marked_cells_are_computed_alone(kind: str) -> None:
    image = picture(5, (310, 475))
    image = {"colour": image, "gray": image[..., 0].copy(), "deep": image.astype(np.uint16) * 257}[kind]
    image = with_drop(with_drop(image, 40, 40), 305, 470)
    image[40, 40] = image[305, 470] = (0, 0, np.iinfo(image.dtype).max) if image.ndim == 3 else 255
    before, made = image.copy(), by_cells()
    found, cells = made.restored(image), RedDetector().cells(image)
    marked = np.repeat(np.repeat(cells, 16, 0), 16, 1)[:310, :475]
    assert np.array_equal(image, before)
    assert np.array_equal(found.image[~marked], image[~marked])
    assert found.computed == pytest.approx(2 * 16 * 16 / image[..., :1].size if image.ndim == 3 else 512 / image.size)
    whole = Restorer(network=network(ZEROS), skip=False)(image)
    wide = by_cells(halo=64)(image)  # what a cell depends on lies within
    inner = slice(36, 44), slice(36, 44)  # inside the ramp
    assert np.array_equal(wide[inner], whole[inner])
    assert not np.array_equal(found.image[inner], image[inner])


def test_all_cells_marked_are_the_whole_image() -> None:
    image = picture(6, (100, 90))
    made = by_cells()
    found = made.with_cells(image, np.ones((7, 6), bool))
    assert found.computed == 1
    assert np.array_equal(found.image, made.whole(image))
    most = np.ones((7, 6), bool)
    most[3, 2] = False
    assert made.with_cells(image, most).computed == 1  # not worth its while to leave out one


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([4, 8, 16, 32, 64]), st.sampled_from([0, 16, 32, 50]))
def test_wide_cells_hold_the_marked_ones(seed: int, wide: int, halo: int) -> None:
    size = (205, 333)
    marked = np.random.default_rng(seed).random((13, 21)) < 0.05
    pixels = np.kron(marked, np.ones((16, 16)))[:205, :333] > 0
    reach = -(-halo // wide) * wide
    down, right = -205 % wide, -333 % wide
    held = np.pad(pixels, ((0, down), (0, right)))  # an independent formulation: by pixels
    coarse = held.reshape(held.shape[0] // wide, wide, -1, wide).any((1, 3))
    grown = cv2.dilate(np.kron(coarse, np.ones((wide, wide))).astype(np.uint8), np.ones((2 * reach + 1,) * 2)) > 0
    expected = grown.reshape(coarse.shape[0], wide, -1, wide).any((1, 3))
    assert np.array_equal(coarser(marked, 16, wide, halo, size), expected)


def test_ramps_stay_inside_what_is_marked() -> None:
    marked = np.zeros((6, 6), bool)
    marked[2:4, 2:5] = True
    weight = ramped(marked, 16, (90, 96), 8)
    wide = np.kron(marked, np.ones((16, 16)))[:90]
    assert (weight[wide == 0] == 0).all()
    assert weight[48, 56] == 1
    assert 0 <= weight.min() <= weight.max() == 1
    assert (np.diff(weight[48, 32:56]) >= 0).all()


def test_batches_equal_single_images() -> None:
    images = [with_drop(picture(i), 5, 5) for i in range(3)] + [picture(7), picture(8, (40, 50))[..., 0]]
    for made in (restorer(), skipping()):
        for image, found in zip(images, made.many(images), strict=True):
            alone = made.restored(image)
            assert np.abs(found.image.astype(int) - alone.image).max() <= 1
            assert (found.marked, found.computed) == (alone.marked, alone.computed)
    assert made.many([]) == []


def test_batches_of_frames_with_few_drops_equal_single_images() -> None:
    """With a network that computes cells of its own size, which the package's does."""
    config = replace(CONFIG, padding="zeros", normalisation="none", patch=4)
    made = Restorer(network=network(config), detector=RedDetector())
    few = [with_drop(picture(i, (192, 256)), 80, 90) for i in range(2)]
    everywhere = picture(3, (192, 256))
    everywhere[::16, ::16] = (0, 0, 255)
    images = [*few, everywhere, picture(4, (192, 256))]
    alone = [made.restored(image) for image in images]
    assert 0 < alone[0].computed < alone[2].computed == 1
    for found, single in zip(made.many(images), alone, strict=True):
        assert np.abs(found.image.astype(int) - single.image).max() <= 1
        assert (found.marked, found.computed) == (single.marked, single.computed)


def test_precision_and_names() -> None:
    image = picture()
    half = restorer()
    half.network = type(half.network)(generator(), "cpu", "bf16")  # type: ignore[call-arg]
    assert half.network.name == "torch bf16 on cpu"
    assert 0 < np.abs(half(image).astype(int) - restorer()(image)).max() <= 8


def test_bad_images_and_settings_are_refused() -> None:
    made = restorer()
    for image in (picture().astype(np.float32), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4), np.uint8), [1]):
        with pytest.raises(ValueError, match="expected"):
            made(image)  # type: ignore[arg-type]
    for more in ({"halo": -1}, {"tile": 8}, {"max_pixels": 5}):
        with pytest.raises(ValueError, match="expected a halo"):
            restorer(**more)
    with (
        pytest.raises(ValueError, match="torch finds no CUDA")
        if not torch.cuda.is_available()
        else pytest.raises(ValueError, match="unknown")
    ):
        Restorer(None, "cuda" if not torch.cuda.is_available() else "abacus", skip=False)
    with pytest.raises(ValueError, match="expected torch or onnx"):
        Restorer(backend="paper")  # type: ignore[arg-type]


def test_checkpoints_for_other_data_are_refused(tmp_path: Path) -> None:
    good = saved(tmp_path / "good")
    assert np.array_equal(Restorer(good, precision="float32", skip=False)(picture()), restorer()(picture()))
    for name, more, words in (
        ("gray", {"input": {"channels": 1}}, "channels 1; expected channels 3"),
        ("range", {"input": {"range": [-1, 1]}}, r"range \[-1, 1\]; expected"),
        ("blue", {"input": {"colour": "bgr", "channels": 3}}, "colour bgr"),
        ("words", {"input": "photographs"}, "photographs"),
        ("role", {"architecture": "discriminator"}, "holds discriminator; expected what restores"),
    ):
        with pytest.raises(ValueError, match=words):
            Restorer(saved(tmp_path / name, **more), skip=False)
    data = good.read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(data[:-9])
    with pytest.raises(checkpoint.DamagedCheckpointError):
        Restorer(tmp_path / "cut.safetensors", skip=False)
    with pytest.raises(FileNotFoundError):
        Restorer(tmp_path / "none.safetensors", skip=False)
    with pytest.raises(ValueError, match="backend onnx"):
        Restorer(tmp_path / "x.onnx", skip=False)


def test_instance_normalisation_is_known_not_to_be_local() -> None:
    assert network().local
    assert not network(replace(CONFIG, normalisation="instance")).local


# -- sequences ---------------------------------------------------------------------------------------------------------


def test_each_frame_by_itself_is_the_default() -> None:
    made = skipping()
    sequence = FrameSequence(made)
    for frame in (with_drop(picture(), 50, 50), picture(1), picture(2, (64, 64))):
        assert np.array_equal(sequence(frame).image, made(frame))


def test_places_are_held_between_looks() -> None:
    made = skipping()
    detector = made.detector
    assert isinstance(detector, RedDetector)
    sequence, frame = FrameSequence(made, every=3, hold=2), with_drop(picture(), 50, 50)
    cells = made.marked(frame)
    detector.looks = 0
    for i in range(6):
        found = sequence(frame if i == 0 else picture())
        assert np.array_equal(found.image, made.with_cells(frame if i == 0 else picture(), cells).image)
    assert detector.looks == 2
    assert np.array_equal(sequence(picture()).image, picture())  # two clear looks


def test_what_did_not_change_is_not_computed_again() -> None:
    made = skipping(halo=16)
    sequence, frame = FrameSequence(made, reuse=2), with_drop(with_drop(picture(), 8, 8), 90, 120)
    first = sequence(frame)
    again = sequence(frame)
    assert (again.computed, first.computed) == (0, pytest.approx(first.computed))
    assert np.array_equal(again.image, first.image)
    noisy = np.clip(frame.astype(int) + 1, 0, 255).astype(np.uint8)
    noisy[8, 8] = noisy[90, 120] = (0, 0, 255)
    kept = sequence(noisy)
    assert kept.computed == 0
    marked = np.kron(made.marked(frame), np.ones((16, 16))).astype(bool)
    assert np.array_equal(kept.image[~marked], noisy[~marked])
    assert np.array_equal(kept.image[marked], first.image[marked])
    changed = noisy.copy()
    changed[10, 10] += 40
    partly = sequence(changed)
    assert 0 < partly.computed < first.computed
    assert np.array_equal(partly.image[90:, 120:], first.image[90:, 120:])
    assert np.array_equal(partly.image[:16, :16], made(changed)[:16, :16])


def test_slow_drift_does_not_add_up() -> None:
    sequence, frame = FrameSequence(skipping(), reuse=3), with_drop(picture(texture=False), 50, 50)
    computed = []
    for i in range(9):
        drifted = np.where(frame == 255, 255, np.minimum(frame + i, 254)).astype(np.uint8)
        drifted[50, 50] = (0, 0, 255)
        computed.append(sequence(drifted).computed > 0)
    assert computed == [True, False, False, False, True, False, False, False, True]


def test_senseless_sequences_are_refused() -> None:
    for more in ({"every": 0}, {"hold": 0}, {"reuse": -1.0}, {"reuse": float("nan")}):
        with pytest.raises(ValueError, match="expected 1 or more frames"):
            FrameSequence(restorer(), **more)  # type: ignore[arg-type]


def test_opencv_reads_what_it_is_given(tmp_path: Path) -> None:
    """The example of the module's docstring, with a checkpoint of one's own."""
    cv2.imwrite(str(tmp_path / "photo.png"), picture())
    image = cv2.imread(str(tmp_path / "photo.png"))
    assert image is not None
    assert Restorer(saved(tmp_path / "own"), skip=False)(image).shape == image.shape


def test_cells_around_are_looked_at_where_that_is_cheap() -> None:
    image = with_drop(picture(0, (160, 160)), 70, 70)
    found = {}
    for around in (0.0, 0.3, 9.0):
        made = by_cells(around=around)
        few, many = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
        few[4, 4], many[::3, ::3] = True, True
        wide = np.zeros((10, 10), bool)
        wide[3:6, 3:6] = True
        assert np.array_equal(made.looked_at(few), wide if around else few)
        assert made.looked_at(many).all() == (around == 9)
        found[around] = made.restored(image)
    assert np.array_equal(found[0.3].image, found[9.0].image)
    assert not np.array_equal(found[0.0].image, found[9.0].image)
    for restored in found.values():
        assert restored.computed == found[0.0].computed
        changed = (restored.image != image).any(-1)
        assert changed[64:80, 64:80].any()
        changed[64:80, 64:80] = False
        assert not changed.any()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [(), (3,)])
def test_mixed_is_the_weighted_mean_and_bits_where_nothing_is_mixed(kind: type, channels: tuple[int, ...]) -> None:
    rng, most = np.random.default_rng(3), np.iinfo(kind).max
    one, other = (rng.integers(0, most, (37, 52, *channels), dtype=kind, endpoint=True) for _ in range(2))
    weight = np.clip(rng.uniform(-0.5, 1.5, (37, 52)), 0, 1).astype(np.float32)
    found, each = mixed(one, other, weight), weight.astype(float).reshape(37, 52, *(1,) * len(channels))
    assert found.dtype == kind
    assert np.abs(found - (each * one + (1 - each) * other)).max() <= 0.5 + most * 1e-5
    np.testing.assert_array_equal(found[weight == 0], other[weight == 0])
    np.testing.assert_array_equal(found[weight == 1], one[weight == 1])
