"""The experts solve their tasks with physics, and their choices are those that they should have."""

import gymnasium as gym
import numpy as np
import pytest

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS
from dataset_tools.experts.xarm_arrange_blocks import possible_moves
from gym_hdp_tasks.xarm_arrange_blocks import SLOT_CENTRES

from .test_xarm_env import IDS, ROBOTS


def demonstrate(gym_id, seed, **kwargs):
    env = gym.make(gym_id, disable_env_checker=True, **kwargs).unwrapped
    env.reset(seed=seed)
    return env, EXPERTS[gym_id](env, expert_generator(seed))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("gym_id", IDS)
def test_the_expert_succeeds(gym_id, robot):
    for seed in range(3):
        env, demonstration = demonstrate(gym_id, seed, robot=robot)
        for action in demonstration.waypoints:
            _, reward, _, truncated, info = env.step(action)
            assert not info["action_clipped"]
        assert truncated
        assert reward == 1.0
        assert info["is_success"]


def test_nothing_but_friction_holds_a_block():
    env, demonstration = demonstrate("hdp/XArmArrangeBlocks-v0", 0)
    for pad in ("left_pad", "right_pad"):
        env.model.geom(pad).friction[:] = 0.01
    highest = 0.0
    for action in demonstration.waypoints:
        env.step(action)
        highest = max(highest, env.object_poses()[:, 2].max())
    assert highest < 0.05
    assert env.score() < 1.0


def test_a_block_on_the_stack_counts_when_it_is_let_go_and_the_hook_is_held_to_drag():
    env, demonstration = demonstrate("hdp/XArmToolUse-v0", 0)
    scores, holds_hook = [], []
    for action in demonstration.waypoints:
        env.step(action)
        scores.append(env.score())
        holds_hook.append(env.touched_by_robot("hook"))
    assert not holds_hook[0]
    assert all(holds_hook[demonstration.steps[0].stop : demonstration.steps[1].stop])
    assert not any(holds_hook[demonstration.steps[2].stop :])
    last_held = np.flatnonzero(demonstration.waypoints[:, 3] < 1)[-1]
    assert scores[last_held] == 2 / 3
    assert scores[-1] == 1.0


@pytest.mark.parametrize("gym_id", IDS)
def test_a_demonstration_fits_the_task_and_starts_where_the_tool_is(gym_id):
    for seed in range(10):
        env, demonstration = demonstrate(gym_id, seed)
        task = env.planning_task
        assert demonstration.waypoints.shape == (task.horizon, 4)
        np.testing.assert_allclose(demonstration.waypoints[0, :3], env.tool_position(), atol=1e-6)
        symbols = demonstration.remaining_symbols(0)
        assert set(symbols) <= set(task.vocabulary)
        assert len(symbols) <= task.symbolic_horizon
        stops = [step.stop for step in demonstration.steps]
        assert stops == sorted(stops)
        assert stops[-1] <= task.horizon


@pytest.mark.parametrize(
    ("gym_id", "n_plans"),
    # 3 exchanges in 2 first moves each and 2 rotations in 3 x 2; all matchings and orders; both orders; red is last.
    [(IDS[0], 18), (IDS[1], 36), (IDS[2], 36), (IDS[3], 12)],
)
def test_every_plan_that_could_be_chosen_is_chosen(gym_id, n_plans):
    env = gym.make(gym_id, disable_env_checker=True).unwrapped
    plans = set()
    for seed in range(500):
        env.reset(seed=seed)
        plans.add(tuple(EXPERTS[gym_id](env, expert_generator(seed)).remaining_symbols(0)))
    assert len(plans) == n_plans


def test_no_block_is_placed_where_another_lies():
    in_first_slot, *away = SLOT_CENTRES[0], (0.3, 0.0), (0.3, -0.2)
    moves = possible_moves(np.array([in_first_slot, *away]))
    assert moves
    for plan in moves:
        first_slot_filled = next(i for i, (_, slot) in enumerate(plan) if slot == 0)
        block_moved = next(i for i, (block, _) in enumerate(plan) if block == 0)
        assert block_moved <= first_slot_filled


def test_blocks_can_always_be_arranged():
    rng = np.random.default_rng(0)
    env = gym.make("hdp/XArmArrangeBlocks-v0", disable_env_checker=True).unwrapped
    for _ in range(300):
        env.reset(seed=int(rng.integers(2**31)))
        assert possible_moves(env.object_poses()[:, :2])
