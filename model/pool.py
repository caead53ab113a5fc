"""The pool of earlier derained images from which the discriminator learns (Shrivastava et al., CVPR 2017, section 2.3).

The discriminator then does not forget what the generator did wrong some steps ago.
"""

from __future__ import annotations

import torch
from torch import Tensor

LARGEST = 1000
DRAWS = "draws"
IMAGE = "image"


class DerainedPool:
    """Up to `size` images. While it fills, images pass; then, one time in two, one of the pool goes out in place of the
    new one, which takes its place there. Size 0: everything passes.

    Images of different sizes may be mixed; one goes out only in place of one of its own size. Draws depend on the seed
    alone, and `state_dict` continues them exactly.
    """

    def __init__(self, size: int = 50, seed: int = 0) -> None:
        if type(size) is not int or not 0 <= size <= LARGEST:
            raise ValueError(f"a pool of {size!r} images was given; expected a whole number in 0..{LARGEST}")
        self.size = size
        self.images: list[Tensor] = []
        self._draws = torch.Generator().manual_seed(seed)

    def __len__(self) -> int:
        """How many images it holds."""
        return len(self.images)

    def query(self, derained: Tensor) -> Tensor:
        """The generator's newest images, (B, C, H, W), in; as many for the discriminator out, without gradients."""
        return torch.stack([self._exchange(image) for image in derained.detach()])

    def _exchange(self, image: Tensor) -> Tensor:
        if len(self.images) < self.size:
            self.images.append(image.clone())
            return image
        alike = [i for i, kept in enumerate(self.images) if kept.shape == image.shape]
        keep, which = torch.rand(2, generator=self._draws, dtype=torch.float64).tolist()
        if not alike or keep < 0.5:
            return image
        place = alike[int(which * len(alike))]
        earlier = self.images[place].to(image)
        self.images[place] = image.clone()
        return earlier

    def state_dict(self) -> dict[str, Tensor]:
        """All it holds, as tensors on the processor."""
        images = {f"{IMAGE}.{i}": image.cpu().clone() for i, image in enumerate(self.images)}
        return images | {DRAWS: self._draws.get_state()}

    def load_state_dict(self, state: dict[str, Tensor], device: torch.device | str = "cpu") -> None:
        """Continue from what `state_dict` gave. The images go to a device.

        ValueError if the state holds anything else, or more images than the pool may.
        """
        count = len(state) - 1
        names = {f"{IMAGE}.{i}" for i in range(count)} | {DRAWS}
        if set(state) != names or count > self.size:
            raise ValueError(
                f"a pool's state of {', '.join(sorted(state)[:4])} ...: expected {DRAWS!r} and up to {self.size} images"
            )
        if any(state[name].ndim != 3 for name in names - {DRAWS}):
            raise ValueError("a pool's state holds images that are not (channels, height, width)")
        try:
            self._draws.set_state(state[DRAWS].cpu())
        except (RuntimeError, TypeError) as error:
            raise ValueError(f"a pool's state of draws cannot be continued: {error}") from error
        self.images = [state[f"{IMAGE}.{i}"].to(device, copy=True) for i in range(count)]
