"""What the planners are trained with: Muon for the hidden matrices, AdamW for the rest or for all."""

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any

import torch
from lerobot.optim import AdamWConfig, OptimizerConfig
from lerobot.optim.optimizers import OptimizerParams
from torch import Tensor, nn
from torch.optim import Muon, Optimizer

from .precision import bfloat16_is_fast

OPTIMIZERS = ["muon", "adamw"]
"""Values of `HDPConfig.optimizer_type`."""
FOR_MUON = "for_muon"
"""Marks a group of parameters, see `parameter_groups`."""


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
        _stay_fused(optimizer, fused)
        return optimizer


@OptimizerConfig.register_subclass("muon_adamw")
@dataclass
class MuonAdamWConfig(FusedAdamWConfig):
    """Muon for the matrices between hidden layers, AdamW for everything else.

    Muon (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks") replaces the momentum of a
    matrix by the nearest orthogonal one, so that a step moves all its directions alike. Its updates are scaled to be
    as large as AdamW's are (Liu et al. 2025, "Muon is Scalable for LLM Training"), so that both have one learning rate
    and one weight decay.

    Attributes:
        momentum: of Muon.
    """

    momentum: float = 0.95

    def build(self, params: OptimizerParams) -> Optimizer:
        """Args:
            params: of `parameter_groups`.

        Raises:
            ValueError: no group is marked as Muon's.
        """
        groups = [group for group in params if isinstance(group, dict)]
        for_muon = [{"params": group["params"]} for group in groups if FOR_MUON in group]
        if not for_muon:
            raise ValueError(
                "optimizer.type=muon_adamw has to know the hidden matrices, which the policy tells with "
                "use_policy_training_preset=true; or set optimizer.type=adamw"
            )
        muon = BatchedMuon(for_muon, lr=self.lr, weight_decay=self.weight_decay, momentum=self.momentum)
        common = {field.name: getattr(self, field.name) for field in fields(FusedAdamWConfig)}
        adamw = FusedAdamWConfig(**common).build([group for group in groups if FOR_MUON not in group])
        return MuonAdamW(muon, adamw)


class BatchedMuon(Muon):
    """PyTorch's Muon with `adjust_lr_fn="match_rms_adamw"`, which updates all matrices of one shape together.

    PyTorch's updates one matrix after the other, each by dozens of small kernels, between which a GPU is idle.
    """

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Update all parameters. No closure is taken."""
        for group in self.param_groups:
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            gradients = [parameter.grad for parameter in parameters]
            for parameter in parameters:
                if not self.state[parameter]:
                    self.state[parameter]["momentum_buffer"] = torch.zeros_like(parameter.grad)
            momenta = [self.state[parameter]["momentum_buffer"] for parameter in parameters]
            torch._foreach_lerp_(momenta, gradients, 1 - group["momentum"])
            directions = torch._foreach_lerp(gradients, momenta, group["momentum"])  # Nesterov's
            torch._foreach_mul_(parameters, 1 - group["lr"] * group["weight_decay"])
            same_shape = defaultdict(list)
            for parameter, direction in zip(parameters, directions, strict=True):
                same_shape[parameter.shape].append((parameter, direction))
            for shape, pairs in same_shape.items():
                matrices, stacked = [parameter for parameter, _ in pairs], torch.stack([each for _, each in pairs])
                update = orthogonalise(stacked, group["ns_coefficients"], group["ns_steps"], group["eps"])
                lr = 0.2 * math.sqrt(max(shape)) * group["lr"]
                torch._foreach_add_(matrices, update.unbind(), alpha=-lr)


def orthogonalise(matrices: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float) -> Tensor:
    """Bring all singular values of some matrices near 1, by Newton-Schulz iterations (Jordan et al. 2024).

    In bfloat16, as PyTorch does, or in float32 where that is faster.

    Args:
        matrices: (n, rows, columns).
        coefficients: a, b, c of an iteration X <- a X + b (X X^T) X + c (X X^T)^2 X.
        steps: iterations.
        eps: the least norm that a matrix is divided by.

    Returns:
        As many matrices of this shape and type.
    """
    a, b, c = coefficients
    is_tall = matrices.shape[1] > matrices.shape[2]
    dtype = torch.bfloat16 if bfloat16_is_fast(matrices.device) else torch.float32
    x = (matrices.mT if is_tall else matrices).to(dtype)
    x = x / x.norm(dim=(1, 2), keepdim=True).clamp(min=eps)
    for _ in range(steps):
        gram = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return (x.mT if is_tall else x).to(matrices.dtype)


class MuonAdamW(Optimizer):
    """Two optimizers as one: the form in which LeRobot schedules, saves and resumes them."""

    def __init__(self, muon: Muon, adamw: Optimizer):
        super().__init__([*muon.param_groups, *adamw.param_groups], {})
        self._muon, self._adamw = muon, adamw
        _stay_fused(self, adamw.param_groups[0]["fused"])

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """Update all parameters. No closure is taken."""
        of_muon = len(self._muon.param_groups)
        for part, groups in ((self._muon, self.param_groups[:of_muon]), (self._adamw, self.param_groups[of_muon:])):
            part.param_groups, part.state = groups, self.state  # loading a state replaces both
            part.step()


def _stay_fused(optimizer: Optimizer, fused: bool) -> None:
    """A run that was stopped on another device goes on with what suits this one."""

    def set_fused(_: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
        groups = [group | {"fused": fused} if "fused" in group else group for group in state["param_groups"]]
        return state | {"param_groups": groups}

    optimizer.register_load_state_dict_pre_hook(set_fused)


def parameter_groups(
    network: nn.Module,
    hidden_matrices: Iterable[nn.Parameter],
    image_encoder: Iterable[nn.Parameter] = (),
    lr_backbone: float = 0.0,
) -> list[dict[str, Any]]:
    """Parameters of a network for an optimizer: Muon's, others with weight decay (matrices), and those without.

    Args:
        network: to be trained.
        hidden_matrices: those of its parameters that Muon is to update; AdamW updates all, if there are none.
        image_encoder: those with a learning rate of their own, `lr_backbone`, and without weight decay.
    """
    for_muon, of_images = list(hidden_matrices), list(image_encoder)
    taken = {id(parameter) for parameter in (*for_muon, *of_images)}
    others = [parameter for parameter in network.parameters() if id(parameter) not in taken]
    decay = [parameter for parameter in others if parameter.ndim == 2]
    no_decay = [parameter for parameter in others if parameter.ndim != 2]
    groups: list[dict[str, Any]] = [{"params": decay}, {"params": no_decay, "weight_decay": 0.0}]
    if for_muon:
        groups.insert(0, {"params": for_muon, FOR_MUON: True})
    if of_images:
        groups.append({"params": of_images, "weight_decay": 0.0, "lr": lr_backbone})
    return groups
