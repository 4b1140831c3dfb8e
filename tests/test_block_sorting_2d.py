"""The 2D sorting task and its expert."""

from collections import Counter

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs.factory import make_env

import gym_hdp_tasks  # noqa: F401
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS
from dataset_tools.experts.cycle_sort import cycle_sort
from gym_hdp_tasks.block_sorting_2d import GRASP_RADIUS, SLOT_HALF_SIZE
from gym_hdp_tasks.env_config import HDPEnv

TASK_ID = "hdp/BlockSorting2D-v0"


def make(n_blocks=3, waypoints_per_pose=1, **kwargs):
    return gym.make(TASK_ID, n_blocks=n_blocks, waypoints_per_pose=waypoints_per_pose, **kwargs)


def finish(env, x=0.0, y=-0.12, opening=1.0):
    """Hold the gripper somewhere until the episode ends."""
    while True:
        _, reward, _, truncated, info = env.step(np.array([x, y, opening], np.float32))
        if truncated:
            return reward, info


def put(env, block, position):
    """Carry a block to a position and open the gripper there."""
    for target, opening in [(env.unwrapped.blocks[block], 0.0), (position, 0.0), (position, 1.0)]:
        env.step(np.array([*target, opening], np.float32))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n_blocks", [2, 3, 8])
def test_passes_gymnasiums_checker(n_blocks):
    env = make(n_blocks, render_mode="rgb_array").unwrapped
    check_env(env)
    assert env.observation_space["agent_pos"] is not env.action_space


def test_starts_are_a_function_of_the_seed():
    first, second, other = (make().reset(seed=seed)[0] for seed in (1, 1, 2))
    assert np.array_equal(first["environment_state"], second["environment_state"])
    assert not np.array_equal(first["environment_state"], other["environment_state"])


def test_never_starts_sorted_and_every_unsorted_order_occurs():
    env = make(3)
    orders = Counter()
    for seed in range(600):
        env.reset(seed=seed)
        sim = env.unwrapped
        distances = np.linalg.norm(sim.blocks[:, None] - sim.slots[None, :3], axis=-1)
        orders[tuple(distances.argmin(axis=1))] += 1
        assert sim.score() < 1
    assert len(orders) == 5
    assert min(orders.values()) > 80


@pytest.mark.parametrize("n_blocks", [2, 3, 4, 8])
@pytest.mark.parametrize("waypoints_per_pose", [1, 3])
def test_the_expert_always_succeeds_within_the_horizon(n_blocks, waypoints_per_pose):
    env = make(n_blocks, waypoints_per_pose)
    for seed in range(30):
        env.reset(seed=seed)
        demonstration = EXPERTS[TASK_ID](env, expert_generator(seed))
        for action in demonstration.waypoints[:-1]:
            _, reward, terminated, truncated, info = env.step(action)
            assert (terminated, truncated, reward, info["is_success"]) == (False, False, 0.0, False)
            assert not info["action_clipped"]
        _, reward, _, truncated, info = env.step(demonstration.waypoints[-1])
        assert truncated
        assert info["is_success"]
        assert reward == 1.0


def test_the_experts_choices_are_uniform():
    """Three ways to begin a 3-cycle: any of its blocks goes home first."""
    counts = Counter(cycle_sort([1, 2, 0], np.random.default_rng(seed))[1][0] for seed in range(3000))
    assert sorted(counts) == [0, 1, 2]
    assert all(abs(count - 1000) < 110 for count in counts.values())


def test_cycle_sort_moves_only_into_free_places():
    for seed in range(200):
        rng = np.random.default_rng(seed)
        order = rng.permutation(6).tolist()
        place_of = {block: place for place, block in enumerate(order)}
        for block, origin, destination in cycle_sort(order, rng):
            assert place_of[block] == origin
            assert destination not in place_of.values()
            place_of[block] = destination
        assert place_of == {block: block for block in range(6)}


def test_the_plan_shrinks_as_its_steps_are_done():
    env = make(2)
    env.reset(seed=0)
    demonstration = EXPERTS[TASK_ID](env, np.random.default_rng(0))
    assert len(demonstration.remaining_symbols(0)) == 18
    assert len(demonstration.remaining_symbols(6)) == 18
    assert len(demonstration.remaining_symbols(7)) == 12
    assert demonstration.remaining_symbols(19) == []


def test_the_gripper_takes_a_block_only_from_near():
    env = make(2)
    env.reset(seed=0)
    block = env.unwrapped.blocks[0].copy()
    env.step(np.array([block[0] + 1.1 * GRASP_RADIUS, block[1], 0.0], np.float32))
    assert env.unwrapped.held is None
    env.step(np.array([block[0] + 1.1 * GRASP_RADIUS, block[1], 1.0], np.float32))
    env.step(np.array([block[0] + 0.9 * GRASP_RADIUS, block[1], 0.0], np.float32))
    assert env.unwrapped.held == 0


def test_the_score_is_the_fraction_of_blocks_in_their_slots():
    env = make(3)
    env.reset(seed=0, options={"order": [1, 0, 2]})
    assert finish(env)[0] == pytest.approx(1 / 3)
    env.reset(seed=0, options={"order": [1, 2, 0]})
    assert finish(env)[0] == 0


@pytest.mark.parametrize("order", [[1, 0], np.array([1.0, 0.0])])
def test_starts_in_the_order_that_it_is_given(order):
    env = make(2).unwrapped
    env.reset(seed=0, options={"order": order})
    assert env.blocks[0, 0] > env.blocks[1, 0]
    for wrong in ([0, 0.5], None, 3):
        with pytest.raises(ValueError, match="permutation"):
            env.reset(options={"order": wrong})


@pytest.mark.parametrize(("offset", "counts"), [(0.99, True), (1.01, False)])
def test_a_block_counts_as_far_as_its_slots_edge(offset, counts):
    env = make(2)
    env.reset(seed=0)
    slots = env.unwrapped.slots
    put(env, 0, slots[2])
    put(env, 0, slots[2] + [0, 0.05])
    put(env, 1, slots[1])
    put(env, 0, slots[0] + [0, offset * SLOT_HALF_SIZE])
    reward, info = finish(env)
    assert info["is_success"] == counts
    assert reward == (1.0 if counts else 0.5)


def test_a_block_dropped_on_another_leaves_it_and_counts_as_misplaced():
    env = make(2)
    env.reset(seed=0)
    slots, blocks = env.unwrapped.slots, env.unwrapped.blocks
    before = blocks[1].copy()
    put(env, 0, blocks[1].copy())
    assert np.array_equal(env.unwrapped.blocks[1], before)
    assert env.unwrapped.collided[0]
    put(env, 1, slots[1])
    env.unwrapped.blocks[0] = slots[0]
    assert env.unwrapped.score() == 0.5


def test_a_held_block_does_not_count():
    env = make(2)
    env.reset(seed=0)
    put(env, 0, env.unwrapped.slots[2])
    put(env, 1, env.unwrapped.slots[1])
    slot = env.unwrapped.slots[0]
    env.step(np.array([*env.unwrapped.blocks[0], 0.0], np.float32))
    assert finish(env, *slot, opening=0.0)[0] == 0.5


def test_an_action_outside_the_workspace_is_clipped_and_reported():
    env = make(2)
    env.reset(seed=0)
    _, _, _, _, info = env.step(np.array([5.0, 0.0, 1.0], np.float32))
    assert info["action_clipped"]
    assert env.unwrapped.gripper[0] == pytest.approx(env.action_space.high[0])


@pytest.mark.parametrize("action", [[np.nan, 0, 1], [0, np.inf, 1], [0, 0]])
def test_a_malformed_action_is_refused(action):
    env = make(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="3 finite numbers"):
        env.step(np.array(action, np.float32))


@pytest.mark.parametrize("kwargs", [{"n_blocks": 1}, {"n_blocks": 9}, {"waypoints_per_pose": 0}])
def test_impossible_tasks_are_refused(kwargs):
    with pytest.raises(ValueError, match="must be"):
        make(**kwargs)


def test_works_in_a_vector_environment():
    env = gym.make_vec(TASK_ID, num_envs=3, vectorization_mode="sync", vector_kwargs={}, n_blocks=2)
    observation, _ = env.reset(seed=0)
    assert observation["environment_state"].shape == (3, 4)
    observation, *_ = env.step(env.action_space.sample())
    assert observation["agent_pos"].shape == (3, 3)


def test_an_episode_is_the_same_in_processes_of_its_own():
    """As `lerobot-eval` runs it by default."""
    seeds, env = [0, 1], make(2)
    plans = []
    for seed in seeds:
        env.reset(seed=seed)
        plans.append(EXPERTS[TASK_ID](env, expert_generator(seed)).waypoints)

    def episode(use_async_envs):
        config = HDPEnv(n_blocks=2, waypoints_per_pose=1)
        envs = make_env(config, len(seeds), use_async_envs=use_async_envs)["hdp"][0]
        poses, rewards = [envs.reset(seed=seeds)[0]["environment_state"].copy()], []
        for actions in np.stack(plans, axis=1):
            observation, reward, *_ = envs.step(actions)
            poses.append(observation["environment_state"].copy())
            rewards.append(reward.copy())
        envs.close()
        return np.array(poses), np.array(rewards)

    (poses, rewards), (poses_in_processes, rewards_in_processes) = episode(False), episode(True)
    assert (rewards[-1] == 1).all()
    np.testing.assert_array_equal(rewards_in_processes, rewards)
    np.testing.assert_array_equal(poses_in_processes, poses)


def test_renders_the_blocks_where_they_are():
    env = make(2, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8
    x, y = env.unwrapped.world_to_pixels(env.unwrapped.blocks[0] + [0.015, 0.015]).round().astype(int)
    assert before[y, x].tolist() == [214, 69, 65]
    put(env, 0, env.unwrapped.slots[2])
    assert env.render()[y, x].tolist() != [214, 69, 65]
