"""One step of training: the discriminator first, then the generator, each from its own losses and for its own
weights."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor, nn

from rainstereo.model import checkpoint
from rainstereo.model.architecture import configure
from rainstereo.model.dataset import Batch
from rainstereo.model.losses import GeneratorLoss, discriminator_loss
from rainstereo.model.pool import DerainedPool
from rainstereo.model.recipe import SHIPPED, Recipe
from rainstereo.model.vgg import VggFeatures

Parts: TypeAlias = list[tuple[Tensor, Tensor]]
"""Rainy and clear images of the parts that a batch is taken in."""
Found: TypeAlias = tuple[dict[str, Tensor], Tensor]
"""Losses by name, and whether all was good so far, on the device."""

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
        started = _started(recipe)
        self.config = configure(recipe.architecture, recipe.network) if started is None else started.config
        self._format = torch.channels_last if self._may_be_channels_last() else torch.contiguous_format
        self._autocast = PRECISIONS.get(recipe.compute.precision)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self._autocast is torch.float16)
        torch.manual_seed(recipe.seed)
        self.generator = self._placed(self.config.build() if started is None else started.build().train())
        self.generator_optimizer = self._adam(self.generator)
        self.average = copy.deepcopy(self.generator).requires_grad_(False) if recipe.optimizer.ema else None
        self.discriminator: nn.Module | None = None
        if recipe.losses.need_discriminator:
            if recipe.discriminator.conditional and recipe.optimizer.pool:
                raise ValueError(
                    "discriminator.conditional needs optimizer.pool = 0: images from a pool are not of the rainy "
                    "image's scene"
                )
            self.discriminator = self._placed(recipe.discriminator.build())
            self.discriminator_optimizer = self._adam(self.discriminator)
            self._run_discriminator = self._replicated(self.discriminator)
        features = VggFeatures(recipe.vgg or None, recipe.seed) if recipe.losses.lambda_perceptual else None
        self.features = "none" if features is None else features.label
        self._loss = self._placed(GeneratorLoss(recipe.losses, features))
        self._run_generator = self._replicated(self.generator)
        if recipe.compute.compile:
            self._run_generator = torch.compile(self._run_generator)  # type: ignore[assignment]
        share, size = recipe.optimizer.batch // world, recipe.optimizer.pool
        size = max(1, size // recipe.optimizer.batch) if size else 0
        self.pools = [DerainedPool(size, recipe.seed + rank * share + i) for i in range(share)]
        self.done = 0
        self.skipped = 0

    @property
    def best(self) -> nn.Module:
        """The generator to be kept: the running mean of its weights where there is one."""
        return self.generator if self.average is None else self.average

    def step(self, batch: Batch, progress: float) -> Stepped:
        """Learn from a batch. progress: share of the run that is over, for the schedule.

        A batch that is not finite changes nothing; a network whose gradients are not finite stays as it is. Either is
        counted in `skipped`.
        """
        words = [self.recipe.seed, STEP_SEED, self.done, self.rank]
        torch.manual_seed(int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0] >> np.uint64(1)))
        rate = self.rate(progress)
        self.done += 1
        if not self._everywhere(all_finite(batch.rainy) and all_finite(batch.clear)):
            self.skipped += 1
            return Stepped(skipped="values that are not finite")
        rainy, clear = self._moved(batch.rainy), self._moved(batch.clear)
        count = self.recipe.optimizer.accumulate
        parts = list(zip(rainy.chunk(count), clear.chunk(count), strict=True))
        # in one part, both networks learn from one pass of the generator; in several, keeping all passes would take the
        # memory that parts are to save
        first = [self._derained(parts[0][0])] if count == 1 else []
        losses: dict[str, Tensor] = {}
        good = torch.ones((), dtype=torch.bool, device=self.device)
        if self.discriminator is not None:
            losses, good = self._discriminator_step(parts, first, rate, good)
        found, good = self._generator_step(parts, first, rate, good)
        losses |= found
        self.scaler.update()
        # a device is waited for here, and only here
        *values, went_well = torch.stack([*(loss.float() for loss in losses.values()), good.float()]).tolist()
        told = dict(zip(losses, values, strict=True))
        if not went_well:
            self.skipped += 1
            return Stepped(told, "gradients that are not finite")
        self._follow()
        return Stepped(told)

    def _discriminator_step(self, parts: Parts, first: list[Tensor], rate: float, good: Tensor) -> Found:
        """L_disc of clear images and of derained ones from the pool."""
        total = torch.zeros((), device=self.device)
        size = len(parts[0][0])
        for i, (rainy, clear) in enumerate(parts):
            if first:
                derained = first[i].detach()
            else:
                with torch.no_grad():
                    derained = self._derained(rainy)
            pools = self.pools[i * size : (i + 1) * size]
            shown = torch.cat([pool.query(image[None]) for pool, image in zip(pools, derained, strict=True)])
            with self._alone(self._run_discriminator, i + 1 < len(parts)):
                with self._casting():
                    loss = self._discriminated(clear, shown, rainy) / len(parts)
                if not i:
                    self.discriminator_optimizer.zero_grad()
                self.scaler.scale(loss).backward()  # type: ignore[no-untyped-call]
            total += loss.detach()
        return {"discriminator": total}, self._update(self.discriminator_optimizer, rate, good)

    def _generator_step(self, parts: Parts, first: list[Tensor], rate: float, good: Tensor) -> Found:
        """L_gen, against the discriminator that has just learnt."""
        losses: dict[str, Tensor] = {}
        for i, (rainy, clear) in enumerate(parts):
            with self._alone(self._run_generator, i + 1 < len(parts)):
                derained = first[i] if first else self._derained(rainy)
                with self._casting():
                    found = self._loss(clear, derained, self.discriminator, rainy)
                if not i:  # not sooner: on a processor, memory freed here and taken again at once costs no page faults
                    self.generator_optimizer.zero_grad()
                self.scaler.scale(found["total"] / len(parts)).backward()
            for name, loss in found.items():
                losses[name] = losses.get(name, 0) + loss.detach() / len(parts)
        return losses, self._update(self.generator_optimizer, rate, good)

    def _discriminated(self, clear: Tensor, derained: Tensor, rainy: Tensor) -> Tensor:
        return discriminator_loss(self._run_discriminator, clear, derained, rainy, self.recipe.losses.adversary)

    def _derained(self, rainy: Tensor) -> Tensor:
        with self._casting():
            derained: Tensor = self._run_generator(rainy)
        return derained.float()

    def rate(self, progress: float) -> float:
        """The learning rate at this step."""
        o = self.recipe.optimizer
        rate = o.rate * min(1.0, (self.done + 1) / o.warmup) if o.warmup else o.rate
        if o.schedule == "cosine":
            rate *= o.final + (1 - o.final) * 0.5 * (1 + math.cos(math.pi * min(max(progress, 0.0), 1.0)))
        return rate

    # -- what it stands on ---------------------------------------------------------------------------------------------

    def _placed(self, module: nn.Module) -> nn.Module:
        module = module.to(self.device)
        if self._format is torch.channels_last:
            module.to(memory_format=self._format)  # type: ignore[call-overload]
        return module

    def _may_be_channels_last(self) -> bool:
        """Whether it is asked for, and right: see `instance_norm_differentiates`."""
        if not self.recipe.compute.channels_last:
            return False
        kinds = getattr(self.config, "normalisation", "instance"), self.recipe.discriminator.normalisation
        needed = kinds if self.recipe.losses.need_discriminator else kinds[:1]
        return "instance" not in needed or instance_norm_differentiates(self.device)

    def _moved(self, images: Tensor) -> Tensor:
        return images.to(self.device, non_blocking=True, memory_format=self._format)

    def _adam(self, module: nn.Module) -> torch.optim.Adam:
        o = self.recipe.optimizer
        fused = self.device.type in {"cpu", "cuda"}  # one pass over the weights in place of ten
        return torch.optim.Adam(module.parameters(), lr=o.rate, betas=(o.beta1, o.beta2), fused=fused)

    def _replicated(self, module: nn.Module) -> nn.Module:
        """The module as it is run: with gradients averaged over processes."""
        if self.world == 1:
            return module
        ids = [self.device.index] if self.device.type == "cuda" else None
        return nn.parallel.DistributedDataParallel(module, device_ids=ids, broadcast_buffers=False)

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

    def _update(self, optimizer: torch.optim.Adam, rate: float, good: Tensor) -> Tensor:
        """Change the weights, unless a gradient is not finite, or not all was good before; whether so, on the device.

        Gradients are the same in all processes, so is this.
        """
        if self._autocast is not torch.float16 or self.recipe.optimizer.clip:
            self.scaler.unscale_(optimizer)
            norm = nn.utils.get_total_norm([p.grad for p in self._weights(optimizer) if p.grad is not None])
            if self.recipe.optimizer.clip:
                nn.utils.clip_grads_with_norm_(self._weights(optimizer), self.recipe.optimizer.clip, norm)
            # too large for half precision happens now and then: the scaler then leaves the weights alone
            good = good if self._autocast is torch.float16 else good & norm.isfinite()
        for group in optimizer.param_groups:
            group["lr"] = rate
        if self._autocast is torch.float16:
            self.scaler.step(optimizer)
        elif optimizer.defaults["fused"]:
            optimizer.found_inf = (~good).float()  # type: ignore[attr-defined]  # as the scaler tells it
            optimizer.step()
        elif good:
            optimizer.step()
        return good

    @staticmethod
    def _weights(optimizer: torch.optim.Optimizer) -> list[Tensor]:
        return [p for group in optimizer.param_groups for p in group["params"]]

    @torch.no_grad()
    def _follow(self) -> None:
        """The running mean takes up the new weights; quickly at first."""
        if self.average is None:
            return
        decay = min(self.recipe.optimizer.ema, (1 + self.done) / (10 + self.done))
        for mean, weight in zip(self.average.parameters(), self.generator.parameters(), strict=True):
            mean.lerp_(weight, 1 - decay)
        for kept, buffer in zip(self.average.buffers(), self.generator.buffers(), strict=True):
            kept.copy_(buffer)

    # -- exact resume --------------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Everything that steps change: tensors by name, and plain values. All processes must call it together."""
        tensors = {f"generator.{name}": tensor for name, tensor in self.generator.state_dict().items()}
        tensors |= _optimizer_tensors("generator_optimizer", self.generator_optimizer)
        if self.average is not None:
            tensors |= {f"average.{name}": tensor for name, tensor in self.average.state_dict().items()}
        if self.discriminator is not None:
            tensors |= {f"discriminator.{name}": tensor for name, tensor in self.discriminator.state_dict().items()}
            tensors |= _optimizer_tensors("discriminator_optimizer", self.discriminator_optimizer)
            tensors |= self._pool_tensors()
        scaler = {key: value for key, value in self.scaler.state_dict().items() if isinstance(value, (int, float))}
        return tensors, {"done": self.done, "skipped": self.skipped, "scaler": scaler}

    def restore(self, tensors: Mapping[str, Tensor], values: Mapping[str, Any]) -> None:
        """Go on from what `state` gave; ValueError where it is another run's."""
        self.generator.load_state_dict(_under("generator", tensors))
        _restore_optimizer("generator_optimizer", self.generator_optimizer, tensors)
        if self.average is not None:
            self.average.load_state_dict(_under("average", tensors))
        if self.discriminator is not None:
            self.discriminator.load_state_dict(_under("discriminator", tensors))
            _restore_optimizer("discriminator_optimizer", self.discriminator_optimizer, tensors)
            for i, pool in enumerate(self.pools, self.rank * len(self.pools)):
                pool.load_state_dict(_under(f"pool.{i}", tensors), self.device)
        if values.get("scaler"):
            self.scaler.load_state_dict({**self.scaler.state_dict(), **values["scaler"]})
        self.done, self.skipped = int(values["done"]), int(values["skipped"])

    def _pool_tensors(self) -> dict[str, Tensor]:
        """Of the pools of all processes; each holds those of its own windows."""
        own = {
            f"pool.{i}.{name}": tensor
            for i, pool in enumerate(self.pools, self.rank * len(self.pools))
            for name, tensor in pool.state_dict().items()
        }
        if self.world == 1:
            return own
        found: list[dict[str, Tensor]] = [{} for _ in range(self.world)]
        torch.distributed.all_gather_object(found, own)
        return {name: tensor for part in found for name, tensor in part.items()}


def all_finite(images: Tensor) -> bool:
    """Whether there is neither NaN nor infinity among values; in one pass, in a tenth of the time of `isfinite`."""
    return all(math.isfinite(value) for value in images.aminmax())


@lru_cache
def instance_norm_differentiates(device: torch.device) -> bool:
    """Whether the gradient of InstanceNorm2d is right for images in channels-last order.

    For a batch of one it is not in torch 2.13 on the processor: off by as much as the gradient itself, without a word.
    """
    draws = torch.Generator().manual_seed(0)
    values, slopes = (torch.randn(1, 4, 8, 8, generator=draws).to(device) for _ in range(2))
    found = []
    for order in (torch.contiguous_format, torch.channels_last):
        images = values.clone(memory_format=order).requires_grad_()
        nn.functional.instance_norm(images).backward(slopes.clone(memory_format=order))  # type: ignore[no-untyped-call]
        found.append(images.grad)
    return bool(torch.allclose(found[0], found[1], atol=1e-4))  # type: ignore[arg-type]


def _started(recipe: Recipe) -> checkpoint.Checkpoint | None:
    """The weights that the recipe starts from; ValueError where they are another network's than it describes."""
    if not recipe.start:
        return None
    path = checkpoint.shipped() if recipe.start == SHIPPED else Path(recipe.start)
    found = checkpoint.load(path)
    if recipe.architecture != found.architecture:
        raise ValueError(
            f"start: {path} holds weights of architecture {found.architecture!r}; the recipe asks for "
            f"{recipe.architecture!r}"
        )
    if not recipe.network:
        return found
    theirs, ours = dataclasses.asdict(found.config), dataclasses.asdict(configure(recipe.architecture, recipe.network))
    other = [f"{key} = {theirs[key]!r}, not {ours[key]!r}" for key in theirs if theirs[key] != ours[key]]
    if other:
        raise ValueError(
            f"start: the network of {path} has {', '.join(other)}; leave [network] out to take it as it is"
        )
    return found


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
            optimizer.state[parameter][key] = kept.detach().copy_(tensor)
        else:
            # the count of steps: one pass over the weights wants it beside them
            device = parameter.device if optimizer.defaults["fused"] else tensor.device
            optimizer.state[parameter][key] = tensor.to(device, copy=True)
