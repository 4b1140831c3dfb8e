"""LeRobot's language columns, made of the plan that a dataset carries, and plans made of such columns.

An episode's `language_persistent` is a list of rows, each with a style, a text and the time from which it holds until
the next row of that style. `subtask` rows say which step is being done, `plan` rows what is left to do. LeRobot's
readers (`lerobot.datasets.language_render`) find the row that is active at a frame.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_info, write_info, write_table_one_row_group_per_episode
from lerobot.datasets.language import LANGUAGE_EVENTS, LANGUAGE_PERSISTENT, language_feature_info

from .demonstration import PlanStep

SYMBOLIC_PLAN = "observation.symbolic_plan"
DONE_TEXT = "done"
"""Text of both styles once nothing is left to do."""


def write_language_columns(root: Path | str, vocabulary: Sequence[str]) -> None:
    """Add the language columns to a dataset on disk, from its column `observation.symbolic_plan`.

    Args:
        root: folder of the dataset.
        vocabulary: the symbols, in the order of their ids.

    Raises:
        ValueError: the dataset has no symbolic plans, or language columns already.
    """
    root = Path(root)
    info = load_info(root)
    if SYMBOLIC_PLAN not in info.features:
        raise ValueError(f"{root} has no column {SYMBOLIC_PLAN}: add_symbolic_plans makes one")
    if LANGUAGE_PERSISTENT in info.features:
        raise ValueError(f"{root} has language columns already")
    info.features = {**info.features, **language_feature_info()}
    features = get_hf_features_from_features(info.features)
    language_features = datasets.Features({key: features[key] for key in (LANGUAGE_PERSISTENT, LANGUAGE_EVENTS)})
    for path in sorted((root / "data").glob("*/*.parquet")):
        table = pq.read_table(path)
        if LANGUAGE_PERSISTENT in table.column_names:
            continue  # an interrupted call has written this one
        plans, timestamps = np.array(table[SYMBOLIC_PLAN].to_pylist()), table["timestamp"].to_numpy()
        episode_indices = table["episode_index"].to_numpy()
        starts = np.flatnonzero(np.diff(episode_indices, prepend=-1))
        rows: list[list[dict[str, Any]]] = []
        for start, stop in zip(starts, [*starts[1:], len(plans)], strict=True):
            rows += [language_rows(plans[start:stop], timestamps[start:stop], vocabulary)] * (stop - start)
        columns = datasets.Dataset.from_dict(
            {LANGUAGE_PERSISTENT: rows, LANGUAGE_EVENTS: [[] for _ in rows]}, features=language_features
        ).with_format("arrow")[:]
        for name in columns.column_names:
            table = table.append_column(columns.field(name), columns[name])
        table = table.replace_schema_metadata(features.arrow_schema.metadata)
        unfinished = path.with_suffix(".unfinished")
        write_table_one_row_group_per_episode(table, unfinished)
        unfinished.replace(path)
    write_info(info, root)


def language_rows(plans: np.ndarray, timestamps: np.ndarray, vocabulary: Sequence[str]) -> list[dict[str, Any]]:
    """The `subtask` and `plan` rows of one episode, in order of time.

    Whenever the plan that remains gets shorter, a step is done: the symbols that it lost.

    Args:
        plans: (L, H_d) token ids of the plan that remains at each frame, filled with PAD (0).
        timestamps: (L,) of the frames, in seconds.
        vocabulary: the symbols, in the order of their ids.
    """
    remaining = [[vocabulary[token] for token in plan if token] for plan in plans]
    starts = [frame for frame in range(len(plans)) if frame == 0 or len(remaining[frame]) < len(remaining[frame - 1])]
    ends = [len(remaining[start]) for start in starts[1:]] + [0]
    # The text of the step that begins at each of the starts, as long as there is one.
    steps = [
        " ".join(remaining[start][: len(remaining[start]) - end])
        for start, end in zip(starts, ends, strict=True)
        if remaining[start]
    ]
    rows = []
    for number, start in enumerate(starts):
        plan = "\n".join(f"{i}. {step}" for i, step in enumerate(steps[number:], start=1))
        for style, text in (("subtask", steps[number] if number < len(steps) else DONE_TEXT), ("plan", plan)):
            rows.append(
                {
                    "role": "assistant",
                    "content": text or DONE_TEXT,
                    "style": style,
                    "timestamp": float(timestamps[start]),
                    "camera": None,
                    "tool_calls": None,
                }
            )
    return rows


def plans_of_subtasks(dataset: LeRobotDataset, words: Mapping[str, str]) -> list[list[PlanStep]]:
    """The plan of each episode, from its `subtask` rows, as `lerobot-annotate` writes them: for `add_symbolic_plans`.

    A subtask is done where the next one begins, the last one at the end of the episode.

    Args:
        dataset: with the column `language_persistent`.
        words: for each text, the symbols of the step, separated by spaces, such as `{"pick up the cup": "PICK CUP"}`.
            A text with no symbols (`""`) is no step, such as waiting, or moving back when all is done.

    Raises:
        ValueError: the dataset has no such rows, or texts without words, all of which the message names.
    """
    if LANGUAGE_PERSISTENT not in dataset.meta.features:
        raise ValueError(f"{dataset.repo_id} has no column {LANGUAGE_PERSISTENT}: annotate it with lerobot-annotate")
    frames = dataset.hf_dataset.with_format(None)
    episode_indices = np.array(frames["episode_index"])
    starts = np.flatnonzero(np.diff(episode_indices, prepend=-1))
    plans, unknown = [], Counter[str]()
    for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(frames)], strict=True):
        rows = [row for row in frames[start][LANGUAGE_PERSISTENT] if row["style"] == "subtask"]
        if not rows:
            raise ValueError(f"episode {episode_indices[start]} has no rows of style subtask")
        rows.sort(key=lambda row: row["timestamp"])
        stops = [round(row["timestamp"] * dataset.fps) for row in rows[1:]] + [stop - start]
        unknown.update(row["content"] for row in rows if row["content"] not in words)
        steps = [(tuple(words.get(row["content"], "").split()), end) for row, end in zip(rows, stops, strict=True)]
        plans.append([PlanStep(symbols, end) for symbols, end in steps if symbols])
    if unknown:
        texts = ", ".join(f"{text!r} ({count})" for text, count in unknown.most_common())
        raise ValueError(f"say the words of each subtask; there are none for {texts}")
    return plans
