"""The way there: a demonstration with noise and masks, and how well it is recognised (paper, Algorithm 1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Generator, Tensor

from .configuration_hdp import HDPConfig
from .denoiser import Denoise
from .processes import Corrupted, GaussianProcess, Process, SymbolProcess
from .processes.base import expand_to
from .processor_hdp import widen_narrow_ranges

POSE_NOISE_POWER = 3
"""Of the share of noise in the motion's variance: how fast `observation_noise` falls as the motion becomes clear."""


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


def training_loss(
    denoise: Denoise,
    motion_process: GaussianProcess,
    symbol_process: SymbolProcess | None,
    motion: Tensor,
    token_ids: Tensor | None,
    noise: TrainingNoise,
    *,
    symbol_loss_weight: float,
    shared_level: bool = False,
    lead_share: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Algorithm 1: corrupt motion and symbols independently, denoise both, L = L_DDPM + lambda L_MD4.

    Args:
        denoise: the denoiser, with its observation.
        motion_process, symbol_process: the processes; without the latter the motion alone is learned (Diffuser).
        motion: (B, H_c, D) A_c, normalised.
        token_ids: (B, H_d) A_d; None without a process of theirs.
        noise: of this step.
        symbol_loss_weight: lambda.
        shared_level: whether k_d is always k_c.
        lead_share: see `HDPConfig`.

    Returns:
        L, (), and its two parts.
    """
    k_c = noise.level(motion_process, len(motion))
    if lead_share > 0:  # pure noise, as in planning while the symbols lead
        k_c = k_c.masked_fill(noise.choose(lead_share, len(motion)), 1.0)
    noisy_motion = noise.corrupt(motion_process, motion, k_c)
    if symbol_process is None:
        prediction = denoise(noisy_motion.value, None, k_c, torch.zeros_like(k_c))
        loss = motion_process.loss(prediction.motion, noisy_motion).mean()
        return loss, {"motion_loss": loss}

    assert token_ids is not None
    k_d = k_c if shared_level else noise.level(symbol_process, len(motion))
    masked_symbols = noise.corrupt(symbol_process, token_ids, k_d)
    prediction = denoise(noisy_motion.value, masked_symbols.value, k_c, k_d)
    assert prediction.symbols is not None
    motion_loss = motion_process.loss(prediction.motion, noisy_motion).mean()
    symbol_loss = symbol_process.loss(prediction.symbols, masked_symbols).mean()
    return motion_loss + symbol_loss_weight * symbol_loss, {"motion_loss": motion_loss, "symbol_loss": symbol_loss}


@torch.no_grad()
def read_losses(losses: dict[str, Tensor]) -> dict[str, float]:
    """Losses () as numbers, for logging. They are read at once: each reading makes the host wait for the device."""
    return dict(zip(losses, torch.stack(list(losses.values())).tolist(), strict=True))


def add_pose_noise(poses: Tensor, std: Tensor, process: GaussianProcess, k_c: Tensor, noise: TrainingNoise) -> Tensor:
    """Poses (B, n) that are the less known the noisier the motion beside them is; see `HDPConfig.observation_noise`.

    Args:
        poses: normalised.
        std: (n,) beside a motion of pure noise, see `pose_noise_std`.
        process: the motion's.
        k_c: (B,) the motion's level.
        noise: of this step.
    """
    strength = (1 - process.alpha_bar(k_c)) ** POSE_NOISE_POWER
    return poses + expand_to(strength, poses) * std * noise.normal(poses)


def pose_noise_std(config: HDPConfig, stats: dict[str, Any]) -> Tensor:
    """`observation_noise` of each component of the poses, normalised as these are: (n,)."""
    ranges = {OBS_ENV_STATE: dict(stats[OBS_ENV_STATE])}
    widen_narrow_ranges(config, ranges)
    low, high = (torch.as_tensor(ranges[OBS_ENV_STATE][bound]) for bound in ("min", "max"))
    return (config.observation_noise * 2 / (high - low)).float()
