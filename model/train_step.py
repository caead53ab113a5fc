"""One step of training: the discriminator first, then the generator, each from its own losses and for its own weights."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rainstereo.model.architectures import config_of
from rainstereo.model.dataset import Batch
from rainstereo.model.recipe import Recipe

PRECISIONS = {"bf16": torch.bfloat16, "fp16": torch.float16}
STEP_SEED = 3
"""Part of the seed of what a step draws; see `dataset.WINDOW`."""


@dataclass(frozen=True)
class Stepped:
    """What a step found. losses: by name, unweighted, means over this process's share of the batch. skipped: why
    nothing was learnt, or empty."""

    losses: Mapping[str, float] = field(default_factory=dict)
    skipped: str = ""


class Trainer:
    """Networks, their optimizers and everything else that a step changes.

    recipe: what to do. device: where. rank, world: which of how many processes this is; with more than one,
    torch.distributed must be initialised, and each gives `step` its own share of the batch.
    """

    def __init__(self, recipe: Recipe, device: torch.device, rank: int = 0, world: int = 1) -> None:
        self.recipe, self.device, self.rank, self.world = recipe, device, rank, world
        if recipe.optimizer.batch % (world * recipe.optimizer.accumulate):
            raise ValueError(
                f"optimizer.batch {recipe.optimizer.batch} cannot be shared by {world} processes in "
                f"{recipe.optimizer.accumulate} parts; give a multiple of {world * recipe.optimizer.accumulate}"
            )
        self.config = config_of(recipe.architecture, recipe.network)
        self._format = torch.channels_last if recipe.compute.channels_last else torch.contiguous_format
        torch.manual_seed(recipe.seed)
        self.generator: nn.Module = self._placed(self.config.build())
        self.average: nn.Module | None = None
        if recipe.optimizer.ema:
            self.average = copy.deepcopy(self.generator).requires_grad_(False)
        self.generator_optimizer = self._adam(self.generator)
        autocast = PRECISIONS.get(recipe.compute.precision)
        self._autocast = autocast
        self.scaler = torch.amp.GradScaler(device.type, enabled=autocast is torch.float16)
        self._run_generator = self._replicated(self.generator, recipe.compute.compile)
        self.done = 0
        self.skipped = 0

    @property
    def best(self) -> nn.Module:
        """The generator to be kept: the running mean of its weights where there is one."""
        return self.generator if self.average is None else self.average

    def step(self, batch: Batch, progress: float) -> Stepped:
        """Learn from a batch. progress: share of the run that is over, for the schedule.

        A batch or a loss that is not finite changes nothing and is counted.
        """
        seed = np.random.SeedSequence([self.recipe.seed, STEP_SEED, self.done, self.rank]).generate_state(2, np.uint32)
        torch.manual_seed(int(seed[0]) << 31 ^ int(seed[1]))
        for group in self.generator_optimizer.param_groups:
            group["lr"] = self.rate(progress)
        rainy, clear = self._moved(batch.rainy), self._moved(batch.clear)
        if not self._everywhere(bool(torch.isfinite(rainy).all() & torch.isfinite(clear).all())):
            return self._skip(f"not finite: {', '.join(batch.names)}")
        count = self.recipe.optimizer.accumulate
        parts = list(zip(rainy.chunk(count), clear.chunk(count), strict=True))
        losses: dict[str, Tensor] = {}
        self.generator_optimizer.zero_grad(set_to_none=True)
        for i, (part_rainy, part_clear) in enumerate(parts):
            with self._alone(self._run_generator, i + 1 < len(parts)):
                with self._casting():
                    derained = self._run_generator(part_rainy)
                found = self._generator_losses(derained.float(), part_clear)
                total = sum((weight * loss for weight, loss in found.values()), torch.zeros((), device=self.device))
                self.scaler.scale(total / len(parts)).backward()
            for name, (_, loss) in found.items():
                losses[name] = losses.get(name, torch.zeros((), device=self.device)) + loss.detach() / len(parts)
        values = {name: float(loss) for name, loss in losses.items()}
        if not self._everywhere(all(map(math.isfinite, values.values()))):
            return self._skip(f"a loss is not finite: {', '.join(batch.names)}")
        self._update(self.generator_optimizer, self.generator)
        self.scaler.update()
        self._follow()
        self.done += 1
        return Stepped(values)

    def rate(self, progress: float) -> float:
        """The learning rate at this step."""
        o = self.recipe.optimizer
        rate = o.rate * min(1.0, (self.done + 1) / o.warmup) if o.warmup else o.rate
        if o.schedule == "cosine":
            rate *= o.final + (1 - o.final) * 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
        return rate

    # -- losses --------------------------------------------------------------------------------------------------------

    def _generator_losses(self, derained: Tensor, clear: Tensor) -> dict[str, tuple[float, Tensor]]:
        """Weight and value of each loss that counts."""
        weights = self.recipe.losses
        found: dict[str, tuple[float, Tensor]] = {}
        if weights.pixel:
            found["pixel"] = weights.pixel, nn.functional.l1_loss(derained, clear)
        return found

    # -- what it stands on ---------------------------------------------------------------------------------------------

    def _placed(self, module: nn.Module) -> nn.Module:
        module = module.to(self.device)
        return module.to(memory_format=self._format) if self.recipe.compute.channels_last else module  # type: ignore[call-overload]

    def _moved(self, images: Tensor) -> Tensor:
        return images.to(self.device, non_blocking=True, memory_format=self._format)

    def _adam(self, module: nn.Module) -> torch.optim.Adam:
        o = self.recipe.optimizer
        return torch.optim.Adam(module.parameters(), lr=o.rate, betas=(o.beta1, o.beta2))

    def _replicated(self, module: nn.Module, compiled: bool) -> nn.Module:
        """The module as it is run: gradients averaged over processes, compiled if asked for."""
        if self.world > 1:
            ids = [self.device.index] if self.device.type == "cuda" else None
            module = nn.parallel.DistributedDataParallel(module, device_ids=ids)
        return torch.compile(module) if compiled else module  # type: ignore[return-value]

    def _casting(self) -> AbstractContextManager[Any]:
        return nullcontext() if self._autocast is None else torch.autocast(self.device.type, self._autocast)

    @contextmanager
    def _alone(self, module: nn.Module, alone: bool) -> Iterator[None]:
        """Gradients stay in this process for now: more of the batch is to come."""
        if alone and isinstance(module, nn.parallel.DistributedDataParallel):
            with module.no_sync():
                yield
        else:
            yield

    def _everywhere(self, good: bool) -> bool:
        """Whether it is so in all processes."""
        if self.world == 1:
            return good
        flag = torch.tensor([int(good)], device=self.device)
        torch.distributed.all_reduce(flag, torch.distributed.ReduceOp.MIN)
        return bool(flag.item())

    def _update(self, optimizer: torch.optim.Adam, module: nn.Module) -> None:
        if self.recipe.optimizer.clip:
            self.scaler.unscale_(optimizer)
            nn.utils.clip_grad_norm_(module.parameters(), self.recipe.optimizer.clip)
        self.scaler.step(optimizer)

    def _skip(self, why: str) -> Stepped:
        self.generator_optimizer.zero_grad(set_to_none=True)
        self.done += 1
        self.skipped += 1
        return Stepped(skipped=why)

    @torch.no_grad()
    def _follow(self) -> None:
        """The running mean takes up the new weights; quickly at first."""
        if self.average is None:
            return
        decay = min(self.recipe.optimizer.ema, (1 + self.done) / (10 + self.done))
        for mean, weight in zip(self.average.parameters(), self.generator.parameters(), strict=True):
            mean.lerp_(weight, 1 - decay)
        for mean, buffer in zip(self.average.buffers(), self.generator.buffers(), strict=True):
            mean.copy_(buffer)

    # -- exact resume --------------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that steps change: tensors by name, and plain values."""
        tensors = {f"generator.{name}": tensor for name, tensor in self.generator.state_dict().items()}
        if self.average is not None:
            tensors |= {f"average.{name}": tensor for name, tensor in self.average.state_dict().items()}
        tensors |= _optimizer_tensors("generator_optimizer", self.generator_optimizer)
        scaler = {key: value for key, value in self.scaler.state_dict().items() if isinstance(value, (int, float))}
        return tensors, {"done": self.done, "skipped": self.skipped, "scaler": scaler}

    def restore(self, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
        """Go on from what `state` gave; ValueError where it is another run's."""
        self.generator.load_state_dict(_under("generator", tensors))
        if self.average is not None:
            self.average.load_state_dict(_under("average", tensors))
        _restore_optimizer("generator_optimizer", self.generator_optimizer, tensors)
        if values.get("scaler"):
            self.scaler.load_state_dict(dict(values["scaler"]))
        self.done, self.skipped = int(values["done"]), int(values["skipped"])


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    start = f"{prefix}."
    found = {name[len(start) :]: tensor for name, tensor in tensors.items() if name.startswith(start)}
    if not found:
        raise ValueError(f"the checkpoint holds no {prefix}; it is no training state of this recipe")
    return found


def _optimizer_tensors(prefix: str, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    return {
        f"{prefix}.{i}.{key}": value
        for i, parameter in enumerate(parameters)
        for key, value in optimizer.state.get(parameter, {}).items()
    }


def _restore_optimizer(prefix: str, optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Moments get the memory layout of their parameters, so that the arithmetic is the same to the last bit."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    start = f"{prefix}."
    for name, tensor in tensors.items():
        if not name.startswith(start):
            continue
        index, key = name[len(start) :].split(".", 1)
        parameter = parameters[int(index)]
        if tensor.shape == parameter.shape:
            kept = torch.empty_like(parameter, dtype=tensor.dtype, memory_format=torch.preserve_format)
            tensor = kept.detach().copy_(tensor)
        else:
            tensor = tensor.clone()
        optimizer.state[parameter][key] = tensor
