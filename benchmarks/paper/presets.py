"""What is trained for each preset, task and method: the cells of `python -m benchmarks.paper`."""

import math
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from lerobot.configs import PreTrainedConfig

from lerobot_hdp.configuration_hdp import PRESETS as POLICY_PRESETS

from ..cells import Cell

METHODS = ("hdp", "diffuser", "joint_diffuser", "separate_diffuser", "hd", "chd")
"""Policy types, in the order in which they are worth running."""
HIERARCHICAL = ("hd", "chd")
"""Two networks each, so that their size is reported and not matched."""
ENVS: dict[str, dict[str, Any]] = {
    "xarm_sorting": {"task": "XArmSorting-v0"},
    "xarm_arrange_blocks": {"task": "XArmArrangeBlocks-v0"},
    "xarm_tool_use": {"task": "XArmToolUse-v0"},
    "xarm_sorting_images": {"task": "XArmSorting-v0", "obs_type": "pixels", "camera_name": "front"},
    "block_sorting_2d_2_blocks": {"task": "BlockSorting2D-v0", "n_blocks": 2, "waypoints_per_pose": 1},
    "block_sorting_2d_3_blocks": {"task": "BlockSorting2D-v0", "n_blocks": 3, "waypoints_per_pose": 1},
    "block_sorting_2d_4_blocks": {"task": "BlockSorting2D-v0", "n_blocks": 4, "waypoints_per_pose": 1},
}


@dataclass(frozen=True)
class Training:
    """How the planners are trained for one task.

    Attributes:
        demonstrations: as many are recorded.
        steps: of the optimiser.
        batch_size: samples a step.
        policy: options that differ from the preset's.
        hdp_policy: options of HDP, beside the others'.
    """

    demonstrations: int
    steps: int
    batch_size: int
    policy: dict[str, Any] = field(default_factory=dict)
    hdp_policy: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Preset:
    """How all planners are trained and evaluated.

    Attributes:
        policy: options of all planners.
        tasks: for each task its training.
        evaluations, starts, average_last: see `Cell`.
        hdp_policy: options of HDP, beside the others'.
    """

    policy: dict[str, Any]
    tasks: dict[str, Training]
    evaluations: int = 10
    starts: int = 100
    average_last: int = 3
    hdp_policy: dict[str, Any] = field(default_factory=dict)


def _steps(epochs: int, demonstrations: int, batch_size: int) -> int:
    """Optimiser steps of some epochs, in each of which each demonstration is seen once; the last batch is smaller."""
    return epochs * math.ceil(demonstrations / batch_size)


_MINI_2D = {"num_layers": 5, "width": 112, "num_inference_steps": 20}
_MINI_XARM = {"num_layers": 4, "width": 128}
_PRETRAINED = {"pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"}
_SMALL_LR = {"optimizer_lr": 3e-3}
_AT_FIRST_THRESHOLD = {"confidence_threshold": 0.8}
_BEFORE_MUON = {"optimizer_type": "adamw", "symbol_lead": 0.0, **_AT_FIRST_THRESHOLD}
_AT_FIRST = {"rotary": False, **_BEFORE_MUON}
_MANY_DEMONSTRATIONS = {"lead_share": 0.3}
_TASKS_2D = {
    "block_sorting_2d_2_blocks": Training(200, 1_000, 50),
    "block_sorting_2d_3_blocks": Training(200, 1_500, 50),
    "block_sorting_2d_4_blocks": Training(200, 2_500, 50),
}
_MINI_TASKS_2D = {task: replace(training, policy=_MINI_2D) for task, training in _TASKS_2D.items()}
PRESETS: dict[str, Preset] = {
    # The paper's hyperparameters and sampler: 100 network calls, weights averaged, the mean over 10 checkpoints.
    "paper": Preset(
        policy={"preset": "paper"},
        tasks={
            "xarm_sorting": Training(200, _steps(5_000, 200, 64), 64, {"symbolic_horizon": 108}),
            "xarm_sorting_images": Training(200, _steps(20_000, 200, 64), 64, {"symbolic_horizon": 108, **_PRETRAINED}),
            "xarm_arrange_blocks": Training(4_000, _steps(5_000, 4_000, 64), 64),
            "xarm_tool_use": Training(4_000, _steps(10_000, 4_000, 64), 64),
        },
        evaluations=50,
        starts=50,
        average_last=10,
    ),
    # Ours: the paper's network, with our training and sampler, and so far fewer steps. On the X-Arm, HDP was run with
    # an earlier threshold, and sorting and tool use with the learning rate of smaller networks.
    "default": Preset(
        policy={"preset": "default", "dtype": "bfloat16", "optimizer_lr": 1e-3},
        tasks={
            "xarm_sorting": Training(200, 2_400, 50, {**_SMALL_LR, **_AT_FIRST_THRESHOLD}),
            "xarm_arrange_blocks": Training(4_000, 3_000, 50, _AT_FIRST_THRESHOLD, hdp_policy=_MANY_DEMONSTRATIONS),
            "xarm_tool_use": Training(400, 2_000, 50, {**_SMALL_LR, **_AT_FIRST_THRESHOLD}),
            **_TASKS_2D,
        },
        starts=50,
    ),
    # `default` with a network of a seventh of the size, and as much training as a CPU core carries in half an hour.
    "small": Preset(
        policy={"preset": "default", "dtype": "bfloat16", **_SMALL_LR, **_MINI_XARM},
        tasks={
            "xarm_sorting": Training(200, 2_400, 50),
            "xarm_arrange_blocks": Training(4_000, 5_000, 50, hdp_policy=_MANY_DEMONSTRATIONS),
            "xarm_tool_use": Training(400, 2_000, 50),
            "xarm_sorting_images": Training(200, 1_500, 50),
            **_TASKS_2D,
        },
    ),
    # The same network before Muon and `symbol_lead`, with condition tokens by an MLP, and trained for longer.
    "small_adamw": Preset(
        policy={
            "preset": "default",
            "dtype": "bfloat16",
            **_BEFORE_MUON,
            "optimizer_lr": 1e-3,
            "state_encoder_hidden_dim": 256,
            "observation_weight_std": 2.0,
            **_MINI_XARM,
        },
        tasks={
            "xarm_sorting": Training(200, 6_000, 50),
            "xarm_arrange_blocks": Training(4_000, 40_000, 50),
            "xarm_tool_use": Training(1_000, 6_000, 50),
        },
    ),
    # Before rotary positions, Muon and `symbol_lead` were part of the preset `default`: the base of docs/ablations.md.
    "mini": Preset(
        policy={
            "preset": "default",
            "dtype": "bfloat16",
            **_AT_FIRST,
            "optimizer_lr": 1e-3,
        },
        tasks={
            **_MINI_TASKS_2D,
            "xarm_sorting": Training(200, 3_000, 50, _MINI_XARM),
            "xarm_arrange_blocks": Training(1_000, 4_000, 50, _MINI_XARM),
            "xarm_tool_use": Training(400, 3_000, 50, _MINI_XARM),
        },
    ),
    # The same with the paper's target, the noise, at half the learning rate (the paper's own, 1e-4, is for a hundred
    # times as many steps). HDP's weight of the symbols is the paper's, since the error of the noise is about ten times
    # that of the clean motion; Joint and Separate, whose symbols have the same target as their motion, keep theirs.
    "mini_epsilon": Preset(
        policy={
            "preset": "default",
            "dtype": "bfloat16",
            **_AT_FIRST,
            "prediction_type": "epsilon",
            "optimizer_lr": 5e-4,
        },
        tasks=_MINI_TASKS_2D,
        hdp_policy={"symbol_loss_weight": 1 / 30},
    ),
}
TASKS = tuple(ENVS)
OF_IMAGES = (
    "vision_backbone",
    "pretrained_backbone_weights",
    "spatial_softmax_num_keypoints",
    "resize_shape",
    "optimizer_lr_backbone",
)
"""Settings of a planner that mean something where it observes images."""


def complete(policy: dict[str, Any], env: dict[str, Any]) -> dict[str, Any]:
    """A policy's options, and the values that its preset fills, without those that mean nothing to it in a task.

    A cell says them all, so that its result is not taken for one of the preset as it is later.
    """
    config = PreTrainedConfig.get_choice_class(policy["type"])
    unused = {"type"}
    if config.symbol_process != "masked":
        unused |= {"confidence_threshold"}
        if not policy.get("symbol_lead"):  # Gaussian symbols lead only where a cell says so
            unused |= {"symbol_lead"}
    if config.symbol_process is None:
        unused |= {"symbolic_horizon", "symbol_loss_weight"}
    options = {name: value for name, value in policy.items() if name not in unused}
    filled = config(**options, device="cpu")
    if filled.sampler != "confidence":
        unused |= {"confidence_threshold"}
    names = (*POLICY_PRESETS["default"], "confidence_threshold", *(OF_IMAGES if observes_images(env) else ()))
    values = {name: getattr(filled, name) for name in names if name not in unused}
    return {"type": policy["type"], **options, **values}


def make_cell(preset_name: str, task: str, method: str, seed: int) -> Cell:
    """The cell of a preset, a task, a method and a seed.

    Raises:
        KeyError: the preset has no such task.
    """
    preset = PRESETS[preset_name]
    training = preset.tasks[task]
    policy = {"type": method, **preset.policy, **training.policy}
    if method == "hdp":
        policy |= preset.hdp_policy | training.hdp_policy
    return Cell(
        group=f"paper/{preset_name}",
        name=f"{task}_{method}_seed{seed}",
        env=ENVS[task],
        demonstrations=training.demonstrations,
        policy=complete(policy, ENVS[task]),
        steps=training.steps,
        batch_size=training.batch_size,
        seed=seed,
        evaluations=preset.evaluations,
        starts=preset.starts,
        average_last=preset.average_last,
        facts={"preset": preset_name, "task_name": task},
    )


def observes_images(env: dict[str, Any]) -> bool:
    return env.get("obs_type", "state") != "state"


def exists(method: str, preset: str, task: str) -> bool:
    """Whether a preset has a task, and a method can do it."""
    takes_images = PreTrainedConfig.get_choice_class(method).takes_images
    return task in PRESETS[preset].tasks and (takes_images or not observes_images(ENVS[task]))


def stage(preset: str, method: str, task: str) -> int:
    """What of a seed comes first: of the paper's tasks our HDP, our Diffuser, then the paper's HDP."""
    if preset == "default" and method in ("hdp", "diffuser") and task not in _TASKS_2D:
        return ("hdp", "diffuser").index(method)
    return 2 if (preset, method, task) == ("paper", "hdp", "xarm_sorting") else 3


def make_cells(presets: list[str], tasks: list[str], methods: list[str], seeds: list[int]) -> list[Cell]:
    """All cells of some presets, tasks, methods and seeds, the ones most worth running first.

    The first seed of everything comes before the second of anything; of a seed, what `stage` says.
    """

    def worth(choice: tuple[int, str, str, str]) -> tuple[int, ...]:
        seed, method, preset, task = choice
        return seed, stage(preset, method, task), METHODS.index(method), list(PRESETS).index(preset), TASKS.index(task)

    choices = [choice for choice in product(seeds, methods, presets, tasks) if exists(*choice[1:])]
    return [make_cell(preset, task, method, seed) for seed, method, preset, task in sorted(choices, key=worth)]
