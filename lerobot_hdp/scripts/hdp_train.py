"""`hdp-train`: LeRobot's own training, with the dataset in memory, for any policy and any dataset that fits.

Takes all flags of `lerobot-train`, and does what it does with them, from checkpoints to `--resume` and `accelerate
launch`: it runs LeRobot's training function. Beyond that, it normalises observations that
`--rename_map` renames; planners of whole episodes train on episodes shorter than their plans, too, and their held-out
loss is that of whole plans.

What it changes are some names in LeRobot's module, below, where LeRobot 0.6.1 has no hook: the functions that open the
datasets, collate a batch with language columns, write a checkpoint and submit a job, for planners of whole episodes the
sampler, and for `--max_train_minutes` those that decide about a checkpoint and do a step. A `dataset_factory`, a
`sampler_factory` and a `should_stop` argument of `lerobot.scripts.lerobot_train.train` would make this unnecessary.

Example:
    hdp-train --config_path=configs/xarm_sorting.json --max_train_minutes=30
"""

import argparse
import gc
import logging
import sys
import time
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
from lerobot_hdp.lerobot_workarounds import keep_data_order_on_resume

GIB = 2**30


class OutOfTimeError(Exception):
    """Training stopped at `--max_train_minutes`, after a checkpoint."""


def hold_datasets_in_memory(max_gib: float) -> None:
    """Let `lerobot-train` hold its datasets in memory, if they need at most `max_gib` GiB; else it reads as always."""
    make_datasets, save_checkpoint = lerobot_train.make_train_eval_datasets, lerobot_train.save_checkpoint
    users_num_workers = None

    def make_datasets_in_memory(cfg: TrainPipelineConfig) -> tuple[LeRobotDataset, LeRobotDataset | None]:
        nonlocal users_num_workers
        users_num_workers = cfg.num_workers
        train_and_eval = make_datasets(cfg)
        opened = [dataset for dataset in train_and_eval if dataset is not None]
        leave_out = _unused_cameras(cfg, opened[0].meta.features) if isinstance(cfg.policy, HDPConfig) else []
        first_images_only = _plans_whole_episodes(cfg)
        if (reason := _why_not_in_memory(opened, leave_out, first_images_only, max_gib)) is not None:
            logging.warning("The dataset is read item by item, as by lerobot-train: %s", reason)
            return train_and_eval
        if all(dataset.image_transforms is None for dataset in opened):
            cfg.num_workers = 0  # there is nothing to wait for; image transforms are made sample by sample
        return tuple(
            None if dataset is None else InMemoryDataset(dataset, leave_out, first_images_only)
            for dataset in train_and_eval
        )

    def save_with_users_num_workers(*args: Any, cfg: TrainPipelineConfig, **kwargs: Any) -> None:
        cfg.num_workers = users_num_workers  # for whoever resumes with lerobot-train
        save_checkpoint(*args, cfg=cfg, **kwargs)

    lerobot_train.make_train_eval_datasets = make_datasets_in_memory
    lerobot_train.save_checkpoint = save_with_users_num_workers
    lerobot_train.lerobot_collate_fn = collate_unless_collated


def normalise_renamed_observations() -> None:
    """Let statistics follow `--rename_map`: LeRobot renames observations before it normalises them, and not these."""
    make_datasets = lerobot_train.make_train_eval_datasets

    def make_datasets_with_renamed_stats(cfg: TrainPipelineConfig) -> tuple[LeRobotDataset, LeRobotDataset | None]:
        train, held_out = make_datasets(cfg)
        stats = train.meta.stats or {}
        train.meta.stats = stats | {new: dict(stats[old]) for old, new in cfg.rename_map.items() if old in stats}
        return train, held_out

    lerobot_train.make_train_eval_datasets = make_datasets_with_renamed_stats


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


def start_where_plans_begin() -> None:
    """Let `lerobot-train` show planners of whole episodes their first frames alone, in training and held out.

    So an episode may be shorter than the horizon: LeRobot repeats its last action.
    """
    make_datasets = lerobot_train.make_train_eval_datasets

    def make_datasets_of_first_frames(cfg: TrainPipelineConfig) -> tuple[LeRobotDataset, Dataset | None]:
        train, held_out = make_datasets(cfg)
        whole_plans = _plans_whole_episodes(cfg)
        lerobot_train.EpisodeAwareSampler = FirstFrameSampler if whole_plans else EpisodeAwareSampler
        if held_out is None or not whole_plans:
            return train, held_out
        columns = held_out.hf_dataset.with_format("numpy")
        frames = np.flatnonzero(columns["frame_index"][:] == 0)
        first_frames = Subset(held_out, frames.tolist())
        # LeRobot looks here when it takes as many of each task for --max_eval_samples.
        tasks = {"task_index": columns["task_index"][:][frames]}
        first_frames.hf_dataset = datasets.Dataset.from_dict(tasks)  # type: ignore[attr-defined]
        return train, first_frames

    lerobot_train.make_train_eval_datasets = make_datasets_of_first_frames


def hold_process_group() -> list[ProcessGroup]:
    """Let a distributed training's process group outlive its model, which `lerobot-train` frees after the group.

    The model would be the last to hold the group, and end the threads of Gloo while it has the interpreter's lock, for
    which one of them may be waiting: the process would hang at its very end. Python's own reference frees the lock.

    Returns:
        What will hold the group, until it is cleared.
    """
    held: list[ProcessGroup] = []
    make_datasets = lerobot_train.make_train_eval_datasets

    def make_datasets_and_hold(cfg: TrainPipelineConfig) -> Any:
        if torch.distributed.is_initialized():
            held.append(torch.distributed.group.WORLD)
        return make_datasets(cfg)

    lerobot_train.make_train_eval_datasets = make_datasets_and_hold
    return held


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


def collate_unless_collated(samples: list[Any]) -> Any:
    """LeRobot's collation of a batch with language columns, which one from memory does not need."""
    return samples[0] if isinstance(samples[0], Batch) else lerobot_collate_fn(samples)


def refuse_to_submit(cfg: TrainPipelineConfig) -> None:
    """In place of LeRobot's submission of a job, which would lose what `hdp-train` adds.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"hdp-train trains on this machine: with --job.target={cfg.job.target}, use lerobot-train")


def stop_after(minutes: float) -> None:
    """Let `lerobot-train` write a checkpoint after some minutes, then raise OutOfTimeError.

    Raises:
        ValueError: from the training, if it writes no checkpoints.
    """
    make_datasets = lerobot_train.make_train_eval_datasets
    deadline = time.monotonic() + 60 * minutes
    should_save, update_policy = lerobot_train.should_save_checkpoint, lerobot_train.update_policy
    out_of_time = False

    def make_datasets_if_saved(cfg: TrainPipelineConfig) -> Any:
        if not cfg.save_checkpoint:
            raise ValueError("--max_train_minutes ends with a checkpoint: it needs --save_checkpoint=true")
        return make_datasets(cfg)

    def should_save_or_stop(step: int, save_freq: int, total_steps: int) -> bool:
        nonlocal out_of_time
        out_of_time = _on_any_process(time.monotonic() >= deadline) and step < total_steps
        return out_of_time or should_save(step, save_freq, total_steps)

    def update_unless_out_of_time(*args: Any, **kwargs: Any) -> Any:
        if out_of_time:
            raise OutOfTimeError
        return update_policy(*args, **kwargs)

    lerobot_train.make_train_eval_datasets = make_datasets_if_saved
    lerobot_train.should_save_checkpoint = should_save_or_stop
    lerobot_train.update_policy = update_unless_out_of_time


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
    lerobot_train.submit_to_hf = refuse_to_submit
    keep_data_order_on_resume()
    normalise_renamed_observations()
    hold_datasets_in_memory(options.max_memory_gib)
    start_where_plans_begin()
    process_group = hold_process_group()
    if options.max_train_minutes is not None:
        stop_after(options.max_train_minutes)
    try:
        lerobot_train.main()
    except OutOfTimeError:
        logging.info(
            "Out of time after %g minutes. Go on with --resume=true. Only a finished training is pushed to the Hub.",
            options.max_train_minutes,
        )
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
    gc.collect()  # the model
    process_group.clear()


if __name__ == "__main__":
    main()
