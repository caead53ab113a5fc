"""VGG-19 features: torchvision's naming, a second formulation, files that hold the weights and files that do not."""

import hashlib
import pickle
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch
from safetensors.torch import save_file
from torch.nn import functional as nnf

from rainstereo.model.vgg import VggFeatures

# Configuration E of Simonyan and Zisserman, table 1, as torchvision numbers it: convolution, ReLU, ..., M for pooling.
CONFIGURATION_E = [
    64,
    64,
    "M",
    128,
    128,
    "M",
    256,
    256,
    256,
    256,
    "M",
    512,
    512,
    512,
    512,
    "M",
    512,
    512,
    512,
    512,
    "M",
]
USED = {
    0: (64, 3), 2: (64, 64), 5: (128, 64), 7: (128, 128), 10: (256, 128), 12: (256, 256), 14: (256, 256),
    16: (256, 256), 19: (512, 256), 21: (512, 512), 23: (512, 512), 25: (512, 512), 28: (512, 512),
}  # fmt: skip
FEATURES = (1, 6, 11, 20, 29)


def weights(seed: int = 5) -> dict[str, torch.Tensor]:
    """A file's content, by torchvision's names, with layers that are not used and a classifier."""
    draws = torch.Generator().manual_seed(seed)
    state = {}
    for i, (made, given) in USED.items():
        state[f"features.{i}.weight"] = torch.randn(made, given, 3, 3, generator=draws) * (2 / (9 * given)) ** 0.5
        state[f"features.{i}.bias"] = torch.randn(made, generator=draws) * 0.1
    state["features.34.bias"] = torch.zeros(512)
    state["classifier.6.bias"] = torch.zeros(1000)
    return state


def images(side: int = 32) -> torch.Tensor:
    return torch.rand(1, 3, side, side, generator=torch.Generator().manual_seed(0))


def test_shapes_are_configuration_e() -> None:
    index, before, expected = 0, 3, {}
    for entry in CONFIGURATION_E:
        if isinstance(entry, int):
            if index <= 28:
                expected[index] = (entry, before)
            index, before = index + 2, entry
        else:
            index += 1
    assert expected == USED
    found = {name: tuple(p.shape) for name, p in VggFeatures().named_parameters()}
    wanted = {f"features.{i}.weight": (*shape, 3, 3) for i, shape in USED.items()}
    assert found == wanted | {f"features.{i}.bias": shape[:1] for i, shape in USED.items()}


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_weights_from_a_file(tmp_path: Path, suffix: str) -> None:
    """Features are those of the network walked through entry by entry, at torchvision's indices of the five ReLUs."""
    path, state = tmp_path / f"vgg19{suffix}", weights()
    if suffix == ".pth":
        torch.save(state, path)
    else:
        save_file(state, path)
    vgg = VggFeatures(path)
    assert (
        vgg.label == f"VGG-19 weights from vgg19{suffix}, SHA-256 {hashlib.sha256(path.read_bytes()).hexdigest()[:8]}"
    )
    x = (images() - torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)) / torch.tensor([0.229, 0.224, 0.225]).view(
        3, 1, 1
    )
    expected, index = [], 0
    for entry in CONFIGURATION_E:
        if index > FEATURES[-1]:
            break
        if entry == "M":
            x, index = nnf.max_pool2d(x, 2), index + 1
        elif index <= 28:
            x = nnf.conv2d(x, state[f"features.{index}.weight"], state[f"features.{index}.bias"], padding=1).clamp(
                min=0
            )
            index += 2
            if index - 1 in FEATURES:
                expected.append(x)
    found = vgg(images())
    assert [tuple(f.shape[1:]) for f in found] == [(64, 32, 32), (128, 16, 16), (256, 8, 8), (512, 4, 4), (512, 2, 2)]
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b)


def test_random_features_say_so_and_keep_their_size() -> None:
    vgg, again, other = VggFeatures(seed=1), VggFeatures(seed=1), VggFeatures(seed=2)
    assert vgg.label == "RANDOM features of VGG-19's shape, seed 1: no file of trained weights was given"
    first, same, another = vgg(images()), again(images()), other(images())
    for a, b, c in zip(first, same, another, strict=True):
        assert torch.equal(a, b)
        assert not torch.equal(a, c)
        assert 0.2 < a.square().mean().sqrt() < 5


def test_nothing_of_it_learns() -> None:
    vgg = VggFeatures()
    given = images(16).requires_grad_()
    vgg.train()
    assert not vgg.training
    sum(f.sum() for f in vgg(given)).backward()
    assert given.grad is not None
    assert given.grad.abs().max() > 0
    assert all(not p.requires_grad and p.grad is None for p in vgg.parameters())


def test_images_that_are_refused() -> None:
    with pytest.raises(ValueError, match="sides of at least 16"):
        VggFeatures()(images(15))


class Opens:
    """A pickle that would run something."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("executed",)


def test_files_that_are_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "vgg19.pth"

    def refused(complaint: str) -> None:
        with pytest.raises(ValueError, match=complaint) as caught:
            VggFeatures(path)
        assert "vgg19.pth" in str(caught.value)

    refused("no such file")
    state = weights()
    torch.save({name: value for name, value in state.items() if not name.startswith("features.28")}, path)
    refused("lacks features.28.weight, features.28.bias")
    torch.save(state | {"features.5.bias": torch.zeros(64)}, path)
    refused(r"features.5.bias is torch.float32 \(64,\); expected finite floats \(128,\)")
    torch.save(state | {"features.5.bias": torch.full((128,), float("nan"))}, path)
    refused("expected finite floats")
    torch.save([1, 2], path)
    refused("something else than named tensors")
    path.write_bytes(b"")
    refused("cannot be read|damaged")
    path.write_bytes(b"not a file of weights")
    refused("cannot be read|damaged")
    path.write_bytes(pickle.dumps(Opens()))
    refused("more than tensors")
    torch.save({"features.0.weight": Opens()}, path)
    refused("more than tensors")
    assert "executed" not in capfd.readouterr().out
    damaged = tmp_path / "vgg19.safetensors"
    damaged.write_bytes(b"\xff" * 64)
    with pytest.raises(ValueError, match="cannot be read as weights"):
        VggFeatures(damaged)


def test_size_is_bounded_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "vgg19.safetensors"
    with path.open("wb") as file:
        file.truncate(2**30 + 1)
    with pytest.raises(ValueError, match="1024 MiB; VGG-19's weights have 548"):
        VggFeatures(path)
