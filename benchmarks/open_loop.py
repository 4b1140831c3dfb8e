"""How fast plans are scored, and by what: processes that step the environment, or `mujoco.rollout`'s threads.

python benchmarks/open_loop.py --num_plans 100

Both ways execute the expert's plans for the same seeds; the scores must agree with stepping one environment. Bare
`mj_step` is one native call that repeats the same physics, without inverse kinematics, controls or scores.
"""

import argparse
import json
import os
import time
from pathlib import Path

import gymnasium as gym
import mujoco
import mujoco.rollout
import numpy as np

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.experts import EXPERTS
from gym_hdp_tasks.open_loop import execute_plans

RESULTS = Path(__file__).parent / "results" / "open_loop.json"
FULL_STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS


def expert_plans(gym_id: str, num_plans: int) -> np.ndarray:
    """The expert's plans for the seeds 0, 1, ...: (num_plans, horizon, 4)."""
    env = gym.make(gym_id, disable_env_checker=True)
    plans = []
    for seed in range(num_plans):
        env.reset(seed=seed)
        plans.append(EXPERTS[gym_id](env, np.random.default_rng(seed)).waypoints)
    return np.stack(plans)


def rollout_scores(gym_id: str, plans: np.ndarray, num_threads: int, batch: int = 20) -> tuple[np.ndarray, float]:
    """Scores (num_plans,) by `mujoco.rollout`, and the seconds that the rollouts alone took."""
    env = gym.make(gym_id, disable_env_checker=True).unwrapped
    threads = [mujoco.MjData(env.model) for _ in range(num_threads)]
    state = np.empty(mujoco.mj_stateSize(env.model, FULL_STATE))
    scores, rollout_time = [], 0.0
    for start in range(0, len(plans), batch):
        states, warmstarts, controls = [], [], []
        for offset, plan in enumerate(plans[start : start + batch]):
            env.reset(seed=start + offset)
            mujoco.mj_getState(env.model, env.data, state, FULL_STATE)
            states.append(state.copy())
            warmstarts.append(env.data.qacc_warmstart.copy())
            controls.append(np.concatenate([env.controls(action)[0] for action in plan]))
        before = time.perf_counter()
        trajectories, _ = mujoco.rollout.rollout(
            env.model, threads, np.array(states), np.array(controls), initial_warmstart=np.array(warmstarts)
        )
        rollout_time += time.perf_counter() - before
        for trajectory in trajectories:
            mujoco.mj_setState(env.model, env.data, trajectory[-1], FULL_STATE)
            env.update_poses()
            scores.append(env.score())
    return np.array(scores), rollout_time


def measure(gym_id: str, num_plans: int, num_workers: int) -> dict:
    """Rollouts per second by each way, and whether the scores agree."""
    plans, seeds = expert_plans(gym_id, num_plans), range(num_plans)

    start = time.perf_counter()
    stepped = np.array([outcome["score"] for outcome in execute_plans(gym_id, seeds, plans, num_workers=1)])
    stepping = time.perf_counter() - start

    start = time.perf_counter()
    by_processes = np.array([outcome["score"] for outcome in execute_plans(gym_id, seeds, plans, num_workers)])
    processes = time.perf_counter() - start

    start = time.perf_counter()
    by_rollout, _ = rollout_scores(gym_id, plans, num_workers)
    rollout = time.perf_counter() - start
    _, bare = rollout_scores(gym_id, plans, 1)

    return {
        "num_plans": num_plans,
        "num_workers": num_workers,
        "mean_score": stepped.mean(),
        "scores_agree": {
            "processes": bool((by_processes == stepped).all()),
            "mujoco.rollout": bool((by_rollout == stepped).all()),
        },
        "rollouts_per_second": {
            "one process": num_plans / stepping,
            "processes": num_plans / processes,
            "mujoco.rollout": num_plans / rollout,
            "bare mj_step, one thread": num_plans / bare,
        },
        "physics_fraction_of_stepping": bare / stepping,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_plans", type=int, default=100)
    parser.add_argument("--num_workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    results = {}
    for gym_id in ("hdp/XArmSorting-v0", "hdp/XArmArrangeBlocks-v0", "hdp/XArmToolUse-v0"):
        results[gym_id] = measure(gym_id, options.num_plans, options.num_workers)
        print(gym_id, json.dumps(results[gym_id], indent=2))
    RESULTS.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
