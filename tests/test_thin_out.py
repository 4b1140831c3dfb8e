"""A dataset is copied at a lower frame rate, and a planner trains on it."""

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset

from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from dataset_tools.thin_out import thin_out
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.scripts import hdp_train

from .conftest import HORIZON, call_command

IMAGE = "observation.images.front"
STARTS, STOPS = [0, 5, 10, 15], [5, 10, 15, HORIZON]
"""Frames of an episode of 19 that become one: observed at the first, acted until the last."""


@pytest.fixture(scope="module")
def thinned(dataset_root, tmp_path_factory) -> LeRobotDataset:
    dataset = LeRobotDataset("test/sorting", root=dataset_root, episodes=[3, 5], video_backend="pyav")
    return thin_out(dataset, 5, "test/thinned", tmp_path_factory.mktemp("datasets") / "thinned")


def test_a_frame_has_the_first_observation_and_the_last_action_of_those_it_stands_for(dataset, thinned):
    assert (dataset.meta.fps, thinned.meta.fps) == (10, 2)
    assert thinned.meta.episodes["length"] == [4, 4]
    for row, frame in enumerate(thinned):
        episode = (3, 5)[row // 4] * HORIZON
        first = dataset.hf_dataset[episode + STARTS[row % 4]]
        last = dataset.hf_dataset[episode + STOPS[row % 4] - 1]
        for name in ("observation.state", "observation.environment_state", "observation.symbolic_plan"):
            assert torch.equal(frame[name], first[name])
        for name in ("action", "next.reward", "next.success", "next.done"):
            assert torch.equal(frame[name], last[name])
        assert frame["task"] == dataset.meta.tasks.iloc[int(first["task_index"])].name
    info = dataset.meta.features["observation.symbolic_plan"]["info"]
    assert thinned.meta.features["observation.symbolic_plan"]["info"] == {"vocabulary": info["vocabulary"]}


def test_a_planner_trains_on_it(thinned, tmp_path):
    flags = ["--dataset.repo_id=test/thinned", f"--dataset.root={thinned.root}", "--dataset.video_backend=pyav"]
    flags += ["--policy.type=hdp", "--policy.horizon=4", "--policy.num_layers=1", "--policy.width=32"]
    flags += ["--policy.push_to_hub=false", "--batch_size=2", "--steps=1", "--env_eval_freq=0"]
    call_command(hdp_train.main, *flags, f"--output_dir={tmp_path / 'run'}")
    assert (tmp_path / "run/checkpoints/000001/pretrained_model/model.safetensors").exists()


def test_other_columns_are_copied_without_loss(tmp_path):
    features = {
        "action": {"dtype": "float32", "shape": (2,), "names": None},
        "clock": {"dtype": "float64", "shape": (1,), "names": None},
        "remark": {"dtype": "string", "shape": (1,), "names": None},
    }
    recorded = LeRobotDataset.create("test/other", fps=4, features=features, root=tmp_path / "recorded")
    for task, length in (("push", 3), ("pull", 4)):
        for frame in range(length):
            clock = np.array([1.7e9 + frame / 4])
            action = np.full(2, frame, np.float32)
            recorded.add_frame({"action": action, "clock": clock, "remark": f"{task} {frame}", "task": task})
        recorded.save_episode()
    recorded.finalize()
    thinned = thin_out(LeRobotDataset("test/other", recorded.root), 2, "test/thinned", tmp_path / "thinned")
    rows = thinned.hf_dataset.with_format(None)
    assert rows["remark"][:] == ["push 0", "push 2", "pull 0", "pull 2"]
    assert rows["clock"][:] == [1.7e9, 1.7e9 + 0.5] * 2
    assert [action[0] for action in rows["action"]] == [1, 2, 1, 3]
    assert [frame["task"] for frame in thinned] == ["push", "push", "pull", "pull"]


@pytest.mark.parametrize("video", [True, False])
def test_cameras_are_thinned_out_too(tmp_path, video):
    size = {"observation_height": 48, "observation_width": 64}
    env = HDPEnv(task="XArmArrangeBlocks-v0", obs_type="pixels", camera_name="front", **size)
    config = RecordDatasetConfig("test/images", tmp_path / "images", num_episodes=1, video=video, language=True)
    dataset = record(RecordConfig(config, env))
    as_in_training = LeRobotDataset(
        "test/images",
        tmp_path / "images",
        delta_timestamps={IMAGE: [0.0, 1.0], "action": [0.0, 1.0]},
        image_transforms=lambda image: 1 - image,
        return_uint8=True,
    )
    thinned = thin_out(as_in_training, dataset.meta.fps, "test/thinned", tmp_path / "thinned")
    assert thinned.meta.features[IMAGE]["dtype"] == ("video" if video else "image")
    kept = range(0, len(dataset), dataset.meta.fps)
    assert len(thinned) == len(kept)
    shown = np.stack([frame[IMAGE] for frame in dataset])
    errors = [np.abs(shown - thinned[row][IMAGE].numpy()).mean(axis=(1, 2, 3)) for row in range(len(kept))]
    loss = 0.03 if video else 1e-6
    for error, frame in zip(errors, kept, strict=True):
        assert error[frame] < min(loss, error.min() + loss / 10)
    assert max(error.max() for error in errors) > loss  # frames differ by more


@pytest.mark.parametrize("every", [3, 0, -2])
def test_a_rate_that_does_not_divide_is_refused(dataset, tmp_path, every):
    with pytest.raises(ValueError, match=f"10 frames a second is no multiple of {every}"):
        thin_out(dataset, every, "test/thinned", tmp_path / "thinned")
    assert not (tmp_path / "thinned").exists()
