"""Adherent rain as kornia's augmentation: what kornia promises of its own, and what the drops promise."""

import copy
import math
import pickle

import numpy as np
import pytest

pytest.importorskip("torch", reason="torch is not installed")
pytest.importorskip("kornia", reason="kornia is not installed")

import torch
from kornia.augmentation import AugmentationSequential, IntensityAugmentationBase2D, RandomHorizontalFlip
from torch.utils.data import DataLoader, Dataset

from rainstereo import Camera, Chamber, Panel
from rainstereo.model.augment import RandomAdherentRain
from rainstereo.model.cap_table import CapTable
from rainstereo.model.rain_layer import render
from rainstereo.rain.population import Population


def images(count: int = 4, channels: int = 3, height: int = 40, width: int = 56, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, channels, height, width, generator=torch.Generator().manual_seed(seed))


def rain(**options: object) -> RandomAdherentRain:
    return RandomAdherentRain(**{"p": 1.0, "cover": (0.1, 0.2), "rays": 3, **options})


@pytest.fixture(params=[{}, {"f_number": (2.0, 8.0)}, {"model": "texture"}], ids=["exact", "blurred", "texture"])
def augment(request: pytest.FixtureRequest) -> RandomAdherentRain:
    return rain(**request.param)


def test_is_kornia_s(augment):
    assert isinstance(augment, IntensityAugmentationBase2D)
    x = images()
    before = x.clone()
    y = augment(x)
    assert torch.equal(x, before)
    assert y.shape == x.shape
    assert bool((y >= 0).all() & (y <= 1).all())
    mask = augment.layer.mask
    assert all(0.01 < float(one.float().mean()) < 0.99 for one in mask)
    assert torch.equal(y[~mask.expand_as(y)], x[~mask.expand_as(y)])
    assert bool((y != x).any(1, keepdim=True)[augment.layer.opacity == 1].float().mean() > 0.99)
    assert torch.equal(augment.transform_matrix, torch.eye(3).expand(4, 3, 3))


def test_parameters_give_the_same(augment):
    x = images()
    y = augment(x)
    params = augment._params
    again = rain(model=augment.flags["model"], f_number=augment._param_generator.f_number)
    assert torch.equal(again(x, params=params), y)
    assert not torch.equal(augment(x), y)  # new ones
    torch.manual_seed(3)
    first = augment(x)
    torch.manual_seed(3)
    assert torch.equal(augment(x), first)


def test_parameters_are_the_drops():
    """The drops in the parameters, rendered, are the answer."""
    augment, x = rain(distance=0.06), images()
    y = augment(x)
    x_, y_, radius, angle, index = augment._params["drops"].unbind(-1)
    caps = CapTable(x_, y_, radius, angle, index)
    camera = Camera.pinhole(56.0, 56.0, 27.5, 19.5, 56, 40)
    found = render(x, caps, camera, Chamber((0, 0, 1), 0.06, (Panel(0.004, 1.49),)), rays=3, clip=(0, 1))
    assert torch.equal(found.image, y)
    assert float(index.max()) == pytest.approx(1.33, abs=0.01)


@pytest.mark.parametrize("p", [0.0, 0.5])
def test_gate(p):
    augment, x = rain(p=p), images(16)
    torch.manual_seed(0)
    y = augment(x)
    applied = augment._params["batch_prob"] > 0.5
    assert applied.any() == (p > 0)
    assert not applied.all()
    changed = (y != x).flatten(1).any(1)
    assert torch.equal(changed, applied)
    assert torch.equal(augment.layer.mask.flatten(1).any(1), applied)


def test_same_on_batch():
    augment, x = rain(same_on_batch=True, f_number=(2.0, 8.0)), images(1).repeat(4, 1, 1, 1)
    y = augment(x)
    assert all(torch.allclose(one, y[0], atol=1e-6) for one in y)
    augment.same_on_batch = False
    assert not torch.allclose((y := augment(x))[0], y[1], atol=1e-2)


def test_in_a_sequence(augment):
    x, mask = images(), images(channels=1, seed=1).round()
    boxes, points = torch.tensor([[[2.0, 3, 20, 30]]]).repeat(4, 1, 1), torch.tensor([[[5.0, 6]]]).repeat(4, 1, 1)
    sequence = AugmentationSequential(augment, data_keys=["input", "mask", "bbox_xyxy", "keypoints"])
    y, *others = sequence(x, mask, boxes, points)
    assert not torch.equal(y, x)
    for given, found in zip((mask, boxes, points), others, strict=True):
        assert torch.equal(found.as_subclass(torch.Tensor), given)
    flipped = AugmentationSequential(RandomHorizontalFlip(p=0.5), rain(p=0.5), data_keys=["input", "mask"])
    once = flipped(x, mask)
    twice = flipped(x, mask, params=flipped._params)
    assert all(torch.equal(a, b) for a, b in zip(once, twice, strict=True))


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_dtype_and_device_follow(augment, device, dtype):
    x = images().to(device, dtype)
    y = augment(x)
    assert y.dtype == dtype
    assert y.device == x.device
    known = augment.layer
    assert known.image.dtype == known.opacity.dtype == dtype
    assert known.unknown.device == x.device
    reference = rain(model=augment.flags["model"], f_number=augment._param_generator.f_number)
    exact = reference(x.double().cpu(), params=augment._params)
    limit = 2e-3 if dtype == torch.float16 else 1e-3  # single: rounding moves rays across edges of pixels' samples
    assert float((y.double().cpu() - exact).square().mean().sqrt()) < limit


@pytest.mark.parametrize("channels", [1, 3])
def test_shapes(channels):
    x = images(channels=channels)
    assert rain()(x).shape == x.shape
    assert rain()(x[0]).shape == (1, channels, 40, 56)
    assert rain(keepdim=True)(x[0]).shape == (channels, 40, 56)
    augment = rain()
    for size in ((24, 64), (64, 24), (40, 56)):
        y = augment(images(2, channels, *size))
        assert y.shape == (2, channels, *size)
        assert augment.layer.opacity.shape == (2, 1, *size)
        assert augment.layer.mask.any()
    assert augment(x[:0]).shape == (0, channels, 40, 56)


def test_refuses():
    with pytest.raises(ValueError, match="4 channels"):
        rain()(images(channels=4))
    augment = rain()
    augment(images(4))
    with pytest.raises(ValueError, match="a table for each of 2"):
        augment(images(2), params=augment._params)
    camera = Camera.pinhole(50.0, 50.0, 27.5, 19.5, 56, 40)
    assert rain(camera=camera)(images()).shape == (4, 3, 40, 56)
    with pytest.raises(ValueError, match="the camera has 56 x 40"):
        rain(camera=camera)(images(height=41))
    for wrong in (
        {"population": "hail"}, {"cover": (0.2, 0.1)}, {"cover": (0.0, 1.0)}, {"f_number": (0.0, 2.0)}, {"model": "x"},
        {"camera": 0.0}, {"distance": -1.0}, {"f_number": (2.0, 4.0), "focal_length": 4.5}, {"rays": 1},
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"expected|there are"):
            rain(**wrong)(images())


def test_gradients_reach_the_image(augment):
    x = images(2).requires_grad_()
    y = augment(x)
    y.sum().backward()
    clear = ~augment.layer.mask.expand_as(x)
    assert bool(x.grad.isfinite().all())
    assert float(x.grad[clear].min()) >= 1 - 1e-6  # its own value, and what drops show of it
    assert not augment.layer.image.requires_grad
    with torch.no_grad():
        assert torch.equal(augment(x, params=augment._params), y)


def test_says_what_it_is(augment):
    text = repr(augment)
    for part in ("RandomAdherentRain(", "population=drops", "cover=(0.1, 0.2)", "p=1.0", "model="):
        assert part in text


def test_can_be_copied(augment):
    x = images().requires_grad_()
    y, params = augment(x), augment._params
    for other in (pickle.loads(pickle.dumps(augment)), copy.deepcopy(augment)):  # noqa: S301  our own
        assert torch.equal(other(x, params=params), y)
        torch.manual_seed(1)
        expected = augment(x)
        torch.manual_seed(1)
        assert torch.equal(other(x), expected)


class Rained(Dataset):
    """Images that are augmented where they are loaded."""

    def __init__(self, augment: RandomAdherentRain) -> None:
        self.augment = augment

    def __len__(self) -> int:
        return 4

    def __getitem__(self, i: int) -> torch.Tensor:
        return self.augment(images(1, seed=i))[0]


def test_serves_workers():
    loader = DataLoader(Rained(rain()), batch_size=2, num_workers=1)
    torch.manual_seed(0)
    first = torch.cat(list(loader))
    torch.manual_seed(0)
    assert torch.equal(torch.cat(list(loader)), first)
    torch.manual_seed(1)
    assert not torch.equal(torch.cat(list(loader)), first)


@pytest.mark.parametrize("cover", [0.05, 0.3])
def test_cover_is_what_was_asked_for(cover):
    """On average over images, within four standard errors."""
    torch.manual_seed(0)
    augment = RandomAdherentRain("large", (cover, cover), p=1.0, rays=2, distance=0.1)
    augment(images(64, 1))
    found = augment.layer.opacity.mean((1, 2, 3)).numpy()
    assert abs(found.mean() - cover) < 4 * found.std() / math.sqrt(len(found))
    assert torch.equal(augment._params["cover"], torch.full((64,), cover))


def test_draws_from_its_ranges():
    torch.manual_seed(0)
    generator = rain(cover=(0.02, 0.1), f_number=(2.0, 16.0), population=Population.preset("paper"))._param_generator
    params = generator((200, 3, 40, 56))
    for name, low, high in (("cover", 0.02, 0.1), ("f_number", 2.0, 16.0)):
        values = params[name].numpy()
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.15 * (high - low) < values.max() <= high + 1e-5
    assert np.median(params["f_number"]) == pytest.approx(math.sqrt(32), rel=0.25)  # in its logarithm
    assert np.corrcoef((params["drops"][..., 2] > 0).sum(1), params["cover"])[0, 1] > 0.4


def test_an_open_lens_blurs_more():
    x = images()
    wide, narrow = rain(f_number=(2.0, 2.0)), rain(f_number=(16.0, 16.0))
    wide(x)
    drops = {**wide._params}
    narrow(x, params={**drops, "f_number": torch.full((4,), 16.0)})
    assert float(wide.layer.mask.float().mean()) > 1.2 * float(narrow.layer.mask.float().mean())
    assert float(wide.layer.opacity.mean()) == pytest.approx(float(narrow.layer.opacity.mean()), rel=0.15)
