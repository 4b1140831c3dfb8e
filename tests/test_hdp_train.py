"""`hdp-train`: the same samples as LeRobot reads, the same training as `lerobot-train` does, from memory."""

import json
import re
import shutil
import sys
import warnings
from pathlib import Path
from unittest import mock

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import ACTConfig
from lerobot.scripts import lerobot_train
from lerobot.transforms import ImageTransforms, ImageTransformsConfig
from safetensors.torch import load_file
from torch.utils.data import DataLoader, Subset

from lerobot_hdp import HDPConfig
from lerobot_hdp.baselines.configuration_hierarchical import HierarchicalDiffuserConfig
from lerobot_hdp.in_memory_dataset import InMemoryDataset, memory_needed, unsupported
from lerobot_hdp.scripts import hdp_train

from .conftest import DIFFUSION_FLAGS, TINY_PLANNER, call_command, run_command

FPS = 10
STEPS = 6
TWO_PROCESSES = ("torchrun", "--nproc_per_node=2", Path(sys.executable).with_name("hdp-train"))
PLANNER_FLAGS = ("--policy.type=hdp", *(f"--policy.{name}={value}" for name, value in TINY_PLANNER.items()))
CROPPED_DIFFUSION_FLAGS = (*DIFFUSION_FLAGS, "--policy.crop_shape=[24,24]")
ACT_FLAGS = ("--policy.type=act", "--policy.dim_model=32", "--policy.dim_feedforward=32", "--policy.n_heads=2")
ACT_FLAGS += ("--policy.chunk_size=5", "--policy.n_action_steps=5", "--policy.pretrained_backbone_weights=null")


@pytest.fixture(scope="module", params=["video", "image"])
def camera_root(request, tmp_path_factory):
    """Four short episodes of noise, with two cameras, a state and words, of different lengths."""
    root = tmp_path_factory.mktemp("cameras") / request.param
    camera = {"dtype": request.param, "shape": (32, 48, 3), "names": ["height", "width", "channels"]}
    vector = {"dtype": "float32", "shape": (3,), "names": None}
    dataset = LeRobotDataset.create(
        "test/cameras",
        fps=FPS,
        root=root,
        features={
            "observation.images.front": camera,
            "observation.images.wrist": camera,
            "observation.state": vector,
            "action": vector,
            "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
            "remark": {"dtype": "string", "shape": (1,), "names": None},
        },
    )
    generator = np.random.default_rng(0)
    for length in (7, 4, 9, 5):
        for _ in range(length):
            dataset.add_frame(
                {
                    "observation.images.front": generator.integers(0, 256, (32, 48, 3), dtype=np.uint8),
                    "observation.images.wrist": generator.integers(0, 256, (32, 48, 3), dtype=np.uint8),
                    "observation.state": generator.random(3, dtype=np.float32),
                    "action": generator.random(3, dtype=np.float32),
                    "next.reward": generator.random(1, dtype=np.float32),
                    "remark": f"number {generator.integers(10)}",
                    "task": f"task {length % 2}",
                }
            )
        dataset.save_episode(parallel_encoding=False)  # no fork: other tests leave threads
    dataset.finalize()
    return root


def assert_same_samples(dataset: LeRobotDataset) -> None:
    """What a data loader makes of 20 frames of the dataset, and of the dataset in memory."""
    indices = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(1))[:20].tolist()
    batches: dict[str, list] = {}
    for name, source in {"LeRobot": dataset, "in memory": InMemoryDataset(dataset)}.items():
        torch.manual_seed(0)
        batches[name] = list(DataLoader(Subset(source, indices), batch_size=8))
    assert len(batches["LeRobot"]) == 3
    for batch, reference in zip(batches["in memory"], batches["LeRobot"], strict=True):
        assert batch.keys() == reference.keys()
        for key, value in reference.items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(batch[key], value, rtol=0, atol=0)
            else:
                assert batch[key] == value


@pytest.mark.parametrize("episodes", [None, [5, 2, 11]])
def test_samples_are_those_of_lerobot(dataset_root, episodes):
    windows = {"action": [i / FPS for i in range(-1, 19)], "observation.state": [-0.1, 0.0]}
    assert_same_samples(LeRobotDataset("test/sorting", root=dataset_root, episodes=episodes, delta_timestamps=windows))


@pytest.mark.parametrize("camera_root", ["video"], indirect=True)
def test_images_of_some_episodes_are_theirs(camera_root):
    assert_same_samples(
        LeRobotDataset("test/cameras", root=camera_root, episodes=[3, 0, 2], return_uint8=True, video_backend="pyav")
    )


@pytest.mark.parametrize("return_uint8", [True, False])
@pytest.mark.parametrize("offsets", [None, [0.0], [-0.2, 0.0, 0.1]])
def test_images_are_those_of_lerobot(camera_root, offsets, return_uint8):
    keys = ("observation.images.front", "observation.images.wrist", "observation.state")
    windows = None if offsets is None else dict.fromkeys(keys, offsets)
    assert_same_samples(
        LeRobotDataset(
            "test/cameras",
            root=camera_root,
            delta_timestamps=windows,
            return_uint8=return_uint8,
            video_backend="pyav",
        )
    )


def test_image_transforms_are_drawn_as_by_lerobot(camera_root):
    transforms = ImageTransforms(ImageTransformsConfig(enable=True))
    assert_same_samples(
        LeRobotDataset(
            "test/cameras", root=camera_root, image_transforms=transforms, return_uint8=True, video_backend="pyav"
        )
    )


@pytest.mark.parametrize("camera_root", ["video"], indirect=True)
def test_frames_are_those_at_the_stored_timestamps(camera_root, tmp_path):
    """Here, each frame is shown twice."""
    root = tmp_path / "repeated"
    shutil.copytree(camera_root, root)
    [path] = root.glob("data/**/*.parquet")
    table = pq.read_table(path)
    repeated = pa.array(table["frame_index"].to_numpy() // 2 / FPS, pa.float32())
    column = table.schema.get_field_index("timestamp")
    pq.write_table(table.set_column(column, table.schema.field(column), repeated), path)
    assert_same_samples(LeRobotDataset("test/repeated", root=root, return_uint8=True, video_backend="pyav"))


@pytest.mark.parametrize("camera_root", ["image"], indirect=True)
def test_a_column_of_another_kind_is_named(camera_root, monkeypatch):
    dataset = LeRobotDataset("test/cameras", root=camera_root)
    assert unsupported(dataset) is None
    monkeypatch.setitem(dataset.meta.features["remark"], "dtype", "binary")
    with pytest.raises(ValueError, match="cannot be held in memory: remark holds values of type binary"):
        InMemoryDataset(dataset)


def test_memory_needed_counts_every_tensor(camera_root):
    dataset = LeRobotDataset("test/cameras", root=camera_root, video_backend="pyav", return_uint8=True)
    columns = InMemoryDataset(dataset)._columns.values()
    assert memory_needed(dataset) == pytest.approx(sum(c.numel() * c.element_size() for c in columns), rel=0.01)


@pytest.fixture
def open_datasets():
    """Open them as hdp-train does: `open_datasets(root, max_gib, policy, **config) -> datasets, num_workers`."""

    def open_(root, max_gib=1.0, policy=None, rename_map=None, **kwargs):
        dataset = DatasetConfig("test/dataset", root=str(root), video_backend="pyav", **kwargs)
        config = TrainPipelineConfig(dataset, policy=policy or ACTConfig(device="cpu"), num_workers=3)
        config.rename_map = rename_map or {}
        hdp_train.Replacements(max_gib).install()
        return lerobot_train.make_train_eval_datasets(config), config.num_workers

    with mock.patch.dict(vars(lerobot_train)):
        yield open_


@pytest.mark.parametrize("camera_root", ["video"], indirect=True)
@pytest.mark.parametrize(("enable", "expected"), [(True, 3), (False, 0)])
def test_workers_are_kept_for_image_transforms_alone(camera_root, open_datasets, enable, expected):
    datasets, num_workers = open_datasets(camera_root, image_transforms=ImageTransformsConfig(enable=enable))
    assert isinstance(datasets[0], InMemoryDataset)
    assert num_workers == expected


def test_cameras_take_no_memory_and_no_time_when_the_policy_has_no_use_for_them(camera_root, open_datasets):
    whole = memory_needed(LeRobotDataset("test/cameras", root=camera_root)) / hdp_train.GIB
    planner = HierarchicalDiffuserConfig(horizon=3, device="cpu")
    (dataset, _), _ = open_datasets(camera_root, max_gib=whole / 2, policy=planner)
    [batch] = dataset.__getitems__([3, 5])
    assert batch["action"].shape == (2, 4, 3)
    assert not any("images" in key for key in batch)
    (dataset, _), _ = open_datasets(camera_root, max_gib=whole / 2)
    assert not isinstance(dataset, InMemoryDataset)


def test_planners_of_whole_episodes_hold_first_images_alone(camera_root, open_datasets):
    whole = LeRobotDataset("test/cameras", root=camera_root, video_backend="pyav", return_uint8=True)
    chosen = {"observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 32, 48))}
    planner = HDPConfig(horizon=3, device="cpu", input_features=chosen)
    budget = memory_needed(whole, ["observation.images.front"], first_images_only=True)
    (dataset, _), _ = open_datasets(camera_root, max_gib=budget / hdp_train.GIB, policy=planner)
    assert isinstance(dataset, InMemoryDataset)
    first = [0, 7, 11, 20]
    [batch] = dataset.__getitems__(first[::-1])
    assert "observation.images.front" not in batch
    expected = torch.stack([whole[frame]["observation.images.wrist"] for frame in first[::-1]])
    assert torch.equal(batch["observation.images.wrist"], expected)
    with pytest.raises(ValueError, match="the first image of each episode alone is held"):
        dataset.__getitems__([0, 1])
    planner.plan_from = "any_frame"
    (dataset, _), _ = open_datasets(camera_root, policy=planner)
    [batch] = dataset.__getitems__([1])
    assert torch.equal(batch["observation.images.wrist"][0], whole[1]["observation.images.wrist"])


def test_a_camera_is_known_by_its_new_name(camera_root, open_datasets):
    planner = HDPConfig(horizon=3, device="cpu", pretrained_path="some/checkpoint")
    planner.input_features = {"observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 32, 48))}
    renamed = {"observation.images.front": "observation.images.top"}
    (dataset, _), _ = open_datasets(camera_root, policy=planner, rename_map=renamed)
    [batch] = dataset.__getitems__([0])
    assert [key for key in batch if "images" in key] == ["observation.images.front"]


@pytest.mark.parametrize(("share", "held"), [(1.1, True), (0.75, False)])
def test_the_held_out_dataset_counts_in_the_budget(dataset_root, open_datasets, share, held):
    whole = LeRobotDataset("test/dataset", root=dataset_root)
    datasets, _ = open_datasets(dataset_root, share * memory_needed(whole) / hdp_train.GIB, eval_split=0.5)
    assert len(datasets[0]) == len(datasets[1]) == len(whole) / 2
    assert [isinstance(dataset, InMemoryDataset) for dataset in datasets] == [held, held]


def test_a_dataset_that_is_nowhere_is_an_error_of_one_sentence(tmp_path):
    with pytest.raises(ValueError, match=r"test/dataset is not in .*nowhere, nor to be had from the Hub: name another"):
        train(hdp_train.main, tmp_path / "nowhere", tmp_path / "run", PLANNER_FLAGS)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flag", ["--max_train_minutes", "--max_memory_gib"])
@pytest.mark.parametrize("value", ["-1", "nan"])
def test_a_limit_below_zero_is_refused(monkeypatch, capsys, flag, value):
    monkeypatch.setattr(sys, "argv", ["hdp-train", f"{flag}={value}"])
    with pytest.raises(SystemExit, match="2"):
        hdp_train.main()
    assert f"argument {flag}: must be at least 0, got {value}" in capsys.readouterr().err


def train_flags(root, output_dir, policy_flags, *flags):
    return (
        "--dataset.repo_id=test/dataset",
        f"--dataset.root={root}",
        "--dataset.video_backend=pyav",
        f"--output_dir={output_dir}",
        *policy_flags,
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--batch_size=10",
        f"--steps={STEPS}",
        f"--save_freq={STEPS}",
        "--num_workers=0",
        "--log_freq=1",
        *flags,
    )


def train(command, *args) -> str:
    """Run a command, or call its `main` in this process; what it logged."""
    if callable(command):
        return call_command(command, *train_flags(*args))
    command = [command] if isinstance(command, str) else command
    return run_command(*command, *train_flags(*args)).stderr


def weights(output_dir):
    return load_file(output_dir / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")


def assert_same_weights(one, other):
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)


def losses(log):
    return re.findall(r"(?: loss:|eval_loss=)([\d.]+)", log)


@pytest.fixture(scope="module")
def lerobot_train_run(dataset_root, tmp_path_factory):
    output_dir = tmp_path_factory.mktemp("runs") / "lerobot_train"
    return train("lerobot-train", dataset_root, output_dir, PLANNER_FLAGS), output_dir


def test_the_planner_ends_with_the_weights_of_lerobot_train(dataset_root, lerobot_train_run, tmp_path):
    expected, expected_dir = lerobot_train_run
    log = train("hdp-train", dataset_root, tmp_path / "run", PLANNER_FLAGS, "--num_workers=3")
    assert len(losses(log)) == STEPS
    assert losses(log) == losses(expected)
    assert_same_weights(weights(tmp_path / "run"), weights(expected_dir))
    config = tmp_path / "run/checkpoints/last/pretrained_model/train_config.json"
    assert json.loads(config.read_text())["num_workers"] == 3


@pytest.mark.parametrize("policy_type", ["hdp", "hd"])
def test_the_horizon_is_looked_up(dataset_root, policy_type, tmp_path):
    size = [f"--policy.{name}={value}" for name, value in TINY_PLANNER.items() if name != "horizon"]
    train(hdp_train.main, dataset_root, tmp_path / "run", [f"--policy.type={policy_type}", *size])
    config = json.loads((tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text())
    assert config["horizon"] == TINY_PLANNER["horizon"]
    assert config.get("subgoal_interval", 4) == 4  # of 19, the square root


def test_a_horizon_that_is_looked_up_has_to_go_with_the_rest(dataset_root, tmp_path):
    flags = ["--policy.type=hdp", "--policy.n_action_steps=30"]
    with pytest.raises(ParsingError, match="n_action_steps=30 is more than the plan has"):
        train(hdp_train.main, dataset_root, tmp_path / "run", flags)


def test_a_run_that_is_out_of_time_leaves_a_checkpoint_and_goes_on_from_it(dataset_root, lerobot_train_run, tmp_path):
    run = tmp_path / "run"
    log = train(hdp_train.main, dataset_root, run, PLANNER_FLAGS, "--max_train_minutes=0")
    config = run / "checkpoints/last/pretrained_model/train_config.json"
    assert f"To go on: hdp-train --resume=true --config_path={config} " in log
    assert [path.name for path in (run / "checkpoints").iterdir() if not path.is_symlink()] == ["000001"]
    call_command(hdp_train.main, f"--config_path={config}", "--resume=true", "--max_train_minutes=60")
    assert_same_weights(weights(run), weights(lerobot_train_run[1]))


def test_a_training_in_bfloat16_goes_on_where_it_stopped(
    dataset_root, lerobot_train_run, accelerate_begins_anew, tmp_path, monkeypatch
):
    """On a CPU that has instructions for it, or not. The weights stay float32."""
    monkeypatch.setattr("lerobot_hdp.configuration_hdp.bfloat16_is_fast", lambda _: True)
    run = tmp_path / "run"
    train(hdp_train.main, dataset_root, run, PLANNER_FLAGS, "--policy.dtype=bfloat16", "--save_freq=3")
    expected, in_float32 = weights(run), weights(lerobot_train_run[1])
    trained = [name for name in expected if name.startswith("planner.")]
    assert all(expected[name].dtype == torch.float32 for name in trained)
    assert not any(torch.equal(expected[name], in_float32[name]) for name in trained)
    config = run / "checkpoints/000003/pretrained_model/train_config.json"
    call_command(hdp_train.main, f"--config_path={config}", "--resume=true")
    assert_same_weights(weights(run), expected)


def test_the_held_out_loss_is_that_of_whole_plans(dataset_root, tmp_path):
    flags = (*PLANNER_FLAGS, f"--eval_steps={STEPS}", "--dataset.eval_split=0.2")
    with pytest.warns(UserWarning, match="eval_loss says nothing of this planner"):
        by_lerobot = train(lerobot_train.main, dataset_root, tmp_path / "lerobot", flags)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "eval_loss says nothing of this planner")
        in_memory = train(hdp_train.main, dataset_root, tmp_path / "hdp", flags)
    assert len(losses(by_lerobot)) == len(losses(in_memory)) == STEPS + 1
    assert losses(in_memory)[:STEPS] == losses(by_lerobot)[:STEPS]


def record_noise(root, lengths, hold_until=0) -> Path:
    """Episodes of noise, which stay where they end until some frame."""
    vector = {"dtype": "float32", "shape": (3,), "names": None}
    features = {"observation.state": vector, "action": vector}
    dataset = LeRobotDataset.create("test/dataset", fps=FPS, root=root, features=features, use_videos=False)
    generator = np.random.default_rng(0)
    for length in lengths:
        states, actions = generator.random((2, length, 3), dtype=np.float32)
        for frame in range(max(length, hold_until)):
            at = min(frame, length - 1)
            dataset.add_frame({"observation.state": states[at], "action": actions[at], "task": "move"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.mark.parametrize("extra", [("diffuser",), ("hd",), ("diffuser", "--max_memory_gib=0")], ids=" ".join)
def test_shorter_episodes_hold_their_last_action(tmp_path, extra):
    policy_type, *options = extra
    flags = (f"--policy.type={policy_type}", *PLANNER_FLAGS[1:], "--policy.horizon=9", *options)
    flags += ("--dataset.eval_split=0.25", f"--eval_steps={STEPS}")
    logs = {}
    for name, hold_until in {"held": 9, "short": 0}.items():
        root = record_noise(tmp_path / name, (7, 4, 9, 5), hold_until)
        logs[name] = train(hdp_train.main, root, tmp_path / f"{name}_run", flags, "--batch_size=2")
    assert "3 of 4 episodes are shorter than the planner's horizon of 9" in logs["short"]
    assert len(losses(logs["short"])) == STEPS + 1
    assert losses(logs["short"]) == losses(logs["held"])
    assert_same_weights(weights(tmp_path / "short_run"), weights(tmp_path / "held_run"))


def test_a_run_on_shorter_episodes_goes_on_where_it_stopped(tmp_path):
    root = record_noise(tmp_path / "short", (7, 4, 9, 5))
    flags = ("--policy.type=diffuser", *PLANNER_FLAGS[1:], "--policy.horizon=9")
    train(hdp_train.main, root, tmp_path / "run", flags, "--batch_size=2", "--save_freq=3")
    expected = weights(tmp_path / "run")
    config = tmp_path / "run/checkpoints/000003/pretrained_model/train_config.json"
    call_command(hdp_train.main, f"--config_path={config}", "--resume=true")
    assert_same_weights(weights(tmp_path / "run"), expected)


def test_planners_that_begin_anywhere_train_on_every_frame(tmp_path):
    root = record_noise(tmp_path / "short", (7, 4, 9, 5))
    flags = ("--policy.type=diffuser", *PLANNER_FLAGS[1:], "--policy.plan_from=any_frame", "--policy.horizon=9")
    logs = [train(script.main, root, tmp_path / script.__name__, flags) for script in (lerobot_train, hdp_train)]
    assert len(losses(logs[0])) == STEPS
    assert losses(logs[0]) == losses(logs[1])


def test_a_job_elsewhere_is_refused():
    flags = ("--dataset.repo_id=test/dataset", *PLANNER_FLAGS, "--job.target=l4x1")
    with pytest.raises(ValueError, match=r"with --job\.target=l4x1, use lerobot-train"):
        call_command(hdp_train.main, *flags)


def test_a_dataset_beyond_the_budget_is_read_as_by_lerobot_train(dataset_root, lerobot_train_run, tmp_path):
    log = train(hdp_train.main, dataset_root, tmp_path / "run", PLANNER_FLAGS, "--max_memory_gib=0.0001")
    assert "more than --max_memory_gib=0.0001" in log
    assert_same_weights(weights(tmp_path / "run"), weights(lerobot_train_run[1]))


def test_two_processes_do_what_one_does_with_twice_the_batch(dataset_root, lerobot_train_run, tmp_path):
    expected, expected_dir = lerobot_train_run
    log = train(TWO_PROCESSES, dataset_root, tmp_path / "run", PLANNER_FLAGS, "--batch_size=5")
    assert "Effective batch size: 5 x 2 = 10" in log
    assert losses(log) == losses(expected)
    one, two = weights(expected_dir), weights(tmp_path / "run")
    for name, value in one.items():
        # Muon computes in bfloat16, which makes small differences larger.
        torch.testing.assert_close(two[name], value, rtol=1e-2, atol=1e-5)


def test_two_processes_that_are_out_of_time_leave_a_checkpoint(dataset_root, tmp_path):
    train(TWO_PROCESSES, dataset_root, tmp_path / "run", PLANNER_FLAGS, "--max_train_minutes=0")
    checkpoints = tmp_path / "run/checkpoints"
    assert [path.name for path in checkpoints.iterdir() if not path.is_symlink()] == ["000001"]
    assert weights(tmp_path / "run")["forward_calls"] == 1


@pytest.mark.parametrize("camera_root", ["video"], indirect=True)
@pytest.mark.parametrize("policy_flags", [CROPPED_DIFFUSION_FLAGS, ACT_FLAGS], ids=["diffusion", "act"])
def test_other_policies_train_with_cameras(camera_root, tmp_path, policy_flags):
    flags = (*policy_flags, "--eval_steps=3", "--dataset.eval_split=0.1")
    by_lerobot, in_memory = (
        train(script.main, camera_root, tmp_path / script.__name__, flags) for script in (lerobot_train, hdp_train)
    )
    assert len(losses(by_lerobot)) == STEPS + 2  # two evaluations on held-out episodes
    assert losses(in_memory) == losses(by_lerobot)
