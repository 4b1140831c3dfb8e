"""Cells: one planner, trained once with `hdp-train` and evaluated along the way. What is finished is never done again.

A cell's figures go to `benchmarks/results/<group>/<cell>.json`, its checkpoints, its log and what is known so far to
`outputs/cells/<group>/<cell>/`. An interrupted cell goes on from its last checkpoint, whenever it was interrupted.
"""

import json
import math
import os
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import torch
from lerobot.scripts import lerobot_train

from dataset_tools.interruption import one_process, when_parent_ends
from dataset_tools.record import RecordConfig, RecordDatasetConfig, record
from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.scripts import hdp_train

from .evaluation import evaluate, load_policy
from .machine import RESULTS, describe_run, write_json

WORK = Path("outputs/cells")
DATASETS = Path("outputs/datasets")
FIRST_EVALUATION_SEED = 1_000_000
POLL_S = 1.0
SHORTEST_TRAINING_S = 30.0
"""A training that the budget leaves less time for is not begun."""
CORES_TO_EVALUATE_MEANWHILE = {"cpu": 4, "cuda": 2}
"""By the device that trains: with fewer, a cell is not evaluated meanwhile, because that would slow its training."""
TRAIN_S = "train_s.json"
"""In a checkpoint's folder, written last: the seconds of training up to it. A checkpoint without it is incomplete."""
os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")  # else what asks for a GPU on import breaks CUDA in forks
PROCESSES = get_context("forkserver")
PROCESSES.set_forkserver_preload([__name__])  # so that LeRobot is imported once, not by every training


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
        starts: fresh starts of an evaluation: the same for all cells of a task that have as many, others at each
            evaluation.
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
    def last_checkpoint(self) -> Path | None:
        """The `pretrained_model` folder of the last checkpoint, if there is one; it stays when the cell is finished."""
        complete = complete_checkpoints(self.folder)
        return complete[-1] / "pretrained_model" if complete else None

    @property
    def last_step(self) -> int:
        """Optimiser steps up to the last checkpoint."""
        complete = complete_checkpoints(self.folder)
        return int(complete[-1].name) if complete else 0

    @property
    def env_config(self) -> HDPEnv:
        return HDPEnv(**self.env)

    @property
    def dataset_root(self) -> Path:
        task, *parameters = self.env.items()
        values = [(name, "_".join(value) if isinstance(value, list) else value) for name, value in parameters]
        parts = [task[1].removesuffix("-v0"), *(f"{name}_{value}" for name, value in values)]
        return DATASETS / "_".join([*parts, f"{self.demonstrations}_episodes"])

    @property
    def settings(self) -> dict[str, Any]:
        """All that its figures depend on, beside the code."""
        names = ("env", "demonstrations", "policy", "steps", "batch_size", "seed")
        names += ("evaluations", "starts", "average_last")
        return {name: getattr(self, name) for name in names}

    @property
    def settings_file(self) -> Path:
        """The settings with which it was begun."""
        return self.folder / "settings.json"

    @property
    def evaluate_every(self) -> int:
        """Optimiser steps between two evaluations. There may be fewer before the last one."""
        return math.ceil(self.steps / self.evaluations)

    @property
    def samples(self) -> int:
        """Demonstrations seen in training, with repetition: LeRobot's last batch of an epoch is smaller."""
        return self.steps * self.demonstrations // math.ceil(self.demonstrations / self.batch_size)

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
        """`finished`, what is left to do, or `missing`."""
        if self.result_file.exists():
            return "finished"
        if self.last_step == self.steps:
            return "trained, not yet evaluated"
        return f"trained {self.last_step} steps of {self.steps}" if self.last_step else "missing"

    def check_result(self, result: dict[str, Any]) -> None:
        """Refuse a result that another description of this cell has made.

        Raises:
            ValueError: it was trained or evaluated otherwise than this cell says.
        """
        for name, value in self.settings.items():
            if result[name] != value:
                raise ValueError(
                    f"{self.result_file} was made with {name}={result[name]}, not {value}: delete it, or put the old "
                    "setting back"
                )

    def check_begun(self) -> None:
        """Refuse to go on with what was begun under another description of this cell.

        Raises:
            ValueError: its folder holds a checkpoint of other settings.
        """
        if self.last_checkpoint is None:
            return
        if not self.settings_file.exists() or json.loads(self.settings_file.read_text()) != self.settings:
            raise ValueError(f"{self.folder} was begun with other settings: delete it to begin again")


def read_result(cell: Cell) -> dict[str, Any] | None:
    """The content of a finished cell's file: `run` and `result`; None if there is none.

    Raises:
        ValueError: see `Cell.check_result`.
    """
    if not cell.result_file.exists():
        return None
    content = json.loads(cell.result_file.read_text())
    cell.check_result(content["result"])
    return content


def all_runs(content: dict[str, Any]) -> list[dict[str, Any]]:
    """All runs (`describe_run`) that a results file comes from, the last one last."""
    return [*content.get("earlier_runs", []), content["run"]]


def points_that_count(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Of a result's learning curve, the evaluations at its end whose mean is the cell's figure."""
    return result["curve"][-result["average_last"] :]


def complete_checkpoints(folder: Path) -> list[Path]:
    """The complete checkpoints in a cell's folder, by their step."""
    return sorted(path.parent for path in folder.glob(f"train/checkpoints/[0-9]*/{TRAIN_S}"))


@dataclass
class Progress:
    """What is known of a cell that is not finished.

    Attributes:
        curve: the evaluations so far.
        runs: of `describe_run`, for each time that it was begun or gone on with.
    """

    curve: list[dict[str, Any]] = field(default_factory=list)
    runs: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def load(cls, cell: Cell) -> "Progress":
        path = cell.folder / "progress.json"
        return cls(**json.loads(path.read_text())) if path.exists() else cls()

    def save(self, cell: Cell) -> None:
        write_json(cell.folder / "progress.json", asdict(self))


class Deadline:
    """When a budget is spent."""

    def __init__(self, budget_minutes: float | None):
        self.at = math.inf if budget_minutes is None else time.monotonic() + 60 * budget_minutes

    @property
    def seconds_left(self) -> float:
        return self.at - time.monotonic()


def run_cells(
    cells: list[Cell], processes: int = 1, budget_minutes: float | None = None, train_flags: Sequence[str] = ()
) -> None:
    """Run what is missing of some cells, in their order.

    Args:
        cells: to run.
        processes: cells at a time; they share the cores.
        budget_minutes: when it is spent, trainings stop with a checkpoint, and nothing more is begun.
        train_flags: further ones of `hdp-train`, for this machine.

    Raises:
        SystemExit: a cell failed; the others have been run.
    """
    deadline, threads = Deadline(budget_minutes), max(1, (os.cpu_count() or 1) // processes)
    missing = [cell for cell in cells if not cell.result_file.exists()]
    if finished := len(cells) - len(missing):
        folders = " and ".join(sorted({str(cell.result_file.parent) for cell in cells}))
        how = f"delete its file in {folders}, and its folder in {WORK}"
        print(f"{finished} of {len(cells)} are finished; to run one again, {how}", flush=True)
    for cell in missing:
        if deadline.seconds_left > SHORTEST_TRAINING_S:
            record_dataset(cell, num_workers=os.cpu_count() or 1)
    failed = []
    with ThreadPoolExecutor(processes) as executor:
        futures = {executor.submit(run_cell, cell, threads, deadline, train_flags): cell for cell in missing}
        try:
            for future in as_completed(futures):
                if error := future.exception():
                    failed.append(futures[future].name)
                    traceback.print_exception(error)
                else:
                    print(future.result(), flush=True)
        except BaseException:  # Ctrl-C, above all
            executor.shutdown(wait=False, cancel_futures=True)
            for child in PROCESSES.active_children():
                child.terminate()
            raise
    if failed:
        raise SystemExit(f"failed, see above: {', '.join(failed)}. Call again to go on with them.")


def run_cell(cell: Cell, threads: int = 1, deadline: Deadline | None = None, train_flags: Sequence[str] = ()) -> str:
    """Train and evaluate a cell from where it stopped; write its result if it comes to an end.

    Args:
        cell: to run.
        threads: of PyTorch, for training and for evaluation.
        deadline, train_flags: see `run_cells`.

    Returns:
        One line that says how it went.

    Raises:
        RuntimeError: the training or an evaluation failed; names its log.
        BlockingIOError: another process runs this cell.
        ValueError: the cell was begun with other settings.
    """
    deadline = deadline or Deadline(None)
    cell.folder.mkdir(parents=True, exist_ok=True)
    with one_process(cell.folder / "lock", f"runs this cell, {cell.folder}"):
        cell.check_begun()
        if cell.last_step < cell.steps:
            if deadline.seconds_left < SHORTEST_TRAINING_S:
                return f"{cell.name}: {cell.state()}, no time left"
            train(cell, threads, deadline, train_flags)
        else:
            note_run(cell, threads)
        evaluate_checkpoints(cell, threads, deadline)
        progress = Progress.load(cell)
        if [point["step"] for point in progress.curve][-1:] != [cell.steps]:
            return f"{cell.name}: {cell.state()}, out of time"
        *earlier, last = progress.runs
        result = result_of(cell, progress)
        write_json(cell.result_file, {"run": last, "earlier_runs": earlier, "result": result})
    return f"{cell.name}: success {progress.curve[-1]['success_rate']:.0%} in the end, {result['train_s'] / 60:.1f} min"


def train(cell: Cell, threads: int, deadline: Deadline, train_flags: Sequence[str] = ()) -> None:
    """Run `hdp-train` from the last checkpoint on, with its output in `train.log` in the cell's folder.

    It ends at the deadline, with a checkpoint. Where there are cores for it, checkpoints are evaluated meanwhile.
    """
    training = start_training(cell, threads, deadline, train_flags)
    evaluate_meanwhile = threads >= CORES_TO_EVALUATE_MEANWHILE["cuda" if torch.cuda.is_available() else "cpu"]
    try:
        while training.is_alive():
            time.sleep(POLL_S)
            for checkpoint in complete_checkpoints(cell.folder)[:-1]:
                shutil.rmtree(checkpoint / "training_state", ignore_errors=True)
            if evaluate_meanwhile:
                evaluate_checkpoints(cell, threads, deadline)
        if training.exitcode:
            raise RuntimeError(f"{cell.name}: hdp-train failed, see {cell.folder / 'train.log'}")
    finally:
        training.terminate()
        training.join()


def start_training(cell: Cell, threads: int, deadline: Deadline, train_flags: Sequence[str] = ()) -> BaseProcess:
    """Start or resume `hdp-train` in a process of its own."""
    train_s = 0.0
    if last := cell.last_checkpoint:
        train_s = json.loads((last.parent / TRAIN_S).read_text())
        arguments = ["--resume=true", f"--config_path={last / 'train_config.json'}"]
    else:
        shutil.rmtree(cell.folder / "train", ignore_errors=True)
        (cell.folder / "progress.json").unlink(missing_ok=True)
        write_json(cell.settings_file, cell.settings)
        config_file = cell.folder / "train_config.json"
        write_json(config_file, cell.train_config())
        arguments = [f"--config_path={config_file}"]
    arguments += train_flags
    if deadline.seconds_left < math.inf:
        arguments.append(f"--max_train_minutes={deadline.seconds_left / 60:.3f}")
    note_run(cell, threads)
    return _start(cell.folder / "train.log", threads, _hdp_train, arguments, train_s)


def note_run(cell: Cell, threads: int) -> None:
    """Add this run to those that a cell's figures come from."""
    progress = Progress.load(cell)
    progress.runs.append({**describe_run(), "threads": threads})
    progress.save(cell)


def _hdp_train(arguments: list[str], train_s: float) -> None:
    """What the command `hdp-train` does; writes the seconds of training, after earlier ones, into each checkpoint."""
    start, save_checkpoint = time.monotonic(), lerobot_train.save_checkpoint

    def save_checkpoint_and_time(checkpoint_dir: Path, *args: Any, **kwargs: Any) -> None:
        save_checkpoint(checkpoint_dir, *args, **kwargs)
        write_json(Path(checkpoint_dir) / TRAIN_S, train_s + time.monotonic() - start)

    lerobot_train.save_checkpoint = save_checkpoint_and_time
    sys.argv = ["hdp-train", *arguments]
    hdp_train.main()


def evaluate_checkpoints(cell: Cell, threads: int, deadline: Deadline) -> None:
    """Evaluate the checkpoints that are not in the learning curve yet, and delete all but the last one.

    Raises:
        RuntimeError: an evaluation failed; names its log.
    """
    progress = Progress.load(cell)
    done = {point["step"] for point in progress.curve}
    checkpoints = complete_checkpoints(cell.folder)
    for checkpoint in checkpoints:
        step = int(checkpoint.name)
        wanted = step % cell.evaluate_every == 0 or step == cell.steps
        if wanted and step not in done:
            if deadline.seconds_left < 0:
                return
            progress.curve.append({"step": step, **_evaluate(cell, checkpoint, threads)})
            progress.save(cell)
        if checkpoint != checkpoints[-1]:
            shutil.rmtree(checkpoint)


def _evaluate(cell: Cell, checkpoint: Path, threads: int) -> dict[str, Any]:
    """Evaluate a checkpoint in a process of its own, whose memory, on a GPU too, is free again afterwards."""
    number = math.ceil(int(checkpoint.name) / cell.evaluate_every) - 1
    outcome, log = cell.folder / "evaluation.json", cell.folder / "evaluation.log"
    outcome.unlink(missing_ok=True)
    arguments = (checkpoint / "pretrained_model", cell.starts, FIRST_EVALUATION_SEED + number * cell.starts, outcome)
    evaluation = _start(log, threads, _evaluate_into, *arguments)
    try:
        evaluation.join()
    finally:
        evaluation.terminate()
    if not outcome.exists():
        raise RuntimeError(f"{cell.name}: the evaluation of {checkpoint} failed, see {log}")
    return json.loads(outcome.read_text())


def _evaluate_into(path: Path, starts: int, first_seed: int, outcome: Path) -> None:
    write_json(outcome, evaluate(path, starts, first_seed, compile_model=False))  # it takes longer than the plans


def result_of(cell: Cell, progress: Progress) -> dict[str, Any]:
    """What a results file says about a finished cell."""
    assert cell.last_checkpoint is not None
    policy, *_ = load_policy(cell.last_checkpoint)
    saved = json.loads((cell.last_checkpoint / "config.json").read_text())  # loaded here, it says what this CPU can do
    train_s = json.loads((cell.last_checkpoint.parent / TRAIN_S).read_text())
    return {
        **cell.facts,
        "planner": cell.policy["type"],
        **cell.settings,
        "computed_in": saved["dtype"],
        "parameters": num_parameters(policy),
        "network_calls_per_plan": policy.config.num_inference_steps,
        "train_s": round(train_s, 1),
        "samples_per_second": round(cell.samples / train_s, 1),
        "curve": progress.curve,
    }


def num_parameters(policy: HDPPolicy) -> int:
    """Parameters of the network that is trained, without their moving average."""
    return sum(parameter.numel() for parameter in policy.planner.parameters())


def record_dataset(cell: Cell, num_workers: int) -> None:
    """Record a cell's demonstrations, if they are not there."""
    if not (cell.dataset_root / "meta" / "episodes").exists():
        config = RecordDatasetConfig(f"local/{cell.dataset_root.name}", cell.dataset_root, cell.demonstrations)
        record(RecordConfig(config, cell.env_config, num_workers=num_workers, resume=True))


def _start(log: Path, threads: int, function: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Start a process that writes to a log file and ends with this one.

    It is no daemon, which could have no children, such as a data loader's workers.
    """
    process = PROCESSES.Process(target=_run_with_log, args=(log, threads, function, *arguments))
    process.start()
    return process


def _run_with_log(log: Path, threads: int, function: Callable[..., None], *arguments: Any) -> None:
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    torch.set_num_threads(threads)
    when_parent_ends(lambda: os._exit(1))
    function(*arguments)
