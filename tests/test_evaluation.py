"""How the benchmarks judge a motion that failed."""

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.evaluation import first_mistake
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS

SEED = 3


def demonstration(gym_id: str, **parameters) -> tuple[gym.Env, np.ndarray]:
    env = gym.make(gym_id, disable_env_checker=True, **parameters).unwrapped
    env.reset(seed=SEED)
    return env, EXPERTS[gym_id](env, expert_generator(SEED)).waypoints


TASKS = pytest.mark.parametrize(
    ("gym_id", "parameters"),
    [("hdp/BlockSorting2D-v0", {"n_blocks": 3, "waypoints_per_pose": 1}), ("hdp/XArmSorting-v0", {})],
    ids=["2d", "xarm"],
)


@TASKS
def test_a_motion_beside_the_block_misses_it(gym_id, parameters):
    env, motion = demonstration(gym_id, **parameters)
    motion[:, 1] += 0.06
    assert first_mistake(env, motion, SEED) == "missed"


@TASKS
def test_a_motion_that_holds_all_it_takes_can_only_have_misplaced_something(gym_id, parameters):
    env, motion = demonstration(gym_id, **parameters)
    carrying = np.flatnonzero(motion[:, -1] < 0.1)
    last_carry = carrying[carrying > carrying[np.flatnonzero(np.diff(carrying) > 1)[-1]]][1:]
    motion[last_carry, 1] += 0.1
    assert first_mistake(env, motion, SEED) == "misplaced"
