"""How fast plans are scored: by `execute_plans`, by processes that step the environment, and by stepping one.

python -m benchmarks.open_loop --num_plans 100

All execute the same plans for the same seeds, and their scores must agree. Processes count their start, as every batch
of plans would. Bare physics is the `mj_step`s alone, in native calls: no inverse kinematics, no scores.
"""

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import gymnasium as gym
import numpy as np

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS
from gym_hdp_tasks import open_loop
from gym_hdp_tasks.open_loop import execute_plans

from .machine import RESULTS, describe_run, write_json

FILE = RESULTS / "open_loop.json"
SHAKE = 0.02
"""Standard deviation of what is added to half of the plans, in metres and in opening."""


def expert_plans(gym_id: str, num_plans: int) -> np.ndarray:
    """The expert's plans for the seeds 0, 1, ...: (num_plans, horizon, 4)."""
    env = gym.make(gym_id, disable_env_checker=True)
    plans = []
    for seed in range(num_plans):
        env.reset(seed=seed)
        plans.append(EXPERTS[gym_id](env, expert_generator(seed)).waypoints)
    return np.stack(plans)


def step_through(gym_id: str, seeds: Sequence[int], plans: np.ndarray) -> list[float]:
    """Scores by stepping one environment."""
    env, scores = gym.make(gym_id, disable_env_checker=True), []
    for seed, plan in zip(seeds, plans, strict=True):
        env.reset(seed=seed)
        scores.append([env.step(action)[1] for action in plan][-1])
    return scores


def bare_physics(gym_id: str, seeds: Sequence[int], plans: np.ndarray) -> float:
    """Seconds that one thread needs for the physics of the plans alone, in native calls."""
    env = gym.make(gym_id, disable_env_checker=True).unwrapped
    seconds = 0.0
    for seed, plan in zip(seeds, plans, strict=True):
        batch = open_loop._prepare(env, [seed], plan[None])
        start = time.perf_counter()
        open_loop._simulate(env.model, [env.data], batch)
        seconds += time.perf_counter() - start
    return seconds


def by_processes(gym_id: str, seeds: Sequence[int], plans: np.ndarray, num_workers: int) -> list[float]:
    """Scores by processes that step an environment each, a share of the plans for each."""
    shares = np.array_split(np.arange(len(seeds)), num_workers)
    with ProcessPoolExecutor(num_workers, multiprocessing.get_context("spawn")) as workers:
        jobs = [workers.submit(step_through, gym_id, share.tolist(), plans[share]) for share in shares]
        return [score for job in jobs for score in job.result()]


def measure(gym_id: str, num_plans: int, num_cores: int) -> dict:
    """Plans per second by each way, and whether the scores agree."""
    plans, seeds = expert_plans(gym_id, num_plans), range(num_plans)
    # Every second plan is shaken, so that there are failures to agree on.
    plans[1::2] += np.random.default_rng(0).normal(0, SHAKE, plans[1::2].shape).astype(np.float32)
    ways = {
        "execute_plans": lambda: [outcome["score"] for outcome in execute_plans(gym_id, seeds, plans, num_cores)],
        "processes": lambda: by_processes(gym_id, seeds, plans, num_cores),
        "one process": lambda: step_through(gym_id, seeds, plans),
    }
    scores, seconds = {}, {}
    for name, way in ways.items():
        start = time.perf_counter()
        scores[name] = way()
        seconds[name] = time.perf_counter() - start
    bare = bare_physics(gym_id, seeds, plans)
    return {
        "num_plans": num_plans,
        "num_cores": num_cores,
        "mean_score": float(np.mean(scores["one process"])),
        "scores_agree": all(other == scores["one process"] for other in scores.values()),
        "plans_per_second": {name: num_plans / time_taken for name, time_taken in seconds.items()},
        "bare_physics_plans_per_second_per_thread": num_plans / bare,
        "physics_fraction_of_one_process": bare / seconds["one process"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_plans", type=int, default=100)
    parser.add_argument("--num_cores", type=int, default=os.cpu_count())
    options = parser.parse_args()
    results = {}
    for gym_id in ("hdp/XArmSorting-v0", "hdp/XArmArrangeBlocks-v0", "hdp/XArmToolUse-v0"):
        run = describe_run()
        results[gym_id] = {"run": run, **measure(gym_id, options.num_plans, options.num_cores)}
        print(gym_id, json.dumps(results[gym_id], indent=2))
    write_json(FILE, results)


if __name__ == "__main__":
    main()
