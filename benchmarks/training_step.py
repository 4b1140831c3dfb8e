"""A training step of the paper's network with each way of making it fast switched on or off.

    python -m benchmarks.training_step --root=outputs/datasets/XArmSorting_200_episodes --device=cuda
    python -m benchmarks.training_speed --report    # its table is on docs/training_speed.md

A step is all that `hdp-train` does between two: reading, preprocessing, forward and backward pass, optimiser, moving
average. The settings take turns, in a random order in each round.
"""

import argparse
import gc
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import AutocastKwargs
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from torch.utils.data import DataLoader

import lerobot_policy_hdp  # noqa: F401 (registers the planners)
from lerobot_hdp.in_memory_dataset import InMemoryDataset

from .machine import RESULTS, describe_run, write_json
from .pages import markdown_table
from .timing import quartiles, take_turns, timed

FILE = RESULTS / "training_step.json"
GRAPHS = {"compile_model": True, "compile_mode": "reduce-overhead"}
SETTINGS: dict[str, dict[str, Any]] = {
    "bfloat16, fused AdamW": {},
    "float32": {"dtype": "float32"},
    "AdamW not fused": {"optimizer_fused": False},
    "no moving average": {"ema_max_decay": 0.0},
    "Muon": {"optimizer_type": "muon"},
    "compiled": {"compile_model": True},
    "compiled, with CUDA graphs": GRAPHS,
    "Muon, compiled, with CUDA graphs": {"optimizer_type": "muon", **GRAPHS},
}
"""By what they are called, how they differ from the first."""

WHAT_THE_SETTINGS_ARE = """\
- bfloat16 (`--policy.dtype=bfloat16`) is autocast; weights, their average and the optimiser stay float32.
- AdamW is fused on CUDA; `--policy.optimizer_fused=false` switches that off.
- Compiled: `--policy.compile_model=true`, the denoiser through `torch.compile`; with CUDA graphs:
  `--policy.compile_mode=reduce-overhead`.
- Muon (`--policy.optimizer_type=muon`) updates all matrices of one shape together.
- Attention is PyTorch's `scaled_dot_product_attention`, with the kernel that PyTorch chooses.

The dataset stays in the host's memory. Once a batch is on the device, the host waits for it three times a step: for the
losses in the log, and in LeRobot's loop for the loss and for the norm of the gradient.
"""


def open_for_training(root: Path, horizon: int) -> LeRobotDataset:
    """A recorded dataset, with as many actions in each sample as a plan has."""
    meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    windows = {"action": [i / meta.fps for i in range(horizon)]}
    return LeRobotDataset(meta.repo_id, root=root, delta_timestamps=windows)


def endless(dataset: LeRobotDataset, batch_size: int, horizon: int) -> Iterator[dict]:
    """Batches as LeRobot's training draws them, without workers."""
    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        episodes["dataset_from_index"], episodes["dataset_to_index"], drop_n_last_frames=horizon - 1, shuffle=True
    )
    loader = DataLoader(dataset, batch_size, sampler=sampler)
    while True:
        yield from loader


def training_steps(
    dataset: LeRobotDataset, config: PreTrainedConfig, batch_size: int
) -> tuple[Callable[[], None], Callable[[], None]]:
    """A whole step of LeRobot's loop, and the bare forward pass, backward pass and optimiser of the same policy."""
    policy = make_policy(config, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    scheduler = config.get_scheduler_preset().build(optimizer, 1000)
    # One state for all accelerators of a process, so that the precision is switched by the context alone.
    autocast = AutocastKwargs(enabled=config.dtype == "bfloat16")
    accelerator = Accelerator(cpu=config.device == "cpu", mixed_precision="bf16", kwargs_handlers=[autocast])
    batches = endless(InMemoryDataset(dataset), batch_size, config.horizon)
    policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
    names = ("loss", "grad_norm", "lr", "update_s", "gpu_mem_gb")
    meters = {name: AverageMeter(name) for name in names}
    tracker = MetricsTracker(batch_size, dataset.num_frames, dataset.num_episodes, meters, accelerator=accelerator)
    fixed = preprocessor(next(batches))

    def whole() -> None:
        batch = preprocessor(next(batches))
        update_policy(tracker, policy, batch, optimizer, 10.0, accelerator=accelerator, lr_scheduler=scheduler)

    def bare() -> None:
        with accelerator.autocast():
            loss, _ = policy.forward(fixed)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    policy.train()
    return whole, bare


def steps_on(device: str, step: Callable[[], None], steps: int) -> None:
    """Some steps, to their end on the device."""
    for _ in range(steps):
        step()
    if device == "cuda":
        torch.cuda.synchronize()


def describe_steps() -> str:
    """The part of docs/training_speed.md about a GPU."""
    if not FILE.exists():
        return f"## A step on a GPU\n\nNot measured yet.\n\n{WHAT_THE_SETTINGS_ARE}"
    file = json.loads(FILE.read_text())
    run, result = file["run"], file["result"]
    rows = [
        [name, f"{middle:.3g} ({low:.3g} to {high:.3g})", f"{result['first_step_s'][name]:g}"]
        for name, (low, middle, high) in result["ms"].items()
    ]
    return (
        "## A step on a GPU\n\n"
        f"`hdp` with {result['num_layers']} layers of width {result['width']}, the preset `paper`, horizon "
        f"{result['horizon']} and {result['symbolic_horizon']} symbols, batches of {result['batch_size']}, on one "
        f"{run['gpu']} (PyTorch {run['packages']['torch']}). Each row differs from the first by what it names; medians "
        f"and quartiles of {result['rounds']} rounds of {result['steps']} steps.\n\n"
        f"{markdown_table(['setting', 'ms a step', 'first step, s'], rows)}\n"
        f"`{run['command']}`, code of {run['git_commit']}.\n\n{WHAT_THE_SETTINGS_ARE}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, required=True, help="a recorded dataset")
    parser.add_argument("--horizon", type=int, default=145)
    parser.add_argument("--symbolic_horizon", type=int, default=108)
    parser.add_argument("--num_layers", type=int, default=8)
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--batch_size", type=int, default=50, help="one that divides the episodes, to be compiled once")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--steps", type=int, default=20, help="of a round")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()

    dataset = open_for_training(options.root, options.horizon)
    size = {name: getattr(options, name) for name in ("horizon", "symbolic_horizon", "num_layers", "width", "device")}
    functions, first_call_s = {}, {}
    for name in options.settings:
        fields = {"preset": "paper", "dtype": "bfloat16", "push_to_hub": False, **size, **SETTINGS[name]}
        config = PreTrainedConfig.get_choice_class("hdp")(**fields)
        whole, _ = training_steps(dataset, config, options.batch_size)
        functions[name] = partial(steps_on, options.device, whole, options.steps)
        first_call_s[name] = round(timed(whole), 1)  # with compilation
        print(f"{name}: first step {first_call_s[name]} s", flush=True)
    gc.collect()
    gc.disable()  # a collection that falls on one setting would count as its own
    facts = {**{name: value for name, value in vars(options).items() if name != "root"}, "dataset": options.root.name}

    def save(times: dict[str, list[float]]) -> None:
        rounds = len(next(iter(times.values())))
        milliseconds = {name: quartiles([1000 * s / options.steps for s in found]) for name, found in times.items()}
        result = {**facts, "rounds": rounds, "first_step_s": first_call_s, "ms": milliseconds}
        write_json(FILE, {"run": describe_run(), "result": result})
        print(f"{rounds} of {options.rounds} rounds: " + ", ".join(f"{n} {ms[1]} ms" for n, ms in milliseconds.items()))

    take_turns(functions, options.rounds, after_round=save)


if __name__ == "__main__":
    main()
