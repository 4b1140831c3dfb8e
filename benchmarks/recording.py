"""How fast `hdp-record` is, and what its time goes to.

    python -m benchmarks.recording

Records 200 sorting demonstrations without cameras and 50 with them, each by the command, start-up included, and writes
`benchmarks/results/recording.json`. A short recording in this process, one worker, says which share of the time goes to
`mj_step` and to rendering.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
from tqdm import tqdm

from dataset_tools.record import (
    EPISODES_PER_SHARD,
    RecordConfig,
    RecordDatasetConfig,
    Shard,
    record_shard,
    shard_starts,
)
from gym_hdp_tasks.env_config import HDPEnv

from .machine import RESULTS, describe_run, write_json

FILE = RESULTS / "recording.json"
TASK = "XArmSorting-v0"


class Timed:
    """A function that adds up its own time, in seconds."""

    def __init__(self, function: Callable):
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments: Any) -> Any:
        start = time.perf_counter()
        result = self.function(*arguments)
        self.seconds += time.perf_counter() - start
        return result


def time_command(obs_type: str, num_episodes: int, num_workers: int) -> dict[str, Any]:
    """Record with the command, as a user does."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "dataset_tools.record", f"--env.task={TASK}", f"--env.obs_type={obs_type}"),
            *("--dataset.repo_id=local/recording", f"--dataset.root={folder}/dataset"),
            *(f"--dataset.num_episodes={num_episodes}", f"--num_workers={num_workers}"),
        ]
        start = time.perf_counter()
        subprocess.run(command, check=True)
        seconds = time.perf_counter() - start
    return {
        "task": TASK,
        "obs_type": obs_type,
        "num_episodes": num_episodes,
        "num_workers": num_workers,
        "seconds": seconds,
        "episodes_per_second": num_episodes / seconds,
    }


def time_shares(obs_type: str, num_episodes: int) -> dict[str, float]:
    """Shares of the time of recording one shard in this process."""
    mj_step, render = mujoco.mj_step, mujoco.Renderer.render
    physics, rendering = Timed(mj_step), Timed(render)
    mujoco.mj_step, mujoco.Renderer.render = physics, lambda *arguments: rendering(*arguments)
    try:
        with tempfile.TemporaryDirectory() as folder:
            dataset = RecordDatasetConfig("local/recording", Path(folder) / "dataset", num_episodes)
            config = RecordConfig(dataset, HDPEnv(task=TASK, obs_type=obs_type))
            start = time.perf_counter()
            record_shard(config, Shard(Path(folder) / "shard", 0, num_episodes), tqdm(total=num_episodes))
            seconds = time.perf_counter() - start
    finally:
        mujoco.mj_step, mujoco.Renderer.render = mj_step, render
    return {"physics_fraction": physics.seconds / seconds, "rendering_fraction": rendering.seconds / seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_episodes", type=int, default=200, help="without cameras")
    parser.add_argument("--num_camera_episodes", type=int, default=50, help="with cameras")
    parser.add_argument("--num_workers", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    for num_episodes in (options.num_episodes, options.num_camera_episodes):
        if len(shard_starts(num_episodes)) < options.num_workers:
            parser.error(f"{num_episodes} episodes do not keep {options.num_workers} workers busy")
    result: dict[str, Any] = {"run": describe_run()}
    for obs_type, num_episodes in (("state", options.num_episodes), ("pixels_state", options.num_camera_episodes)):
        shares = time_shares(obs_type, min(num_episodes, EPISODES_PER_SHARD))
        result[obs_type] = time_command(obs_type, num_episodes, options.num_workers) | shares
        print(json.dumps(result[obs_type], indent=2), flush=True)
    write_json(FILE, result)


if __name__ == "__main__":
    main()
