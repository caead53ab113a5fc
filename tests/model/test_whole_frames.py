"""A stream of frames, computed whole: each comes back as it would alone, in order, on every device."""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from rainstereo.model.networks import TorchNetwork
from rainstereo.model.restore import Restorer
from rainstereo.model.whole_frames import AHEAD, WholeFrames
from rainstereo.types import Image
from tests.model.small_restorer import RedDetector, generator, network, picture, with_drop


def on(device: torch.device) -> TorchNetwork:
    return TorchNetwork(generator(), device, "float32")


def mixed() -> list[Image]:
    """Frames whose size, type and channels change on the way."""
    small, large = [picture(i, (48, 64)) for i in range(5)], [picture(9 + i, (60, 40)) for i in range(2)]
    return [*small, *large, small[0][..., 0], small[1].astype(np.uint16) * 257, small[2][:, ::2], small[3]]


@pytest.mark.parametrize("batch", [1, 3])
def test_frames_come_back_as_each_alone(device: torch.device, batch: int) -> None:
    frames = mixed()
    before = [frame.copy() for frame in frames]
    made = WholeFrames(on(device), batch)
    alone = Restorer(network=network(), skip=False)
    for _ in range(2):  # a second time, in memory that was used before
        found = list(made(frames))
        assert len(found) == len(frames)
        for given, image in zip(frames, found, strict=True):
            assert (image.shape, image.dtype) == (given.shape, given.dtype)
            apart = np.abs(image.astype(int) - alone(given)).max()
            close, rough = (1, 2) if given.dtype == np.uint8 else (40, 514)
            assert apart <= (close if device.type == "cpu" else rough)  # products in TF32 there
            assert np.abs(image.astype(int) - given).mean() > 1
    assert all(np.array_equal(a, b) for a, b in zip(frames, before, strict=True))


def test_frames_that_came_back_are_ones_own(device: torch.device) -> None:
    frames = [picture(i, (48, 64)) for i in range(2 * AHEAD + 3)]
    found = WholeFrames(on(device))(frames)
    first = next(found)
    kept = first.copy()
    rest = list(found)
    assert len(rest) == len(frames) - 1
    assert np.array_equal(first, kept)
    assert all(not np.shares_memory(first, other) for other in rest)


def test_a_stream_is_read_as_it_is_needed(device: torch.device) -> None:
    read = []

    def camera() -> Iterator[Image]:
        for i in range(100):
            read.append(i)
            yield picture(i, (32, 32))

    found = WholeFrames(on(device), 2)(camera())
    next(found)
    assert len(read) <= 2 * (AHEAD + 1) + 1


def test_the_restorers_stream_equals_frame_by_frame() -> None:
    frames = [*mixed(), picture(40, (300, 300))]
    whole = Restorer(network=network(), skip=False, max_pixels=1 << 16)  # the last one is tiled
    for given, image in zip(frames, whole.stream(frames, 2), strict=True):
        assert np.abs(image.astype(int) - whole(given)).max() <= (1 if given.dtype == np.uint8 else 40)
    skipping = Restorer(network=network(), detector=RedDetector())
    rainy = [with_drop(picture(0), 40, 50), picture(1)]
    found = list(skipping.stream(rainy, 2))
    assert np.array_equal(found[0], skipping(rainy[0]))
    assert np.array_equal(found[1], rainy[1])


def test_what_is_no_frame_is_refused() -> None:
    with pytest.raises(ValueError, match="expected 1 or more"):
        WholeFrames(network(), 0)
    for made in (WholeFrames(network()), Restorer(network=network(), skip=False).stream):
        with pytest.raises(ValueError, match="expected uint8 or uint16"):
            list(made([picture(), picture().astype(np.float32)]))
    assert list(WholeFrames(network())([])) == []


def test_cudnn_chooses_for_shapes_that_come_again(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    made, chosen = on(device), []

    def seen(*_: object) -> None:
        chosen.append(bool(torch.backends.cudnn.benchmark))

    made.module.register_forward_pre_hook(seen)
    monkeypatch.setattr(torch.backends.cudnn, "benchmark", False)
    for side in (32, 48, 32, 48):
        made(torch.rand(1, 3, side, side))
    again = device.type == "cuda"
    assert chosen == [False, False, again, again]
    assert not torch.backends.cudnn.benchmark
