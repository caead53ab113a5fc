"""Recipes: the paper by default, and nothing unknown gets through."""

from pathlib import Path

import pytest

pytest.importorskip("torch", reason="torch is not installed")

from rainstereo.model import recipe as recipes
from rainstereo.model.train import _without_none


def test_defaults_are_the_papers():
    found = recipes.parse({})
    o, weights = found.optimizer, found.losses
    assert (o.rate, o.batch, o.schedule, o.ema, o.pool) == (2e-4, 1, "constant", 0, 50)
    assert (weights.lambda_adversarial, weights.lambda_perceptual, weights.lambda_msadv) == (1, 1, 1)
    assert (weights.lambda_pixel, weights.lambda_ssim) == (0, 0)
    assert (found.architecture, found.network, found.discriminator.layers) == ("generator", {}, 5)


def test_an_architecture_brings_its_losses():
    found = recipes.parse({"architecture": "pix2pix"})
    assert (found.losses.lambda_pixel, found.discriminator.conditional, found.optimizer.pool) == (100, True, 0)
    assert recipes.parse({"architecture": "eigen2013"}).losses.lambda_squared == 1
    assert recipes.parse({"architecture": "pix2pix", "losses": {"lambda_pixel": 1}}).losses.lambda_pixel == 1


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"optimiser": {}}, "Did you mean 'optimizer'"),
        ({"optimizer": {"rat": 1.0}}, "Did you mean 'rate'"),
        ({"data": {"train": [{"foldr": "x"}]}}, "Did you mean 'folder'"),
        ({"steps": 1.5}, "steps is 1.5; expected a whole number"),
        ({"steps": True}, "steps is True"),
        ({"minutes": float("nan")}, "minutes is nan"),
        ({"data": {"crop": -1}}, "data.crop is -1; expected 0"),
        ({"compute": {"precision": "int8"}}, "expected 'float32' or"),
        ({"rain": {"cover": [0.1]}}, "rain.cover has 1 values; expected 2"),
        ({"data": []}, r"expected a table \[data\]"),
        ({"optimizer": 3}, "expected a table"),
        ({"losses": {f"lambda_{n}": 0.0 for n in ("adversarial", "perceptual", "msadv")}}, "nothing to learn"),
    ],
)
def test_mistakes_are_named(table, words):
    with pytest.raises(ValueError, match=words):
        recipes.parse(table)


def test_plain_values_make_it_again(tmp_path):
    (tmp_path / "r.toml").write_text('seed = 3\nvgg = "v.pth"\n[[data.train]]\nclear = "a"\nrainy = ["b", "/c"]\n')
    found = recipes.read(tmp_path / "r.toml")
    assert recipes.parse(_without_none(recipes.plain(found))) == found
    source = found.data.train[0]
    assert (source.clear, source.rainy, source.folder) == (str(tmp_path / "a"), (str(tmp_path / "b"), "/c"), "")
    assert found.vgg == str(tmp_path / "v.pth")


def test_a_file_that_is_no_toml_is_named(tmp_path):
    path = Path(tmp_path / "r.toml")
    path.write_text("steps = = 3")
    with pytest.raises(ValueError, match=r"r\.toml is no TOML"):
        recipes.read(path)
