"""The generator: the published figures, a second formulation, sizes, gradients, and how far it looks."""

import dataclasses

import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.func import functional_call
from torch.nn import functional as nnf

from rainstereo.model.convolution_blocks import ChannelNorm
from rainstereo.model.generator import Generator, GeneratorConfig
from rainstereo.model.macs import macs, parameters, size_of
from rainstereo.model.receptive_field import halo, receptive_field

TINY = GeneratorConfig(base_channels=2, downs=1, blocks=1, stem_kernel=3)
COMPACT = GeneratorConfig(
    base_channels=4, max_channels=8, downs=2, blocks=1, level_blocks=1, block="separable", expansion=2, patch=2,
    stem_kernel=3, normalisation="none", up_sampling="pixel_shuffle", padding="zeros", activation="gelu",
    output_residual=True, output_gate=True,
)  # fmt: skip
NEAREST = GeneratorConfig(
    base_channels=3,
    downs=2,
    blocks=1,
    block_kernel=5,
    normalisation="channel",
    up_sampling="nearest",
    padding="replicate",
)
SHAPES = {"paper's": dataclasses.replace(TINY, downs=4), "compact": COMPACT, "nearest": NEAREST}


def built(config: GeneratorConfig, seed: int = 0) -> Generator:
    """With weights everywhere, also where training begins with none."""
    torch.manual_seed(seed)
    generator = config.build()
    if config.output_residual:
        nn.init.normal_(generator.head.weight, 0.0, 0.1)
    return generator


def rainy(height: int, width: int, count: int = 1, seed: int = 0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(count, 3, height, width, generator=torch.Generator().manual_seed(seed), dtype=dtype)


# -- the published figures ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [64, 32, 16])
def test_size_is_the_sum_over_its_layers(base: int) -> None:
    """Written out layer by layer: channels in and out, side of the kernel, and places where it is applied."""
    frame = 640 * 480
    layers = [(3, base, 7, frame)]
    layers += [(base * 2**i, base * 2 ** (i + 1), 3, frame // 4 ** (i + 1)) for i in range(4)]
    layers += [(16 * base, 16 * base, 3, frame // 256)] * 18
    layers += [(base * 2 ** (i + 1), base * 2**i, 3, frame // 4 ** (i + 1)) for i in range(4)]
    layers += [(base, 3, 7, frame)]
    weights = sum(a * b * k * k + b for a, b, k, _ in layers)
    products = sum(a * b * k * k * places for a, b, k, places in layers)
    assert size_of(GeneratorConfig(base_channels=base)) == (weights, products)


def test_default_is_the_papers() -> None:
    weights, products = size_of(GeneratorConfig())
    assert weights == 182_443_267
    assert round(weights / 1e6, 1) == 182.4
    assert round(products / 1e9) == 255


@pytest.mark.parametrize(
    ("layer", "shape", "expected"),
    [
        (nn.Conv2d(3, 5, 3, stride=2, padding=1), (1, 3, 8, 6), 4 * 3 * 5 * 3 * 9),
        (nn.Conv2d(4, 8, 5, padding=2, groups=4), (2, 4, 6, 6), 2 * 36 * 8 * 25),
        (nn.ConvTranspose2d(6, 2, 3, stride=2, padding=1, output_padding=1), (1, 6, 4, 5), 20 * 6 * 2 * 9),
        (nn.Linear(7, 3), (4, 7), 4 * 7 * 3),
        (nn.Sequential(nn.ReLU(), nn.InstanceNorm2d(3)), (1, 3, 4, 4), 0),
    ],
)
def test_macs_by_hand(layer: nn.Module, shape: tuple[int, ...], expected: int) -> None:
    assert macs(layer, torch.zeros(shape)) == expected


def test_counting_without_computing_is_counting() -> None:
    generator = built(COMPACT).eval()
    assert size_of(COMPACT, 48, 32) == (parameters(generator), macs(generator, rainy(32, 48)))
    assert parameters(generator) == sum(p.numel() for p in generator.parameters())


# -- a second formulation ----------------------------------------------------------------------------------------------


def paper_network(weights: dict[str, torch.Tensor], images: torch.Tensor, blocks: int) -> torch.Tensor:
    """The paper's network written down once more, for sides that need no padding."""

    def normal(x: torch.Tensor) -> torch.Tensor:
        mean = x.mean((2, 3), keepdim=True)
        return (x - mean) / (((x - mean) ** 2).mean((2, 3), keepdim=True) + 1e-5) ** 0.5

    def conv(x: torch.Tensor, name: str, pad: int, stride: int = 1) -> torch.Tensor:
        x = nnf.pad(x, [pad] * 4, mode="reflect") if stride == 1 else nnf.pad(x, [pad] * 4)
        return nnf.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], stride=stride)

    x = normal(conv(images, "stem.0", 3)).clamp(min=0)
    skips = []
    for i in range(4):
        skips.append(x)
        x = normal(conv(x, f"downs.{i}.0", 1, stride=2)).clamp(min=0)
    for i in range(blocks):
        y = normal(conv(x, f"blocks.{i}.change.0", 1)).clamp(min=0)
        x = x + normal(conv(y, f"blocks.{i}.change.3", 1))
    for i in range(4):
        w, b = weights[f"ups.{i}.0.weight"], weights[f"ups.{i}.0.bias"]
        # a transposed convolution is a convolution, kernel turned about, of the image with zeros between its pixels
        apart = x.new_zeros(*x.shape[:2], 2 * x.shape[2], 2 * x.shape[3])
        apart[:, :, ::2, ::2] = x
        x = normal(nnf.conv2d(nnf.pad(apart, [1] * 4), w.transpose(0, 1).flip(2, 3), b)).clamp(min=0) + skips.pop()
    return (conv(x, "head", 3).tanh() + 1) / 2


def test_network_is_the_papers() -> None:
    config = GeneratorConfig(base_channels=3, blocks=2)
    generator = built(config).double()
    images = rainy(64, 48, 2, dtype=torch.float64)
    expected = paper_network(dict(generator.named_parameters()), images, blocks=2)
    torch.testing.assert_close(generator(images), expected, rtol=0, atol=1e-12)


def test_channel_norm_is_layer_norm_over_channels() -> None:
    norm = ChannelNorm(5)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    features = torch.randn(2, 5, 3, 4, generator=torch.Generator().manual_seed(1))
    expected = nnf.layer_norm(features.permute(0, 2, 3, 1), (5,), norm.weight, norm.bias).permute(0, 3, 1, 2)
    torch.testing.assert_close(norm(features), expected)


# -- images in and out -------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(height=st.integers(1, 70), width=st.integers(1, 70), name=st.sampled_from(sorted(SHAPES)))
def test_any_size_goes_in_and_comes_out(height: int, width: int, name: str) -> None:
    generator = built(SHAPES[name]).eval()
    with torch.no_grad():
        derained = generator(rainy(height, width))
    assert derained.shape == (1, 3, height, width)
    assert ((derained >= 0) & (derained <= 1)).all()


def test_input_is_left_alone_and_size_needs_no_padding_to_be_right() -> None:
    """An image that the user mirrored to a multiple himself gives the same as one that was mirrored inside."""
    generator = built(dataclasses.replace(COMPACT, output_gate=False)).eval()
    images = rainy(37, 41)
    before = images.clone()
    with torch.no_grad():
        inside = generator(images)
        outside = generator(nnf.pad(images, (0, 7, 0, 3), mode="reflect"))[:, :, :37, :41]
    assert torch.equal(images, before)
    torch.testing.assert_close(inside, outside, rtol=0, atol=0)


def test_residual_generator_begins_as_the_identity() -> None:
    torch.manual_seed(0)
    images = rainy(20, 30)
    for config in (COMPACT, dataclasses.replace(TINY, output_residual=True)):
        assert torch.equal(config.build().eval()(images), images)


def test_gate_scales_the_change() -> None:
    generator = built(COMPACT)
    images = rainy(32, 32)
    derained, gate = generator.with_gate(images)
    drawn = generator.network(images)
    assert gate is not None
    assert gate.shape == (1, 1, 32, 32)
    torch.testing.assert_close(gate, 1 / (1 + (-drawn[:, 3:]).exp()))
    torch.testing.assert_close(derained - images, gate * drawn[:, :3].tanh())
    assert built(TINY).with_gate(images)[1] is None


def test_clamped_in_use_but_not_in_training() -> None:
    generator = built(dataclasses.replace(TINY, output_residual=True))
    nn.init.constant_(generator.head.bias, 3.0)
    images = rainy(8, 8)
    assert generator(images).max() > 1.2
    assert generator.eval()(images).max() == 1


@pytest.mark.parametrize("normalisation", ["instance", "batch", "channel", "none"])
def test_untrained_output_is_neither_flat_nor_saturated(normalisation: str) -> None:
    generator = built(GeneratorConfig(base_channels=8, blocks=3, normalisation=normalisation))
    with torch.no_grad():
        spread = generator.network(rainy(64, 64)).std()
    assert 0.01 < spread < 2


def test_same_seed_same_weights() -> None:
    first, again, other = built(TINY), built(TINY), built(TINY, seed=1)
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), again.parameters(), strict=True))
    assert not torch.equal(first.head.weight, other.head.weight)


# -- gradients ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        TINY,
        dataclasses.replace(TINY, normalisation="channel", up_sampling="nearest", output_residual=True),
        dataclasses.replace(TINY, normalisation="none", up_sampling="pixel_shuffle", block="separable", patch=2),
    ],
)
def test_gradients(config: GeneratorConfig) -> None:
    """Smooth activations: differences across the corner of a rectifier are no derivatives."""
    generator = built(dataclasses.replace(config, activation="gelu", output_gate=config.output_residual)).double()
    names, values = zip(*generator.named_parameters(), strict=True)

    def call(images: torch.Tensor, *weights: torch.Tensor) -> torch.Tensor:
        return functional_call(generator, dict(zip(names, weights, strict=True)), (images,))

    images = rainy(5, 6, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(call, (images, *values), fast_mode=True)
    one_by_one = [v.detach() for v in values]
    assert torch.autograd.gradcheck(lambda x: call(x, *one_by_one), (images,))


def test_every_weight_learns() -> None:
    for config in SHAPES.values():
        generator = built(config)
        generator(rainy(40, 40)).square().sum().backward()
        assert all(p.grad is not None for p in generator.parameters())
        for name, p in generator.named_parameters():
            if name.endswith("weight"):  # a bias before a normalisation cannot
                assert p.grad is not None
                assert p.grad.abs().max() > 0, name


# -- how far it looks --------------------------------------------------------------------------------------------------

FINITE = {
    "transposed": GeneratorConfig(base_channels=1, downs=2, blocks=1, stem_kernel=3, up_sampling="transposed"),
    "nearest": GeneratorConfig(base_channels=1, downs=2, blocks=1, stem_kernel=5, up_sampling="nearest"),
    "shuffled": GeneratorConfig(base_channels=1, downs=2, blocks=2, stem_kernel=1, up_sampling="pixel_shuffle"),
    "separable": GeneratorConfig(base_channels=1, downs=1, blocks=2, block="separable", block_kernel=5, stem_kernel=3),
    "patches": GeneratorConfig(base_channels=1, downs=1, blocks=1, level_blocks=1, patch=3, stem_kernel=3),
    "flat": GeneratorConfig(base_channels=1, downs=0, blocks=2, stem_kernel=7),
}


@pytest.mark.parametrize("name", FINITE)
def test_halo_is_what_gradients_reach(name: str) -> None:
    """With positive weights everything that can count does; each place on the grid is asked."""
    config = dataclasses.replace(FINITE[name], normalisation="none", padding="zeros")
    generator = built(config).double()
    for p in generator.parameters():
        nn.init.constant_(p, 1 / p[0].numel())
    reach = halo(config)
    assert receptive_field(config) == 2 * reach + 1
    step = config.multiple
    before = (reach // step + 1) * step
    length = 2 * before + step
    found = 0
    for phase in range(step):
        images = torch.ones(1, 3, length, length, dtype=torch.float64, requires_grad=True)
        at = before + phase
        generator.network(images)[0, 0, at, at].backward()
        assert images.grad is not None
        for axis in (0, 1):
            seen = images.grad[0, 0].abs().sum(axis).nonzero().flatten()
            found = max(found, int((seen - at).abs().max()))
    assert found == reach


def test_the_papers_halo() -> None:
    """Head, ups, 18 convolutions at a sixteenth of the size, downs, stem."""
    assert halo(GeneratorConfig()) == 3 + (1 + 2 + 4 + 8) + 18 * 16 + (8 + 4 + 2 + 1) + 3


@pytest.mark.parametrize("normalisation", ["none", "channel", "batch", "instance"])
def test_tile_equals_frame(normalisation: str) -> None:
    """Unless normalisation looks at the whole image, as the configuration says."""
    config = GeneratorConfig(base_channels=4, downs=2, blocks=1, stem_kernel=3, normalisation=normalisation)
    generator = built(config)
    images = rainy(160, 128)
    with torch.no_grad():
        generator(images)  # statistics for batch normalisation
        generator.eval()
        whole = generator(images)
        margin = -(-halo(config) // config.multiple) * config.multiple
        top, left, side = 64, 48, 32
        tile = images[:, :, top - margin : top + side + margin, left - margin : left + side + margin]
        assert tile.shape[2] == side + 2 * margin < 160
        alone = generator(tile)[:, :, margin : margin + side, margin : margin + side]
    difference = (alone - whole[:, :, top : top + side, left : left + side]).abs().max()
    assert (difference < 1e-6) == config.tiles_equal_frame
    assert config.tiles_equal_frame == (normalisation != "instance")


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"normalisation": "group"}, "normalisation 'group' is unknown; expected one of 'instance'"),
        ({"up_sampling": "bilinear"}, "up_sampling"),
        ({"padding": "circular"}, "padding"),
        ({"block": "dilated"}, "block"),
        ({"activation": "tanh"}, "activation"),
        ({"base_channels": 0}, "base_channels 0"),
        ({"base_channels": 2.0}, "base_channels 2.0"),
        ({"downs": 7}, "downs 7"),
        ({"blocks": True}, "blocks True"),
        ({"stem_kernel": 4}, "stem_kernel 4 was given; expected an odd number in 1..15"),
        ({"block_kernel": 2}, "block_kernel 2"),
        ({"patch": 0}, "patch 0"),
        ({"output_residual": 1}, "output_residual 1"),
        ({"output_gate": True}, "output_gate needs output_residual"),
    ],
)
def test_options_that_are_refused(options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        GeneratorConfig(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("images", "complaint"),
    [
        (torch.zeros(3, 8, 8), r"shape \(3, 8, 8\)"),
        (torch.zeros(1, 1, 8, 8), "expected"),
        (torch.zeros(1, 3, 0, 8), "at least 1"),
        (torch.zeros(1, 3, 8, 8, dtype=torch.uint8), "torch.uint8; expected floats"),
    ],
)
def test_images_that_are_refused(images: torch.Tensor, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        built(TINY)(images)
