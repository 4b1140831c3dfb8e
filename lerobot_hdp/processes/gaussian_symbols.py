"""A Gaussian process over symbols, in place of the masked one: what two of the paper's ablations do."""

import torch.nn.functional as F
from torch import Generator, Tensor

from .base import Corrupted
from .gaussian import GaussianProcess


class GaussianSymbolProcess(GaussianProcess):
    """DDPM over one-hot vectors, normalised like a motion: 1 at the token's id, -1 elsewhere.

    Clean data are token ids (B, H); values are (B, H, m), and the greatest component of a vector is its token.

    Args:
        vocabulary_size: m.
        num_train_timesteps, prediction_type, eta: see `GaussianProcess`.
    """

    def __init__(self, vocabulary_size: int, num_train_timesteps: int, prediction_type: str, eta: float = 1.0):
        super().__init__(num_train_timesteps, prediction_type, eta)
        self.num_states = vocabulary_size

    def corrupt(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Corrupted:
        """Token ids below 0 (FREE in a prompt) count as symbol 0."""
        one_hot = F.one_hot(clean.clamp(min=0), self.num_states).float()
        return super().corrupt(2 * one_hot - 1, level, generator)

    def prior(self, shape: tuple[int, ...], device, generator: Generator | None = None) -> Tensor:
        return super().prior((*shape, self.num_states), device, generator)

    def tokens(self, value: Tensor) -> Tensor:
        return value.argmax(dim=-1)
