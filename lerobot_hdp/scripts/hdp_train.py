"""`hdp-train`: LeRobot's own training, with the dataset in memory, for any policy and any dataset that fits.

Takes all flags of `lerobot-train`, and does what it does with them, from checkpoints to `--resume` and `accelerate
launch`: it runs LeRobot's training function. Beyond that, it looks up a planner's horizon, and normalises observations
that `--rename_map` renames; planners of whole episodes train on episodes shorter than their plans, too, and their
held-out loss is that of whole plans.

What it replaces are some functions of LeRobot's module (`Replacements`), where LeRobot 0.6.1 has no hook, and for
planners of whole episodes the sampler. A `dataset_factory`, a `sampler_factory` and a `should_stop` argument of
`lerobot.scripts.lerobot_train.train` would make this unnecessary.

Example:
    hdp-train --config_path=configs/xarm_sorting.json --max_train_minutes=30
"""

import argparse
import gc
import logging
import sys
import time
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import torch
from lerobot.configs import FeatureType
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler, LeRobotDataset
from lerobot.scripts import lerobot_train
from lerobot.utils.collate import lerobot_collate_fn
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch.distributed import ProcessGroup
from torch.utils.data import Dataset, Subset

from lerobot_hdp.configuration_hdp import HDPConfig
from lerobot_hdp.in_memory_dataset import Batch, InMemoryDataset, memory_needed, unsupported
from lerobot_hdp.lerobot_workarounds import keep_data_order_on_resume, read_metadata

GIB = 2**30


class OutOfTimeError(Exception):
    """Training stopped at `--max_train_minutes`, after a checkpoint."""


class FirstFrameSampler(EpisodeAwareSampler):
    """LeRobot's sampler, of the first frame of each episode, however long it is.

    Args:
        dataset_from_indices: first frame of each episode.
        dataset_to_indices: its end.
        drop_n_last_frames: what LeRobot's would leave out, which of equally long episodes leaves the first frame.
        kwargs: see `EpisodeAwareSampler`.
    """

    def __init__(
        self, dataset_from_indices: list[int], dataset_to_indices: list[int], drop_n_last_frames: int = 0, **kwargs: Any
    ):
        first = np.asarray(dataset_from_indices)
        super().__init__(first, first + 1, **kwargs)


class Replacements:
    """What takes the place of functions of `lerobot.scripts.lerobot_train` in one training, by the names of these.

    Args:
        max_memory_gib: datasets that need more are read as LeRobot reads them.
        max_train_minutes: after which there is a checkpoint, and OutOfTimeError; None: no limit.
    """

    def __init__(self, max_memory_gib: float, max_train_minutes: float | None = None):
        self.max_memory_gib = max_memory_gib
        self.deadline = None if max_train_minutes is None else time.monotonic() + 60 * max_train_minutes
        self.out_of_time = False
        self.output_dir: Path | None = None
        self.users_num_workers: int | None = None
        self.process_group: ProcessGroup | None = None
        self._open = lerobot_train.make_train_eval_datasets
        self._save = lerobot_train.save_checkpoint
        self._should_save = lerobot_train.should_save_checkpoint
        self._update = lerobot_train.update_policy

    def install(self) -> None:
        lerobot_train.make_train_eval_datasets = self.make_train_eval_datasets
        lerobot_train.lerobot_collate_fn = collate
        lerobot_train.save_checkpoint = self.save_checkpoint
        lerobot_train.should_save_checkpoint = self.should_save_checkpoint
        lerobot_train.update_policy = self.update_policy
        lerobot_train.submit_to_hf = self.submit_to_hf

    def make_train_eval_datasets(self, cfg: TrainPipelineConfig) -> tuple[Dataset, Dataset | None]:
        """Open the datasets in memory, if they fit; for planners of whole episodes, let plans begin at first frames.

        Raises:
            ValueError: there is no such dataset; or training time is limited, and no checkpoints are written.
        """
        if self.deadline is not None and not cfg.save_checkpoint:
            raise ValueError("--max_train_minutes ends with a checkpoint: it needs --save_checkpoint=true")
        if torch.distributed.is_initialized():
            # LeRobot frees the model after the process group. The model would be the last to hold it, and end the
            # threads of Gloo while it has the interpreter's lock, for which one of them may be waiting: the process
            # would hang at its very end. Python's own reference frees the lock.
            self.process_group = torch.distributed.group.WORLD
        self.output_dir = cfg.output_dir
        meta = read_metadata(cfg.dataset)
        if isinstance(cfg.policy, HDPConfig) and cfg.policy.horizon is None:
            cfg.policy.set_horizon(max(meta.episodes["length"]))
            logging.info("The horizon is %d, the length of the longest episode", cfg.policy.horizon)

        train, held_out = self._open(cfg)
        # LeRobot renames observations before it normalises them, and not their statistics.
        stats = train.meta.stats or {}
        train.meta.stats = stats | {new: dict(stats[old]) for old, new in cfg.rename_map.items() if old in stats}

        self.users_num_workers = cfg.num_workers
        train, held_out = self._hold_in_memory(cfg, train, held_out)
        whole_plans = _plans_whole_episodes(cfg)
        lerobot_train.EpisodeAwareSampler = FirstFrameSampler if whole_plans else EpisodeAwareSampler
        return train, _first_frames(held_out) if whole_plans and held_out is not None else held_out

    def _hold_in_memory(
        self, cfg: TrainPipelineConfig, train: LeRobotDataset, held_out: LeRobotDataset | None
    ) -> tuple[LeRobotDataset, LeRobotDataset | None]:
        opened = [dataset for dataset in (train, held_out) if dataset is not None]
        leave_out = _unused_cameras(cfg, train.meta.features) if isinstance(cfg.policy, HDPConfig) else []
        options = leave_out, _plans_whole_episodes(cfg)
        if (reason := _why_not_in_memory(opened, *options, self.max_memory_gib)) is not None:
            logging.warning("The dataset is read item by item, as by lerobot-train: %s", reason)
            return train, held_out
        if all(dataset.image_transforms is None for dataset in opened):
            cfg.num_workers = 0  # there is nothing to wait for; image transforms are made sample by sample
        return InMemoryDataset(train, *options), None if held_out is None else InMemoryDataset(held_out, *options)

    def save_checkpoint(self, *args: Any, cfg: TrainPipelineConfig, **kwargs: Any) -> None:
        """Save the number of workers that the user said, for whoever resumes with lerobot-train."""
        cfg.num_workers = self.users_num_workers
        self._save(*args, cfg=cfg, **kwargs)

    def should_save_checkpoint(self, step: int, save_freq: int, total_steps: int) -> bool:
        """Also when time is over."""
        if self.deadline is not None:
            self.out_of_time = _on_any_process(time.monotonic() >= self.deadline) and step < total_steps
        return self.out_of_time or self._should_save(step, save_freq, total_steps)

    def update_policy(self, *args: Any, **kwargs: Any) -> Any:
        """Do a step.

        Raises:
            OutOfTimeError: time is over.
        """
        if self.out_of_time:
            raise OutOfTimeError
        return self._update(*args, **kwargs)

    def submit_to_hf(self, cfg: TrainPipelineConfig) -> None:
        """Refuse to submit a job, which would lose what `hdp-train` adds.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"hdp-train trains on this machine: with --job.target={cfg.job.target}, use lerobot-train")


def collate(samples: list[Any]) -> Any:
    """Collate a batch with language columns, which one from memory does not need; data-loader workers get it, too."""
    return samples[0] if isinstance(samples[0], Batch) else lerobot_collate_fn(samples)


def _first_frames(dataset: Dataset) -> Subset:
    """Of each episode the first frame, where whole plans begin."""
    columns = dataset.hf_dataset.with_format("numpy")
    frames = np.flatnonzero(columns["frame_index"][:] == 0)
    first_frames = Subset(dataset, frames.tolist())
    # LeRobot looks here when it takes as many of each task for --max_eval_samples.
    tasks = {"task_index": columns["task_index"][:][frames]}
    first_frames.hf_dataset = datasets.Dataset.from_dict(tasks)  # type: ignore[attr-defined]
    return first_frames


def _plans_whole_episodes(cfg: TrainPipelineConfig) -> bool:
    """Whether the policy is trained on the first frames of episodes alone."""
    return isinstance(cfg.policy, HDPConfig) and cfg.policy.plans_whole_episodes


def _unused_cameras(cfg: TrainPipelineConfig, features: dict[str, dict]) -> list[str]:
    """Cameras of a dataset, by its own names, that a planner does not observe."""
    cameras = [item for item in dataset_to_policy_features(features).items() if item[1].type is FeatureType.VISUAL]
    return [key for key, camera in cameras if not cfg.policy.observes_camera(cfg.rename_map.get(key, key), camera)]


def _why_not_in_memory(
    opened: list[LeRobotDataset], leave_out: list[str], first_images_only: bool, max_gib: float
) -> str | None:
    """What keeps datasets from being held in memory together, in words; None: nothing."""
    for dataset in opened:
        if (reason := unsupported(dataset, leave_out)) is not None:
            return reason
    needed = sum(memory_needed(dataset, leave_out, first_images_only) for dataset in opened) / GIB
    return f"it needs {needed:.1f} GiB, more than --max_memory_gib={max_gib:g}" if needed > max_gib else None


def _on_any_process(flag: bool) -> bool:
    """Whether a flag is set on any process of a distributed run, so that all of them stop at the same step."""
    if not torch.distributed.is_initialized():
        return flag
    device = "cuda" if torch.distributed.get_backend() == "nccl" else "cpu"
    flags = torch.tensor(float(flag), device=device)
    torch.distributed.all_reduce(flags, torch.distributed.ReduceOp.MAX)
    return bool(flags)


def non_negative(text: str) -> float:
    """A number of at least 0, for argparse."""
    if not (number := float(text)) >= 0:
        raise argparse.ArgumentTypeError(f"must be at least 0, got {text}")
    return number


def main() -> None:
    parser = argparse.ArgumentParser(
        "hdp-train", description="lerobot-train with the dataset in memory.", add_help=False, allow_abbrev=False
    )
    parser.add_argument("--max_train_minutes", type=non_negative, help="write a checkpoint and stop after this time")
    parser.add_argument(
        "--max_memory_gib",
        type=non_negative,
        default=8.0,
        help="largest dataset, with its held-out part, to hold in each process's memory, in GiB",
    )
    options, sys.argv[1:] = parser.parse_known_args()
    if "--help" in sys.argv or "-h" in sys.argv:
        parser.print_help()
    keep_data_order_on_resume()
    replacements = Replacements(options.max_memory_gib, options.max_train_minutes)
    replacements.install()
    try:
        lerobot_train.main()
    except OutOfTimeError:
        logging.info(
            "Out of time after %g minutes. To go on: hdp-train --resume=true "
            "--config_path=%s/checkpoints/last/pretrained_model/train_config.json (and only a finished training is "
            "pushed to the Hub)",
            options.max_train_minutes,
            replacements.output_dir,
        )
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
    gc.collect()  # the model
    replacements.process_group = None


if __name__ == "__main__":
    main()
