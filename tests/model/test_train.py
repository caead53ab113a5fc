"""Training: who changes whom, exact resume, processes that agree, and what stress does."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from rainstereo.model import checkpoint  # noqa: E402
from rainstereo.model import recipe as recipes  # noqa: E402
from rainstereo.model.card import to_toml  # noqa: E402
from rainstereo.model.dataset import Windows, collate  # noqa: E402
from rainstereo.model.pair_folders import find  # noqa: E402
from rainstereo.model.train import psnr  # noqa: E402
from rainstereo.model.train_step import Trainer  # noqa: E402
from tests.model.training_pairs import small, tables, train, write_pairs  # noqa: E402


@pytest.fixture
def pairs(tmp_path):
    return write_pairs(tmp_path / "pairs")


def trainer_and_batches(pairs, count=3, **changes):
    recipe = small(pairs, **changes)
    windows = Windows(find(recipe.data.train), recipe.data, recipe.rain, recipe.augment, recipe.seed)
    size = recipe.optimizer.batch
    batches = [collate([windows[step * size + i] for i in range(size)]) for step in range(count)]
    return Trainer(recipe, torch.device("cpu")), batches


def copied(module):
    return {name: tensor.clone() for name, tensor in module.state_dict().items()}


def same(module, before):
    return all(torch.equal(tensor, before[name]) for name, tensor in module.state_dict().items())


def test_each_update_touches_its_own_network_only(pairs):
    trainer, (batch, *_) = trainer_and_batches(pairs)
    parts, first = [(batch.rainy, batch.clear)], [trainer.generator(batch.rainy)]
    generator, discriminator = copied(trainer.generator), copied(trainer.discriminator)
    _, good = trainer._discriminator_step(parts, first, 1e-3, torch.tensor(True))
    assert good
    assert same(trainer.generator, generator)
    assert not same(trainer.discriminator, discriminator)
    assert all(p.grad is None for p in trainer.generator.parameters())
    discriminator = copied(trainer.discriminator)
    gradients = [p.grad.clone() for p in trainer.discriminator.parameters()]
    _, good = trainer._generator_step(parts, first, 1e-3, torch.tensor(True))
    assert good
    assert same(trainer.discriminator, discriminator)
    assert not same(trainer.generator, generator)
    assert all(map(torch.equal, gradients, (p.grad for p in trainer.discriminator.parameters())))


def test_a_step_is_adam_on_the_mean_absolute_difference(pairs):
    """Against the same written out with torch alone."""
    only = {"losses": {"lambda_adversarial": 0.0, "lambda_perceptual": 0.0, "lambda_msadv": 0.0, "lambda_pixel": 2.0}}
    trainer, batches = trainer_and_batches(pairs, optimizer={"ema": 0.0}, compute={"channels_last": False}, **only)
    assert trainer.discriminator is None
    torch.manual_seed(trainer.recipe.seed)
    twin, other = trainer.config.build(), trainer.config.build()
    other.load_state_dict(twin.state_dict())
    adam = torch.optim.Adam(twin.parameters(), 2e-4, (0.5, 0.999), fused=True)
    one_by_one = torch.optim.Adam(other.parameters(), 2e-4, (0.5, 0.999), foreach=False, fused=False)
    for batch in batches:
        found = trainer.step(batch, 0.0).losses
        loss = (twin(batch.rainy) - batch.clear).abs().mean()
        adam.zero_grad()
        (2 * loss).backward()
        for weight, same_weight in zip(twin.parameters(), other.parameters(), strict=True):
            same_weight.grad = weight.grad.clone()
        adam.step()
        one_by_one.step()
        assert found == {"pixel": float(loss.detach()), "total": 2 * float(loss.detach())}
    assert same(trainer.generator, twin.state_dict())
    for weight, same_weight in zip(twin.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(weight, same_weight, rtol=1e-5, atol=1e-8)


def test_parts_of_a_batch_learn_the_same(pairs):
    found = []
    for accumulate in (1, 2):
        trainer, batches = trainer_and_batches(pairs, optimizer={"accumulate": accumulate})
        found.append([value for batch in batches for value in trainer.step(batch, 0.0).losses.values()])
    assert found[0] == pytest.approx(found[1], abs=1e-5)


@pytest.mark.parametrize("count", [1, 2])
def test_gradients_through_instance_norm_are_right(pairs, count):
    """torch 2.13 gives wrong ones for single images in channels-last order; whatever order we take, ours are right."""
    trainer, (batch, *_) = trainer_and_batches(pairs, optimizer={"batch": count, "ema": 0.0})
    twin = trainer.config.build()
    twin.load_state_dict(trainer.generator.state_dict())
    for network, place in ((trainer.generator, trainer._moved), (twin, torch.Tensor.contiguous)):
        (network(place(batch.rainy)) - place(batch.clear)).abs().mean().backward()
    for ours, plain in zip(trainer.generator.parameters(), twin.parameters(), strict=True):
        assert torch.allclose(ours.grad, plain.grad, atol=1e-7)


def test_values_that_are_not_finite_are_skipped_and_counted(pairs):
    trainer, (good, *_) = trainer_and_batches(pairs)
    for bad_value in (np.nan, np.inf, -np.inf):
        rainy = good.rainy.clone()
        rainy[1, 0, 3, 4] = bad_value
        before, moments = copied(trainer.generator), len(trainer.generator_optimizer.state)
        assert trainer.step(dataclasses.replace(good, rainy=rainy), 0.0).skipped == "values that are not finite"
        assert same(trainer.generator, before)
        assert len(trainer.generator_optimizer.state) == moments
    huge = dataclasses.replace(good, rainy=torch.full_like(good.rainy, 3e38))
    before = copied(trainer.generator), copied(trainer.discriminator)
    assert trainer.step(huge, 0.0).skipped == "gradients that are not finite"
    assert same(trainer.generator, before[0])
    assert same(trainer.discriminator, before[1])
    assert not trainer.step(good, 0.0).skipped
    assert (trainer.done, trainer.skipped) == (5, 4)
    assert all(bool(t.isfinite().all()) for t in trainer.generator.state_dict().values())


def test_a_run_may_stop_at_them(pairs, tmp_path, monkeypatch):
    from rainstereo.model import dataset

    real = dataset.tensor
    monkeypatch.setattr(dataset, "tensor", lambda image: real(image) * float("nan"))
    run, heard = train(small(pairs, steps=3), tmp_path / "skips")
    assert (run.trainer.skipped, len(heard.skipped)) == (3, 3)
    assert sum(run.unlearnt.values()) == 6
    with pytest.raises(RuntimeError, match=r"step 1: values that are not finite from \d, \d"):
        train(small(pairs, keep={"not_finite": "stop"}), tmp_path / "stops")


def test_schedule(pairs):
    trainer, _ = trainer_and_batches(pairs, optimizer={"schedule": "cosine", "rate": 1.0, "final": 0.1, "warmup": 4})
    trainer.done = 1
    assert trainer.rate(0.0) == 0.5
    trainer.done = 10
    assert [trainer.rate(x) for x in (0.0, 0.5, 1.0, 2.0)] == pytest.approx([1.0, 0.55, 0.1, 0.1])


@pytest.mark.parametrize("precision", ["float32", "bf16"])
def test_a_run_that_goes_on_finds_the_same(pairs, tmp_path, precision):
    compute = {"precision": precision}
    run, whole = train(small(pairs, steps=6, compute=compute), tmp_path / "whole")
    _, first = train(small(pairs, steps=3, compute=compute), tmp_path / "parts")
    again, second = train(small(pairs, steps=6, compute=compute), tmp_path / "parts")
    assert first.losses + second.losses == whole.losses
    assert len({str(x) for x in whole.losses}) == 6
    assert again.begun_at == 3
    for name, tensor in run.trainer.state()[0].items():
        assert torch.equal(tensor, again.trainer.state()[0][name]), name
    rows = [(tmp_path / d / "losses.csv").read_text().splitlines() for d in ("whole", "parts")]
    assert [[c for i, c in enumerate(r.split(",")) if i != 1] for r in rows[0]] == [
        [c for i, c in enumerate(r.split(",")) if i != 1] for r in rows[1]
    ]
    assert checkpoint.load(tmp_path / "parts/model").build()(torch.rand(1, 3, 9, 7)).shape == (1, 3, 9, 7)


def test_a_damaged_checkpoint_is_passed_over(pairs, tmp_path):
    _, whole = train(small(pairs, steps=6), tmp_path / "a")
    train(small(pairs, steps=4), tmp_path / "b")
    path = checkpoint.numbered(tmp_path / "b/checkpoints", 4)
    path.write_bytes(path.read_bytes()[:-3])
    _, heard = train(small(pairs, steps=6), tmp_path / "b")
    assert "step-000000004" in heard.words[0]
    assert "goes on after step 2" in heard.words[1]
    assert heard.losses == whole.losses[2:]
    assert len((tmp_path / "b/losses.csv").read_text().splitlines()) == 7


def test_another_recipe_is_refused(pairs, tmp_path):
    train(small(pairs, steps=2), tmp_path / "a")
    with pytest.raises(ValueError, match=r"differs in optimizer\.rate \(optimizer\.rate was 0\.0002"):
        train(small(pairs, optimizer={"rate": 1e-3}), tmp_path / "a")


def test_a_run_starts_from_given_weights(pairs, tmp_path):
    first, _ = train(small(pairs, steps=2), tmp_path / "a")
    kept = tmp_path / "a/model.safetensors"
    table = tables(pairs, start=str(kept), optimizer={"ema": 0.5})
    other = {**table, "network": {**table["network"], "base_channels": 6}}
    with pytest.raises(ValueError, match=r"has base_channels = \d+, not 6; leave \[network\] out"):
        Trainer(recipes.parse(other), torch.device("cpu"))
    with pytest.raises(ValueError, match="architecture 'generator'; the recipe asks for 'pix2pix'"):
        Trainer(recipes.parse({**table, "architecture": "pix2pix"}), torch.device("cpu"))
    del table["network"]
    begun = Trainer(recipes.parse(table), torch.device("cpu"))
    assert begun.config == first.trainer.config
    assert begun.generator.training
    assert begun.done == 0
    for module in (begun.generator, begun.average):
        assert same(module, copied(first.trainer.best))


def test_a_run_may_start_from_the_shipped_weights(pairs, tmp_path):
    from rainstereo.model import checkpoint

    (tmp_path / "r.toml").write_text('start = "shipped"\n[[data.train]]\nfolder = "pairs"\n')
    found = Trainer(recipes.read(tmp_path / "r.toml"), torch.device("cpu"))
    assert same(found.generator, checkpoint.load(checkpoint.shipped()).tensors)


def test_shifted_pairs_stop_a_run(pairs, tmp_path):
    from rainstereo import imagefile

    for path in sorted((pairs / "wet").iterdir()):
        imagefile.write(path, np.roll(imagefile.read(path.parents[1] / "dry" / path.name), 5, 1))
    with pytest.raises(ValueError, match=r"wet/0\.png by \+5\.\d, [+-]0\.\d pixels against .*dry/0\.png"):
        train(small(pairs), tmp_path / "a")
    _, heard = train(small(pairs, data={"align": "warn"}), tmp_path / "a")
    assert "are shifted" in heard.words[0]


@pytest.mark.parametrize("architecture", ["pix2pix", "eigen2013"])
def test_baselines_train(pairs, tmp_path, architecture):
    table = tables(pairs, steps=2, architecture=architecture, optimizer={"ema": 0.0})
    del table["losses"], table["network"], table["optimizer"]["pool"]
    table["network"] = {"units": 4} if architecture == "eigen2013" else {"base_channels": 2}
    if architecture == "pix2pix":
        table["discriminator"] = {"base_channels": 2, "conditional": True}
    else:
        del table["discriminator"]
    _, heard = train(recipes.parse(table), tmp_path / "a")
    assert len(heard.losses) == 2
    expected = (
        {"squared", "total"} if architecture == "eigen2013" else {"discriminator", "adversarial", "pixel", "total"}
    )
    assert heard.losses[0].keys() == expected


def test_psnr_by_hand():
    a = torch.zeros(3, 4, 4)
    assert psnr(a, a + 1 / 255) == pytest.approx(20 * np.log10(255))
    assert psnr(a, a) == 99


# -- other processes ---------------------------------------------------------------------------------------------

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def write_recipe(path: Path, table: dict) -> Path:
    sources = "".join(f'[[data.train]]\nfolder = "{s["folder"]}"\n' for s in table["data"]["train"])
    rest = {**table, "data": {k: v for k, v in table["data"].items() if k != "train"}}
    path.write_text(to_toml(rest) + sources)
    return path


def losses_of(out: Path) -> dict[int, list[float]]:
    rows = [line.split(",") for line in (out / "losses.csv").read_text().splitlines()[1:]]
    return {int(row[0]): [float(x) for x in row[3:]] for row in rows}


@pytest.mark.slow
def test_killed_and_begun_again(pairs, tmp_path):
    table = tables(pairs, steps=60, keep={"log": 1, "checkpoint": 7, "validate": 0})
    command = [sys.executable, "-m", "rainstereo.apps.cli", "train", str(write_recipe(tmp_path / "r.toml", table))]
    out = tmp_path / "killed"
    process = subprocess.Popen([*command, "--out", str(out)], env=ENVIRONMENT, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (out / "losses.csv").is_file():
        time.sleep(0.05)
    while time.monotonic() < deadline and len(losses_of(out)) < 20:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert 20 <= len(losses_of(out)) < 60
    done = subprocess.run(
        [*command, "--out", str(out)], env=ENVIRONMENT, check=False, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 0, done.stderr
    assert "goes on after step" in done.stderr
    # in a process like the other's: a sum's last bit depends on how many threads share it
    whole = [*command, "--out", str(tmp_path / "whole")]
    subprocess.run(whole, env=ENVIRONMENT, check=True, capture_output=True, timeout=100)
    assert losses_of(out) == losses_of(tmp_path / "whole")
    assert len(losses_of(out)) == 60


@pytest.mark.slow
def test_two_processes_learn_what_one_learns(pairs, tmp_path):
    # without instance norm: what stands before it has biases whose gradient is rounding alone, and Adam magnifies it
    free = {"normalisation": "none"}
    path = write_recipe(tmp_path / "r.toml", tables(pairs, steps=5, network=free, discriminator=free))
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--standalone",
               "-m", "rainstereo.apps.cli", "train", str(path), "--out", str(tmp_path / "two")]  # fmt: skip
    done = subprocess.run(command, env=ENVIRONMENT, check=False, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr[-2000:]
    train(recipes.read(path), tmp_path / "one")
    one, two = (checkpoint.load(checkpoint.numbered(tmp_path / d / "checkpoints", 5)) for d in ("one", "two"))
    assert one.tensors.keys() == two.tensors.keys()
    for name, tensor in one.tensors.items():
        if name.startswith(("generator.", "discriminator.", "average.")):
            assert float((tensor - two.tensors[name]).abs().max()) < 1e-5, name
    for step, values in losses_of(tmp_path / "one").items():
        assert len(values) == 4, step
    assert json.loads((tmp_path / "two/report.json").read_text())["steps"] == 5
    assert two.card["processes"] == 2


def test_a_run_on_each_device_goes_on_where_it_stopped(pairs, tmp_path, device):
    """Named by its kind alone, as "auto" finds it."""
    compute = {"device": device.type}
    run, first = train(small(pairs, steps=2, compute=compute), tmp_path)
    again, second = train(small(pairs, steps=4, compute=compute), tmp_path)
    assert again.trainer.device.type == device.type
    assert (again.begun_at, again.trainer.done) == (2, 4)
    assert all(np.isfinite(value) for losses in first.losses + second.losses for value in losses.values())
    assert not same(again.trainer.generator, copied(run.trainer.generator))
