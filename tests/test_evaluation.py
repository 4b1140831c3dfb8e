"""How the benchmarks judge a motion that failed, and how sure they are of a rate."""

import gymnasium as gym
import numpy as np
import pytest

from benchmarks.evaluation import first_mistake, wilson_interval
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


def test_what_slips_out_of_the_gripper_is_lost():
    env, motion = demonstration("hdp/XArmSorting-v0")
    for pad in ("left_pad", "right_pad"):
        env.model.geom(pad).friction[:] = 0.01
    assert first_mistake(env, motion, SEED) == "lost"


def test_the_interval_of_a_rate_is_wilsons():
    assert wilson_interval(200, 200) == (0.9812, 1.0)
    assert wilson_interval(82, 100) == (0.7333, 0.883)
