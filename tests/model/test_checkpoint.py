"""Checkpoints: what comes back, what is refused, and that nothing is lost on the way."""

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from rainstereo.model import checkpoint  # noqa: E402
from rainstereo.model.card import from_toml, to_toml  # noqa: E402
from rainstereo.model.generator import GeneratorConfig  # noqa: E402

CONFIG = {"base_channels": 2, "downs": 1, "blocks": 1}
CARD = {"architecture": "generator", "config": CONFIG, "notes": 'a "quoted" line\nand another'}


@pytest.fixture
def saved(tmp_path):
    torch.manual_seed(0)
    module = GeneratorConfig(**CONFIG).build()
    return module, checkpoint.save(tmp_path / "net", module, CARD)


def test_comes_back(saved):
    module, path = saved
    torch.manual_seed(7)
    before = torch.random.get_rng_state()
    for name in (path, path.with_suffix(".toml"), path.with_suffix("")):
        found = checkpoint.load(name)
        assert found.card["notes"] == CARD["notes"]
        assert found.config == GeneratorConfig(**CONFIG)
        built = found.build()
        assert not built.training
        assert all(torch.equal(a, b) for a, b in zip(built.parameters(), module.parameters(), strict=True))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_half_precision_is_half_the_size(saved, tmp_path):
    module, _path = saved
    half = checkpoint.save(tmp_path / "half", module, CARD, storage=torch.float16)
    found = checkpoint.load(half)
    for name, tensor in module.state_dict().items():
        assert found.tensors[name].dtype == torch.float32
        assert torch.equal(found.tensors[name], tensor.half().float())
    header = 8 + int.from_bytes(half.read_bytes()[:8], "little")
    assert half.stat().st_size - header == 2 * sum(t.numel() for t in module.state_dict().values())


@pytest.mark.parametrize("place", [0.3, 0.99])
def test_a_changed_byte_is_noticed(saved, place):
    _, path = saved
    data = bytearray(path.read_bytes())
    data[
        8 + int.from_bytes(data[:8], "little") + int(place * (len(data) - 8 - int.from_bytes(data[:8], "little")))
    ] ^= 1
    path.write_bytes(data)
    with pytest.raises(checkpoint.DamagedCheckpointError, match="checksum"):
        checkpoint.load(path)


@pytest.mark.parametrize("length", [0, 5, 400, -1])
def test_a_cut_file_is_refused(saved, length):
    _, path = saved
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(checkpoint.DamagedCheckpointError, match="not a whole"):
        checkpoint.load(path)


def test_the_file_stands_alone_and_people_may_write_in_the_card(saved):
    _, path = saved
    card = path.with_suffix(".toml")
    card.write_text('limits = "fog"\n' + card.read_text())
    assert checkpoint.load(path).card["limits"] == "fog"
    card.write_text("sha256 = 'of another'")
    assert "limits" not in checkpoint.load(path).card
    card.unlink()
    assert checkpoint.load(path).config == GeneratorConfig(**CONFIG)


def test_another_network_is_refused(tmp_path):
    path = checkpoint.save(tmp_path / "net", GeneratorConfig(**CONFIG).build(), CARD | {"config": {"base_channels": 3}})
    with pytest.raises(checkpoint.DamagedCheckpointError, match="another network"):
        checkpoint.load(path).build()
    path = checkpoint.save(tmp_path / "net", {}, CARD | {"architecture": "oracle"})
    with pytest.raises(checkpoint.DamagedCheckpointError, match="oracle"):
        checkpoint.load(path).build()


def test_the_latest_whole_one_is_found(tmp_path):
    for step in (2, 10, 9):
        checkpoint.save(checkpoint.numbered(tmp_path, step), {"x": torch.full((2,), float(step))}, {})
    checkpoint.numbered(tmp_path, 10).write_bytes(b"")
    (bad, error), (step, found) = checkpoint.latest(tmp_path)
    assert (bad, step, float(found.tensors["x"][0])) == (10, 9, 9.0)
    assert isinstance(error, checkpoint.DamagedCheckpointError)
    checkpoint.rotate(tmp_path, 2)
    assert [step for step, _ in checkpoint.in_order(tmp_path)] == [10, 9]


plain = st.recursive(
    st.text(max_size=8) | st.integers(-(2**63), 2**63 - 1) | st.booleans() | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=25, deadline=None)
@given(st.dictionaries(st.text(max_size=6), plain, max_size=4))
def test_cards_come_back(card):
    assert from_toml(to_toml(card)) == card


def test_what_a_card_cannot_hold_is_named():
    with pytest.raises(ValueError, match="when is a complex"):
        to_toml({"when": 1j})
