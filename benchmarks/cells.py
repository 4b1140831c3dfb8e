"""Cells: one planner, trained once with `hdp-train` and evaluated along the way. What is finished is never done again.

A cell's figures go to `benchmarks/results/<group>/<cell>.json`, its checkpoints, its log and what is known so far to
`outputs/cells/<group>/<cell>/`. An interrupted cell goes on from its last checkpoint.
"""

import json
import math
import os
import shutil
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.factory import get_policy_class

from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.scripts import hdp_train

from .evaluation import evaluate
from .machine import describe_run

RESULTS = Path(__file__).parent / "results"
WORK = Path("outputs/cells")
DATASETS = Path("outputs/datasets")
FIRST_EVALUATION_SEED = 1_000_000
POLL_S = 2.0
SHORTEST_TRAINING_MIN = 0.5
"""A training that the budget leaves less time for is not begun."""
PROCESSES = get_context("forkserver")
PROCESSES.set_forkserver_preload([__name__])  # LeRobot is imported once, not by every process


@dataclass(frozen=True)
class Cell:
    """One planner, trained once.

    Attributes:
        group: of cells, and the folder of their results.
        name: of the cell in its group.
        env: the task, as under `env` in a train config.
        demonstrations: to record and to train on.
        policy: its `type` and options, as under `policy` in a train config.
        steps, batch_size, seed: of the training.
        evaluations: at regular intervals of the training, the last one at its end.
        starts: fresh starts of an evaluation: the same for all cells of a task, others at each evaluation.
        average_last: evaluations at the end whose mean is the cell's figure.
        facts: what a report needs to know beside these.
    """

    group: str
    name: str
    env: dict[str, Any]
    demonstrations: int
    policy: dict[str, Any]
    steps: int
    batch_size: int
    seed: int
    evaluations: int
    starts: int
    average_last: int
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def result_file(self) -> Path:
        return RESULTS / self.group / f"{self.name}.json"

    @property
    def folder(self) -> Path:
        return WORK / self.group / self.name

    @property
    def checkpoints(self) -> Path:
        return self.folder / "train" / "checkpoints"

    @property
    def last_checkpoint(self) -> Path:
        """The `pretrained_model` folder of the last checkpoint; it stays when the cell is finished."""
        return self.checkpoints / "last" / "pretrained_model"

    @property
    def env_config(self) -> HDPEnv:
        return HDPEnv(**self.env)

    @property
    def dataset_root(self) -> Path:
        return DATASETS / f"{dataset_name(self.env)}_{self.demonstrations}"

    @property
    def evaluate_every(self) -> int:
        """Optimiser steps between two evaluations. There may be fewer before the last one."""
        return math.ceil(self.steps / self.evaluations)

    def train_config(self) -> dict[str, Any]:
        """For `hdp-train --config_path`."""
        horizon = self.env_config.planning_task.horizon
        return {
            "dataset": {
                "repo_id": f"local/{self.dataset_root.name}",
                "root": str(self.dataset_root),
                "video_backend": "pyav",
            },
            "env": {"type": "hdp", **self.env},
            "policy": {"horizon": horizon, "push_to_hub": False, **self.policy},
            "output_dir": str(self.folder / "train"),
            "batch_size": self.batch_size,
            "steps": self.steps,
            "seed": self.seed,
            "save_freq": self.evaluate_every,
            "log_freq": 100,
            "env_eval_freq": 0,
        }

    def state(self) -> str:
        """`finished`, the step where it stopped, or `missing`."""
        if self.result_file.exists():
            return "finished"
        step = last_step(self.folder)
        return f"stopped after step {step} of {self.steps}" if step else "missing"


def dataset_name(env: dict[str, Any]) -> str:
    """`xarm_sorting`, `block_sorting_2d_3_blocks`, ...: what the task's train config in `configs/` is called."""
    name = {
        "BlockSorting2D-v0": "block_sorting_2d",
        "XArmSorting-v0": "xarm_sorting",
        "XArmArrangeBlocks-v0": "xarm_arrange_blocks",
        "XArmToolUse-v0": "xarm_tool_use",
    }[env["task"]]
    return f"{name}_{env['n_blocks']}_blocks" if "n_blocks" in env else name


@dataclass
class Progress:
    """What is known of a cell that is not finished.

    Attributes:
        train_s: seconds in `hdp-train`, its start and its checkpoints included.
        curve: the evaluations so far.
    """

    train_s: float = 0.0
    curve: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def load(cls, cell: Cell) -> "Progress":
        path = cell.folder / "progress.json"
        return cls(**json.loads(path.read_text())) if path.exists() else cls()

    def save(self, cell: Cell) -> None:
        _write_json(cell.folder / "progress.json", asdict(self))


def record_dataset(cell: Cell, num_workers: int) -> None:
    """Record a cell's demonstrations, if they are not there."""
    if not (cell.dataset_root / "meta" / "episodes").exists():
        config = RecordDatasetConfig(f"local/{cell.dataset_root.name}", cell.dataset_root, cell.demonstrations)
        record(RecordConfig(config, cell.env_config, num_workers=num_workers, resume=True))


def run_cells(cells: list[Cell], processes: int = 1, budget_minutes: float | None = None) -> None:
    """Run what is missing of some cells, in their order.

    Args:
        cells: to run.
        processes: cells at a time; they share the cores. With one, a cell is evaluated while its training goes on.
        budget_minutes: cells are stopped with a checkpoint when it is spent, and no more are begun.

    Raises:
        SystemExit: a cell failed; the others have been run.
    """
    deadline = None if budget_minutes is None else time.time() + 60 * budget_minutes
    missing = [cell for cell in cells if not cell.result_file.exists()]
    for cell in missing:
        record_dataset(cell, num_workers=os.cpu_count() or 1)
    run_facts = describe_run()
    with ProcessPoolExecutor(
        processes, mp_context=PROCESSES, initializer=_share_cores, initargs=(processes,)
    ) as executor:
        futures = [executor.submit(run_cell, cell, run_facts, processes == 1, deadline) for cell in missing]
        for future in as_completed(futures):
            print(future.exception() or future.result(), flush=True)
    failures = [str(future.exception()) for future in futures if future.exception()]
    if failures:
        raise SystemExit("\n".join(["Some cells failed; call again to go on with them:", *failures]))


def run_cell(cell: Cell, run_facts: dict[str, Any], evaluate_meanwhile: bool, deadline: float | None) -> str:
    """Train and evaluate a cell from where it stopped; write its result if it comes to an end.

    Args:
        cell: to run.
        run_facts: of `describe_run`.
        evaluate_meanwhile: evaluate checkpoints while the training goes on, not after it.
        deadline: on `time.time()`'s clock, when the training stops with a checkpoint. Checkpoints that are there are
            evaluated in any case.

    Returns:
        One line that says how it went.

    Raises:
        RuntimeError: `hdp-train` failed; names its log.
    """
    progress, training = Progress.load(cell), None
    if last_step(cell.folder) < cell.steps:
        minutes = None if deadline is None else (deadline - time.time()) / 60
        if minutes is not None and minutes < SHORTEST_TRAINING_MIN:
            return f"{cell.name}: {cell.state()}, no time left"
        training = start_training(cell, minutes)
    before, start = progress.train_s, time.time()
    while training is not None and training.is_alive():
        time.sleep(POLL_S)
        progress.train_s = before + time.time() - start
        if evaluate_meanwhile:
            evaluate_checkpoints(cell, progress)
        cell.folder.mkdir(parents=True, exist_ok=True)
        progress.save(cell)
    if training is not None and training.exitcode:
        raise RuntimeError(f"{cell.name}: hdp-train failed, see {cell.folder / 'train.log'}")
    evaluate_checkpoints(cell, progress)
    if last_step(cell.folder) < cell.steps:
        return f"{cell.name}: {cell.state()}"
    _write_json(cell.result_file, {"run": run_facts, "result": result_of(cell, progress)})
    return f"{cell.name}: success {progress.curve[-1]['success_rate']:.0%} in the end, {progress.train_s / 60:.1f} min"


def start_training(cell: Cell, minutes: float | None) -> BaseProcess:
    """Start or resume `hdp-train` in a process of its own, which writes to `train.log` in the cell's folder."""
    cell.folder.mkdir(parents=True, exist_ok=True)
    arguments = [] if minutes is None else [f"--max_train_minutes={minutes:.2f}"]
    if last_step(cell.folder):
        arguments += ["--resume=true", f"--config_path={cell.last_checkpoint / 'train_config.json'}"]
    else:
        shutil.rmtree(cell.folder / "train", ignore_errors=True)
        config = cell.folder / "train_config.json"
        _write_json(config, cell.train_config())
        arguments += [f"--config_path={config}"]
    training = PROCESSES.Process(
        target=_hdp_train, args=(arguments, cell.folder / "train.log", torch.get_num_threads())
    )
    training.start()
    return training


def _hdp_train(arguments: list[str], log: Path, threads: int) -> None:
    """What the command `hdp-train` does, without its start-up time."""
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    torch.set_num_threads(threads)
    sys.argv = ["hdp-train", *arguments]
    hdp_train.main()


def evaluate_checkpoints(cell: Cell, progress: Progress) -> None:
    """Evaluate the checkpoints that are not in the learning curve yet, and delete all but the last one."""
    last = last_step(cell.folder)
    done = {point["step"] for point in progress.curve}
    for checkpoint in sorted(path for path in cell.checkpoints.glob("[0-9]*") if int(path.name) <= last):
        step = int(checkpoint.name)
        if step not in done and (step % cell.evaluate_every == 0 or step == cell.steps):
            first_seed = FIRST_EVALUATION_SEED + len(progress.curve) * cell.starts
            outcome = evaluate(checkpoint / "pretrained_model", cell.starts, first_seed)
            progress.curve.append({"step": step, **outcome})
            progress.save(cell)
        if step < last:
            shutil.rmtree(checkpoint)


def result_of(cell: Cell, progress: Progress) -> dict[str, Any]:
    """What a results file says about a finished cell."""
    policy = get_policy_class(cell.policy["type"]).from_pretrained(cell.last_checkpoint)
    return {
        **cell.facts,
        "task": cell.env["task"].removesuffix("-v0"),
        "planner": cell.policy["type"],
        "seed": cell.seed,
        "demonstrations": cell.demonstrations,
        "steps": cell.steps,
        "batch_size": cell.batch_size,
        "starts": cell.starts,
        "average_last": cell.average_last,
        "policy": cell.policy,
        "parameters": num_parameters(policy),
        "network_calls_per_plan": policy.config.num_inference_steps,
        "train_s": round(progress.train_s, 1),
        "samples_per_second": round(cell.steps * cell.batch_size / progress.train_s, 1),
        "curve": progress.curve,
    }


def num_parameters(policy: HDPPolicy) -> int:
    """Parameters of the network that is trained, without their moving average."""
    return sum(parameter.numel() for parameter in policy.planner.parameters())


def last_step(folder: Path) -> int:
    """Step of the last complete checkpoint in a cell's folder; 0 if there is none."""
    last = folder / "train" / "checkpoints" / "last"
    return int(last.resolve().name) if last.exists() else 0


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".new")
    unfinished.write_text(json.dumps(content, indent=2) + "\n")
    unfinished.rename(path)


def _share_cores(processes: int) -> None:
    """Let each process, and the training that it starts, use its part of the cores."""
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // processes))
