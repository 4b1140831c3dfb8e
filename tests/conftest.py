"""What several test files share: a recorded dataset, and a policy made for it."""

import contextlib
import functools
import inspect
import io
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
import torch
from accelerate.state import AcceleratorState
from draccus.wrappers import docstring
from huggingface_hub import constants
from lerobot.configs import PreTrainedConfig
from lerobot.configs.parser import get_cli_overrides  # noqa: F401 (imports LeRobot once, before the timers of pytest)
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts import lerobot_train

import lerobot_policy_hdp  # noqa: F401 (registers the policy and the environments)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import sort_blocks_2d
from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp import HDPConfig
from lerobot_hdp.denoiser import Denoiser
from lerobot_hdp.modeling_hdp import HDPPolicy

# draccus reads the sources of all configurations anew, for the texts of --help, whenever a command parses its flags.
docstring._contains_attribute_definition = functools.cache(docstring._contains_attribute_definition)
torch.set_num_threads(1)  # as in the commands that tests run: weights are compared
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore Ctrl-C, which tests send

REPOSITORY = Path(__file__).parents[1]
N_EPISODES = 30
HORIZON = 19
"""Actions in an episode of sorting two blocks with one waypoint a pose."""

TASK_FLAGS = ("--env.task=BlockSorting2D-v0", "--env.n_blocks=2", "--env.waypoints_per_pose=1")
TINY_PLANNER = {"horizon": HORIZON, "num_layers": 1, "num_heads": 2, "width": 32, "num_train_timesteps": 10}
TINY_PLANNER |= {"optimizer_lr": 3e-3}

DIFFUSION_FLAGS = ("--policy.type=diffusion", "--policy.down_dims=[16,32]", "--policy.use_group_norm=true")
DIFFUSION_FLAGS += ("--policy.pretrained_backbone_weights=null",)
"""LeRobot's diffusion policy, small, with a backbone that is not downloaded."""


def run_command(command: str, *arguments, check: bool = True, cwd: Path | None = None) -> subprocess.CompletedProcess:
    """Run an installed command, as a user would, without a network; one that hangs is an error."""
    executable = Path(sys.executable).with_name(command)
    result = subprocess.run(
        [executable, *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=cwd or REPOSITORY,
        env={**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"},
        timeout=300,
        check=False,
    )
    if check and result.returncode:
        raise AssertionError(f"{command} failed:\n{result.stdout[-2000:]}\n{result.stderr[-6000:]}")
    return result


def call_command(main: Callable[[], None], *arguments) -> str:
    """Call a command in this process, which saves its start, without a network; what it wrote to stderr.

    What it leaves behind is undone: LeRobot's logging, and the names that `hdp-train` replaces in LeRobot's module.
    """
    stderr = io.StringIO()
    with (
        mock.patch.object(sys, "argv", [main.__module__, *map(str, arguments)]),
        mock.patch.object(constants, "HF_HUB_OFFLINE", True),
        mock.patch.object(logging.getLogger(), "handlers", []),
        mock.patch.dict(vars(lerobot_train)),
        contextlib.redirect_stderr(stderr),
    ):
        main()
    return stderr.getvalue()


@pytest.fixture(scope="session")
def dataset_root(tmp_path_factory) -> Path:
    """A dataset of two-block sorting."""
    root = tmp_path_factory.mktemp("datasets") / "sorting"
    env = HDPEnv(task="BlockSorting2D-v0", n_blocks=2, waypoints_per_pose=1)
    record(RecordConfig(RecordDatasetConfig("test/sorting", root, N_EPISODES), env))
    return root


@pytest.fixture(scope="session")
def dataset(dataset_root) -> LeRobotDataset:
    """The same, opened as a planner trains on it."""
    delta_timestamps = {"action": [i / 10 for i in range(HORIZON)]}
    return LeRobotDataset("test/sorting", root=dataset_root, delta_timestamps=delta_timestamps, video_backend="pyav")


@pytest.fixture
def make_planner(dataset):
    """Build a tiny planner for the dataset: `make_planner(type, **config) -> policy, preprocessor, postprocessor`."""

    def make(policy_type="hdp", **kwargs):
        config_class = PreTrainedConfig.get_choice_class(policy_type)
        config = config_class(**{**TINY_PLANNER, "device": "cpu", "push_to_hub": False, **kwargs})
        torch.manual_seed(0)
        policy = make_policy(config, ds_meta=dataset.meta)
        return policy, *make_pre_post_processors(config, dataset_stats=dataset.meta.stats)

    return make


@pytest.fixture
def batch(dataset):
    """The first frames of four episodes, collated as LeRobot's data loader does."""
    items = [dataset[episode * HORIZON] for episode in range(4)]
    return torch.utils.data.default_collate(items)


@pytest.fixture(scope="session")
def training_batch(dataset):
    """Training samples of four episodes, in the windows that a policy asks LeRobot for: `training_batch(policy)`."""
    batches = {}

    def load(policy):
        windows = resolve_delta_timestamps(policy.config, dataset.meta)
        if (asked := repr(windows)) not in batches:
            windowed = LeRobotDataset("test/sorting", root=dataset.root, delta_timestamps=windows, video_backend="pyav")
            batches[asked] = torch.utils.data.default_collate([windowed[episode * HORIZON] for episode in range(4)])
        return {key: value.clone() if torch.is_tensor(value) else value for key, value in batches[asked].items()}

    return load


def observation(batch: dict) -> dict:
    """What is observed, of a batch."""
    return {key: value for key, value in batch.items() if key in ("observation.state", "observation.environment_state")}


@pytest.fixture
def inputs(make_planner, batch):
    """The preprocessed observations of the same."""
    _, preprocessor, _ = make_planner()
    return observation(preprocessor(batch))


def calls_of_network(policy: HDPPolicy) -> list[dict[str, torch.Tensor]]:
    """The arguments, by name, of each call of the policy's denoisers from now on."""
    calls, signature = [], inspect.signature(Denoiser.forward)

    def note(denoiser, args, kwargs):
        calls.append(signature.bind(denoiser, *args, **kwargs).arguments)

    for module in policy.modules():
        if isinstance(module, Denoiser):
            module.register_forward_pre_hook(note, with_kwargs=True)
    return calls


def train_in_process(policy, inputs, steps: int) -> list[dict[str, float]]:
    """Optimise on one preprocessed batch; the parts of the loss at each step."""
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    history = []
    policy.train()
    for _ in range(steps):
        loss, parts = policy.forward(inputs)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        history.append(parts)
    return history


@pytest.fixture
def accelerate_begins_anew():
    """Before and after a test that computes in another precision: Accelerate keeps a process' first one."""
    AcceleratorState._reset_state(reset_partial_state=True)
    yield
    AcceleratorState._reset_state(reset_partial_state=True)


@pytest.fixture(autouse=True)
def fixed_seed():
    torch.manual_seed(0)


class Demonstrations(NamedTuple):
    """Starts, and what the expert does there: n observations, actions in metres, and plans in words."""

    observations: list[dict[str, np.ndarray]]
    batch: dict[str, torch.Tensor]
    plans: list[list[str]]


class Trained(NamedTuple):
    """A planner that can do its task, and demonstrations that it has not seen, of the environment's seeds 0, 1, ..."""

    policy: HDPPolicy
    postprocessor: object
    env: gym.Env
    unseen: Demonstrations
    inputs: dict[str, torch.Tensor]
    """The preprocessed observations of the unseen demonstrations, ..."""
    actions: torch.Tensor
    """... and their normalised actions."""


SYMBOLIC_HORIZON = 20
"""Of the trained planner: two more than a plan has, so that plans end in PAD."""


def demonstrate(env: gym.Env, seeds) -> Demonstrations:
    """Let the expert demonstrate from each seed."""
    observations, actions, plans = [], [], []
    for seed in seeds:
        observations.append(env.reset(seed=seed)[0])
        demonstration = sort_blocks_2d(env, expert_generator(seed))
        actions.append(demonstration.waypoints)
        plans.append(demonstration.remaining_symbols(0))
    batch = {
        "observation.state": torch.tensor(np.stack([o["agent_pos"] for o in observations])),
        "observation.environment_state": torch.tensor(np.stack([o["environment_state"] for o in observations])),
        "action": torch.tensor(np.stack(actions)),
    }
    return Demonstrations(observations, batch, plans)


@pytest.fixture(scope="session")
def trained(dataset) -> Trained:
    """Two-block sorting, learned in half a minute: a small planner, the whole data set in memory."""
    env = gym.make("hdp/BlockSorting2D-v0", n_blocks=2, waypoints_per_pose=1, disable_env_checker=True)
    seen, unseen = demonstrate(env, range(1000, 1400)), demonstrate(env, range(40))
    small = {"horizon": HORIZON, "symbolic_horizon": SYMBOLIC_HORIZON, "num_layers": 2, "width": 64}
    config = HDPConfig(**small, num_train_timesteps=50, ema_max_decay=0.99, device="cpu", push_to_hub=False)
    torch.manual_seed(0)
    policy = make_policy(config, ds_meta=dataset.meta)
    rows = {key: value.flatten(0, -2) for key, value in seen.batch.items()}
    stats = {key: {"min": value.min(dim=0).values, "max": value.max(dim=0).values} for key, value in rows.items()}
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=stats)

    tokens = torch.stack([policy.vocabulary.encode(plan, SYMBOLIC_HORIZON) for plan in seen.plans])
    data = preprocessor({**seen.batch, "observation.symbolic_plan": tokens})
    keys, steps, peak_lr = [*seen.batch, "observation.symbolic_plan"], 300, 3e-3
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, peak_lr, steps, pct_start=0.1, cycle_momentum=False)
    policy.train()
    for _ in range(steps):
        chosen = torch.randint(len(tokens), (48,))
        policy.forward({key: data[key][chosen] for key in keys})[0].backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        schedule.step()
        policy.update()
    policy.eval()
    policy.config.num_inference_steps = 20

    inputs = preprocessor(unseen.batch)
    observed = {key: inputs[key] for key in config.input_features}
    return Trained(policy, postprocessor, env, unseen, observed, inputs["action"])
