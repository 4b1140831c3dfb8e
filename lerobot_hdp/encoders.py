"""Observation -> condition tokens."""

from collections.abc import Iterable, Mapping
from itertools import groupby

import torch
from torch import Tensor, nn


class StateEncoder(nn.Module):
    """Condition tokens from the low-dimensional observations.

    The observations are concatenated and cut into parts; each part becomes a token. One part is Diffusion Policy's
    way. With a part for each object, attention can look up the one that a symbol names, instead of finding its
    numbers in a vector of all.

    Args:
        keys: names of the observations, in the order in which they are concatenated.
        token_sizes: size of each part.
        width: size of a token.
        weight_std: standard deviation of the initial weights that an observation meets first.
        hidden_dim: 0 makes a token by a linear layer, more by an MLP with as many hidden units. Their initial weights
            and thresholds are spread over `weight_std`, so that they respond to observations that differ by about
            1 / `weight_std`: fine positions are learned early (Tancik et al. 2020, "Fourier features let networks
            learn high frequency functions in low dimensional domains").
    """

    def __init__(
        self, keys: Iterable[str], token_sizes: Iterable[int], width: int, weight_std: float, hidden_dim: int = 0
    ):
        super().__init__()
        self.keys = list(keys)
        self.token_sizes = list(token_sizes)
        self.projections = nn.ModuleList()
        for size in self.token_sizes:
            first = nn.Linear(size, hidden_dim or width)
            nn.init.normal_(first.weight, std=weight_std)
            if hidden_dim:
                nn.init.uniform_(first.bias, -weight_std, weight_std)
                self.projections.append(nn.Sequential(first, nn.GELU(), nn.Linear(hidden_dim, width)))
            else:
                nn.init.zeros_(first.bias)
                self.projections.append(first)

    @property
    def num_tokens(self) -> int:
        return len(self.token_sizes)

    def forward(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Observations (B, n) or (B, 1, n), or (B,) where n is 1, each -> (B, num_tokens, width)."""
        state = torch.cat([batch[key].reshape(len(batch[key]), -1) for key in self.keys], dim=-1)
        parts = state.split(self.token_sizes, dim=-1)
        return torch.stack([project(part) for project, part in zip(self.projections, parts, strict=True)], dim=1)


def object_sizes(names: Iterable[str]) -> list[int]:
    """How many consecutive components belong to each object; they are named `object.component`.

    Example:
        >>> object_sizes(["red.x", "red.y", "blue.x", "blue.y"])
        [2, 2]
    """
    return [len(list(group)) for _, group in groupby(names, key=lambda name: name.rpartition(".")[0])]
