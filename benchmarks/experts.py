"""How often the experts succeed by the environments' own scores, what they choose, and how fast.

python -m benchmarks.experts --num_episodes 1000

Writes one JSON file for each task to `benchmarks/results/`; a task whose file is there with as many episodes is not run
again, without `--overwrite`. `physics_fraction` is the share of the time of resets,
experts and steps together that is spent inside `mj_step`.
"""

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import gymnasium as gym
import mujoco
from tqdm import trange

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS

from .machine import RESULTS, describe_run, write_json

XARM_TASKS = [gym_id for gym_id in EXPERTS if "XArm" in gym_id]


class TimedPhysics:
    """Replaces `mujoco.mj_step` by one that counts calls and adds up their time, in seconds."""

    def __init__(self):
        self.seconds, self.steps = 0.0, 0
        self._mj_step = mujoco.mj_step

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        start = time.perf_counter()
        self._mj_step(model, data)
        self.seconds += time.perf_counter() - start
        self.steps += 1


def measure(gym_id: str, num_episodes: int, robot: str) -> dict:
    """Let the expert demonstrate the seeds 0, 1, ... and count."""
    env = gym.make(gym_id, robot=robot, disable_env_checker=True)
    mj_step = mujoco.mj_step
    mujoco.mj_step = physics = TimedPhysics()
    failures, clipped, plans = {}, 0, Counter()
    start = time.perf_counter()
    for seed in trange(num_episodes, desc=gym_id, mininterval=10):
        env.reset(seed=seed)
        demonstration = EXPERTS[gym_id](env, expert_generator(seed))
        for action in demonstration.waypoints:
            _, score, _, _, info = env.step(action)
            clipped += info["action_clipped"]
        plans[" ".join(demonstration.remaining_symbols(0))] += 1
        if not info["is_success"]:
            failures[seed] = score
    seconds = time.perf_counter() - start
    mujoco.mj_step = mj_step
    return {
        "task": gym_id,
        "robot": robot,
        "num_episodes": num_episodes,
        "success_rate": 1 - len(failures) / num_episodes,
        "failures": failures,
        "clipped_actions": clipped,
        "episodes_per_second": num_episodes / seconds,
        "physics_fraction": physics.seconds / seconds,
        "physics_steps_per_second": physics.steps / physics.seconds,
        "plans": dict(sorted(plans.items())),
    }


def is_finished(path: Path, num_episodes: int) -> bool:
    """Whether a results file holds that many episodes, and says where they come from."""
    result = json.loads(path.read_text()) if path.exists() else {}
    return "run" in result and result["num_episodes"] == num_episodes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_episodes", type=int, default=1000)
    parser.add_argument("--tasks", nargs="+", choices=XARM_TASKS, default=XARM_TASKS)
    parser.add_argument("--robot", default="primitive")
    parser.add_argument("--overwrite", action="store_true", help="measure finished tasks again")
    options = parser.parse_args()
    for gym_id in options.tasks:
        name = gym_id.removeprefix("hdp/").removesuffix("-v0")
        suffix = "" if options.robot == "primitive" else f"_{options.robot}"
        path = RESULTS / f"expert_{name}{suffix}.json"
        if is_finished(path, options.num_episodes) and not options.overwrite:
            print(f"{gym_id}: kept {path.name}")
            continue
        run = describe_run()
        result = {"run": run, **measure(gym_id, options.num_episodes, options.robot)}
        print(json.dumps(result, indent=2), flush=True)
        write_json(path, result)


if __name__ == "__main__":
    main()
