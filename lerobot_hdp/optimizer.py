"""What the planners are trained with."""

from typing import Any

from torch import nn


def parameter_groups(network: nn.Module) -> list[dict[str, Any]]:
    """Parameters with weight decay (matrices of linear layers) and without (the rest), for an optimizer."""
    decay = [parameter for parameter in network.parameters() if parameter.ndim == 2]
    no_decay = [parameter for parameter in network.parameters() if parameter.ndim != 2]
    return [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}]
