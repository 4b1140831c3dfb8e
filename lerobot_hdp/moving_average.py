"""The weights that plan: an exponential moving average of those that are trained."""

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn


class MovingAverage(nn.Module):
    """Exponential moving average of a network's parameters, with Diffusion Policy's warm-up of the decay.

    Update n = 0, 1, ... is average <- d average + (1 - d) network, with d = min(1 - (1 + n)^-power, max_decay), so
    that the first one copies the network. The number of updates is kept as a number, too: PyTorch's `AveragedModel`
    reads it from the device, and so waits for the device, at every update.

    Args:
        network: what is averaged; its buffers are taken as constants.
        power, max_decay: of the decay.

    Attributes:
        module: a copy of the network with the averaged parameters, which take no gradient.
        n_averaged: () int64, the number of updates.
    """

    def __init__(self, network: nn.Module, power: float, max_decay: float):
        super().__init__()
        self.module = deepcopy(network).requires_grad_(False).eval()
        self.power = power
        self.max_decay = max_decay
        self.n_averaged: Tensor
        self.register_buffer("n_averaged", torch.tensor(0))
        self._updates: int | None = None  # read when first needed: a distributed run sends the buffers around first

    def train(self, mode: bool = True) -> "MovingAverage":
        """The averaged network only plans: it has no dropout, whatever the policy that holds it does."""
        self.training = mode
        return self

    @property
    def updates(self) -> int:
        """The number of updates; without any, `module` is the network as it was when this was made."""
        if self._updates is None:
            self._updates = int(self.n_averaged)
        return self._updates

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Move towards the network's parameters."""
        decay = min(1 - (1 + self.updates) ** -self.power, self.max_decay)
        torch._foreach_lerp_(list(self.module.parameters()), list(network.parameters()), 1 - decay)
        self._updates = self.updates + 1
        self.n_averaged += 1

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._updates = None
