"""Copy a LeRobotDataset at a lower frame rate: teleoperation wants 30 Hz, a plan a few hundred waypoints.

Example:
    from lerobot.datasets import LeRobotDataset
    from dataset_tools.thin_out import thin_out

    thin_out(LeRobotDataset("me/cups"), 6, "me/cups_5hz", "outputs/cups_5hz")
"""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from lerobot.utils.constants import DEFAULT_FEATURES, OBS_PREFIX
from torch import Tensor


def thin_out(dataset: LeRobotDataset, every: int, repo_id: str, root: Path | str) -> LeRobotDataset:
    """Copy a dataset with one frame for each `every` of an episode.

    What is observed is that of the first of them; the action, and what follows from it (`next.*`), of the last: it
    leads to what the next frame observes. Actions must be absolute positions. Language columns are left out.

    Args:
        dataset: to be copied, or the episodes of it that were opened.
        every: frames that become one; its frame rate must be a multiple.
        repo_id: name of the new dataset.
        root: its folder, which must not exist.

    Raises:
        ValueError: the frame rate is no multiple, or the dataset has depth images.
        FileExistsError: the folder exists.
    """
    fps, rest = divmod(dataset.meta.fps, every)
    if rest:
        raise ValueError(f"a rate of {dataset.meta.fps} frames a second is no multiple of {every}")
    if dataset.meta.depth_keys:
        raise ValueError(f"depth images cannot be thinned out: remove {', '.join(dataset.meta.depth_keys)} first")
    skipped = {*DEFAULT_FEATURES, *LANGUAGE_COLUMNS}
    features = {name: feature for name, feature in dataset.meta.features.items() if name not in skipped}
    thinned = LeRobotDataset.create(
        repo_id,
        fps,
        features,
        root,
        robot_type=dataset.meta.robot_type,
        use_videos=bool(dataset.meta.video_keys),
        image_writer_threads=4 * len(dataset.meta.camera_keys),
    )
    episodes = np.array(dataset.hf_dataset["episode_index"])
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes == episode).tolist()
        for start in range(0, len(rows), every):
            first, last = dataset[rows[start]], dataset.hf_dataset[rows[start : start + every][-1]]
            columns = {name: (first if name.startswith(OBS_PREFIX) else last)[name] for name in features}
            frame = {name: _as_recorded(column, features[name]) for name, column in columns.items()}
            thinned.add_frame({**frame, "task": first["task"]})
        thinned.save_episode()
    thinned.finalize()
    return LeRobotDataset(repo_id, root)


def _as_recorded(value: Tensor, feature: dict[str, Any]) -> np.ndarray:
    """What a dataset returned, as it takes it: images (height, width, channels) uint8, numbers in their shape."""
    if feature["dtype"] in ("image", "video"):
        return (255 * value).round().byte().permute(1, 2, 0).numpy()
    return value.numpy().astype(feature["dtype"]).reshape(feature["shape"])
