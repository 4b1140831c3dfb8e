"""Execute a dataset's actions again, from the seeds that it was recorded with."""

import json
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, REWARD

import gym_hdp_tasks  # noqa: F401 (registers the tasks)

from .language import SYMBOLIC_PLAN
from .record import RECORDING_PATH, episode_seed


class Recording(NamedTuple):
    """What it takes to replay episodes.

    Attributes:
        gym_id: the task.
        parameters: of the task, for `gymnasium.make`.
        seeds: of the starts of B episodes.
        plans: (B, horizon, action size) their actions.
        scores: (B,) their last rewards.
    """

    gym_id: str
    parameters: dict[str, Any]
    seeds: list[int]
    plans: np.ndarray
    scores: np.ndarray

    def part(self, start: int, stop: int) -> "Recording":
        episodes = slice(start, stop)
        return self._replace(seeds=self.seeds[episodes], plans=self.plans[episodes], scores=self.scores[episodes])


def load_recording(dataset: LeRobotDataset) -> Recording:
    """Actions and scores of a dataset that `hdp-record` wrote, or of some of its episodes, with their seeds.

    The seeds follow from `RECORDING_PATH` and from the episodes' indices.

    Raises:
        ValueError: the dataset is no recording, or episodes were added since.
    """
    path, total = dataset.root / RECORDING_PATH, dataset.meta.total_episodes
    if not path.exists():
        raise ValueError(
            f"{dataset.root} has no {RECORDING_PATH}: hdp-record did not write it, or it was edited: which seeds its "
            "episodes have is not known"
        )
    recording = json.loads(path.read_text())
    if total != recording["num_episodes"]:
        raise ValueError(
            f"{dataset.root} has {total} episodes and was recorded with {recording['num_episodes']}: which seeds they "
            "have is not known"
        )
    rows = dataset.hf_dataset.with_format("numpy")
    episodes = np.unique(rows["episode_index"][:])
    failed = recording["failed_attempts"]
    seeds = [episode_seed(recording["seed"], i, failed.get(str(i), 0)) for i in episodes.tolist()]
    plans = np.stack(rows[ACTION]).reshape(len(seeds), -1, dataset.meta.shapes[ACTION][0])
    scores = np.stack(rows[REWARD]).reshape(len(seeds), -1)[:, -1]
    info = dataset.meta.features[SYMBOLIC_PLAN]["info"]
    return Recording(info["gym_id"], info["parameters"], seeds, plans, scores)


def replay(recording: Recording) -> list[float]:
    """The scores of executing the actions again, each episode in an environment that is reset to its seed."""
    env = gym.make(recording.gym_id, disable_env_checker=True, **recording.parameters)
    scores = []
    for seed, plan in zip(recording.seeds, recording.plans, strict=True):
        env.reset(seed=seed)
        scores.append([env.step(action)[1] for action in plan][-1])
    return scores
