"""What a robot scores that stays where it is: the floor under the mean scores of docs/results.md.

    python -m benchmarks.doing_nothing

Stands still for an episode from each of some fresh starts of each task, those of `python -m benchmarks.paper`, and
writes what it measured into `benchmarks/results/doing_nothing.json`.
"""

import argparse
import json
from statistics import mean

import gymnasium as gym

from gym_hdp_tasks.env_config import HDPEnv

from .cells import FIRST_EVALUATION_SEED
from .machine import RESULTS, describe_run, write_json
from .paper.presets import ENVS, observes_images

FILE = RESULTS / "doing_nothing.json"
TASKS = [task for task, env in ENVS.items() if not observes_images(env)]


def mean_score(config: HDPEnv, starts: int) -> float:
    """The mean of the last rewards of episodes in which the tool is told to stay, and to keep its opening."""
    task = config.planning_task
    env = gym.make(task.gym_id, disable_env_checker=True, **task.parameters)
    scores = []
    for number in range(starts):
        observation, _ = env.reset(seed=FIRST_EVALUATION_SEED + number)
        rewards = [env.step(observation["agent_pos"])[1] for _ in range(task.horizon)]
        scores.append(float(rewards[-1]))
    env.close()
    return mean(scores)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--starts", type=int, default=100)
    options = parser.parse_args()
    run = describe_run()
    results = json.loads(FILE.read_text()) if FILE.exists() else {}
    for task in options.tasks:
        score = mean_score(HDPEnv(**ENVS[task]), options.starts)
        results[task] = {"run": run, "starts": options.starts, "mean_score": round(score, 4)}
        write_json(FILE, results)
        print(f"{task}: {score:.4f}", flush=True)


if __name__ == "__main__":
    main()
