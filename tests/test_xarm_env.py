"""What all X-Arm environments promise, in real physics."""

import copy
import os
import subprocess
import sys
from dataclasses import asdict, replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from gymnasium.utils.env_checker import check_env
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from gym_hdp_tasks import PlanningTask, env_config
from gym_hdp_tasks.env_config import HDPEnv
from gym_hdp_tasks.task import CAMERAS, OBS_TYPES
from gym_hdp_tasks.xarm_env import WORKSPACE_HIGH, WORKSPACE_LOW

IDS = (
    "hdp/XArmSorting-v0",
    "hdp/XArmArrangeBlocks-v0",
    "hdp/XArmToolUse-v0",
    "hdp/XArmToolUseRedOnTop-v0",
)
needs_menagerie = pytest.mark.skipif(
    not os.path.isdir(os.environ.get("MENAGERIE_ROOT", "")),
    reason="downloads MuJoCo Menagerie's model, unless MENAGERIE_ROOT names a folder with a copy",
)
ROBOTS = ("primitive", pytest.param("menagerie", marks=needs_menagerie))


def make(gym_id="hdp/XArmSorting-v0", **kwargs):
    return gym.make(gym_id, disable_env_checker=True, **kwargs).unwrapped


@pytest.mark.parametrize("obs_type", OBS_TYPES)
@pytest.mark.parametrize("gym_id", IDS)
def test_gymnasium_finds_nothing_wrong(gym_id, obs_type):
    env = make(gym_id, obs_type=obs_type, render_mode="rgb_array", observation_height=32, observation_width=48)
    check_env(env, skip_render_check=obs_type != "state")
    observation, _ = env.reset(seed=0)
    assert ("pixels" in observation) == (obs_type != "state")
    assert ("agent_pos" in observation) == (obs_type != "pixels")
    assert ("environment_state" in observation) == (obs_type in ("state", "pixels_state"))
    env.close()


@needs_menagerie
def test_gymnasium_finds_nothing_wrong_with_menagerie_s_robot():
    check_env(make(robot="menagerie"), skip_render_check=True)


def test_menagerie_s_model_that_cannot_be_had_is_one_clear_error(tmp_path, monkeypatch):
    monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))
    with pytest.raises(OSError, match=r"cannot load the model of robot='menagerie', .*'ufactory_xarm7' not found"):
        make(robot="menagerie")


WITHOUT_EGL = """
import ctypes, ctypes.util

find_library, load = ctypes.util.find_library, ctypes.CDLL.__init__

def load_unless_egl(self, name, *args, **kwargs):
    if "EGL" in str(name):
        raise OSError(f"{name}: cannot open shared object file")
    load(self, name, *args, **kwargs)

ctypes.util.find_library = lambda name: None if name == "EGL" else find_library(name)
ctypes.CDLL.__init__ = load_unless_egl

import gymnasium as gym
import gym_hdp_tasks

env = gym.make("hdp/XArmSorting-v0", render_mode="rgb_array")
env.reset(seed=0)
try:
    env.render()
except OSError as error:
    assert "libegl1" in str(error), error
else:
    raise AssertionError("rendered without EGL")
"""


def test_without_egl_there_are_states_and_one_clear_error_instead_of_images():
    """As in a slim container: no display, and no libEGL to be found."""
    unset = ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in unset}
    subprocess.run([sys.executable, "-c", WITHOUT_EGL], env=environment, check=True, timeout=300)


@pytest.mark.parametrize("gym_id", IDS)
def test_an_episode_depends_on_its_seed_alone(gym_id):
    env, actions = make(gym_id), np.random.default_rng(0)
    plan = actions.uniform(env.action_space.low, env.action_space.high, size=(5, 4))

    def episode(seed):
        observations = [env.reset(seed=seed)[0], *(env.step(action)[0] for action in plan)]
        return np.array([[*o["agent_pos"], *o["environment_state"]] for o in observations])

    first, other, again = episode(1), episode(2), episode(1)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize("obs_type", ["state", "pixels_state"])
def test_a_copy_goes_on_from_the_same_state_and_leaves_the_original_alone(obs_type):
    env, actions = make("hdp/XArmArrangeBlocks-v0", obs_type=obs_type), np.random.default_rng(0)
    plan = actions.uniform(env.action_space.low, env.action_space.high, size=(4, 4))
    env.reset(seed=0)
    env.step(plan[0])

    def rest_of_episode(env):
        observations = [env.step(action)[0] for action in plan[1:]]
        return np.array([[*o["agent_pos"], *o["environment_state"]] for o in observations])

    np.testing.assert_array_equal(rest_of_episode(copy.deepcopy(env)), rest_of_episode(env))


@pytest.mark.parametrize("gym_id", IDS)
def test_an_episode_lasts_its_horizon_and_pays_at_its_end(gym_id):
    """Sorting is solved from its start on, the others never."""
    env = make(gym_id)
    observation, info = env.reset(seed=0, options={"order": [0, 1, 2]})
    solved = gym_id == "hdp/XArmSorting-v0"
    assert (info["score"] == 1) == solved
    assert not info["is_success"]
    stay = observation["agent_pos"]
    horizon = env.planning_task.horizon
    steps = [env.step(stay) for _ in range(horizon)]
    assert [truncated for _, _, _, truncated, _ in steps] == [False] * (horizon - 1) + [True]
    assert [reward for _, reward, *_ in steps[:-1]] == [0] * (horizon - 1)
    assert (steps[-1][1] == 1) == solved
    assert [step_info["is_success"] for *_, step_info in steps] == [False] * (horizon - 1) + [solved]
    assert not any(terminated for _, _, terminated, _, _ in steps)
    assert set(info) == set(steps[-1][-1])
    assert gym.spec(gym_id).max_episode_steps == horizon


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(("gym_id", "stride"), [("hdp/XArmSorting-v0", 0.05), ("hdp/XArmArrangeBlocks-v0", 0.2)])
def test_the_tool_ends_a_waypoint_within_1_mm(gym_id, stride, robot):
    env, rng = make(gym_id, robot=robot), np.random.default_rng(0)
    env.reset(seed=0)
    waypoint = env.tool_position()
    for _ in range(40):
        waypoint += rng.uniform(-stride, stride, size=3)
        waypoint = np.clip(waypoint, WORKSPACE_LOW + [0.05, 0, 0.08], WORKSPACE_HIGH - [0, 0, 0.08])
        *_, info = env.step(np.array([*waypoint, 1.0]))
        assert not info["action_clipped"]
        assert np.linalg.norm(env.tool_position() - waypoint) < 0.001


@pytest.mark.parametrize(
    ("gym_id", "axis", "length", "tolerance"),
    [
        ("hdp/XArmSorting-v0", 0, 0.06, 0.003),
        ("hdp/XArmSorting-v0", 1, 0.2, 0.003),
        ("hdp/XArmArrangeBlocks-v0", 0, 0.2, 0.002),
    ],
)
def test_the_tool_moves_straight(gym_id, axis, length, tolerance):
    env = make(gym_id)
    env.reset(seed=0)
    start = np.array([0.39, 0.0, 0.12])
    start[axis] -= length / 2
    end = start.copy()
    end[axis] += length
    for _ in range(5):
        env.step(np.array([*start, 1.0]))
    controls, clipped = env.controls(np.array([*end, 1.0]))
    assert not clipped
    for control in controls:
        env.data.ctrl[:] = control
        mujoco.mj_step(env.model, env.data)
        across = np.delete(env.tool_position() - start, axis)
        assert np.linalg.norm(across) < tolerance
    assert np.linalg.norm(env.tool_position() - end) < 0.001


def test_the_whole_workspace_is_reachable():
    env = make("hdp/XArmArrangeBlocks-v0")
    for corner in np.stack(np.meshgrid(*zip(WORKSPACE_LOW, WORKSPACE_HIGH, strict=True)), axis=-1).reshape(-1, 3):
        env.reset(seed=0)
        for _ in range(3):
            env.step(np.array([*corner, 1.0]))
        assert np.linalg.norm(env.tool_position() - corner) < 0.002


def test_what_cannot_be_reached_is_clipped_and_reported():
    env = make()
    env.reset(seed=0)
    for _ in range(5):
        *_, info = env.step(np.array([2.0, 0.0, 0.2, 1.0]))
        assert info["action_clipped"]
    assert abs(env.tool_position()[0] - WORKSPACE_HIGH[0]) < 0.002


def test_a_waypoint_too_far_for_one_step_is_reported_and_reached_later():
    env = make()
    env.reset(seed=0)
    near_base = np.array([0.23, -0.3, 0.2, 1.0])
    for _ in range(5):
        env.step(near_base)
    across = near_base * [1, -1, 1, 1]
    clipped = [env.step(across)[-1]["action_clipped"] for _ in range(5)]
    assert clipped[0]
    assert not clipped[-1]
    assert np.linalg.norm(env.tool_position() - across[:3]) < 0.002


def test_after_a_move_that_was_cut_short_the_arm_goes_on_from_where_it_is():
    """Not from where it should have been: the arm would reach for the far corner around the back of its base."""
    env = make("hdp/XArmArrangeBlocks-v0")
    env.reset(seed=0)
    near, far = WORKSPACE_LOW * [1, -1, 1], WORKSPACE_HIGH
    env.step(np.array([far[0], far[1], near[2], 1.0]))
    *_, info = env.step(np.array([near[0], -near[1], near[2], 1.0]))
    assert info["action_clipped"]
    for _ in range(3):
        *_, info = env.step(np.array([*far, 1.0]))
        assert abs(env.data.joint("joint1").qpos[0]) < 1
    assert not info["action_clipped"]
    assert np.linalg.norm(env.tool_position() - far) < 0.002


def test_what_the_arm_cannot_reach_inside_the_workspace_is_reported():
    env = make("hdp/XArmArrangeBlocks-v0")
    env.action_space = gym.spaces.Box(env.action_space.low, np.float32(2))
    env.reset(seed=0)
    clipped = [env.step(np.array([0.8, 0.0, 0.2, 1.0]))[-1]["action_clipped"] for _ in range(8)]
    assert all(clipped)


@pytest.mark.parametrize(
    "parameters",
    [
        {"task": "XArmSorting-v0", "n_blocks": 7},
        {"task": "XArmToolUse-v0", "waypoints_per_pose": 1},
        {"task": "XArmSorting-v0", "fps": 99},
        {"task": "BlockSorting2D-v0", "observation_width": 64},
        {"task": "BlockSorting2D-v0", "robot": "menagerie"},
    ],
)
def test_a_parameter_that_a_task_does_not_have_is_refused(parameters):
    name = list(parameters)[-1]
    with pytest.raises(ParsingError, match=f"--env.{name} must be left out"):
        HDPEnv(**parameters)


def a_task_of_ones_own() -> PlanningTask:
    """Without an arm, and without anything to choose."""
    return replace(HDPEnv().planning_task, gym_id="hdp/Toy-v0", parameters={})


def test_a_task_has_the_parameters_that_its_facts_depend_on(monkeypatch):
    monkeypatch.setitem(env_config.TASKS, "Toy-v0", f"{__name__}:a_task_of_ones_own")
    config = HDPEnv(task="Toy-v0")
    assert (config.gym_id, config.gym_kwargs) == ("hdp/Toy-v0", {"render_mode": "rgb_array"})
    for parameter in ({"n_blocks": 4}, {"robot": "menagerie"}, {"obs_type": "pixels"}):
        with pytest.raises(ParsingError, match="Toy-v0 does not have it"):
            HDPEnv(task="Toy-v0", **parameter)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"robot": "primitve"}, r"--env.robot must be one of \('primitive', 'menagerie'\), got 'primitve'"),
        ({"obs_type": "image"}, "--env.obs_type must be one of"),
        ({"render_mode": "human"}, "--env.render_mode must be one of"),
        ({"observation_height": 64}, "--env.observation_height is of images: add --env.obs_type=pixels"),
        ({"observation_width": 0, "obs_type": "pixels"}, "must be at least 1 pixel, got 128 and 0"),
    ],
)
def test_a_value_that_no_environment_has_is_refused_before_one_is_made(parameters, message):
    with pytest.raises(ParsingError, match=message):
        HDPEnv(task="XArmSorting-v0", **parameters)


@pytest.mark.parametrize("order", [[0, 0, 1], [0, 1], 5, None, [[0, 1, 2]]])
def test_a_start_that_is_refused_leaves_the_episode_as_it_was(order):
    env = gym.make("hdp/XArmSorting-v0").unwrapped
    env.reset(seed=0)
    before = env.data.qpos.copy()
    with pytest.raises(ValueError, match=r"order must be a permutation of 0\.\.2, got"):
        env.reset(options={"order": order})
    assert np.array_equal(env.data.qpos, before)


def test_a_start_in_a_given_order():
    env = gym.make("hdp/XArmSorting-v0").unwrapped
    env.reset(seed=0, options={"order": [2, 0, 1]})
    assert np.argsort(-env.object_poses()[:, 1]).tolist() == [2, 0, 1]


@pytest.mark.parametrize("task", ["XArmSorting-v0", "BlockSorting2D-v0"])
def test_a_config_that_was_saved_loads_again(task):
    saved = asdict(HDPEnv(task=task))
    assert asdict(HDPEnv(**saved)) == saved


@pytest.mark.parametrize("action", [np.zeros(3), np.full(4, np.nan), np.array([0.4, 0, 0.1, np.inf]), np.zeros((1, 4))])
def test_an_action_that_is_no_waypoint_is_refused(action):
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="4 finite numbers"):
        env.step(action)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"obs_type": "smell"},
        {"robot": "panda"},
        {"camera_name": "side"},
        {"camera_name": ()},
        {"camera_name": ("front", "front")},
        {"observation_height": 0},
    ],
)
def test_an_argument_without_meaning_is_refused(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs)).split("_")[0]):
        make(**kwargs)


def assert_stable(env):
    assert not env.data.warning.number.any()
    assert np.isfinite(env.data.qpos).all()
    assert np.abs(env.object_poses()[:, :3]).max() < 5


@pytest.mark.parametrize(("gym_id", "num_actions"), [(IDS[0], 400), (IDS[1], 200), (IDS[2], 200)])
def test_random_actions_leave_the_simulation_stable(gym_id, num_actions):
    """Every second number of an action is at the edge of the workspace, where the ways are long."""
    env, rng = make(gym_id), np.random.default_rng(0)
    low, high = env.action_space.low, env.action_space.high
    env.reset(seed=0)
    for step in range(num_actions):
        env.step(rng.uniform(low - (high - low) / 2, high + (high - low) / 2))
        assert (env.tool_position() > WORKSPACE_LOW - 0.05).all()
        assert (env.tool_position() < WORKSPACE_HIGH + 0.05).all()
        assert abs(env.data.joint("joint1").qpos[0]) < np.pi / 2
        if step % 100 == 0:
            assert_stable(env)
            env.reset()
    assert_stable(env)


@pytest.mark.parametrize("gym_id", IDS[1:3])
def test_pressing_blocks_and_tool_into_the_table_leaves_the_simulation_stable(gym_id):
    env, rng = make(gym_id), np.random.default_rng(0)
    env.reset(seed=0)
    for step in range(150):
        target = env.object_poses()[rng.integers(len(env.object_names)), :3] + rng.normal(0, 0.01, 3)
        height = rng.choice([-1.0, 0.0, 0.02, 0.05])
        env.step(np.array([*target[:2], height, rng.integers(2)]))
        if step % 50 == 0:
            assert_stable(env)
            env.reset()
    assert_stable(env)


def test_world_to_pixels_finds_the_blocks_in_the_image():
    env = make(render_mode="rgb_array")
    env.reset(seed=3)
    image = env.render().astype(int)
    tops = env.object_poses()[:, :3] + [0, 0, 0.02]
    for (u, v), channel in zip(env.world_to_pixels(tops).round().astype(int), (0, 1, 2), strict=True):
        pixel = image[v, u]
        assert pixel.argmax() == channel, f"{pixel} at ({u}, {v})"
    env.close()


def test_cameras_have_the_size_that_was_asked_for():
    env = make(obs_type="pixels", camera_name=("wrist",), observation_height=500, observation_width=700)
    observation, _ = env.reset(seed=0)
    assert {name: image.shape for name, image in observation["pixels"].items()} == {"wrist": (500, 700, 3)}
    env.close()


@pytest.mark.parametrize("obs_type", OBS_TYPES)
@pytest.mark.parametrize("gym_id", IDS)
def test_lerobot_sees_the_features_that_the_config_announces(gym_id, obs_type):
    size = {} if obs_type == "state" else {"observation_height": 32, "observation_width": 32}
    config = HDPEnv(task=gym_id.removeprefix("hdp/"), obs_type=obs_type, **size)
    vector_env = make_env(config, n_envs=1, use_async_envs=False)["hdp"][0]
    observation, _ = vector_env.reset(seed=[0])
    batch = preprocess_observation(observation)
    announced = env_to_policy_features(config)
    announced.pop("action")
    for name, feature in announced.items():
        assert tuple(batch[name].shape) == (1, *feature.shape), name
    prompts = {"observation.symbolic_plan"} if "RedOnTop" in gym_id else set()
    assert set(batch) == set(announced) | prompts
    for name in prompts:
        assert torch.equal(batch[name][0].long(), torch.tensor(vector_env.call("plan_prompt")[0]))
    assert vector_env.call("_max_episode_steps") == (config.planning_task.horizon,)
    assert len([name for name in announced if "images" in name]) == (0 if obs_type == "state" else len(CAMERAS))
    for _ in range(2):
        *_, info = vector_env.step(vector_env.action_space.sample())
    assert info["score"].shape == (1,)
    vector_env.close()
