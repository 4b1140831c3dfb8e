"""Muon and fused AdamW, through LeRobot's configs and checkpoints."""

from pathlib import Path

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig, load_optimizer_state, save_optimizer_state
from torch.optim import Optimizer

from lerobot_hdp import HDPConfig
from lerobot_hdp.optimizer import BatchedMuon, FusedAdamWConfig, MuonAdamW, MuonAdamWConfig, parameter_groups

from .conftest import TINY_PLANNER


def is_fused(optimizer: Optimizer) -> bool:
    [fused] = {group["fused"] for group in optimizer.param_groups if "fused" in group}
    return fused


def step_with_gradient(optimizer: Optimizer, parameter: torch.nn.Parameter, gradient: torch.Tensor) -> None:
    parameter.grad = gradient.clone()
    optimizer.step()
    optimizer.zero_grad()


def test_fused_training_ends_with_the_same_weights(make_planner, batch):
    weights = []
    for fused in (False, True):
        policy, preprocessor, _ = make_planner(optimizer_type="adamw", optimizer_fused=fused)
        inputs = preprocessor(batch)
        optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
        assert is_fused(optimizer) == fused
        for _ in range(10):
            policy.train().forward(inputs)[0].backward()
            optimizer.step()
            optimizer.zero_grad()
        weights.append(torch.nn.utils.parameters_to_vector(policy.planner.parameters()))
    torch.testing.assert_close(*weights, rtol=1e-4, atol=1e-5)


def test_unless_told_so_only_cuda_is_fused():
    optimizer = (
        HDPConfig(preset="paper", device="cpu").get_optimizer_preset().build([torch.nn.Parameter(torch.zeros(2))])
    )
    assert not is_fused(optimizer)


def saved_and_read(policy: HDPConfig, optimizer: AdamWConfig, folder: Path) -> TrainPipelineConfig:
    TrainPipelineConfig(DatasetConfig("local/none"), policy=policy, optimizer=optimizer).save_pretrained(folder)
    return TrainPipelineConfig.from_pretrained(folder)


@pytest.mark.parametrize("fused", [None, True, False])
@pytest.mark.parametrize(("name", "kind"), [("muon", MuonAdamWConfig), ("adamw", FusedAdamWConfig)])
def test_the_choice_is_kept_in_the_train_config(tmp_path, name, kind, fused):
    policy = HDPConfig(**TINY_PLANNER, optimizer_type=name, optimizer_fused=fused, device="cpu", push_to_hub=False)
    config = saved_and_read(policy, policy.get_optimizer_preset(), tmp_path)
    assert (config.policy.optimizer_type, config.policy.optimizer_fused) == (name, fused)
    assert config.optimizer == policy.get_optimizer_preset()
    assert type(config.optimizer) is kind


def test_a_train_config_with_plain_adamw_keeps_it(tmp_path):
    policy = HDPConfig(**TINY_PLANNER, device="cpu", push_to_hub=False)
    config = saved_and_read(policy, AdamWConfig(lr=3e-4), tmp_path)
    assert type(config.optimizer) is AdamWConfig
    assert config.optimizer.lr == 3e-4


def muon_for(matrix: torch.nn.Parameter, **options) -> MuonAdamW:
    """An optimizer of a matrix by Muon, and of a bias by AdamW."""
    network = torch.nn.ParameterDict({"matrix": matrix, "bias": torch.nn.Parameter(torch.zeros(len(matrix)))})
    config = MuonAdamWConfig(**{"lr": 0.1, "weight_decay": 0.0, **options})
    return config.build(parameter_groups(network, [matrix]))


@pytest.mark.parametrize(
    "optimizer_of", [muon_for, lambda matrix, **options: FusedAdamWConfig(**options).build([matrix])]
)
def test_a_run_that_goes_on_on_another_device_takes_what_suits_this_one(tmp_path, optimizer_of):
    parameter = torch.nn.Parameter(torch.ones(2, 2))
    there, here = (optimizer_of(parameter, fused=fused) for fused in (False, True))
    step_with_gradient(there, parameter, torch.ones(2, 2))
    save_optimizer_state(there, tmp_path)
    load_optimizer_state(here, tmp_path)
    assert is_fused(here)
    assert len(here.state[parameter]) == len(there.state[parameter])


def test_muon_moves_all_directions_of_a_matrix_alike():
    matrix = torch.nn.Parameter(torch.zeros(4, 8))
    strengths = torch.tensor([1.0, 0.1, 0.01, 0.001])
    gradient = torch.nn.init.orthogonal_(torch.empty(4, 8)).mul(strengths[:, None])
    step_with_gradient(muon_for(matrix), matrix, gradient)
    step = torch.linalg.svdvals(matrix.detach())
    assert step.max() < 3 * step.min()  # the gradient's largest singular value is 1,000 times its smallest
    assert ((matrix * gradient).sum(dim=1) < 0).all()  # downhill in each of them


def test_muon_updates_matrices_as_pytorchs_does_one_by_one():
    torch.manual_seed(0)
    shapes = [(8, 16), (16, 8), (8, 16), (8, 8)]
    gradients = [[torch.randn(shape) for shape in shapes] for _ in range(3)]
    starts = [torch.randn(shape) for shape in shapes]
    ends = []
    for kind, options in ((BatchedMuon, {}), (torch.optim.Muon, {"adjust_lr_fn": "match_rms_adamw"})):
        matrices = [torch.nn.Parameter(start.clone()) for start in starts]
        optimizer = kind(matrices, lr=0.1, weight_decay=0.1, momentum=0.9, **options)
        for gradient in gradients:
            for matrix, its_own in zip(matrices, gradient, strict=True):
                matrix.grad = its_own.clone()
            optimizer.step()
        ends.append(matrices)
    for found, expected, start in zip(*ends, starts, strict=True):
        assert (found - expected).norm() < 0.03 * (expected - start).norm()  # bfloat16 has 3 digits


def test_muons_steps_are_as_large_as_adamws():
    torch.manual_seed(0)
    matrix, gradient = torch.nn.Parameter(torch.zeros(64, 128)), torch.randn(64, 128)
    step_with_gradient(muon_for(matrix, lr=1e-3), matrix, gradient)
    # AdamW's usual size is 0.2 to 0.4 of the learning rate (Liu et al. 2025).
    assert 0.1e-3 < matrix.square().mean().sqrt() < 0.4e-3


def test_hidden_matrices_are_muons_and_all_else_is_adamws(make_planner):
    policy, *_ = make_planner(optimizer_type="muon")
    muon, *adamw = policy.get_optim_params()
    names = {id(parameter): name for name, parameter in policy.planner.named_parameters()}
    of_muon = {names.pop(id(parameter)) for parameter in muon["params"]}
    assert {"denoiser.decoder.layers.0.linear1.weight", "denoiser.decoder.layers.0.self_attn.in_proj_weight"} <= of_muon
    assert {id(parameter) for group in adamw for parameter in group["params"]} == set(names)
    assert {"denoiser.embed_motion.weight", "denoiser.motion_head.weight", "denoiser.positions"} <= set(names.values())


def test_what_was_stopped_goes_on_as_if_it_had_not_been(tmp_path):
    torch.manual_seed(0)
    gradients = torch.randn(4, 3, 5)
    whole, stopped, resumed = (torch.nn.Parameter(torch.ones(3, 5)) for _ in range(3))
    optimizer, first = muon_for(whole), muon_for(stopped)
    for gradient in gradients:
        step_with_gradient(optimizer, whole, gradient)
    for gradient in gradients[:2]:
        step_with_gradient(first, stopped, gradient)
    save_optimizer_state(first, tmp_path)
    resumed.data.copy_(stopped)
    second = load_optimizer_state(muon_for(resumed), tmp_path)
    for gradient in gradients[2:]:
        step_with_gradient(second, resumed, gradient)
    assert torch.equal(resumed, whole)
    assert not torch.equal(resumed, stopped)


def test_muon_asks_for_the_policys_parameter_groups():
    with pytest.raises(ValueError, match="use_policy_training_preset=true"):
        MuonAdamWConfig().build([torch.nn.Parameter(torch.zeros(2, 2))])
