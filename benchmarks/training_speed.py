"""`hdp-train` beside `lerobot-train`: the data path alone, the step's overhead, and both commands end to end.

    python -m benchmarks.training_speed --root=outputs/datasets/xarm_sorting --horizon=145

On one dataset and with one policy. What is compared is measured in turns, so that whatever else the machine does falls
on both; a ratio compares neighbours, and is given as [first quartile, median, third quartile].
"""

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from torch.utils.data import DataLoader

import lerobot_policy_hdp  # noqa: F401 (registers the planners)
from lerobot_hdp.in_memory_dataset import InMemoryDataset

from .machine import describe_run

RESULTS = Path(__file__).parent / "results" / "training_speed.json"
PAGE = Path(__file__).parents[1] / "docs" / "training_speed.md"


def timed(function: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def quartiles(values: list[float]) -> list[float]:
    return [float(f"{value:.4g}") for value in statistics.quantiles(values, n=4, method="inclusive")]


def endless(dataset: LeRobotDataset, batch_size: int, horizon: int) -> Iterator[dict]:
    """Batches as LeRobot's training draws them, without workers."""
    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        episodes["dataset_from_index"], episodes["dataset_to_index"], drop_n_last_frames=horizon - 1, shuffle=True
    )
    loader = DataLoader(dataset, batch_size, sampler=sampler)
    while True:
        yield from loader


def data_path(dataset: LeRobotDataset, batch_size: int, horizon: int, rounds: int) -> dict[str, Any]:
    """Samples per second that each way reads, on one core."""
    item_by_item, at_once = (endless(source, batch_size, horizon) for source in (dataset, InMemoryDataset(dataset)))
    next(item_by_item), next(at_once)
    batches = 50
    times = [
        (timed(lambda: next(item_by_item)), timed(lambda: [next(at_once) for _ in range(batches)]) / batches)
        for _ in range(rounds)
    ]
    return {
        "samples_per_s_lerobot": quartiles([batch_size / slow for slow, _ in times]),
        "samples_per_s_in_memory": quartiles([batch_size / fast for _, fast in times]),
        "ratio": quartiles([slow / fast for slow, fast in times]),
    }


def step_overhead(dataset: LeRobotDataset, config: PreTrainedConfig, batch_size: int, rounds: int) -> dict[str, Any]:
    """A whole step of LeRobot's loop over the bare forward, backward and optimiser of the same policy."""
    policy = make_policy(config, ds_meta=dataset.meta)
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
    scheduler = config.get_scheduler_preset().build(optimizer, 1000)
    accelerator = Accelerator(cpu=True, mixed_precision={"bfloat16": "bf16", "float32": "no"}[config.dtype])
    batches = endless(InMemoryDataset(dataset), batch_size, config.horizon)
    policy, optimizer, scheduler = accelerator.prepare(policy, optimizer, scheduler)
    names = ("loss", "grad_norm", "lr", "update_s")
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
    bare(), whole()
    times = [(timed(bare), timed(whole)) for _ in range(rounds)]
    return {
        "bare_s": quartiles([bare_s for bare_s, _ in times]),
        "whole_s": quartiles([whole_s for _, whole_s in times]),
        "ratio": quartiles([whole_s / bare_s for bare_s, whole_s in times]),
        "ratio_of_medians": round(
            statistics.median(whole_s for _, whole_s in times) / statistics.median(bare_s for bare_s, _ in times), 4
        ),
    }


def end_to_end(flags: list[str], steps: int, rounds: int) -> dict[str, Any]:
    """Samples per second of the two commands, by their own log, without the first steps."""
    rates: dict[str, list[float]] = {"lerobot-train": [], "hdp-train": []}
    for _ in range(rounds):
        for command, found in rates.items():
            with tempfile.TemporaryDirectory() as folder:
                run_flags = [f"--output_dir={folder}/run", f"--steps={2 * steps}", f"--log_freq={steps}"]
                run = subprocess.run(
                    [Path(sys.executable).with_name(command), *flags, *run_flags, "--save_checkpoint=false"],
                    check=True,
                    capture_output=True,
                    text=True,
                )
            found.append(float(re.findall(r"smp/s:(\d+)", run.stderr)[-1]))
            print(command, found[-1], "samples/s", flush=True)
    ratios = [fast / slow for slow, fast in zip(*rates.values(), strict=True)]
    return {"samples_per_s": rates, "ratio": [round(ratio, 3) for ratio in ratios]}


def write_page() -> None:
    """The result in words."""
    file = json.loads(RESULTS.read_text())
    run, result = file["run"], file["result"]
    data, step, commands = result["data_path"], result["step"], result["end_to_end"]
    rates = {name: statistics.median(found) for name, found in commands["samples_per_s"].items()}
    PAGE.write_text(
        "# `hdp-train` beside `lerobot-train`\n\n"
        f"`hdp` with {result['num_layers']} layers of width {result['width']} in bfloat16, "
        f"horizon {result['horizon']}, batches of {result['batch_size']}, dataset `{result['dataset']}`, "
        f"on {run['cores']} cores ({run['cpu']}, LeRobot {run['packages']['lerobot']}, "
        f"PyTorch {run['packages']['torch']}). Medians; quartiles are in "
        f"[the results file](../benchmarks/results/{RESULTS.name}).\n\n"
        "| | `lerobot-train` | `hdp-train` | ratio |\n|---|---|---|---|\n"
        f"| reading alone, one core, samples/s | {data['samples_per_s_lerobot'][1]:.0f} | "
        f"{data['samples_per_s_in_memory'][1]:.0f} | {data['ratio'][1]:.0f} |\n"
        f"| training, {result['num_workers']} workers for `lerobot-train`, samples/s | {rates['lerobot-train']:.0f} | "
        f"{rates['hdp-train']:.0f} | {statistics.median(commands['ratio']):.2f} |\n\n"
        f"A whole step of `hdp-train` takes {step['ratio_of_medians']:.3f} times as long as the bare forward pass, "
        f"backward pass and optimiser on a batch at hand, on one core.\n\n`{run['command']}`\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("outputs/datasets/xarm_sorting"))
    parser.add_argument("--horizon", type=int, default=145)
    parser.add_argument("--batch_size", type=int, default=50)
    parser.add_argument("--num_layers", type=int, default=4)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--num_workers", type=int, default=4, help="of lerobot-train; 4 is its default")
    parser.add_argument("--rounds", type=int, default=10, help="of the data path and the step; commands take a third")
    parser.add_argument("--steps", type=int, default=20, help="of the commands, twice, the first for warming up")
    options = parser.parse_args()

    sizes = {name: getattr(options, name) for name in ("horizon", "num_layers", "width")}
    config = PreTrainedConfig.get_choice_class("hdp")(**sizes, dtype="bfloat16", device="cpu", push_to_hub=False)
    meta = LeRobotDatasetMetadata(f"local/{options.root.name}", root=options.root)
    windows = {"action": [i / meta.fps for i in range(options.horizon)]}
    dataset = LeRobotDataset(meta.repo_id, root=options.root, delta_timestamps=windows)
    flags = [
        "--policy.type=hdp",
        *(f"--policy.{name}={value}" for name, value in sizes.items()),
        "--policy.dtype=bfloat16",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--dataset.repo_id=local/{options.root.name}",
        f"--dataset.root={options.root}",
        "--dataset.video_backend=pyav",
        f"--batch_size={options.batch_size}",
        f"--num_workers={options.num_workers}",
        "--dataloader_multiprocessing_context=fork",
    ]
    result = {name: value for name, value in vars(options).items() if name != "root"} | {"dataset": options.root.name}
    torch.set_num_threads(1)
    result["data_path"] = data_path(dataset, options.batch_size, options.horizon, options.rounds)
    result["step"] = step_overhead(dataset, config, options.batch_size, options.rounds)
    result["end_to_end"] = end_to_end(flags, options.steps, max(options.rounds // 3, 1))
    RESULTS.write_text(json.dumps({"run": describe_run(), "result": result}, indent=2) + "\n")
    write_page()
    print(PAGE.read_text())


if __name__ == "__main__":
    main()
