"""LeRobot's language columns, made of the plan that a dataset carries.

An episode's `language_persistent` is a list of rows, each with a style, a text and the time from which it holds until
the next row of that style. `subtask` rows say which step is being done, `plan` rows what is left to do. LeRobot's
readers (`lerobot.datasets.language_render`) find the row that is active at a frame.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.io_utils import load_info, write_info, write_table_one_row_group_per_episode
from lerobot.datasets.language import LANGUAGE_EVENTS, LANGUAGE_PERSISTENT, language_feature_info

SYMBOLIC_PLAN = "observation.symbolic_plan"
DONE_TEXT = "done"
"""Text of both styles once nothing is left to do."""


def write_language_columns(root: Path, vocabulary: Sequence[str]) -> None:
    """Add the language columns to a dataset on disk, from its column `observation.symbolic_plan`.

    Args:
        root: folder of the dataset.
        vocabulary: the symbols, in the order of their ids.

    Raises:
        ValueError: the dataset has language columns already.
    """
    info = load_info(root)
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
