"""Whether replaying a dataset's actions from its seeds gives back the recorded score, for every episode.

    python -m benchmarks.replay

Records 200 demonstrations of each X-Arm task, if they are not there yet, executes the actions again in processes of
their own, and writes `benchmarks/results/replay.json`. A finished task is not done again.
"""

import argparse
import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from dataset_tools.replay import load_recording, replay
from gym_hdp_tasks.env_config import TASKS, HDPEnv

from .machine import RESULTS, describe_run, write_json

FILE = RESULTS / "replay.json"
DATASETS = Path("outputs/benchmarks/replay")
EPISODES_PER_PART = 5
XARM_TASKS = [task for task in TASKS if task.startswith("XArm")]


def measure(task: str, num_episodes: int, num_workers: int) -> dict[str, object]:
    """Record what is not there, replay it, and compare."""
    config = RecordDatasetConfig(f"local/{task}", DATASETS / f"{task}_{num_episodes}", num_episodes)
    if config.root.exists():
        dataset = LeRobotDataset(config.repo_id, root=config.root, video_backend="pyav")
    else:
        dataset = record(RecordConfig(config, HDPEnv(task=task), num_workers=num_workers, resume=True))
    recording = load_recording(dataset)
    parts = [recording.part(start, start + EPISODES_PER_PART) for start in range(0, num_episodes, EPISODES_PER_PART)]
    with ProcessPoolExecutor(num_workers, get_context("forkserver")) as workers:
        scores = np.concatenate(list(tqdm(workers.map(replay, parts), total=len(parts), desc=f"Replaying {task}")))
    same = scores.astype(np.float32) == recording.scores  # as a dataset stores them
    return {
        "num_episodes": num_episodes,
        "same_score": int(same.sum()),
        "differing_episodes": np.flatnonzero(~same).tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=XARM_TASKS, default=XARM_TASKS)
    parser.add_argument("--num_episodes", type=int, default=200)
    parser.add_argument("--num_workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    results = json.loads(FILE.read_text()) if FILE.exists() else {}
    for task in options.tasks:
        if results.get(task, {}).get("num_episodes") == options.num_episodes:
            print(f"{task}: kept from {FILE.name}, delete it to measure again")
            continue
        run = describe_run()
        results[task] = {"run": run, **measure(task, options.num_episodes, options.num_workers)}
        write_json(FILE, results)
        print(task, json.dumps(results[task], indent=2))


if __name__ == "__main__":
    main()
