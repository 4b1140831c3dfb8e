"""Observation -> condition tokens."""

from collections.abc import Mapping

import torch
from lerobot.configs import PolicyFeature
from torch import Tensor, nn


class StateEncoder(nn.Module):
    """One condition token from all low-dimensional observations, as in Diffusion Policy's transformer.

    Args:
        features: the observations by name; they are concatenated in this order.
        width: size of a token.
    """

    def __init__(self, features: Mapping[str, PolicyFeature], width: int):
        super().__init__()
        self.keys = list(features)
        self.projection = nn.Linear(sum(feature.shape[0] for feature in features.values()), width)

    @property
    def num_tokens(self) -> int:
        return 1

    def forward(self, batch: Mapping[str, Tensor]) -> Tensor:
        """Observations (B, n) or (B, 1, n) each -> (B, 1, width)."""
        states = [batch[key].flatten(1) for key in self.keys]
        return self.projection(torch.cat(states, dim=-1)).unsqueeze(1)
