"""Plans of a checkpoint, and what comes of them: what the benchmarks share that evaluate trained planners."""

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector.utils import concatenate, create_empty_array
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import preprocess_observation
from lerobot.policies import PreTrainedPolicy, get_policy_class, make_pre_post_processors

import lerobot_policy_hdp  # noqa: F401 (registers the policies and the tasks)
from gym_hdp_tasks.block_sorting_2d import CLOSED_BELOW, block_name
from gym_hdp_tasks.open_loop import execute_plans
from gym_hdp_tasks.xarm_env import XArmEnv
from lerobot_hdp import PlanPrompt

BATCH = 50
"""Plans that are made at once."""
MISTAKES = ("missed", "lost", "misplaced")
"""How a motion fails: the gripper closes on nothing; what it holds slips out; or it takes or sets down something in a
wrong place."""
GRIPS_BELOW, EMPTY_BELOW = 0.1, 0.15
"""A gripper of the X-Arm that is told to close to less than the first, and closes to less than the second, holds
nothing."""
Outcome = dict[str, Any]
"""`is_success`, and what else is known of an executed plan."""


@dataclass
class Subject:
    """A planner, and the starts that it plans for.

    Attributes:
        path: of its checkpoint.
        policy, postprocessor: the planner.
        gym_id, parameters: what makes its task.
        seeds: of the starts.
        observations: as the environment gives them.
        inputs: the same, preprocessed.
    """

    path: Path
    policy: Any
    postprocessor: Any
    gym_id: str
    parameters: dict[str, Any]
    seeds: range
    observations: list[dict[str, np.ndarray]]
    inputs: dict[str, torch.Tensor]

    def make_env(self) -> gym.Env:
        return gym.make(self.gym_id, disable_env_checker=True, **self.parameters)

    def facts(self) -> dict[str, Any]:
        """What a results file says about it."""
        train = json.loads((self.path / "train_config.json").read_text())
        steps = self.policy.config.num_inference_steps or self.policy.config.num_train_timesteps
        return {
            "planner": self.policy.config.type,
            "task": self.gym_id.removeprefix("hdp/"),
            "parameters": self.parameters,
            "train_steps": train["steps"],
            "train_seed": train["seed"],
            "network_calls_per_plan": steps,
            "starts": len(self.seeds),
        }


class Plans(NamedTuple):
    """A plan for each start.

    Attributes:
        motions: (starts, horizon, D) in the task's units.
        symbols: the symbolic plans in words; empty ones from a planner that models none.
    """

    motions: np.ndarray
    symbols: list[list[str]]


def load_policy(path: Path, **options: Any) -> tuple[PreTrainedPolicy, Any, Any]:
    """A checkpoint's policy, preprocessor and postprocessor.

    Args:
        path: a `pretrained_model` folder.
        options: fields of the policy's configuration to be set otherwise; None leaves a field as it is.
    """
    config = PreTrainedConfig.from_pretrained(path)
    for name, value in options.items():
        if value is not None:
            setattr(config, name, value)
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    device = {"device_processor": {"device": config.device}}
    return policy, *make_pre_post_processors(config, str(path), preprocessor_overrides=device)


def load(path: Path, starts: int, gym_id: str | None = None, first_seed: int = 0, **options: Any) -> Subject:
    """Load a checkpoint and reset its task (or another one) to some seeds.

    Args:
        path: a `pretrained_model` folder.
        starts: number of seeds. Demonstrations were recorded from seeds of 32 random bits.
        gym_id: a task with the parameters of the one that the checkpoint was trained for.
        first_seed: the others follow it.
        options: see `load_policy`.
    """
    policy, preprocessor, postprocessor = load_policy(path, **options)
    env_config = TrainPipelineConfig.from_pretrained(path).env.with_poses()
    task = env_config.planning_task
    gym_id = gym_id or task.gym_id
    env = gym.make(gym_id, disable_env_checker=True, **env_config.gym_kwargs)
    seeds = range(first_seed, first_seed + starts)
    observations = [env.reset(seed=seed)[0] for seed in seeds]
    space = env.observation_space
    stacked = preprocess_observation(concatenate(space, observations, create_empty_array(space, starts)))
    env.close()
    inputs = {key: value for key, value in preprocessor(stacked).items() if key in policy.config.input_features}
    return Subject(path, policy, postprocessor, gym_id, task.parameters, seeds, observations, inputs)


def make_plans(subject: Subject, prompts: Sequence[str] | torch.Tensor | None = None) -> Plans:
    """A plan for each start, with its prompt, if any.

    Args:
        subject: the planner and the starts.
        prompts: one for each start, as words or as token ids (starts, H_d).
    """
    torch.manual_seed(0)
    motions, symbols = [], []
    for first in range(0, len(subject.seeds), BATCH):
        part = slice(first, first + BATCH)
        prompt = None if prompts is None else prompts[part]
        if isinstance(prompt, torch.Tensor):
            prompt = PlanPrompt(token_ids=prompt.to(subject.policy.config.device))
        plan = subject.policy.plan({key: value[part] for key, value in subject.inputs.items()}, prompt)
        motions.append(subject.postprocessor(plan.actions))
        symbols += [plan.symbols(index) for index in range(len(plan.actions))]
    return Plans(torch.cat(motions).numpy(), symbols)


def execute(subject: Subject, motions: np.ndarray, seeds: Sequence[int]) -> list[Outcome]:
    """Carry plans out; in the plane, say which block the gripper took first."""
    if "XArm" in subject.gym_id:
        return execute_plans(subject.gym_id, seeds, motions, **subject.parameters)
    env, outcomes = subject.make_env(), []
    for seed, motion in zip(seeds, motions, strict=True):
        env.reset(seed=seed)
        first_block = None
        for action in motion:
            *_, info = env.step(action)
            if first_block is None and env.unwrapped.held is not None:
                first_block = block_name(env.unwrapped.held)
        outcomes.append({**info, "first_block": first_block})
    return outcomes


def first_mistake(env: gym.Env, motion: np.ndarray, seed: int) -> str:
    """What goes wrong first in a motion that fails, one of `MISTAKES`."""
    env = env.unwrapped
    env.reset(seed=seed)
    on_arm, held = isinstance(env, XArmEnv), False
    for action in motion:
        env.step(action)
        if action[-1] >= (GRIPS_BELOW if on_arm else CLOSED_BELOW):
            held = False
            continue
        empty = env.gripper_opening() < EMPTY_BELOW if on_arm else env.held is None
        if empty:
            return "lost" if held else "missed"
        held = True
    return "misplaced"


def rate(hits: Sequence[bool]) -> dict[str, Any]:
    """How often, with its 95 % interval (Wilson)."""
    hits = [bool(hit) for hit in hits]
    if not hits:
        return {"rate": None, "of": 0}
    return {"rate": round(np.mean(hits), 4), "interval_95": wilson_interval(sum(hits), len(hits)), "of": len(hits)}


def evaluate(path: Path, starts: int, first_seed: int, **options: Any) -> dict[str, Any]:
    """How well a checkpoint does: success with its 95 % interval, and mean score.

    Of the failures of a planner with symbols also how many had a valid symbolic plan, and how these failed.

    Args:
        path: a `pretrained_model` folder.
        starts: fresh starts of the task that it was trained for.
        first_seed: of the starts.
        options: see `load_policy`.
    """
    subject = load(path, starts, first_seed=first_seed, **options)
    plans = make_plans(subject)
    outcomes = execute(subject, plans.motions, subject.seeds)
    success = rate([outcome["is_success"] for outcome in outcomes])
    result = {
        "success_rate": success["rate"],
        "interval_95": success["interval_95"],
        "mean_score": round(np.mean([outcome["score"] for outcome in outcomes]), 4),
    }
    if subject.policy.symbol_process is not None:
        env = subject.make_env()
        check = env.unwrapped.planning_task.check_plan
        valid = [not check(*pair) for pair in zip(plans.symbols, subject.observations, strict=True)]
        failed = [index for index, outcome in enumerate(outcomes) if not outcome["is_success"]]
        of_motion = [index for index in failed if valid[index]]
        mistakes = Counter(first_mistake(env, plans.motions[index], subject.seeds[index]) for index in of_motion)
        result |= {"valid_plans": sum(valid), "failures": len(failed), "failures_with_valid_plan": len(of_motion)}
        result["first_mistakes"] = {mistake: mistakes[mistake] for mistake in MISTAKES}
    return result


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a success rate (Wilson 1927)."""
    z, rate = 1.96, successes / trials
    centre = rate + z * z / (2 * trials)
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return tuple(round((centre + sign * spread) / (1 + z * z / trials), 4) for sign in (-1, 1))
