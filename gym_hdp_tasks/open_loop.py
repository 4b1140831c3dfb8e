"""Open-loop evaluation of many plans, in parallel over the cores, with the outcomes of stepping the environment.

The actuator controls of a plan follow from its waypoints alone. So native threads (`mujoco.rollout`) run the physics of
some plans while the inverse kinematics of the next ones is solved.

Command: `python -m gym_hdp_tasks.open_loop XArmSorting-v0 plans.npz`, where `plans.npz` holds `seeds` (B,) and `plans`
(B, horizon, action size).
"""

import argparse
import json
import os
import sys
import zipfile
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import gymnasium as gym
import mujoco
import mujoco.rollout
import numpy as np

from .xarm_env import XArmEnv

Outcome = dict[str, Any]
"""The `info` of an episode's last step: `score` in [0, 1], `is_success`, and what the task adds."""

PLANS_PER_THREAD = 2
"""In one batch. A batch keeps its whole trajectories in memory, about 10 MB for each plan."""
FULL_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


class Batch(NamedTuple):
    """Plans that are ready for physics, b of them, with n physics steps each.

    Attributes:
        states: (b, state size) full physics states after reset.
        warmstarts: (b, nv) where the solver starts.
        controls: (b, n, nu) actuator controls.
        clipped: b times whether the last action was clipped.
    """

    states: np.ndarray
    warmstarts: np.ndarray
    controls: np.ndarray
    clipped: list[bool]


def execute_plans(
    gym_id: str, seeds: Sequence[int], plans: np.ndarray, num_threads: int | None = None, **env_kwargs: Any
) -> list[Outcome]:
    """Reset the environment to each seed and carry out the plan that belongs to it.

    Args:
        gym_id: an X-Arm task, e.g. `hdp/XArmSorting-v0`.
        seeds: B of them.
        plans: (B, horizon, 4) actions, in the task's units.
        num_threads: for physics; None takes as many as there are cores.
        env_kwargs: for `gymnasium.make`.

    Returns:
        B outcomes, in the order of the seeds.

    Raises:
        ValueError: `gym_id` is no X-Arm task, `plans` has the wrong shape or holds NaN or infinity, or `num_threads`
            is less than 1.
    """
    env, plans = gym.make(gym_id, disable_env_checker=True, **env_kwargs).unwrapped, np.asarray(plans)
    if not isinstance(env, XArmEnv):
        raise ValueError(f"{gym_id} is no X-Arm task")
    expected = (len(seeds), env.planning_task.horizon, *env.action_space.shape)
    if plans.shape != expected:
        raise ValueError(f"{len(seeds)} plans for {gym_id} have the shape {expected}, got {plans.shape}")
    if not np.isfinite(plans).all():
        raise ValueError("a plan holds NaN or infinity")
    num_threads = num_threads if num_threads is not None else os.cpu_count() or 1
    if num_threads < 1:
        raise ValueError(f"num_threads must be at least 1, got {num_threads}")

    datas = [mujoco.MjData(env.model) for _ in range(num_threads)]
    outcomes: list[Outcome] = []
    with ThreadPoolExecutor(max_workers=1) as background:
        running: tuple[Batch, Future] | None = None
        size = PLANS_PER_THREAD * num_threads
        for start in range(0, len(seeds), size):
            batch = _prepare(env, seeds[start : start + size], plans[start : start + size])
            if running:
                outcomes += _outcomes(env, *running)
            running = batch, background.submit(_simulate, env.model, datas, batch)
        if running:
            outcomes += _outcomes(env, *running)
    return outcomes


def _prepare(env: XArmEnv, seeds: Sequence[int], plans: np.ndarray) -> Batch:
    """Reset to each seed and turn its plan into controls."""
    states, warmstarts, controls, clipped = [], [], [], []
    for seed, plan in zip(seeds, plans, strict=True):
        env.reset(seed=int(seed))
        states.append(np.empty(mujoco.mj_stateSize(env.model, FULL_STATE)))
        mujoco.mj_getState(env.model, env.data, states[-1], FULL_STATE)
        warmstarts.append(env.data.qacc_warmstart.copy())
        steps = [env.controls(action) for action in plan]
        controls.append(np.concatenate([step_controls for step_controls, _ in steps]))
        clipped.append(steps[-1][1])
    return Batch(np.array(states), np.array(warmstarts), np.array(controls), clipped)


def _simulate(model: mujoco.MjModel, datas: list[mujoco.MjData], batch: Batch) -> np.ndarray:
    """Run the physics in one thread for each of `datas`: (b, state size) final states."""
    trajectories, _ = mujoco.rollout.rollout(
        model, datas, batch.states, batch.controls, initial_warmstart=batch.warmstarts
    )
    return trajectories[:, -1].copy()


def _outcomes(env: XArmEnv, batch: Batch, final_states: Future) -> list[Outcome]:
    """Wait for the physics of a batch and let the environment judge where it ended."""
    outcomes = []
    for state, clipped in zip(final_states.result(), batch.clipped, strict=True):
        mujoco.mj_setState(env.model, env.data, state, FULL_STATE)
        outcomes.append(env.end_episode(clipped))
    return outcomes


def main() -> None:
    """Print the scores of a file of plans as one JSON object."""
    parser = argparse.ArgumentParser(description="Score a batch of plans in parallel.")
    parser.add_argument("task", help="e.g. XArmSorting-v0")
    parser.add_argument("plans", help="an .npz file with `seeds` (B,) and `plans` (B, horizon, 4)")
    parser.add_argument("--num_threads", type=int, help="as many as there are cores when not given")
    options = parser.parse_args()
    try:
        file = np.load(options.plans, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise ValueError(f"{options.plans} is one array, not an .npz file with `seeds` and `plans`")
        with file:
            seeds, plans = file["seeds"], file["plans"]
        if seeds.ndim != 1 or not len(seeds) or not np.issubdtype(seeds.dtype, np.integer):
            raise ValueError(f"`seeds` must be (B,) integers, at least one, got {seeds.shape} {seeds.dtype}")
        outcomes = execute_plans(f"hdp/{options.task}", seeds.tolist(), plans, options.num_threads)
    except (OSError, zipfile.BadZipFile, KeyError, ValueError, gym.error.Error) as error:
        sys.exit(f"open_loop: {error}")
    scores = [outcome["score"] for outcome in outcomes]
    success = [outcome["is_success"] for outcome in outcomes]
    print(json.dumps({"mean_score": np.mean(scores), "success_rate": np.mean(success), "scores": scores}))


if __name__ == "__main__":
    main()
