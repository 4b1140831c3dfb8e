"""The interface that the two diffusion processes share.

A level is a number in [0, 1] for each sample: 0 is clean, 1 is fully corrupted (the paper's k_c and k_d).
"""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor


@dataclass(frozen=True)
class Corrupted:
    """A training example of a process.

    Attributes:
        value: (B, H, ...) what the denoiser sees.
        target: (B, H, ...) what the denoiser should predict.
        level: (B,) how strongly the value is corrupted.
    """

    value: Tensor
    target: Tensor
    level: Tensor


class Process(Protocol):
    """Corrupts clean data step by step, and knows how to go back."""

    def sample_level(self, batch_size: int, device: torch.device, generator: Generator | None = None) -> Tensor:
        """Levels to train on: (B,)."""
        ...

    def corrupt(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Corrupted:
        """Draw from q(value at a level | clean)."""
        ...

    def loss(self, prediction: Tensor, corrupted: Corrupted) -> Tensor:
        """The training loss of each sample: (B,)."""
        ...

    def prior(self, shape: tuple[int, ...], device: torch.device, generator: Generator | None = None) -> Tensor:
        """Fully corrupted data, where the way back starts."""
        ...

    def show_given(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Tensor:
        """How the denoiser sees, at a level, the part of a plan that is given."""
        ...

    def levels(self, num_steps: int) -> Tensor:
        """The levels of a way back in `num_steps` steps, from 1 down to 0: (num_steps + 1,)."""
        ...

    def told_level(self, value: Tensor, level: Tensor) -> Tensor:
        """The level that the denoiser is told for a value on its way back: (B,).

        Args:
            level: the scheduled one, a scalar.
        """
        ...

    def reverse_step(
        self, value: Tensor, prediction: Tensor, level: Tensor, next_level: Tensor, generator: Generator | None = None
    ) -> Tensor:
        """Draw from p(value at the next, lower level | value, prediction). The two levels are scalars."""
        ...


class SymbolProcess(Process, Protocol):
    """A process over symbols: its clean data are token ids (B, H_d), its values what the denoiser sees of them.

    Attributes:
        num_states: size of the vector that stands for a symbol.
    """

    num_states: int

    def tokens(self, value: Tensor) -> Tensor:
        """The token ids that a value stands for: (B, H_d)."""
        ...


def expand_to(level: Tensor, value: Tensor) -> Tensor:
    """Give a tensor trailing axes, so that it broadcasts against a (B, ...) value; a scalar stays one."""
    return level.reshape(level.shape + (1,) * (value.ndim - level.ndim)) if level.ndim else level
