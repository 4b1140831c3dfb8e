"""What the planners are trained with: AdamW, fused on a GPU, with weight decay where it belongs."""

from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams
from torch import nn
from torch.optim import Optimizer


@OptimizerConfig.register_subclass("adamw_fused")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """AdamW that can update all parameters in one kernel.

    Attributes:
        fused: whether it does; None: where they are on CUDA.
    """

    fused: bool | None = None

    def build(self, params: OptimizerParams) -> Optimizer:
        groups = list(params)
        parameters = chain.from_iterable(group["params"] if isinstance(group, dict) else [group] for group in groups)
        fused = all(parameter.is_cuda for parameter in parameters) if self.fused is None else self.fused
        optimizer = AdamWConfig.build(replace(self, fused=fused), groups)

        def keep_fused(_: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
            return state | {"param_groups": [group | {"fused": fused} for group in state["param_groups"]]}

        # A run that was stopped on another device goes on with what suits this one.
        optimizer.register_load_state_dict_pre_hook(keep_fused)
        return optimizer


def parameter_groups(network: nn.Module) -> list[dict[str, Any]]:
    """Parameters with weight decay (matrices of linear layers) and without (the rest), for an optimizer."""
    decay = [parameter for parameter in network.parameters() if parameter.ndim == 2]
    no_decay = [parameter for parameter in network.parameters() if parameter.ndim != 2]
    return [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}]
