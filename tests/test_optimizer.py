"""Fused AdamW: the same training, through LeRobot's configs and checkpoints."""

from pathlib import Path

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import AdamWConfig, load_optimizer_state, save_optimizer_state
from torch.optim import Optimizer

from lerobot_hdp import HDPConfig
from lerobot_hdp.optimizer import FusedAdamWConfig

from .conftest import TINY_PLANNER


def is_fused(optimizer: Optimizer) -> bool:
    [fused] = {group["fused"] for group in optimizer.param_groups}
    return fused


def test_fused_training_ends_with_the_same_weights(make_planner, batch):
    weights = []
    for fused in (False, True):
        policy, preprocessor, _ = make_planner(optimizer_fused=fused)
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
    optimizer = HDPConfig(device="cpu").get_optimizer_preset().build([torch.nn.Parameter(torch.zeros(2))])
    assert not is_fused(optimizer)


def saved_and_read(policy: HDPConfig, optimizer: AdamWConfig, folder: Path) -> TrainPipelineConfig:
    TrainPipelineConfig(DatasetConfig("local/none"), policy=policy, optimizer=optimizer).save_pretrained(folder)
    return TrainPipelineConfig.from_pretrained(folder)


@pytest.mark.parametrize("fused", [None, True, False])
def test_the_choice_is_kept_in_the_train_config(tmp_path, fused):
    policy = HDPConfig(**TINY_PLANNER, optimizer_fused=fused, device="cpu", push_to_hub=False)
    config = saved_and_read(policy, policy.get_optimizer_preset(), tmp_path)
    assert config.policy.optimizer_fused == fused
    assert config.optimizer == policy.get_optimizer_preset()
    assert type(config.optimizer) is FusedAdamWConfig


def test_a_train_config_with_plain_adamw_keeps_it(tmp_path):
    policy = HDPConfig(**TINY_PLANNER, device="cpu", push_to_hub=False)
    config = saved_and_read(policy, AdamWConfig(lr=3e-4), tmp_path)
    assert type(config.optimizer) is AdamWConfig
    assert config.optimizer.lr == 3e-4


def test_a_run_that_goes_on_on_another_device_takes_what_suits_this_one(tmp_path):
    parameter = torch.nn.Parameter(torch.ones(2))
    there, here = (FusedAdamWConfig(fused=fused).build([parameter]) for fused in (False, True))
    parameter.grad = torch.ones(2)
    there.step()
    save_optimizer_state(there, tmp_path)
    load_optimizer_state(here, tmp_path)
    assert is_fused(here)
    assert here.state[parameter]["step"] == 1
