"""Starts, vocabularies and scores of the X-Arm tasks; the objects are put where a plan may leave them."""

import gymnasium as gym
import numpy as np
import pytest

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from gym_hdp_tasks import xarm_arrange_blocks, xarm_sorting, xarm_tool_use
from gym_hdp_tasks.env_config import HDPEnv
from gym_hdp_tasks.scene import BLOCK_HALF_SIZE
from gym_hdp_tasks.xarm_env import WORKSPACE_HIGH

ON_TABLE = BLOCK_HALF_SIZE
BLOCK_SIZE = 2 * BLOCK_HALF_SIZE
FAR = {"RED": (0.7, 0.3), "GREEN": (0.7, 0.4), "BLUE": (0.7, 0.5), "A": (0.7, 0.3), "B": (0.7, 0.4), "C": (0.7, 0.5)}
MILLIMETRE = 0.001


def scored(gym_id, places):
    """The score and the info after each named block was put at (x, y, z), and the others out of the way."""
    env = gym.make(gym_id, disable_env_checker=True).unwrapped
    env.reset(seed=0)
    for name in env.object_names[:3]:
        env.set_object_pose(name, places.get(name, (*FAR[name], ON_TABLE)))
    env.update_poses()
    return env.score(), env.end_episode(clipped=False)


@pytest.mark.parametrize(
    ("task", "horizon", "symbolic_horizon", "vocabulary"),
    [
        ("XArmSorting-v0", 145, 36, "PAD A B C PICK PLACE S1 S2 S3 AUX"),
        ("XArmArrangeBlocks-v0", 25, 15, "PAD A B C PICK PLACE S1 S2 S3"),
        ("XArmToolUse-v0", 61, 15, "PAD RED GREEN BLUE DRAG STACK"),
        ("XArmToolUseRedOnTop-v0", 61, 15, "PAD RED GREEN BLUE DRAG STACK"),
    ],
)
def test_sizes_are_the_papers(task, horizon, symbolic_horizon, vocabulary):
    facts = HDPEnv(task=task).planning_task
    assert (facts.horizon, facts.symbolic_horizon) == (horizon, symbolic_horizon)
    assert facts.vocabulary == tuple(vocabulary.split())
    assert len(facts.action_names) == 4
    env = gym.make(facts.gym_id, disable_env_checker=True, **facts.parameters).unwrapped
    assert env.planning_task == facts
    assert hash(env.planning_task) == hash(facts)
    observation, _ = env.reset(seed=0)
    assert observation["environment_state"].shape == (len(facts.environment_state_names),)
    assert observation["agent_pos"].shape == (len(facts.state_names),)


# Sorting


def test_sorting_starts_unsorted_with_a_block_in_each_of_the_three_slots():
    env = gym.make("hdp/XArmSorting-v0", disable_env_checker=True).unwrapped
    orders = set()
    for seed in range(60):
        env.reset(seed=seed)
        offsets = np.abs(env.object_poses()[:, None, :2] - xarm_sorting.SLOT_CENTRES).max(axis=2)
        order = offsets.argmin(axis=1)
        assert sorted(order) == [0, 1, 2]
        assert offsets.min(axis=1).max() <= xarm_sorting.START_OFFSET
        orders.add(tuple(order))
    assert len(orders) == 5
    assert (0, 1, 2) not in orders


def test_sorting_takes_the_order_that_it_is_given():
    env = gym.make("hdp/XArmSorting-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"order": [0, 1, 2]})
    assert env.score() == 1.0
    env.reset(seed=0, options={"order": np.array([0.0, 1.0, 2.0])})
    assert env.score() == 1.0
    with pytest.raises(ValueError, match="permutation"):
        env.reset(options={"order": [0, 0, 1]})


@pytest.mark.parametrize(("distance", "score"), [(-MILLIMETRE, 1 / 3), (MILLIMETRE, 0.0)])
def test_sorting_counts_a_block_on_the_rim_by_its_centre(distance, score):
    x, y = xarm_sorting.SLOT_CENTRES[0]
    rim = (x + xarm_sorting.SLOT_HALF_SIZE + distance, y, ON_TABLE)
    assert scored("hdp/XArmSorting-v0", {"A": rim})[0] == score


def test_sorting_does_not_count_a_block_in_the_slot_of_another():
    x, y = xarm_sorting.SLOT_CENTRES[1]
    places = {"A": (x, y - 0.025, ON_TABLE), "B": (x, y + 0.025, ON_TABLE)}
    assert scored("hdp/XArmSorting-v0", places)[0] == 1 / 3


def test_sorting_counts_only_the_lower_block_of_a_stack():
    x, y = xarm_sorting.SLOT_CENTRES[0]
    places = {"B": (x, y, ON_TABLE), "A": (x, y, ON_TABLE + BLOCK_SIZE)}
    assert scored("hdp/XArmSorting-v0", places)[0] == 0.0


def test_a_block_between_the_fingers_is_not_placed():
    env = gym.make("hdp/XArmSorting-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0, options={"order": [0, 1, 2]})
    grasp = np.array([*env.object_poses()[0, :3], 1.0])
    for waypoint in (grasp + [0, 0, 0.1, 0], grasp, grasp, grasp - [0, 0, 0, 1], grasp - [0, 0, 0, 1]):
        env.step(waypoint)
    assert env.score() == 2 / 3
    env.step(grasp)
    env.step(grasp)
    assert env.score() == 1.0


# Arrange blocks


def test_arrange_blocks_starts_where_the_gripper_can_take_each_block():
    env = gym.make("hdp/XArmArrangeBlocks-v0", disable_env_checker=True).unwrapped
    for seed in range(100):
        env.reset(seed=seed)
        positions = env.object_poses()[:, :2]
        assert (positions >= xarm_arrange_blocks.START_LOW).all()
        assert (positions <= xarm_arrange_blocks.START_HIGH).all()
        for i in range(3):
            assert xarm_arrange_blocks.clear(positions[i], np.delete(positions, i, axis=0))


def test_arrange_blocks_counts_slots_whichever_block_they_hold():
    slots = xarm_arrange_blocks.SLOT_CENTRES
    places = {name: (*slots[slot], ON_TABLE) for name, slot in (("A", 2), ("B", 0), ("C", 1))}
    assert scored("hdp/XArmArrangeBlocks-v0", places)[0] == 1.0


def test_arrange_blocks_counts_a_slot_with_two_blocks_once():
    x, y = xarm_arrange_blocks.SLOT_CENTRES[0]
    places = {"A": (x, y - 0.025, ON_TABLE), "B": (x, y + 0.025, ON_TABLE)}
    assert scored("hdp/XArmArrangeBlocks-v0", places)[0] == 1 / 3
    stacked = {"A": (x, y, ON_TABLE), "B": (x, y, ON_TABLE + BLOCK_SIZE)}
    assert scored("hdp/XArmArrangeBlocks-v0", stacked)[0] == 1 / 3


@pytest.mark.parametrize(("distance", "score"), [(-MILLIMETRE, 1 / 3), (MILLIMETRE, 0.0)])
def test_arrange_blocks_counts_a_block_on_the_rim_by_its_centre(distance, score):
    x, y = xarm_arrange_blocks.SLOT_CENTRES[2]
    rim = (x, y - xarm_arrange_blocks.SLOT_HALF_SIZE - distance, ON_TABLE)
    assert scored("hdp/XArmArrangeBlocks-v0", {"C": rim})[0] == score


# Tool use


def tower(*names, shift=0.0):
    x, y = xarm_tool_use.TARGET
    return {name: (x, y + shift * level, ON_TABLE + level * BLOCK_SIZE) for level, name in enumerate(names)}


@pytest.mark.parametrize("height", [0, 1, 2, 3])
def test_tool_use_pays_a_third_for_each_block_of_the_stack(height):
    names = ("GREEN", "RED", "BLUE")[:height]
    score, info = scored("hdp/XArmToolUse-v0", tower(*names))
    assert score == height / 3
    assert info["all_stacked"] == (height == 3)
    assert info["top_block"] == (names[-1] if names else None)


def test_two_blocks_side_by_side_on_the_target_are_a_stack_of_one():
    x, y = xarm_tool_use.TARGET
    places = {"RED": (x, y - 0.025, ON_TABLE), "BLUE": (x, y + 0.025, ON_TABLE)}
    assert scored("hdp/XArmToolUse-v0", places)[0] == 1 / 3


def test_a_stack_beside_the_target_counts_nothing():
    beside = {name: (x + 0.1, y, z) for name, (x, y, z) in tower("RED", "GREEN", "BLUE").items()}
    assert scored("hdp/XArmToolUse-v0", beside)[0] == 0.0


def test_a_leaning_tower_counts_as_far_as_each_block_carries_the_next():
    assert scored("hdp/XArmToolUse-v0", tower("RED", "GREEN", "BLUE", shift=0.019))[0] == 1.0
    assert scored("hdp/XArmToolUse-v0", tower("RED", "GREEN", "BLUE", shift=0.021))[0] == 1 / 3


def test_red_on_top_pays_for_all_three_with_red_on_top_alone():
    gym_id = "hdp/XArmToolUseRedOnTop-v0"
    score, info = scored(gym_id, tower("GREEN", "BLUE", "RED"))
    assert (score, info["all_stacked"], info["top_block"]) == (1.0, True, "RED")
    score, info = scored(gym_id, tower("RED", "BLUE", "GREEN"))
    assert (score, info["all_stacked"], info["top_block"]) == (0.0, True, "GREEN")
    score, info = scored(gym_id, tower("BLUE", "RED"))
    assert (score, info["all_stacked"], info["top_block"]) == (0.0, False, "RED")


def test_red_on_top_prompts_for_the_end_of_the_plan():
    env = gym.make("hdp/XArmToolUseRedOnTop-v0", disable_env_checker=True).unwrapped
    prompt = env.reset(seed=0)[0]["symbolic_plan"]
    words = [env.planning_task.vocabulary[token] if token >= 0 else "open" for token in prompt]
    assert prompt.dtype == np.int64
    assert words == ["open"] * 10 + ["STACK", "RED"] + ["PAD"] * 3


def test_without_the_hook_no_block_can_be_moved():
    env, rng = gym.make("hdp/XArmToolUse-v0", disable_env_checker=True).unwrapped, np.random.default_rng(0)
    for seed in range(3):
        env.reset(seed=seed)
        env.set_object_pose("hook", (-1.0, 0.0, ON_TABLE))
        start = env.object_poses()[:3]
        for _ in range(30):
            # As far forward as an action can ask for, at every y, from above the blocks to below the table.
            *_, info = env.step(np.array([1.0, rng.uniform(-0.4, 0.4), rng.uniform(-0.1, 0.1), rng.integers(2)]))
            assert info["action_clipped"]
        np.testing.assert_allclose(env.object_poses()[:3], start, atol=MILLIMETRE)
        assert env.score() == 0.0
    assert min(xarm_tool_use.BLOCK_START_X) - BLOCK_HALF_SIZE - WORKSPACE_HIGH[0] > 0.1
