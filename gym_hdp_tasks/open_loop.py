"""Open-loop evaluation of many plans, in parallel over the cores.

The results are those of stepping the environment through each plan, because that is what every worker does: in
`benchmarks/open_loop.py` processes measure faster than `mujoco.rollout`, whose threads wait for the inverse kinematics.

Command: `python -m gym_hdp_tasks.open_loop XArmSorting-v0 plans.npz`, where `plans.npz` holds `seeds` (B,) and `plans`
(B, horizon, action size).
"""

import argparse
import json
import multiprocessing
import os
import sys
import zipfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import gymnasium as gym
import numpy as np

Outcome = dict[str, Any]
"""The `info` of an episode's last step: `score` in [0, 1], `is_success`, and what the task adds."""


def execute_plans(
    gym_id: str,
    seeds: Sequence[int],
    plans: np.ndarray,
    num_workers: int | None = None,
    **env_kwargs: Any,
) -> list[Outcome]:
    """Reset the environment to each seed and carry out the plan that belongs to it.

    Args:
        gym_id: the task, e.g. `hdp/XArmSorting-v0`.
        seeds: B of them.
        plans: (B, horizon, action size) actions, in the task's units.
        num_workers: processes; None takes as many as there are cores, 1 stays in this process.
        env_kwargs: for `gymnasium.make`.

    Returns:
        B outcomes, in the order of the seeds.

    Raises:
        ValueError: `plans` has the wrong shape or holds NaN or infinity, or `num_workers` is less than 1.
    """
    plans = np.asarray(plans)
    env = gym.make(gym_id, disable_env_checker=True, **env_kwargs)
    expected = (len(seeds), env.unwrapped.planning_task.horizon, *env.action_space.shape)  # type: ignore[attr-defined,misc]
    if plans.shape != expected:
        raise ValueError(f"{len(seeds)} plans for {gym_id} have the shape {expected}, got {plans.shape}")
    if not np.isfinite(plans).all():
        raise ValueError("a plan holds NaN or infinity")
    num_workers = num_workers if num_workers is not None else os.cpu_count() or 1
    if num_workers < 1:
        raise ValueError(f"num_workers must be at least 1, got {num_workers}")
    num_workers = min(num_workers, len(seeds))
    if num_workers <= 1:
        return [_execute(env, seed, plan) for seed, plan in zip(seeds, plans, strict=True)]

    # Processes that start fresh: a fork would copy the locks of a trainer's threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(num_workers, context, _start_worker, (gym_id, env_kwargs)) as workers:
        return list(workers.map(_execute_in_worker, map(int, seeds), plans, chunksize=4))


def _execute(env: gym.Env, seed: int, plan: np.ndarray) -> Outcome:
    env.reset(seed=int(seed))
    for action in plan:
        *_, info = env.step(action)
    return info


_worker_env: gym.Env
"""The environment of a worker process."""


def _start_worker(gym_id: str, env_kwargs: dict[str, Any]) -> None:
    import gym_hdp_tasks  # noqa: F401 (registers the tasks)

    global _worker_env
    _worker_env = gym.make(gym_id, disable_env_checker=True, **env_kwargs)


def _execute_in_worker(seed: int, plan: np.ndarray) -> Outcome:
    return _execute(_worker_env, seed, plan)


def main() -> None:
    """Print the outcomes of a file of plans as one JSON object."""
    parser = argparse.ArgumentParser(description="Score a batch of plans in parallel.")
    parser.add_argument("task", help="e.g. XArmSorting-v0")
    parser.add_argument("plans", help="an .npz file with `seeds` (B,) and `plans` (B, horizon, action size)")
    parser.add_argument("--num_workers", type=int, help="processes; all cores when not given")
    options = parser.parse_args()
    try:
        with np.load(options.plans, allow_pickle=False) as file:
            seeds, plans = file["seeds"], file["plans"]
        outcomes = execute_plans(f"hdp/{options.task}", seeds, plans, options.num_workers)
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, gym.error.Error) as error:
        sys.exit(f"open_loop: {error}")
    scores = [outcome["score"] for outcome in outcomes]
    success = [outcome["is_success"] for outcome in outcomes]
    print(json.dumps({"mean_score": np.mean(scores), "success_rate": np.mean(success), "scores": scores}))


if __name__ == "__main__":
    main()
