"""`hdp-record` with cameras and with LeRobot's language columns, read back by LeRobot itself."""

import itertools
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from draccus.utils import ParsingError
from lerobot.datasets.dataset_tools import remove_feature
from lerobot.datasets.language_render import active_at
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.utils import env_to_policy_features
from lerobot.scripts import lerobot_train
from lerobot.utils.feature_utils import dataset_to_policy_features
from safetensors.torch import load_file

from dataset_tools import record as recorder
from dataset_tools.demonstration import PlanStep, expert_generator
from dataset_tools.experts import EXPERTS
from dataset_tools.language import plans_of_subtasks, write_language_columns
from dataset_tools.record import RecordConfig, RecordDatasetConfig, episode_seed, record
from dataset_tools.replay import load_recording, replay
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.scripts import hdp_train

from .conftest import DIFFUSION_FLAGS, call_command

SORTING = HDPEnv(task="XArmSorting-v0", obs_type="pixels_state", observation_height=40, observation_width=48)
ARRANGE = HDPEnv(task="XArmArrangeBlocks-v0", obs_type="pixels_state", observation_height=40, observation_width=48)
IMAGES = ("observation.images.front", "observation.images.wrist")
N_EPISODES = 2


def config(root: Path, env: HDPEnv = SORTING, num_episodes: int = N_EPISODES, num_workers: int = 1, **kwargs):
    dataset = RecordDatasetConfig(repo_id="test/cameras", root=root, num_episodes=num_episodes, **kwargs)
    return RecordConfig(dataset=dataset, env=env, num_workers=num_workers)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> LeRobotDataset:
    """Two sorting demonstrations with videos and language columns."""
    return record(config(tmp_path_factory.mktemp("datasets") / "cameras", language=True))


def episode_of(dataset: LeRobotDataset, index: int) -> list[dict]:
    episode = dataset.meta.episodes[index]
    return [dataset[row] for row in range(episode["dataset_from_index"], episode["dataset_to_index"])]


def test_a_policy_finds_the_columns_of_the_environment_under_its_own_names(dataset):
    recorded = dataset_to_policy_features(dataset.meta.features)
    for name, feature in env_to_policy_features(SORTING).items():
        assert tuple(recorded[name].shape) == tuple(feature.shape), name
        assert recorded[name].type == feature.type, name


def test_a_video_shows_what_the_environment_showed(dataset):
    env = gym.make(SORTING.gym_id, disable_env_checker=True, **SORTING.gym_kwargs)
    for index in range(N_EPISODES):
        observation, _ = env.reset(seed=episode_seed(0, index))
        frames, observations = episode_of(dataset, index)[:24], []
        for frame in frames:
            np.testing.assert_allclose(frame["observation.state"], observation["agent_pos"], atol=1e-6)
            observations.append(observation)
            observation, *_ = env.step(frame["action"].numpy())
        for name in IMAGES:
            # Every fourth, so that the arm has moved by more than the codec loses.
            recorded = np.stack([frame[name].numpy() for frame in frames[::4]])
            shown = np.stack([shown["pixels"][name.rsplit(".", 1)[1]] for shown in observations[::4]])
            errors = np.abs(recorded[:, None] - shown.transpose(0, 3, 1, 2)[None] / 255).mean(axis=(2, 3, 4))
            assert errors.argmin(axis=1).tolist() == list(range(len(recorded)))
            assert errors.diagonal().max() < 0.03
    env.close()


def test_images_can_be_kept_without_loss(tmp_path):
    pixels = HDPEnv(task=ARRANGE.task, obs_type="pixels_agent_pos", observation_height=40, observation_width=48)
    dataset = record(config(tmp_path / "images", pixels, num_episodes=1, video=False))
    assert {"observation.state", "observation.environment_state"} & set(dataset.features) == {"observation.state"}
    env = gym.make(pixels.gym_id, disable_env_checker=True, **pixels.gym_kwargs)
    observation, _ = env.reset(seed=episode_seed(0, 0))
    for name in IMAGES:
        shown = observation["pixels"][name.rsplit(".", 1)[1]].transpose(2, 0, 1)
        np.testing.assert_array_equal((dataset[0][name].numpy() * 255).round(), shown)
    env.close()


def test_neither_the_number_of_processes_nor_an_interruption_changes_a_frame(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder, "FEWEST_SHARDS", 2)
    whole = record(config(tmp_path / "two_processes", ARRANGE, num_episodes=4, num_workers=2))

    expert, calls = EXPERTS[ARRANGE.gym_id], itertools.count()

    def interrupted(env, rng):
        if next(calls) == 1:
            raise KeyboardInterrupt
        return expert(env, rng)

    monkeypatch.setitem(EXPERTS, ARRANGE.gym_id, interrupted)
    settings = config(tmp_path / "interrupted", ARRANGE, num_episodes=4)
    with pytest.raises(KeyboardInterrupt):
        record(settings)
    monkeypatch.setitem(EXPERTS, ARRANGE.gym_id, expert)
    settings.resume = True
    resumed = record(settings)
    assert len(whole) == len(resumed) == 4 * ARRANGE.planning_task.horizon
    for one, other in zip(whole, resumed, strict=True):
        assert one.keys() == other.keys()
        for key in (*IMAGES, "action", "observation.state", "episode_index", "timestamp"):
            np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def test_replaying_the_actions_from_the_seed_gives_the_recorded_score(dataset):
    recording = load_recording(dataset)
    assert replay(recording) == recording.scores.tolist() == [1.0] * dataset.num_episodes
    never_open = recording._replace(plans=recording.plans * [1, 1, 1, 0])
    assert max(replay(never_open)) < 1.0


@pytest.fixture(scope="module")
def expert_steps() -> list[list[PlanStep]]:
    """What the expert does in the episodes of `dataset`."""
    env = gym.make(SORTING.gym_id, disable_env_checker=True)
    plans = []
    for index in range(N_EPISODES):
        seed = episode_seed(0, index)
        env.reset(seed=seed)
        plans.append(list(EXPERTS[SORTING.gym_id](env, expert_generator(seed)).steps))
    return plans


def test_language_columns_say_which_step_is_being_done(dataset, expert_steps):
    for index, steps in enumerate(expert_steps):
        for number, frame in enumerate(episode_of(dataset, index)):
            left = [" ".join(step.symbols) for step in steps if step.stop > number] or ["done"]
            rows, time = frame["language_persistent"], frame["timestamp"].item()
            assert active_at(time, persistent=rows, style="subtask")["content"] == left[0]
            plan = active_at(time, persistent=rows, style="plan")["content"]
            assert [line.split(". ")[-1] for line in plan.splitlines()] == left
            assert frame["language_events"] == []
    with pytest.raises(ValueError, match="already"):
        write_language_columns(str(dataset.root), SORTING.planning_task.vocabulary)


def test_plans_are_made_of_subtasks(dataset, expert_steps):
    texts = {" ".join(step.symbols) for steps in expert_steps for step in steps}
    words = {text: text for text in texts}
    assert plans_of_subtasks(dataset, {**words, "done": ""}) == expert_steps
    only_the_second = LeRobotDataset(dataset.repo_id, dataset.root, episodes=[1])
    assert plans_of_subtasks(only_the_second, {**words, "done": ""}) == expert_steps[1:]

    waits = plans_of_subtasks(dataset, {**words, "done": "WAIT"})
    horizon = dataset.meta.episodes["length"][0]
    assert waits == [[*steps, PlanStep(("WAIT",), horizon)] for steps in expert_steps]

    with pytest.raises(ValueError, match=r"there are none for 'done' \(2\)"):
        plans_of_subtasks(dataset, words)


def test_a_dataset_without_subtasks_says_so(tmp_path):
    without = record(config(tmp_path / "without", HDPEnv(task=ARRANGE.task), num_episodes=1))
    with pytest.raises(ValueError, match="test/cameras has no column language_persistent: annotate it"):
        plans_of_subtasks(without, {})
    bare = remove_feature(without, "observation.symbolic_plan", output_dir=tmp_path / "bare", repo_id="test/bare")
    with pytest.raises(ValueError, match=r"has no column observation\.symbolic_plan: add_symbolic_plans makes one"):
        write_language_columns(bare.root, ["PAD", "PICK"])


def test_cameras_that_a_task_cannot_have_are_refused():
    with pytest.raises(ParsingError, match="does not have it"):
        HDPEnv(task="BlockSorting2D-v0", obs_type="pixels")
    for name in ("side", "front,front", "front,side", ""):
        with pytest.raises(ParsingError, match=r"camera_name must be one of .*, or several, as front,wrist; got"):
            HDPEnv(task="XArmSorting-v0", obs_type="pixels", camera_name=name)
    with pytest.raises(ParsingError, match=r"add --env.obs_type=pixels"):
        HDPEnv(task="XArmSorting-v0", camera_name="front")


PLANNER_FLAGS = ("--policy.type=hdp", "--policy.horizon=145", "--policy.num_layers=1", "--policy.width=32")


@pytest.mark.parametrize(
    ("script", "policy_flags"),
    [
        (lerobot_train, (*DIFFUSION_FLAGS, "--policy.horizon=16", "--policy.n_action_steps=8")),
        (hdp_train, PLANNER_FLAGS),
        (hdp_train, (*PLANNER_FLAGS, "--max_memory_gib=0", "--num_workers=1")),
    ],
    ids=["diffusion", "hdp", "hdp, read by a worker"],
)
def test_lerobot_trains_its_own_diffusion_policy_on_it_and_hdp_train_the_planner(
    dataset, tmp_path, script, policy_flags
):
    log = call_command(
        script.main,
        "--num_workers=0",
        *policy_flags,
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--dataset.repo_id=test/cameras",
        f"--dataset.root={dataset.root}",
        "--dataset.video_backend=pyav",
        f"--output_dir={tmp_path / 'run'}",
        "--batch_size=2",
        "--steps=2",
        "--log_freq=1",
    )
    assert "step:2" in log
    weights = load_file(tmp_path / "run/checkpoints/last/pretrained_model/model.safetensors")
    assert any("backbone" in name for name in weights)
