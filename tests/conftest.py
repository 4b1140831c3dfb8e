"""What several test files share: a recorded dataset, and a policy made for it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.configs.parser import get_cli_overrides  # noqa: F401 (imports LeRobot once, before the timers of pytest)
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors

import lerobot_policy_hdp  # noqa: F401 (registers the policy and the environments)
from lerobot_hdp import HDPConfig

REPOSITORY = Path(__file__).parents[1]
N_EPISODES = 30
HORIZON = 19
"""Actions in an episode of sorting two blocks with one waypoint a pose."""

TASK_FLAGS = ("--env.task=BlockSorting2D-v0", "--env.n_blocks=2", "--env.waypoints_per_pose=1")
TINY_PLANNER = {"horizon": HORIZON, "num_layers": 1, "num_heads": 2, "width": 32, "num_train_timesteps": 10}


def run_command(command: str, *arguments, check: bool = True, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """Run an installed command, as a user would, without a network."""
    executable = Path(sys.executable).with_name(command)
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "2"}
    result = subprocess.run(
        [executable, *map(str, arguments)], capture_output=True, text=True, cwd=cwd or REPOSITORY, env=environment
    )
    if check and result.returncode:
        raise AssertionError(f"{command} failed:\n{result.stdout[-2000:]}\n{result.stderr[-6000:]}")
    return result


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory) -> Path:
    """A dataset of two-block sorting, recorded by the real command."""
    root = tmp_path_factory.mktemp("datasets") / "sorting"
    run_command(
        "hdp-record",
        *TASK_FLAGS,
        "--dataset.repo_id=test/sorting",
        f"--dataset.root={root}",
        f"--dataset.num_episodes={N_EPISODES}",
    )
    return root


@pytest.fixture(scope="session")
def dataset(dataset_root) -> LeRobotDataset:
    """The same, opened as a planner trains on it."""
    delta_timestamps = {"action": [i / 10 for i in range(HORIZON)]}
    return LeRobotDataset("test/sorting", root=dataset_root, delta_timestamps=delta_timestamps, video_backend="pyav")


@pytest.fixture
def make_planner(dataset):
    """Build a tiny planner for the dataset: `make_planner(**config) -> policy, preprocessor, postprocessor`."""

    def make(**kwargs):
        config = HDPConfig(**{**TINY_PLANNER, "device": "cpu", "push_to_hub": False, **kwargs})
        torch.manual_seed(0)
        policy = make_policy(config, ds_meta=dataset.meta)
        return policy, *make_pre_post_processors(config, dataset_stats=dataset.meta.stats)

    return make


@pytest.fixture
def batch(dataset):
    """The first frames of four episodes, collated as LeRobot's data loader does."""
    items = [dataset[episode * HORIZON] for episode in range(4)]
    return torch.utils.data.default_collate(items)


@pytest.fixture
def inputs(make_planner, batch):
    """The preprocessed observations of the same."""
    _, preprocessor, _ = make_planner()
    names = ("observation.state", "observation.environment_state")
    return {name: value for name, value in preprocessor(batch).items() if name in names}
