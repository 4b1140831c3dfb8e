"""What runs on CUDA does what it does on a CPU. Skipped where there is no such device."""

import warnings

import pytest
import torch
from lerobot.policies import get_policy_class
from lerobot.utils.feature_utils import dataset_to_policy_features

from benchmarks.evaluation import evaluate
from benchmarks.paper.presets import METHODS
from benchmarks.training_step import GRAPHS
from lerobot_hdp import HDPConfig, PlanPrompt
from lerobot_hdp.modeling_hdp import HDPPolicy

from .conftest import REPOSITORY, TASK_FLAGS, TINY_PLANNER, observation, run_command, train_in_process

IMAGE = "observation.images.front"

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="tests CUDA, which is not on this machine")


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_the_network_predicts_the_same(make_planner, batch, dtype):
    policy, preprocessor, _ = make_planner(dtype=dtype)
    inputs = preprocessor(batch)
    motion, tokens = inputs["action"], policy.symbol_process.prior((4, policy.config.symbolic_horizon), "cpu")
    level = torch.full((4,), 0.5)
    expected = policy._denoiser(inputs)(motion, tokens, level, level)
    inputs = {key: value.cuda() for key, value in observation(inputs).items()}
    found = policy.cuda()._denoiser(inputs)(motion.cuda(), tokens.cuda(), level.cuda(), level.cuda())
    tolerance = 1e-4 if dtype == "float32" else 3e-2
    for one, other in zip(found, expected, strict=True):
        assert (one.cpu() - other).norm() < tolerance * other.norm()


def test_images_are_encoded_the_same(dataset):
    camera = {"dtype": "video", "shape": (60, 80, 3), "names": ["height", "width", "channels"]}
    features = {**dataset.meta.features, IMAGE: camera}
    known = dataset_to_policy_features(features)
    config = HDPConfig(**TINY_PLANNER, device="cpu", resize_shape=(48, 64), input_features={IMAGE: known[IMAGE]})
    config.output_features = {"action": known["action"]}
    config.set_dataset_feature_metadata(features)
    policy, image = HDPPolicy(config).eval(), torch.rand(2, 3, 60, 80)
    expected = policy.planner.encode({IMAGE: image})
    found = policy.cuda().planner.encode({IMAGE: image.cuda()})
    assert (found.cpu() - expected).norm() < 1e-3 * expected.norm()
    assert policy.plan({IMAGE: image.cuda()}).actions.isfinite().all()


@pytest.mark.parametrize("planner", METHODS)
def test_a_planner_learns_and_plans(make_planner, batch, training_batch, planner):
    policy, preprocessor, _ = make_planner(planner, device="cuda")
    history = train_in_process(policy, preprocessor(training_batch(policy)), steps=60)
    for part in history[0]:
        assert sum(step[part] for step in history[-10:]) < 0.85 * sum(step[part] for step in history[:10])
    plan = policy.eval().plan(observation(preprocessor(batch)))
    assert plan.actions.is_cuda
    assert plan.actions.isfinite().all()


def test_the_given_part_of_a_plan_is_kept(make_planner, batch):
    policy, preprocessor, _ = make_planner(device="cuda")
    inputs = preprocessor(batch)
    given = torch.zeros(inputs["action"].shape[:2], dtype=torch.bool)
    given[:, :7] = True
    prompt = PlanPrompt(actions=inputs["action"], actions_given=given)
    plan = policy.eval().plan(observation(inputs), prompt, num_candidates=3)
    assert torch.equal(plan.actions[:, :7], inputs["action"][:, :7])


@pytest.mark.parametrize("planner", ["hdp", "chd"])
def test_cuda_graphs_change_nothing(make_planner, batch, training_batch, planner):
    results = []
    for options in ({}, GRAPHS):
        policy, preprocessor, _ = make_planner(planner, device="cuda", **options)
        losses = train_in_process(policy, preprocessor(training_batch(policy)), steps=5)
        plan = policy.eval().plan(observation(preprocessor(batch)), generator=torch.Generator("cuda").manual_seed(0))
        results.append((torch.tensor([step["motion_loss"] for step in losses]), plan.actions))
    torch.testing.assert_close(results[0], results[1], rtol=1e-3, atol=1e-3)


def test_a_step_waits_once_for_the_device(make_planner, training_batch):
    policy, preprocessor, _ = make_planner(device="cuda")
    inputs = preprocessor(training_batch(policy))
    train_in_process(policy, inputs, steps=2)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            train_in_process(policy, inputs, steps=1)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([wait for wait in waits if "synchronizing CUDA operation" in str(wait.message)]) == 1


@pytest.mark.parametrize(("first", "then"), [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_training_goes_on_on_another_device(dataset_root, tmp_path, first, then):
    flags = [f"--policy.{name}={value}" for name, value in TINY_PLANNER.items()]
    run_command(
        "hdp-train",
        "--policy.type=hdp",
        *flags,
        f"--policy.device={first}",
        "--policy.dtype=bfloat16",
        "--policy.push_to_hub=false",
        "--dataset.repo_id=test/sorting",
        "--dataset.video_backend=pyav",
        f"--dataset.root={dataset_root}",
        *("--env.type=hdp", *TASK_FLAGS, "--env_eval_freq=0"),
        f"--output_dir={tmp_path / 'run'}",
        *("--batch_size=10", "--steps=4", "--save_freq=2", "--log_freq=1"),
    )
    config = tmp_path / "run/checkpoints/000002/pretrained_model/train_config.json"
    result = run_command("hdp-train", "--resume=true", f"--config_path={config}", f"--policy.device={then}")
    assert "End of training" in result.stderr
    policy = get_policy_class("hdp").from_pretrained(tmp_path / "run/checkpoints/last/pretrained_model")
    assert policy.forward_calls == 4
    assert all(weight.isfinite().all() for weight in policy.parameters())


def test_a_checkpoint_from_a_cpu_does_its_task():
    result = evaluate(REPOSITORY / "checkpoints/xarm_sorting", starts=20, first_seed=5_000, device="cuda")
    assert result["success_rate"] >= 0.85
