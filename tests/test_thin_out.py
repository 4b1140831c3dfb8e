"""A dataset is copied at a lower frame rate, and a planner trains on it."""

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDataset

from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from dataset_tools.thin_out import thin_out
from gym_hdp_tasks.env_config import HDPEnv

from .conftest import HORIZON, run_command

IMAGE = "observation.images.front"
STARTS, STOPS = [0, 5, 10, 15], [5, 10, 15, HORIZON]
"""Frames of an episode of 19 that become one: observed at the first, acted until the last."""


@pytest.fixture
def thinned(dataset_root, tmp_path) -> LeRobotDataset:
    dataset = LeRobotDataset("test/sorting", root=dataset_root, episodes=[3, 5], video_backend="pyav")
    return thin_out(dataset, 5, "test/thinned", tmp_path / "thinned")


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
    column = "observation.symbolic_plan"
    assert thinned.meta.features[column]["info"] == dataset.meta.features[column]["info"]


def test_a_planner_trains_on_it(thinned, tmp_path):
    flags = ["--dataset.repo_id=test/thinned", f"--dataset.root={thinned.root}", "--dataset.video_backend=pyav"]
    flags += ["--policy.type=hdp", "--policy.horizon=4", "--policy.num_layers=1", "--policy.width=32"]
    flags += ["--policy.push_to_hub=false", "--batch_size=2", "--steps=1", "--env_eval_freq=0"]
    run_command("hdp-train", *flags, f"--output_dir={tmp_path / 'run'}")
    assert (tmp_path / "run/checkpoints/000001/pretrained_model/model.safetensors").exists()


@pytest.mark.parametrize("video", [True, False])
def test_cameras_are_thinned_out_too(tmp_path, video):
    env = HDPEnv(
        task="XArmArrangeBlocks-v0", obs_type="pixels", camera_names=("front",), camera_height=48, camera_width=64
    )
    config = RecordDatasetConfig("test/images", tmp_path / "images", num_episodes=1, video=video, language=True)
    dataset = record(RecordConfig(config, env))
    thinned = thin_out(dataset, dataset.meta.fps, "test/thinned", tmp_path / "thinned")
    assert thinned.meta.features[IMAGE]["dtype"] == ("video" if video else "image")
    kept = range(0, len(dataset), dataset.meta.fps)
    assert len(thinned) == len(kept)
    shown = np.stack([frame[IMAGE] for frame in dataset])
    errors = [np.abs(shown - thinned[row][IMAGE].numpy()).mean(axis=(1, 2, 3)) for row in range(len(kept))]
    assert all(error[frame] == error.min() for error, frame in zip(errors, kept, strict=True))
    assert max(error.min() for error in errors) < (0.03 if video else 1e-6)


def test_a_rate_that_does_not_divide_is_refused(dataset, tmp_path):
    with pytest.raises(ValueError, match="10 frames a second is no multiple of 3"):
        thin_out(dataset, 3, "test/thinned", tmp_path / "thinned")
    assert not (tmp_path / "thinned").exists()
