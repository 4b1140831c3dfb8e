"""What a dataset must be for a planner to be trained on it; asked before the training begins."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
from lerobot.configs import NormalizationMode

from .configuration_hdp import OBS_SYMBOLIC_PLAN, HDPConfig
from .vocabulary import PAD_ID


def check_statistics(config: HDPConfig, stats: dict[str, Any]) -> None:
    """Whether all that is normalised can be: LeRobot would leave the rest as it is, without a word.

    Raises:
        ValueError: statistics are missing, or not finite.
    """
    for key, feature in {**config.input_features, **config.output_features}.items():
        if config.normalization_mapping.get(feature.type.value) in (None, NormalizationMode.IDENTITY):
            continue
        if key not in stats:
            raise ValueError(
                f"there are no statistics of {key}, to normalise it by. Where --rename_map renames it, train with "
                "hdp-train; where it was added to the dataset, first run lerobot-edit-dataset "
                "--operation.type=recompute_stats"
            )
        for name in ("min", "max", "mean", "std"):
            unknown = np.flatnonzero(~np.isfinite(np.asarray(stats[key].get(name, 0.0))))
            if len(unknown):
                raise ValueError(
                    f"the {name} of {key} in the dataset is NaN or infinite, in components {unknown.tolist()}: mend "
                    "its frames, then run lerobot-edit-dataset --operation.type=recompute_stats"
                )


def check_token_ids(config: HDPConfig, stats: dict[str, Any]) -> None:
    """Whether the dataset's plans hold symbols alone, as far as its statistics say.

    Raises:
        ValueError: there are other token ids.
    """
    if config.symbol_process is None or OBS_SYMBOLIC_PLAN not in stats:
        return
    plans, last = stats[OBS_SYMBOLIC_PLAN], len(config.vocabulary) - 1
    low, high = int(np.min(plans["min"])), int(np.max(plans["max"]))
    if low < PAD_ID or high > last:
        raise ValueError(
            f"{OBS_SYMBOLIC_PLAN} holds token ids from {low} to {high}, but the symbols are 0 to {last}: what follows "
            f"a plan is {PAD_ID}"
        )


def check_episodes_fit(config: HDPConfig, lengths: Sequence[int]) -> None:
    """A plan holds a whole episode: the longest has the horizon's length, or less in fine-tuning.

    LeRobot gives a policy the metadata of all episodes, and does not say which of them it trains on.

    Raises:
        ValueError: the longest has another length.
    """
    longest, fine_tunes = max(lengths), config.pretrained_path is not None
    if longest > config.horizon or (longest < config.horizon and not fine_tunes):
        remedy = "the checkpoint's plans cannot hold them" if fine_tunes else f"set --policy.horizon={longest}"
        raise ValueError(
            f"the dataset's episodes have up to {longest} frames, the planner's horizon is {config.horizon}: {remedy}. "
            "Episodes that --dataset.episodes leaves out count, too; lerobot-edit-dataset can delete them."
        )
    if shorter := sum(length < config.horizon for length in lengths):
        logging.warning(
            "%d of %d episodes are shorter than the planner's horizon of %d: with hdp-train they hold their last "
            "action; lerobot-train leaves them out.",
            shorter, len(lengths), config.horizon,
        )  # fmt: skip
