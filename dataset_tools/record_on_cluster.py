"""`hdp-record` on many machines: its shards as tasks of datatrove, the engine of LeRobot's own porting scripts.

    python -m dataset_tools.record_on_cluster --env.task=XArmToolUse-v0 --dataset.num_episodes=4000 \\
        --dataset.repo_id=me/xarm_tool_use --dataset.root=/shared/xarm_tool_use \\
        --num_workers=40 --slurm.partition=cpu

Takes all flags of `hdp-record`; the dataset that comes out is the same. A shard is up to 25 episodes, each with a seed
of its own, so that it does not matter which machine records it. When all are done, one more task merges them with
LeRobot's `aggregate_datasets`. When a job has failed or was stopped, the same command goes on with it. The dataset's
folder must be one that all machines see; the engine's logs are written beside it. Needs the extra `cluster`:
`pip install '.[cluster]'` in a clone.
"""

import os
import sys
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import multiprocess
from datatrove.executor import LocalPipelineExecutor, SlurmPipelineExecutor
from draccus.utils import ParsingError
from lerobot.configs import parser

from .interruption import end_with_parent, exit_when_terminated, one_process
from .record import (
    RecordConfig,
    Shard,
    accept_env_type,
    finish_earlier_recording,
    merge_shards,
    plan_shards,
    record_shard,
    try_environment,
)


@dataclass
class SlurmConfig:
    """Where the tasks run.

    Attributes:
        partition: Slurm's partition. None: this machine, in `num_workers` processes.
        time: limit for a task, `hours:minutes:seconds`.
        mem_per_cpu_gb: memory of a task, in GB.
    """

    partition: str | None = None
    time: str = "01:00:00"
    mem_per_cpu_gb: int = 4


@dataclass
class ClusterRecordConfig(RecordConfig):
    """Options of `hdp-record`, and the cluster's. `num_workers` tasks run at a time; `resume` is on by default."""

    slurm: SlurmConfig = field(default_factory=SlurmConfig)
    resume: bool = True


@cache
def _end_with_engine() -> None:
    """In a worker on the engine's machine, once, as it may do many tasks; the engine's own process is none."""
    if multiprocess.parent_process() is not None:
        end_with_parent(multiprocess)


def record_task(config: ClusterRecordConfig, shards: list[Shard], _: Any, rank: int, world_size: int) -> None:
    """One of `world_size` tasks of the engine."""
    if config.slurm.partition is None:
        _end_with_engine()
    for shard in shards[rank::world_size]:
        record_shard(config, shard)


def merge_task(config: RecordConfig, shards: list[Shard], _: Any, rank: int, world_size: int) -> None:
    """The last task, unless another run of the same command has done it meanwhile."""
    with one_process(config.lock_file, f"records {config.root}"):
        if finish_earlier_recording(config) is None:
            merge_shards(config, shards)


def record_on_cluster(config: ClusterRecordConfig) -> None:
    """Record, or submit the jobs that do.

    Raises:
        FileExistsError: the dataset's folder exists, and holds something else.
        ValueError: the environment cannot be made, or the interrupted recording had other settings.
        OSError: the upload of a dataset that was recorded earlier failed.
    """
    if finish_earlier_recording(config) is not None:
        return
    try_environment(config)
    shards = plan_shards(config)
    logs = config.root.with_name(config.root.name + ".logs")

    def executor(name: str, task: Any, tasks: int, **kwargs: Any) -> LocalPipelineExecutor | SlurmPipelineExecutor:
        common = {
            "pipeline": [partial(task, config, shards)],
            "tasks": tasks,
            "logging_dir": str(logs / name),
            "skip_completed": False,  # a shard knows itself
            **kwargs,
        }
        workers = min(config.num_workers, tasks)
        conda = None if sys.prefix != sys.base_prefix else os.environ.get("CONDA_PREFIX")
        environment = {"condaenv": conda} if conda else {"venv_path": str(Path(sys.prefix) / "bin" / "activate")}
        if config.slurm.partition is None:
            return LocalPipelineExecutor(workers=workers, **common)
        return SlurmPipelineExecutor(
            job_name=f"hdp-record-{name}",
            workers=workers,
            partition=config.slurm.partition,
            time=config.slurm.time,
            mem_per_cpu_gb=config.slurm.mem_per_cpu_gb,
            **environment,
            **common,
        )

    recording = executor("record", record_task, len(shards))
    executor("merge", merge_task, 1, depends=recording).run()


@parser.wrap()
def _main(config: ClusterRecordConfig) -> None:
    record_on_cluster(config)


def main() -> None:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    exit_when_terminated()
    try:
        accept_env_type()
        _main()
    except KeyboardInterrupt:
        sys.exit("record_on_cluster: interrupted; the same command goes on")
    except (ParsingError, ValueError, OSError, ImportError) as error:
        sys.exit(f"record_on_cluster: {error}")


if __name__ == "__main__":
    # The jobs unpickle what this module defines, and their `__main__` is another one.
    from dataset_tools.record_on_cluster import main

    main()
