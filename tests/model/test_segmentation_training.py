"""The segmentation networks: sizes, what they are made of, that they learn, and that a killed training goes on."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from rainstereo import imagefile
from rainstereo.model import checkpoint
from rainstereo.model.deeplab import AtrousPyramid, DeepLabConfig
from rainstereo.model.group_convolution import separable
from rainstereo.model.segmentation_metrics import VOID, binary, confusion
from rainstereo.model.segmentation_training import Example, Training, Windows, load, loss_of, predict, train
from rainstereo.model.unet import UNetConfig
from tests.model.small_restorer import saved

CPU = torch.device("cpu")
UNET = UNetConfig(1, 4, 2)
DEEPLAB = DeepLabConfig(3, 4, (1, 2), 4)


@pytest.mark.parametrize("config", [UNET, DEEPLAB, UNetConfig(5, 3, 1)])
@pytest.mark.parametrize("size", [(1, 1), (7, 33), (32, 48)])
def test_any_size_gives_scores_of_that_size(config: UNetConfig | DeepLabConfig, size: tuple[int, int]) -> None:
    scores = config.build().eval()(torch.rand(2, 3, *size))
    assert scores.shape == (2, config.classes, *size)
    assert scores.isfinite().all()


def test_the_published_u_net_has_its_31_million_parameters() -> None:
    """Counted from the paper's figure 1 by hand: 3x3 pairs down and up, 2x2 up-convolutions, and the last 1x1."""
    pairs = [(3, 64), (64, 128), (128, 256), (256, 512), (512, 1024), (1024, 512), (512, 256), (256, 128), (128, 64)]
    convolutions = sum(9 * (a * b + b * b) for a, b in pairs)
    norms = sum(2 * 2 * b for _, b in pairs)
    ups = sum(4 * a * a // 2 + a // 2 for a in (1024, 512, 256, 128))
    with torch.device("meta"):
        network = UNetConfig(2, 64).build()
    assert sum(p.numel() for p in network.parameters()) == convolutions + norms + ups + 64 * 2 + 2
    assert 31.0e6 < convolutions + ups < 31.1e6


def test_an_atrous_convolution_is_one_with_zeros_between_its_taps() -> None:
    torch.manual_seed(0)
    layer, features = separable(3, 4, rate=3), torch.randn(1, 3, 19, 21)
    taps = layer[0].weight.detach()
    spread = torch.zeros(3, 1, 7, 7)
    spread[:, :, ::3, ::3] = taps
    dense = nn.functional.conv2d(features, spread, padding=3, groups=3)
    torch.testing.assert_close(layer(features), layer[1](dense))


def test_the_pyramid_sees_as_far_as_its_largest_rate_and_the_mean_of_all() -> None:
    torch.manual_seed(0)
    pyramid = AtrousPyramid(2, 4, (2, 5))
    pyramid.join = nn.Sequential(nn.Conv2d(16, 1, 1))  # without the normalisation, which looks at the whole image
    for branch in (pyramid.alone, *pyramid.around):
        for module in branch.modules():
            if isinstance(module, nn.Sequential):
                for i, part in enumerate(module):
                    if isinstance(part, nn.GroupNorm | nn.ReLU):
                        module[i] = nn.Identity()
    pyramid.mean = nn.Sequential(nn.Conv2d(2, 4, 1))
    features = torch.zeros(1, 2, 21, 21, requires_grad=True)
    pyramid(features)[0, 0, 10, 10].backward()
    assert features.grad is not None
    gradient = features.grad[0, 0].numpy()
    everywhere = gradient[0, 0]
    seen = {(int(y) - 10, int(x) - 10) for y, x in np.argwhere(abs(gradient - everywhere) > 1e-7)}
    assert seen == {(r * a, r * b) for r in (2, 5) for a in (-1, 0, 1) for b in (-1, 0, 1)}
    assert everywhere != 0


def test_losses_as_they_are_written() -> None:
    rng = np.random.default_rng(0)
    scores, targets = rng.normal(size=(2, 3, 4, 5)), rng.integers(0, 3, (2, 4, 5))
    targets[0, :2] = VOID
    known = targets != VOID
    logs = scores - np.log(np.exp(scores).sum(1, keepdims=True))
    picked = np.take_along_axis(logs, np.where(known, targets, 0)[:, None], 1)[:, 0]
    found = loss_of(torch.from_numpy(scores), torch.from_numpy(targets.astype(np.uint8)))
    assert float(found) == pytest.approx(-picked[known].mean())
    one, wanted = scores[:, :1], np.where(known, targets == 1, 0)
    p = 1 / (1 + np.exp(-one[:, 0]))
    entropy = -(wanted * np.log(p) + (1 - wanted) * np.log(1 - p))[known].mean()
    dice = 1 - (2 * (p * wanted * known).sum() + 1) / ((p * known).sum() + wanted.sum() + 1)
    binary_targets = torch.from_numpy(np.where(known, wanted, VOID).astype(np.uint8))
    assert float(loss_of(torch.from_numpy(one), binary_targets)) == pytest.approx(entropy + dice, rel=1e-6)
    nothing = torch.full((1, 2, 2), VOID, dtype=torch.uint8)
    assert float(loss_of(torch.zeros(1, 3, 2, 2), nothing)) == 0


def pattern(folder: Path, count: int = 4, size: tuple[int, int] = (48, 64)) -> list[Example]:
    """Bright discs on noise are 1, a strip below is void."""
    examples = []
    for i in range(count):
        rng = np.random.default_rng(i)
        image = rng.integers(0, 120, (*size, 3), dtype=np.uint8)
        truth = np.zeros(size, np.uint8)
        for x, y in rng.integers(6, 40, (4, 2)):
            cv2.circle(truth, (int(x), int(y)), 5, 1, -1)
        image[truth == 1] += 100
        truth[-6:] = VOID
        for name, array in ((f"{i}.png", image), (f"{i}-dark.png", image // 2), (f"{i}-truth.png", truth)):
            imagefile.write(folder / name, array)
        examples.append(Example((folder / f"{i}.png",), folder / f"{i}-truth.png"))
    return examples


def test_it_learns_a_pattern(tmp_path: Path) -> None:
    examples = pattern(tmp_path)
    training = Training(60, 4, 32, zoom=1, rate=0.02)
    network = train(UNET, examples, training, tmp_path / "net.safetensors", "k", CPU)
    total = np.zeros((2, 2), np.int64)
    for example in examples:
        found = predict(network, imagefile.read(example.variants[0]), CPU)
        total += confusion(imagefile.read(example.target), found, 2)
    assert binary(total).iou > 0.7
    again, card = load(tmp_path / "net.safetensors")
    assert np.array_equal(predict(again, imagefile.read(examples[0].variants[0]), CPU),
                          predict(network, imagefile.read(examples[0].variants[0]), CPU))  # fmt: skip
    assert card["losses"][-1] < card["losses"][0] / 2


class Killed(Exception):  # noqa: N818 - it is no error
    pass


@pytest.mark.parametrize("config", [UNET, DeepLabConfig(2, 4, (1, 2), 4)])
def test_a_killed_training_goes_on_as_if_nothing_had_been(config: UNetConfig | DeepLabConfig, tmp_path: Path) -> None:
    examples, training = pattern(tmp_path, 3), Training(7, 2, 32, keep=2)
    whole = train(config, examples, training, tmp_path / "whole.safetensors", "k", CPU)

    def die(done: int, total: int) -> None:
        if done == 5:
            raise Killed

    path = tmp_path / "cut.safetensors"
    with pytest.raises(Killed):
        train(config, examples, training, path, "k", CPU, die)
    assert not path.exists()
    steps: list[int] = []
    resumed = train(config, examples, training, path, "k", CPU, lambda done, total: steps.append(done))
    assert steps == [5, 6, 7]
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    assert load(path)[1]["losses"] == load(tmp_path / "whole.safetensors")[1]["losses"]
    assert [p.name for p in tmp_path.glob("*unfinished*")] == []
    with pytest.raises(Killed):
        train(config, examples, training, path, "k", CPU, die)
    train(config, examples, training, path, "another key", CPU, lambda done, total: steps.append(done))
    assert steps[3:] == [1, 2, 3, 4, 5, 6, 7]


def test_windows_do_not_depend_on_how_many_variants_there_are(tmp_path: Path) -> None:
    examples = pattern(tmp_path, 5)
    both = [
        Example((*e.variants, e.target.with_name(e.target.name.replace("truth", "dark"))), e.target) for e in examples
    ]
    training = Training(10, 5, 32)
    one, two = Windows(examples, training), Windows(both, training)
    taken = 0
    for step in range(4):
        (images, targets), (other, same) = one.batch(step), two.batch(step)
        assert torch.equal(targets, same)
        assert images.shape == (5, 3, 32, 32)
        taken += sum(not torch.equal(a, b) for a, b in zip(images, other, strict=True))
    assert 4 <= taken <= 16  # of 20, about half
    assert torch.equal(one.batch(3)[0], Windows(examples, training).batch(3)[0])
    whole = Windows(examples, Training(1, 2, 0, light=0)).batch(0)
    assert whole[0].shape == (2, 3, 48, 64)


def test_what_makes_no_sense_is_refused(tmp_path: Path) -> None:
    examples = pattern(tmp_path, 1)
    path = tmp_path / "net.safetensors"
    with pytest.raises(ValueError, match="nothing to learn from"):
        train(UNET, [], Training(1), path, "k", CPU)
    imagefile.write(tmp_path / "small.png", np.zeros((5, 5), np.uint8))
    with pytest.raises(ValueError, match="expected as many"):
        train(UNET, [Example(examples[0].variants, tmp_path / "small.png")], Training(1), path, "k", CPU)
    with pytest.raises(ValueError, match="crop of 32 or more"):
        Training(crop=8)
    with pytest.raises(ValueError, match="rate between"):
        Training(rate=2)
    with pytest.raises(ValueError, match="1 to 8 levels"):
        UNetConfig(levels=0)
    with pytest.raises(ValueError, match="at least one rate"):
        DeepLabConfig(rates=())
    with pytest.raises(ValueError, match="expected one that segments"):
        load(saved(tmp_path / "restorer"))
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "none.safetensors")
    card = {"architecture": "unet", "role": "segmentation", "config": {"classes": 2, "base_channels": 4, "levels": 2}}
    with pytest.raises(checkpoint.DamagedCheckpointError, match="another network"):
        load(checkpoint.save(tmp_path / "other", UNET.build(), card))
