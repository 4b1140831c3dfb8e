"""Planners that see the scene through cameras, from recording to execution."""

import json
import signal

import numpy as np
import pytest
import torch
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts import lerobot_eval, lerobot_rollout, lerobot_train
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.utils.process import ProcessSignalHandler
from safetensors.torch import load_file
from torch.utils.data import default_collate
from torchvision.models import resnet18

from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp import HDPConfig
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.scripts import hdp_plan, hdp_train

from .conftest import TINY_PLANNER, call_command, train_in_process
from .simulatedarm import SimulatedArm

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
TASK = {"task": "XArmArrangeBlocks-v0", "obs_type": "pixels", "camera_name": "front"}
TASK |= {"observation_height": 48, "observation_width": 64}
TASK_FLAGS = ("--env.type=hdp", "--env.task=XArmArrangeBlocks-v0", "--env.obs_type=pixels")
TASK_FLAGS += ("--env.camera_name=front", "--env.observation_height=48", "--env.observation_width=64")
TINY = {**TINY_PLANNER, "horizon": 25}
STEPS = 3


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Four arrangements, seen by one camera and in no other way."""
    root = tmp_path_factory.mktemp("datasets") / "images"
    recorded = record(RecordConfig(RecordDatasetConfig("test/images", root, num_episodes=4), HDPEnv(**TASK)))
    windows = {"action": [i / recorded.fps for i in range(25)]}
    return LeRobotDataset("test/images", root=root, delta_timestamps=windows, video_backend="pyav")


@pytest.fixture
def make_planner(dataset):
    def make(**kwargs):
        config = HDPConfig(**{**TINY, "device": "cpu", "push_to_hub": False, **kwargs})
        torch.manual_seed(0)
        policy = make_policy(config, ds_meta=dataset.meta)
        preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
        return policy, preprocessor(default_collate([dataset[frame] for frame in (0, 25, 50, 75)]))

    return make


@pytest.fixture(scope="module")
def runs(dataset, tmp_path_factory):
    """The same short training by `lerobot-train` and by `hdp-train`: their output folders."""
    folders = []
    for script in (lerobot_train, hdp_train):
        folders.append(tmp_path_factory.mktemp("runs") / script.__name__)
        call_command(
            script.main,
            *("--policy.type=hdp", *(f"--policy.{name}={value}" for name, value in TINY.items())),
            *("--policy.device=cpu", "--policy.push_to_hub=false", f"--output_dir={folders[-1]}"),
            *("--dataset.repo_id=test/images", f"--dataset.root={dataset.root}", "--dataset.video_backend=pyav"),
            *(*TASK_FLAGS, f"--steps={STEPS}", "--batch_size=2", "--num_workers=0", "--env_eval_freq=0"),
            *("--dataset.eval_split=0.3", "--eval_steps=3"),
        )
    return folders


def test_both_commands_train_on_images_alone(runs):
    by_lerobot, in_memory = (load_file(run / "checkpoints/last/pretrained_model/model.safetensors") for run in runs)
    assert any("image_encoder" in name for name in by_lerobot)
    assert by_lerobot["forward_calls"] == STEPS
    assert all(torch.equal(in_memory[name], value) for name, value in by_lerobot.items())


def test_lerobot_eval_plans_from_images(runs, tmp_path):
    call_command(
        lerobot_eval.main,
        *(f"--policy.path={runs[1]}/checkpoints/last/pretrained_model", "--policy.device=cpu", *TASK_FLAGS),
        *("--eval.n_episodes=2", "--eval.batch_size=2", "--eval.use_async_envs=false", f"--output_dir={tmp_path}"),
    )
    assert json.loads((tmp_path / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


@pytest.fixture
def signal_handlers():
    """Those of before a command that installs its own."""
    numbers = [getattr(signal, name) for name in ProcessSignalHandler._SUPPORTED_SIGNALS]
    handlers = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signal_handlers")
def test_lerobot_rollout_executes_a_plan(runs, tmp_path):
    path = runs[1] / "checkpoints/last/pretrained_model"
    call_command(
        lerobot_rollout.main,
        *(f"--policy.path={path}", "--policy.device=cpu", "--device=cpu", "--fps=1000"),
        *("--robot.type=simulated_arm", f"--robot.env.task={TASK['task']}", "--robot.env.obs_type=pixels"),
        *("--robot.env.camera_name=front", "--robot.env.observation_height=48", "--robot.env.observation_width=64"),
        *(f"--robot.calibration_dir={tmp_path}", "--return_to_initial_position=false"),
    )
    arm = SimulatedArm.last
    policy = HDPPolicy.from_pretrained(path, cli_overrides=["--device=cpu"])
    preprocess, postprocess = make_pre_post_processors(policy.config, path)
    image = torch.tensor(arm.seen["front"]).permute(2, 0, 1) / 255
    torch.manual_seed(0)
    waypoints = postprocess(policy.plan(preprocess({FRONT: image[None]})).actions)[0]
    torch.testing.assert_close(torch.tensor(np.array(arm.sent)), waypoints)


def test_another_camera_is_refused(runs, tmp_path):
    with pytest.raises(ValueError, match=r"images.front of shape \[3, 48, 64\], here it has \[3, 32, 64\]"):
        call_command(
            lerobot_eval.main,
            *(f"--policy.path={runs[1]}/checkpoints/last/pretrained_model", "--policy.device=cpu", *TASK_FLAGS[:-2]),
            *("--env.observation_height=32", "--env.observation_width=64", f"--output_dir={tmp_path}"),
            *("--eval.n_episodes=1", "--eval.batch_size=1", "--eval.use_async_envs=false"),
        )


def test_a_plan_from_an_image_is_checked_and_a_recorded_motion_explained(runs, tmp_path, capsys):
    path = f"--policy.path={runs[1]}/checkpoints/last/pretrained_model"
    call_command(hdp_plan.main, path, f"--output_dir={tmp_path}", "--prompt=PICK A")
    assert "checked: " in capsys.readouterr().out
    call_command(hdp_plan.main, path, "--explain=2")
    assert "recorded: PICK" in capsys.readouterr().out


def test_what_an_image_shows_is_learned(make_planner):
    policy, batch = make_planner(ema_max_decay=0)
    train_in_process(policy, batch, steps=120)
    policy.eval()
    of_other_episodes = {**batch, FRONT: batch[FRONT].roll(1, dims=0)}
    with torch.no_grad():
        right, wrong = (policy.forward(samples)[1]["motion_loss"] for samples in (batch, of_other_episodes))
    assert wrong > 2 * right


@pytest.mark.parametrize("optimizer", ["muon", "adamw"])
def test_image_encoders_have_a_learning_rate_of_their_own(make_planner, optimizer):
    policy, _ = make_planner(optimizer_type=optimizer)
    groups = policy.config.get_optimizer_preset().build(policy.get_optim_params()).param_groups
    rates = {id(parameter): group["lr"] for group in groups for parameter in group["params"]}
    trained = dict(policy.planner.named_parameters())
    assert len(rates) == len(trained)
    for name, parameter in trained.items():
        assert rates[id(parameter)] == (1e-4 if name.startswith("image_encoder") else 3e-3)


def test_a_saved_planner_makes_the_same_plans(make_planner, tmp_path):
    policy, batch = make_planner()
    policy.save_pretrained(tmp_path)
    loaded = HDPPolicy.from_pretrained(tmp_path)
    plans = [planner.plan(batch, "", torch.Generator().manual_seed(0)) for planner in (policy, loaded)]
    assert torch.equal(plans[0].actions, plans[1].actions)


def test_each_camera_is_a_condition_token_of_its_own(dataset):
    camera = {"dtype": "video", "shape": (40, 40, 3), "names": ["height", "width", "channels"]}
    depth = {**camera, "shape": (40, 40, 1)}
    config = HDPConfig(**TINY, device="cpu")
    features = {**dataset.meta.features, WRIST: camera, "observation.images.depth": depth, "preview": camera}
    known = dataset_to_policy_features(features)
    config.output_features = {"action": known.pop("action")}
    config.input_features = known
    config.set_dataset_feature_metadata(features)
    assert list(config.input_features) == [FRONT, WRIST]
    assert config.observation_token_sizes == [64, 64]
    policy = HDPPolicy(config)
    batch = {key: torch.rand(2, *feature.shape) for key, feature in config.input_features.items()}
    tokens = policy.planner.encode(batch)
    for position, camera in enumerate((FRONT, WRIST)):
        changed = policy.planner.encode({**batch, camera: torch.rand_like(batch[camera])})
        assert [torch.equal(changed[:, i], tokens[:, i]) for i in range(2)] == [i != position for i in range(2)]


def test_images_are_encoded_once_for_all_candidates(make_planner):
    policy, batch = make_planner()
    seen = []
    policy.update()
    encoder = policy.ema.module.image_encoder
    encoder.register_forward_hook(lambda module, inputs, outputs: seen.append(len(inputs[0][FRONT])))
    candidates = policy.plan(batch, "... S1", num_candidates=5)
    assert seen == [4]
    assert candidates.scores.shape == (4,)
    plan = policy.plan({FRONT: batch[FRONT]}, "", torch.Generator().manual_seed(0))
    again = policy.plan({FRONT: batch[FRONT]}, "", torch.Generator().manual_seed(0))
    assert torch.equal(plan.actions, again.actions)
    assert seen == [4, 4, 4]


def test_images_of_any_size_are_resized(dataset):
    config = HDPConfig(**TINY, resize_shape=(48, 64), device="cpu")
    policy = make_policy(config, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    image = dataset[0][FRONT][None]
    larger = image.repeat_interleave(4, dim=-1).repeat_interleave(4, dim=-2)
    tokens, others, of_larger = (
        policy.planner.encode(preprocessor({FRONT: images})) for images in (image, image.flip(-1), larger)
    )
    assert (of_larger - tokens).norm() < 0.5 * (others - tokens).norm()
    with pytest.raises(ValueError, match="here it has"):
        preprocessor({FRONT: image[:, :1]})
    with pytest.raises(ValueError, match=r"front is uint8: make it float32 in \[0, 1\]"):
        preprocessor({FRONT: (255 * image).to(torch.uint8)})
    with pytest.raises(ValueError, match=r"front has values of up to 2\d\d: make it float32 in \[0, 1\]"):
        preprocessor({FRONT: (255 * image).round()})


def test_pretrained_weights_keep_their_batch_statistics(make_planner, tmp_path, monkeypatch):
    """The file lies where torchvision looks for what it has downloaded before."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    weights = resnet18().state_dict()
    weights["bn1.running_mean"] += 0.1
    (tmp_path / "hub/checkpoints").mkdir(parents=True)
    torch.save(weights, tmp_path / "hub/checkpoints/resnet18-f37072fd.pth")
    policy, batch = make_planner(pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    backbone = policy.planner.image_encoder.encoders[0].backbone
    assert torch.equal(backbone[0].weight, weights["conv1.weight"])
    train_in_process(policy, batch, steps=2)
    assert not torch.equal(backbone[0].weight, weights["conv1.weight"])
    assert torch.equal(backbone[1].running_mean, weights["bn1.running_mean"])

    policy.save_pretrained(tmp_path / "checkpoint")
    (tmp_path / "hub/checkpoints/resnet18-f37072fd.pth").unlink()  # a checkpoint needs it no more
    loaded = HDPPolicy.from_pretrained(tmp_path / "checkpoint")
    assert torch.equal(loaded.planner.encode(batch), policy.eval().planner.encode(batch))


def test_hierarchical_planners_take_no_images(dataset, caplog):
    config = PreTrainedConfig.get_choice_class("hd")(horizon=25, device="cpu", push_to_hub=False)
    with pytest.raises(ValueError, match="nothing to observe"):
        make_policy(config, ds_meta=dataset.meta)
    assert f"{FRONT} is left out: a planner of type hd takes no images" in caplog.text


def test_images_of_one_cell_are_refused(make_planner):
    """Of one number, the softmax over places is 1: there, the encoder would see nothing."""
    with pytest.raises(ValueError, match=r"images.front has 32 x 64 pixels.*resize_shape"):
        make_planner(resize_shape=(32, 64))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"vision_backbone": "vgg16"}, "vision_backbone must be one of"),
        (
            {"pretrained_backbone_weights": "ResNet34_Weights.DEFAULT"},
            "must be one of .'ResNet18_Weights.IMAGENET1K_V1'",
        ),
        ({"resize_shape": (0, 32)}, "resize_shape is a height and a width of at least 1"),
        ({"spatial_softmax_num_keypoints": 0}, "spatial_softmax_num_keypoints must be at least 1"),
    ],
)
def test_impossible_settings_are_refused(options, message):
    with pytest.raises(ParsingError, match=message):
        HDPConfig(**options, device="cpu")
