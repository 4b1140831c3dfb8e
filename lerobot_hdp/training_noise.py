"""The noise of a training step: the same after an interruption, and on any number of devices."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Generator, Tensor

from .processes import Corrupted, Process


@dataclass(frozen=True)
class TrainingNoise:
    """What a step draws at random for one process' batch of B samples.

    A distributed run of n processes has the noise of a run of one process with n times the batch size: each draws it
    for the batches of all, and takes its own part.

    Attributes:
        generator: the same on all processes.
        rank: number of this process.
        world_size: how many there are.
    """

    generator: Generator
    rank: int = 0
    world_size: int = 1

    @classmethod
    def seeded(cls, device: torch.device, *seed: int) -> "TrainingNoise":
        """That of a seed, on this process of the distributed run, if there is one."""
        generator = Generator(device).manual_seed(mix_seeds(*seed))
        if not torch.distributed.is_initialized():
            return cls(generator)
        return cls(generator, torch.distributed.get_rank(), torch.distributed.get_world_size())

    def level(self, process: Process, batch_size: int) -> Tensor:
        """How strongly to corrupt each sample: (B,)."""
        levels = process.sample_level(self.world_size * batch_size, self.generator.device, self.generator)
        return self._own_part(levels)

    def corrupt(self, process: Process, clean: Tensor, level: Tensor) -> Corrupted:
        """Corrupt (B, H, ...) clean data to levels (B,)."""
        of_all = process.corrupt(self._for_all(clean), self._for_all(level), self.generator)
        return Corrupted(*(self._own_part(part) for part in (of_all.value, of_all.target, of_all.level)))

    def normal(self, like: Tensor) -> Tensor:
        """Standard normal noise, like a (B, ...) tensor."""
        shape = (self.world_size * len(like), *like.shape[1:])
        return self._own_part(torch.randn(shape, device=like.device, dtype=like.dtype, generator=self.generator))

    def choose(self, share: float, batch_size: int) -> Tensor:
        """A share of the samples, each drawn by itself: (B,) bool."""
        size = self.world_size * batch_size
        return self._own_part(torch.rand(size, device=self.generator.device, generator=self.generator) < share)

    def _own_part(self, of_all: Tensor) -> Tensor:
        return of_all.chunk(self.world_size)[self.rank]

    def _for_all(self, own: Tensor) -> Tensor:
        return own.repeat(self.world_size, *[1] * (own.ndim - 1))


def mix_seeds(*numbers: int) -> int:
    """A seed that follows from some numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])
