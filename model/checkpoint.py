"""Weights on disk: NAME.safetensors and its card NAME.toml, written whole or not at all, refused when damaged.

The card says what the weights are (architecture, its configuration, what they were trained on, versions), so that
nothing else is needed to use them. A copy of it lies in the header of NAME.safetensors, which therefore stands alone;
the card beside it is for people, who may add to it. Either must name the checksum of the tensors.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as tensor_bytes
from torch import Tensor, nn

from rainstereo.model.architecture import configure
from rainstereo.model.card import Card, from_toml, to_toml

SUFFIX = ".safetensors"
MAX_BYTES = 16 << 30
FORMAT = 1
"""Of the card; a number that is larger comes from a newer rainstereo."""

Path_ = str | os.PathLike[str]


class DamagedCheckpointError(ValueError):
    """A file that is no whole checkpoint; the message says why and names the file."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a file holds. card: as described above. tensors: by name, single precision where they were stored in
    half."""

    path: Path
    card: Card
    tensors: Mapping[str, Tensor]

    @property
    def architecture(self) -> str:
        """The network's name, as in `architecture`."""
        return str(self.card.get("architecture", ""))

    @property
    def config(self) -> Any:
        """The network's configuration, such as a `GeneratorConfig`; DamagedCheckpointError where the card has none."""
        values = self.card.get("config")
        if not isinstance(values, dict):
            raise DamagedCheckpointError(f"{self.path}: the card has no table `config`")
        try:
            return configure(self.architecture, values)
        except (ValueError, TypeError) as error:
            raise DamagedCheckpointError(f"{self.path}: {error}; a newer rainstereo may know it") from error

    def build(self) -> nn.Module:
        """The network with these weights, in eval mode, on the processor.

        DamagedCheckpointError where the tensors are not those of the network that the card describes.
        """
        with torch.random.fork_rng(devices=[]):  # initial weights are drawn, and thrown away
            module: nn.Module = self.config.build()
        own = module.state_dict()
        wrong = sorted(own.keys() ^ self.tensors.keys()) or sorted(
            name for name, tensor in own.items() if tensor.shape != self.tensors[name].shape
        )
        if wrong:
            raise DamagedCheckpointError(
                f"{self.path}: {len(wrong)} tensors are not those of {self.architecture} with {self.config}, such as "
                f"{wrong[0]}; the card describes another network than the file holds"
            )
        module.load_state_dict(dict(self.tensors))
        return module.eval()


def save(
    path: Path_,
    tensors: nn.Module | Mapping[str, Tensor],
    card: Mapping[str, object],
    *,
    storage: torch.dtype | None = None,
) -> Path:
    """Write a module's weights, or tensors by name, and their card; return the path of the .safetensors file.

    card: at least `architecture` and `config` where `Checkpoint.build` shall work. storage: a type in which floating
    point tensors are kept, such as torch.float16, half the size. Whoever reads meanwhile, or after a crash, finds the
    old checkpoint or the new one.
    """
    path = _weights(path)
    given = tensors.state_dict() if isinstance(tensors, nn.Module) else tensors
    kept = {name: _stored(tensor, storage) for name, tensor in given.items()}
    full = {**card, "format": FORMAT, "versions": _versions(), "sha256": checksum(kept)}
    text = to_toml(full)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, tensor_bytes(kept, {"card": text}))
    _write(path.with_suffix(".toml"), text.encode())
    return path


def load(path: Path_) -> Checkpoint:
    """Read a checkpoint: NAME, NAME.safetensors or NAME.toml.

    FileNotFoundError where there is none; DamagedCheckpointError where it is cut off, changed, or no checkpoint at all.
    """
    path = _weights(path)
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DamagedCheckpointError(f"{path}: {size >> 20} MiB; expected at most {MAX_BYTES >> 20}")
    data = path.read_bytes()
    try:
        tensors = parse_tensors(data)
        embedded = _header_card(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise DamagedCheckpointError(f"{path}: not a whole safetensors file ({error})") from error
    del data
    found = checksum(tensors)
    cards = [card for card in (_card_beside(path), embedded) if card is not None]
    card = next((card for card in cards if card.get("sha256") == found), None)
    if card is None:
        raise DamagedCheckpointError(
            f"{path}: its tensors have the checksum {found[:12]}..., its card says "
            f"{str(cards[0].get('sha256'))[:12] if cards else 'nothing'}...; the file is damaged, get it again"
        )
    if not isinstance(card.get("format"), int) or card["format"] > FORMAT:
        raise DamagedCheckpointError(f"{path}: format {card.get('format')} is newer than {FORMAT}; update rainstereo")
    single = {n: t.float() if t.dtype in (torch.float16, torch.bfloat16) else t for n, t in tensors.items()}
    return Checkpoint(path, card, single)


def shipped() -> Path:
    """The weights in the package."""
    return Path(__file__).parent / "weights" / f"compact{SUFFIX}"


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


# -- checkpoints in a row ---------------------------------------------------------------------------------------------

_NUMBERED = re.compile(rf"step-(\d{{1,12}}){re.escape(SUFFIX)}")


def numbered(folder: Path_, step: int) -> Path:
    """Where the checkpoint of a step lies."""
    return Path(folder) / f"step-{step:09d}{SUFFIX}"


def in_order(folder: Path_) -> list[tuple[int, Path]]:
    """Checkpoints of a folder with their steps, the latest first; damaged ones among them."""
    paths = Path(folder).glob(f"*{SUFFIX}") if Path(folder).is_dir() else ()
    found = [(int(match[1]), path) for path in paths if (match := _NUMBERED.fullmatch(path.name))]
    return sorted(found, reverse=True)


def latest(folder: Path_) -> Iterator[tuple[int, Checkpoint | DamagedCheckpointError]]:
    """The latest checkpoint that is whole, after those newer ones that are not, each with its step."""
    for step, path in in_order(folder):
        try:
            checkpoint = load(path)
        except DamagedCheckpointError as error:
            yield step, error
            continue
        yield step, checkpoint
        return


def rotate(folder: Path_, keep: int) -> None:
    """Remove all but the latest `keep` checkpoints of a folder."""
    if keep < 1:
        raise ValueError(f"keep is {keep}; expected 1 or more")
    for _, path in in_order(folder)[keep:]:
        path.unlink(missing_ok=True)
        path.with_suffix(".toml").unlink(missing_ok=True)


# -- files -----------------------------------------------------------------------------------------------------------


def _weights(path: Path_) -> Path:
    path = Path(path)
    if path.suffix == SUFFIX:
        return path
    return path.with_suffix(SUFFIX) if path.suffix == ".toml" else path.with_name(path.name + SUFFIX)


def _stored(tensor: Tensor, storage: torch.dtype | None) -> Tensor:
    tensor = tensor.detach().cpu()
    if storage is not None and tensor.is_floating_point():
        tensor = tensor.to(storage)
    return tensor.contiguous().clone() if tensor._is_view() else tensor.contiguous()


def _card_beside(path: Path) -> Card | None:
    try:
        return from_toml(path.with_suffix(".toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _header_card(data: bytes) -> Card | None:
    """The card in a safetensors file's header: eight bytes of length, then JSON, whose `__metadata__` holds texts."""
    import json

    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    text = header.get("__metadata__", {}).get("card")
    return None if text is None else from_toml(text)


def _write(path: Path, data: bytes) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _versions() -> dict[str, str]:
    found = {"torch": str(torch.__version__)}
    for name in ("rainstereo", "kornia"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
