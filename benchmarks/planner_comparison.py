"""All planners on 2D sorting with 2 and 3 blocks: the same demonstrations, samples, network size and starts.

python -m benchmarks.planner_comparison              # runs what is missing, then writes the table and the plot
python -m benchmarks.planner_comparison --list       # says what is finished and what is not
python -m benchmarks.planner_comparison --report     # only writes the table and the plot (needs the extra `benchmarks`)

A cell is one planner, trained with one seed. It trains in this process, on the dataset held in memory, with LeRobot's
own policies, processors, optimizers and schedulers, and is evaluated by LeRobot's own rollout. Its learning curve goes
to `benchmarks/results/planners/<cell>.json`. A finished cell is never run again; an interrupted one goes on from its
last evaluation.
"""

import argparse
import json
import multiprocessing
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import torch
from lerobot.common.train_utils import load_training_state, save_training_state
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import EpisodeAwareSampler, compute_sampler_state
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import set_seed
from torch import Tensor
from torch.utils.data import DataLoader

import lerobot_policy_hdp  # noqa: F401 (registers the planners)
from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.in_memory_dataset import InMemoryDataset
from lerobot_hdp.modeling_hdp import HDPPolicy

from .machine import describe_run
from .planner_latency import PLANNERS, num_parameters

RESULTS = Path(__file__).parent / "results" / "planners"
WORK = Path("outputs/benchmarks/planners")
DATASETS = Path("outputs/datasets")
PREDICTION_TYPES = ("sample", "epsilon")
HIERARCHICAL = ("hd", "chd")
"""Two networks each, so that their size is reported and not matched."""
MAX_SIZE_RATIO = 1.02
FIRST_EVALUATION_SEED = 1_000_000


@dataclass(frozen=True)
class Protocol:
    """What all cells of a comparison share.

    Attributes:
        num_episodes: demonstrations.
        steps: optimiser steps.
        evaluate_every: optimiser steps between two evaluations; divides `steps`.
        starts: fresh starts of an evaluation, the same for all planners and others at each evaluation.
        batch_size: divides the number of demonstrations.
        network: options of every policy.
    """

    num_episodes: int = 200
    steps: int = 1500
    evaluate_every: int = 250
    starts: int = 100
    batch_size: int = 50
    network: dict[str, Any] = field(
        default_factory=lambda: {"num_layers": 5, "width": 112, "dtype": "bfloat16", "num_inference_steps": 50}
    )


@dataclass(frozen=True)
class Cell:
    """One planner, trained once."""

    n_blocks: int
    prediction_type: str
    planner: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.n_blocks}_blocks_{self.prediction_type}_{self.planner}_seed{self.seed}"

    @property
    def result_file(self) -> Path:
        return RESULTS / f"{self.name}.json"

    @property
    def checkpoint(self) -> Path:
        return WORK / self.name

    @property
    def env(self) -> HDPEnv:
        return HDPEnv(task="BlockSorting2D-v0", n_blocks=self.n_blocks, waypoints_per_pose=1)

    def policy_options(self, protocol: Protocol) -> dict[str, Any]:
        """What differs from the `default` preset."""
        options = {"prediction_type": self.prediction_type, **protocol.network}
        if self.prediction_type == "epsilon":
            options["optimizer_lr"] = 5e-4
            if self.planner == "hdp":
                options["symbol_loss_weight"] = 1 / 30  # the paper's, against the error of the noise
        return options

    def policy_config(self, protocol: Protocol) -> PreTrainedConfig:
        return PreTrainedConfig.get_choice_class(self.planner)(
            horizon=self.env.planning_task.horizon,
            device="cpu",
            push_to_hub=False,
            **self.policy_options(protocol),
        )


def dataset_root(cell: Cell, protocol: Protocol) -> Path:
    """The dataset's folder; it is recorded when it is not there."""
    root = DATASETS / f"block_sorting_2d_{cell.n_blocks}_blocks"
    if not root.exists():
        dataset = RecordDatasetConfig(f"local/{root.name}", root=str(root), num_episodes=protocol.num_episodes)
        record(RecordConfig(dataset, cell.env, resume=True))
    return root


def load_dataset(root: Path, config: PreTrainedConfig) -> InMemoryDataset:
    """The dataset in memory, with the windows that a policy trains on."""
    meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    windows = resolve_delta_timestamps(config, meta)
    return InMemoryDataset(LeRobotDataset(meta.repo_id, root=root, delta_timestamps=windows, video_backend="pyav"))


def batches(
    dataset: LeRobotDataset, config: PreTrainedConfig, batch_size: int, seed: int, step: int
) -> Iterator[dict[str, Tensor]]:
    """The batches of `lerobot-train` from a step on."""
    episodes = dataset.meta.episodes
    sampler = EpisodeAwareSampler(
        episodes["dataset_from_index"],
        episodes["dataset_to_index"],
        drop_n_last_frames=config.drop_n_last_frames,
        shuffle=True,
        seed=seed,
    )
    sampler.load_state_dict(compute_sampler_state(step, len(sampler), batch_size, num_processes=1))
    loader = DataLoader(dataset, batch_size, sampler=sampler)
    while True:
        yield from loader


class Training:
    """A cell in training: its policy, and all that a checkpoint has to hold."""

    def __init__(self, cell: Cell, protocol: Protocol):
        set_seed(cell.seed)
        self.cell, self.protocol = cell, protocol
        config = cell.policy_config(protocol)
        self.dataset = load_dataset(dataset_root(cell, protocol), config)
        meta = self.dataset.meta
        self.policy: HDPPolicy = make_policy(config, ds_meta=meta)
        self.preprocessor, self.postprocessor = make_pre_post_processors(config, dataset_stats=meta.stats)
        self.step, self.seconds, self.curve = 0, 0.0, []
        if cell.checkpoint.exists():
            self.policy = get_policy_class(cell.planner).from_pretrained(cell.checkpoint)
        self.optimizer = config.get_optimizer_preset().build(self.policy.get_optim_params())
        self.scheduler = config.get_scheduler_preset().build(self.optimizer, protocol.steps)
        if cell.checkpoint.exists():
            self.step, self.optimizer, self.scheduler = load_training_state(
                cell.checkpoint, self.optimizer, self.scheduler
            )
            saved = json.loads((cell.checkpoint / "curve.json").read_text())
            self.seconds, self.curve = saved["train_s"], saved["curve"]

    def train(self, steps: int) -> None:
        """Take optimiser steps, as `lerobot-train` does."""
        start, config = time.perf_counter(), self.policy.config
        self.policy.train()
        data = batches(self.dataset, config, self.protocol.batch_size, self.cell.seed, self.step)
        for batch, _ in zip(data, range(steps), strict=False):
            with torch.autocast("cpu", torch.bfloat16, enabled=config.dtype == "bfloat16"):
                loss, _ = self.policy.forward(self.preprocessor(batch))
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), config.optimizer_grad_clip_norm)
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.scheduler.step()
            self.policy.update()
        self.step += steps
        self.seconds += time.perf_counter() - start

    def evaluate(self) -> None:
        """Add a point to the learning curve."""
        number, starts = len(self.curve), self.protocol.starts
        set_seed(self.cell.seed + number)
        environments = make_env(self.cell.env, n_envs=starts)
        start = time.perf_counter()
        info = eval_policy_all(
            environments,
            self.policy,
            *make_env_pre_post_processors(self.cell.env, self.policy.config),
            self.preprocessor,
            self.postprocessor,
            n_episodes=starts,
            start_seed=FIRST_EVALUATION_SEED + number * starts,
        )
        close_envs(environments)
        self.curve.append(
            {
                "step": self.step,
                "success_rate": round(info["overall"]["pc_success"] / 100, 4),
                "mean_score": round(info["overall"]["avg_sum_reward"], 4),
                "train_s": round(self.seconds, 1),
                "evaluation_s": round(time.perf_counter() - start, 1),
            }
        )

    def save(self) -> None:
        """Write a checkpoint in place of the last one."""
        new = self.cell.checkpoint.with_name(self.cell.name + ".new")
        shutil.rmtree(new, ignore_errors=True)
        self.policy.save_pretrained(new)
        save_training_state(new, self.step, self.optimizer, self.scheduler)
        (new / "curve.json").write_text(json.dumps({"train_s": self.seconds, "curve": self.curve}))
        shutil.rmtree(self.cell.checkpoint, ignore_errors=True)
        new.rename(self.cell.checkpoint)


def run_cell(cell: Cell, protocol: Protocol, run_facts: dict[str, object]) -> None:
    """Train and evaluate one planner, from where it stopped, and write its result."""
    torch.set_num_threads(1)
    training = Training(cell, protocol)
    while training.step < protocol.steps:
        training.train(protocol.evaluate_every)
        training.evaluate()
        training.save()
        print(cell.name, training.curve[-1], flush=True)
    result = {
        "planner": cell.planner,
        "n_blocks": cell.n_blocks,
        "prediction_type": cell.prediction_type,
        "seed": cell.seed,
        "parameters": num_parameters(training.policy),
        "batch_size": protocol.batch_size,
        "starts": protocol.starts,
        "policy": cell.policy_options(protocol),
        "curve": training.curve,
    }
    cell.result_file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = cell.result_file.with_suffix(".new")
    unfinished.write_text(json.dumps({"run": run_facts, "result": result}, indent=2) + "\n")
    unfinished.rename(cell.result_file)
    shutil.rmtree(cell.checkpoint)


def check_sizes(cells: list[Cell], protocol: Protocol) -> None:
    """The flat planners must have the same number of parameters, within 2 %.

    Raises:
        ValueError: they have not.
    """
    for n_blocks in {cell.n_blocks for cell in cells}:
        sizes = {}
        for planner in set(PLANNERS) - set(HIERARCHICAL):
            cell = Cell(n_blocks, "sample", planner, seed=0)
            meta = LeRobotDatasetMetadata("local", root=dataset_root(cell, protocol))
            sizes[planner] = num_parameters(make_policy(cell.policy_config(protocol), ds_meta=meta))
        if max(sizes.values()) > MAX_SIZE_RATIO * min(sizes.values()):
            raise ValueError(f"with {n_blocks} blocks, the planners' sizes differ by more than 2 %: {sizes}")


def state_of(cell: Cell) -> str:
    """`finished`, the step where it stopped, or `not begun`."""
    if cell.result_file.exists():
        return "finished"
    if (curve := cell.checkpoint / "curve.json").exists():
        return f"stopped after step {json.loads(curve.read_text())['curve'][-1]['step']}"
    return "not begun"


def main() -> None:
    protocol = Protocol()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_blocks", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--predictions", nargs="+", default=PREDICTION_TYPES, choices=PREDICTION_TYPES)
    parser.add_argument("--planners", nargs="+", default=PLANNERS, choices=PLANNERS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, each on one core")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()

    # Seed by seed and planner by planner, so that a part of the comparison is a comparison, too.
    order = product(options.seeds, options.n_blocks, options.predictions, options.planners)
    cells = [Cell(n_blocks, prediction, planner, seed) for seed, n_blocks, prediction, planner in order]
    if options.list:
        for cell in cells:
            print(f"{cell.name:45} {state_of(cell)}")
        return
    if not options.report:
        missing = [cell for cell in cells if not cell.result_file.exists()]
        check_sizes(missing, protocol)
        run_facts = describe_run()
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(options.processes, mp_context=context) as executor:
            for future in [executor.submit(run_cell, cell, protocol, run_facts) for cell in missing]:
                future.result()

    from .planner_report import write_report

    write_report(sorted(RESULTS.glob("*.json")))


if __name__ == "__main__":
    main()
