"""`hdp-train` beside `lerobot-train`: the data path alone, the step's overhead, and both commands end to end.

    python -m benchmarks.training_speed --root=outputs/datasets/xarm_sorting --horizon=145
    python -m benchmarks.training_speed --report    # docs/training_speed.md, from results of this and training_step.py

On one dataset and with one policy. What is compared is measured in turns, in a random order in each round, so that
whatever else the machine does falls on both; a ratio compares the two of a round, and is given as [first quartile,
median, third quartile].
"""

import argparse
import json
import random
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

import lerobot_policy_hdp  # noqa: F401 (registers the planners)
from lerobot_hdp.in_memory_dataset import InMemoryDataset

from .machine import RESULTS, describe_run, write_json
from .pages import DOCS
from .timing import quartiles, quartiles_of_ratio, take_turns
from .training_step import describe_steps, endless, open_for_training, training_steps

FILE = RESULTS / "training_speed.json"
PAGE = DOCS / "training_speed.md"


def data_path(dataset: LeRobotDataset, batch_size: int, horizon: int, rounds: int) -> dict[str, Any]:
    """Samples per second that each way reads, on one core."""
    item_by_item, at_once = (endless(source, batch_size, horizon) for source in (dataset, InMemoryDataset(dataset)))
    batches = 50
    times = take_turns(
        {"one": lambda: next(item_by_item), "many": lambda: [next(at_once) for _ in range(batches)]}, rounds
    )
    slow, fast = times["one"], [seconds / batches for seconds in times["many"]]
    return {
        "samples_per_s_lerobot": quartiles([batch_size / seconds for seconds in slow]),
        "samples_per_s_in_memory": quartiles([batch_size / seconds for seconds in fast]),
        "ratio": quartiles_of_ratio(slow, fast),
    }


def step_overhead(dataset: LeRobotDataset, config: PreTrainedConfig, batch_size: int, rounds: int) -> dict[str, Any]:
    """A whole step of LeRobot's loop over the bare one."""
    whole, bare = training_steps(dataset, config, batch_size)
    times = take_turns({"bare": bare, "whole": whole}, rounds)
    return {
        "bare_s": quartiles(times["bare"]),
        "whole_s": quartiles(times["whole"]),
        "ratio": quartiles_of_ratio(times["whole"], times["bare"]),
    }


def end_to_end(flags: list[str], steps: int, rounds: int) -> dict[str, Any]:
    """Samples per second of the two commands, by their own log, without the first steps."""
    rates: dict[str, list[float]] = {"lerobot-train": [], "hdp-train": []}
    for _ in range(rounds):
        for command in random.sample(list(rates), len(rates)):
            with tempfile.TemporaryDirectory() as folder:
                run_flags = [f"--output_dir={folder}/run", f"--steps={2 * steps}", f"--log_freq={steps}"]
                run = subprocess.run(
                    [Path(sys.executable).with_name(command), *flags, *run_flags, "--save_checkpoint=false"],
                    check=True,
                    capture_output=True,
                    text=True,
                )
            rates[command].append(float(re.findall(r"smp/s:(\d+)", run.stderr)[-1]))
            print(command, rates[command][-1], "samples/s", flush=True)
    ratios = [fast / slow for slow, fast in zip(*rates.values(), strict=True)]
    return {"samples_per_s": rates, "ratio": [round(ratio, 3) for ratio in ratios]}


def write_page() -> None:
    """The result in words."""
    file = json.loads(FILE.read_text())
    run, result = file["run"], file["result"]
    data, step, commands = result["data_path"], result["step"], result["end_to_end"]
    rates = {name: statistics.median(found) for name, found in commands["samples_per_s"].items()}

    def ratio(values: list[float]) -> str:
        low, median, high = (f"{value:.4g}" for value in values)
        return f"{median} ({low} to {high})"

    PAGE.write_text(
        "# `hdp-train` beside `lerobot-train`\n\n"
        f"`hdp` with {result['num_layers']} layers of width {result['width']} in bfloat16, "
        f"horizon {result['horizon']}, batches of {result['batch_size']}, dataset `{result['dataset']}`, "
        f"on {run['cores']} cores ({run['cpu']}, LeRobot {run['packages']['lerobot']}, "
        f"PyTorch {run['packages']['torch']}). Medians, and quartiles of the ratios, over {result['rounds']} rounds; "
        f"of training, {len(commands['ratio'])}.\n\n"
        "| | `lerobot-train` | `hdp-train` | ratio |\n|---|---|---|---|\n"
        f"| reading alone, one core, samples/s | {data['samples_per_s_lerobot'][1]:.0f} | "
        f"{data['samples_per_s_in_memory'][1]:.0f} | {ratio(data['ratio'])} |\n"
        f"| training, {result['num_workers']} workers for `lerobot-train`, samples/s | {rates['lerobot-train']:.0f} | "
        f"{rates['hdp-train']:.0f} | {ratio(quartiles(commands['ratio']))} |\n\n"
        f"A whole step of `hdp-train` takes {ratio(step['ratio'])} times as long as the bare forward pass, backward "
        "pass and optimiser on a batch at hand, on one core. A ratio below 1 shows the measurement's error.\n\n"
        f"`{run['command']}`, code of {run['git_commit']}.\n\n{describe_steps()}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("outputs/datasets/xarm_sorting"))
    parser.add_argument("--horizon", type=int, default=145)
    parser.add_argument("--batch_size", type=int, default=50)
    parser.add_argument("--num_layers", type=int, default=4)
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--num_workers", type=int, default=4, help="of lerobot-train; 4 is its default")
    parser.add_argument("--rounds", type=int, default=50, help="of the data path and the step")
    parser.add_argument("--command_rounds", type=int, default=5, help="of the commands, at least 2")
    parser.add_argument("--steps", type=int, default=20, help="of the commands, twice, the first for warming up")
    parser.add_argument("--report", action="store_true", help="only write docs/training_speed.md")
    options = parser.parse_args()
    if options.report:
        return write_page()

    sizes = {name: getattr(options, name) for name in ("horizon", "num_layers", "width")}
    config = PreTrainedConfig.get_choice_class("hdp")(**sizes, dtype="bfloat16", device="cpu", push_to_hub=False)
    dataset = open_for_training(options.root, options.horizon)
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
    left_out = ("root", "report")
    result = {name: value for name, value in vars(options).items() if name not in left_out}
    result["dataset"] = options.root.name
    torch.set_num_threads(1)
    run = describe_run()
    result["data_path"] = data_path(dataset, options.batch_size, options.horizon, options.rounds)
    result["step"] = step_overhead(dataset, config, options.batch_size, options.rounds)
    result["end_to_end"] = end_to_end(flags, options.steps, options.command_rounds)
    write_json(FILE, {"run": run, "result": result})
    write_page()
    print(PAGE.read_text())


if __name__ == "__main__":
    main()
