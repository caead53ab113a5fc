"""Training data: layouts, windows that depend on nothing but their number, odd images, and shifted pairs."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from rainstereo import imagefile  # noqa: E402
from rainstereo.model.augmentation import Augmentation  # noqa: E402
from rainstereo.model.dataset import Rain, Steps, Windows, collate, loader, order, read, tensor, whole  # noqa: E402
from rainstereo.model.misalignment import misaligned  # noqa: E402
from rainstereo.model.pair_folders import Item, find  # noqa: E402
from rainstereo.model.recipe import AugmentOptions, DataOptions, RainOptions, Source  # noqa: E402
from tests.model.training_pairs import scene, write_pairs  # noqa: E402

ALL = AugmentOptions(rotate=10, scale=(0.9, 1.2), brightness=0.1, contrast=0.1, saturation=0.1, hue=0.05, noise=0.02)


def windows(items, crop=32, augment=ALL, seed=1, **data):
    return Windows(items, DataOptions(crop=crop, **data), RainOptions(), augment, seed)


def put(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(path, image)


def test_layouts(tmp_path):
    write_pairs(tmp_path / "aligned", 2)
    for k in range(2):
        put(tmp_path / f"qian/data/{k}_rain.png", scene(k))
        put(tmp_path / f"qian/gt/{k}_clean.png", scene(k))
        for word in ("left", "right", "mask"):
            put(tmp_path / f"robotcar/{word}_{k}.png", scene(k))
        put(tmp_path / f"clear/{k}.png", scene(k))
        put(tmp_path / f"bank/a/{k}.png", scene(k))
        put(tmp_path / f"bank/a/masks/{k}.png", scene(k))
        put(tmp_path / f"bank/b/{k}.jpg", scene(k))
    (tmp_path / "aligned/manifest.csv").write_text(
        "name,dry,wet,split\n0,dry/0.png,wet/0.png,val\n1,dry/1.png,wet/1.png,train\n"
    )

    def pairs(**source):
        items = find([Source(**{k: str(tmp_path / v) if k in ("folder", "clear") else v for k, v in source.items()})])
        return [
            (i.clear.relative_to(tmp_path).as_posix(), [p.relative_to(tmp_path).as_posix() for p in i.rainy])
            for i in items
        ]

    assert pairs(folder="aligned", split="train") == [("aligned/dry/1.png", ["aligned/wet/1.png"])]
    assert pairs(folder="qian")[1] == ("qian/gt/1_clean.png", ["qian/data/1_rain.png"])
    assert pairs(folder="robotcar")[0] == ("robotcar/right_0.png", ["robotcar/left_0.png"])
    assert pairs(folder="clear", repeat=2, limit=1) == [("clear/0.png", [])] * 2
    banks = tuple(str(tmp_path / "bank" / b) for b in "ab")
    assert pairs(clear="clear", rainy=banks)[1] == ("clear/1.png", ["bank/a/1.png", "bank/b/1.jpg"])
    assert find([Source(clear=str(tmp_path / "clear"), rainy=banks[:1])])[0].masks[0].name == "0.png"
    (tmp_path / "bank/b/1.jpg").unlink()
    with pytest.raises(ValueError, match="no version of 1 of 2"):
        pairs(clear="clear", rainy=banks)
    with pytest.raises(ValueError, match="give one of them"):
        find([Source()])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        pairs(folder="nowhere")
    with pytest.raises(ValueError, match="split 'test'"):
        pairs(folder="aligned", split="test")


def test_windows_depend_on_their_number_alone(tmp_path):
    items = find([Source(folder=str(write_pairs(tmp_path)))])
    one, other = windows(items), windows(items)
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    forward = [one[n] for n in range(6)]
    backward = [other[n] for n in reversed(range(6))][::-1]
    assert torch.equal(torch.random.get_rng_state(), before)
    for a, b in zip(forward, backward, strict=True):
        assert (a.name, a.seed) == (b.name, b.seed)
        assert all(torch.equal(getattr(a, k), getattr(b, k)) for k in ("rainy", "clear", "mask"))
    assert {s.name for s in forward[:4]} == {"0", "1", "2", "3"}  # an epoch
    assert not torch.equal(one[0].clear, windows(items, seed=2)[0].clear)
    assert sorted(order(1, 0, 9)) == list(range(9))


def test_processes_share_each_batch():
    alone = list(Steps(3, 6, 4))
    parts = [list(Steps(3, 6, 4, rank, 2)) for rank in range(2)]
    assert (
        alone == [a + b for a, b in zip(*parts, strict=True)] == [[12, 13, 14, 15], [16, 17, 18, 19], [20, 21, 22, 23]]
    )


def test_geometry_is_the_same_for_image_truth_and_mask():
    torch.manual_seed(0)
    x = torch.rand(3, 40, 40)
    mask = (x[:1] > 0.5).float()
    geometric = Augmentation(AugmentOptions(rotate=20, scale=(0.8, 1.2)))
    a, b, _ = geometric(x, x, mask, 3)
    assert torch.equal(a, b)
    assert not torch.equal(a, x)
    flipped = next(Augmentation(AugmentOptions())(x, x.square(), mask, seed) for seed in range(9) if seed)
    for got, given in zip(flipped, (x, x.square(), mask), strict=True):
        assert torch.equal(got, given) or torch.equal(got, given.flip(-1))
    a, b, c = Augmentation(AugmentOptions(flip=0, brightness=0.3))(x, x, mask, 3)
    assert torch.equal(a, b)
    assert torch.equal(c, mask)
    assert not torch.equal(a, x)
    a, b, _ = Augmentation(AugmentOptions(flip=0, noise=0.1))(x, x, mask, 3)
    assert torch.equal(b, x)
    assert 0.05 < float((a - b).std()) < 0.11
    with pytest.raises(ValueError, match="flip 2"):
        Augmentation(AugmentOptions(flip=2))


def test_windows_hold_drops(tmp_path):
    clear = scene(0, (200, 160))
    rainy = clear.copy()
    rainy[100:120, 150:170] = 255 - rainy[100:120, 150:170]
    for name, image in (("clear", clear), ("rain", rainy)):
        put(tmp_path / f"{name}.png", image)
    items = [Item("a", tmp_path / "clear.png", (tmp_path / "rain.png",))]
    shares = {
        wanted: np.mean([float(windows(items, augment=None, crop_drops=wanted)[n].mask.mean() > 0) for n in range(60)])
        for wanted in (0.0, 1.0)
    }
    assert shares[0.0] < 0.25
    assert shares[1.0] > 2 * shares[0.0] + 0.2
    dry = windows(items, augment=None, clear=1.0)[0]
    assert torch.equal(dry.rainy, dry.clear)
    assert float(dry.mask.sum()) == 0


def test_rain_is_rendered_on_clear_images(tmp_path):
    put(tmp_path / "c.png", scene(1, (120, 90)))
    items = [Item("c", tmp_path / "c.png")]
    found = windows(items, augment=None)
    sample, again = found[4], found[4]
    assert torch.equal(sample.rainy, again.rainy)
    changed = (sample.rainy != sample.clear).any(0)
    assert changed.any()
    assert not (changed & (sample.mask[0] == 0)).any()
    rain = Rain(RainOptions())
    assert torch.equal(whole(items[0], rain, 3).rainy, whole(items[0], rain, 3).rainy)
    assert whole(items[0], rain, 3, crop=50).clear.shape == (3, 50, 50)


@pytest.mark.parametrize("kind", ["gray", "16 bits", "one pixel", "a line"])
def test_odd_images_are_taken(tmp_path, kind):
    image = {
        "gray": scene(0)[..., 0],
        "16 bits": scene(0).astype(np.uint16) * 257,
        "one pixel": scene(0)[:1, :1],
        "a line": scene(0)[:1],
    }[kind]
    put(tmp_path / "c.png", image)
    put(tmp_path / "r.png", image // 2)
    pair = [Item("p", tmp_path / "c.png", (tmp_path / "r.png",))]
    sample = windows(pair)[0]
    assert sample.rainy.shape == sample.clear.shape == (3, 32, 32)
    assert bool(torch.isfinite(sample.rainy).all())
    sample = windows(pair, augment=None)[0]
    assert float(sample.clear.max()) <= 1
    if kind == "16 bits":
        assert torch.equal(sample.clear.mul(65535).round() % 257, torch.zeros_like(sample.clear))
    rained = windows([Item("c", tmp_path / "c.png")], augment=None)[0]
    assert rained.rainy.shape == (3, 32, 32)


def test_a_large_image_is_taken(tmp_path):
    put(tmp_path / "c.jpg", np.zeros((6000, 8000), np.uint8))
    sample = windows([Item("c", tmp_path / "c.jpg")], augment=None, clear=1.0)[0]
    assert sample.clear.shape == (3, 32, 32)


def test_what_does_not_fit_is_named(tmp_path):
    put(tmp_path / "c.png", scene(0))
    put(tmp_path / "r.png", scene(0, (40, 32)))
    (tmp_path / "broken.png").write_bytes((tmp_path / "c.png").read_bytes()[:500])
    c, r, broken = (tmp_path / f"{n}.png" for n in ("c", "r", "broken"))
    with pytest.raises(ValueError, match=r"r\.png has 40 x 32 pixels.*c\.png has 80 x 64"):
        windows([Item("p", c, (r,))])[0]
    with pytest.raises(ValueError, match=r"broken\.png: truncated"):
        windows([Item("p", broken, (c,))])[0]
    sizes = [windows([Item("p", p, (p,))], crop=0)[0] for p in (c, r)]
    with pytest.raises(ValueError, match=r"p has 80 x 64.*set data\.crop"):
        collate(sizes)
    with pytest.raises(ValueError, match="no training images"):
        windows([])


def test_colours_are_rgb(tmp_path):
    image = np.zeros((4, 4, 3), np.uint8)
    image[..., 2] = 255  # red, in OpenCV's order
    put(tmp_path / "red.png", image)
    assert tensor(read(tmp_path / "red.png"))[:, 0, 0].tolist() == [1, 0, 0]


@pytest.mark.parametrize("shift", [(0, 0), (4, 0), (-3, 5)])
def test_shifted_pairs_are_found(tmp_path, shift):
    rng = np.random.default_rng(0)
    wide = np.kron(rng.integers(0, 255, (60, 80), dtype=np.uint8), np.ones((3, 3), np.uint8))
    dx, dy = shift
    clear, rainy = wide[10:160, 10:210], wide[10 - dy : 160 - dy, 10 - dx : 210 - dx].copy()
    rainy[40:80, 60:120] = 128  # a drop
    put(tmp_path / "c.png", clear)
    put(tmp_path / "r.png", rainy)
    found = misaligned([Item("p", tmp_path / "c.png", (tmp_path / "r.png",))])
    assert bool(found) == (shift != (0, 0))
    if found:
        assert (found[0].dx, found[0].dy) == pytest.approx(shift, abs=0.3)


def test_real_pairs(shared_data):
    """The rig's published pairs are row-aligned, not shifted onto each other; Qian et al.'s lie on each other."""
    assert misaligned(find([Source(folder=str(shared_data / "raindrop" / "qian"))])) == []
    found = misaligned(find([Source(folder=str(shared_data / "raindrop" / "robotcar_rainy"))]))
    assert [round(s.dx, -1) for s in found] == [140, 140]


@pytest.mark.slow
def test_workers_change_nothing(tmp_path):
    found = windows(find([Source(folder=str(write_pairs(tmp_path)))]))
    here, there = (list(loader(found, Steps(0, 3, 2), count)) for count in (0, 1))
    for a, b in zip(here, there, strict=True):
        assert (a.names, a.seeds) == (b.names, b.seeds)
        assert all(torch.equal(getattr(a, k), getattr(b, k)) for k in ("rainy", "clear", "mask"))
