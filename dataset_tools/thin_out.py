"""Copy a LeRobotDataset at a lower frame rate: teleoperation wants 30 Hz, a plan a few hundred waypoints.

Example:
    from lerobot.datasets import LeRobotDataset
    from dataset_tools.thin_out import thin_out

    thin_out(LeRobotDataset("me/cups"), 6, "me/cups_5hz", "outputs/cups_5hz")
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES

from lerobot_hdp.lerobot_workarounds import shorten_torchcodec_warning

from .language import SYMBOLIC_PLAN

shorten_torchcodec_warning()


def thin_out(dataset: LeRobotDataset, every: int, repo_id: str, root: Path | str) -> LeRobotDataset:
    """Copy a dataset with one frame for each `every` of an episode.

    The action, and what comes of it (`next.*`), is that of the last of them, which leads to the next frame; all else is
    that of the first. Actions must be absolute positions. Language columns are left out.

    Args:
        dataset: to be copied, or the episodes of it that were opened.
        every: frames that become one; its frame rate must be a multiple.
        repo_id: name of the new dataset.
        root: its folder, which must not exist.

    Raises:
        ValueError: the frame rate is no multiple, or the dataset has depth images.
        FileExistsError: the folder exists.
    """
    fps = int(dataset.meta.fps)
    if every < 1 or fps % every:
        raise ValueError(f"a rate of {fps} frames a second is no multiple of {every}")
    if dataset.meta.depth_keys:
        raise ValueError(f"depth images cannot be thinned out: remove {', '.join(dataset.meta.depth_keys)} first")
    # Another view of it, of frames as they were recorded: without windows, image transforms or images as uint8.
    frames = LeRobotDataset(
        dataset.repo_id, dataset.root, episodes=dataset.episodes, video_backend=dataset._video_backend
    )
    features = _features_to_keep(dataset)
    thinned = LeRobotDataset.create(
        repo_id,
        fps // every,
        features,
        root,
        robot_type=dataset.meta.robot_type,
        use_videos=bool(dataset.meta.video_keys),
        image_writer_threads=4 * len(dataset.meta.camera_keys),
    )
    try:
        _write_every(frames, every, features, thinned)
    except BaseException:
        shutil.rmtree(thinned.root)  # half of a dataset, whose files have no footers
        raise
    return LeRobotDataset(repo_id, root)


def _features_to_keep(dataset: LeRobotDataset) -> dict[str, dict[str, Any]]:
    """The columns of the copy; of a symbolic plan, its vocabulary, but not the seeds to replay it from."""
    skipped = {*DEFAULT_FEATURES, *LANGUAGE_COLUMNS}
    features = {name: feature for name, feature in dataset.meta.features.items() if name not in skipped}
    if SYMBOLIC_PLAN in features:
        column = features[SYMBOLIC_PLAN]
        features[SYMBOLIC_PLAN] = {**column, "info": {"vocabulary": column["info"]["vocabulary"]}}
    return features


def _write_every(
    frames: LeRobotDataset, every: int, features: dict[str, dict[str, Any]], thinned: LeRobotDataset
) -> None:
    table = frames.hf_dataset.with_format("numpy", columns=[n for n in features if n not in frames.meta.camera_keys])
    episodes = frames.hf_dataset.with_format("numpy")["episode_index"][:]
    for episode in np.unique(episodes):
        rows = np.flatnonzero(episodes == episode).tolist()
        for start in range(0, len(rows), every):
            first, last = table[rows[start]], table[rows[start : start + every][-1]]
            shown = frames[rows[start]]
            frame = {"task": shown["task"]}
            for name, feature in features.items():
                if name in frames.meta.camera_keys:  # (channels, height, width) in [0, 1]
                    frame[name] = (255 * shown[name]).round().byte().permute(1, 2, 0).numpy()
                    continue
                value = (last if name == ACTION or name.startswith("next.") else first)[name]
                is_text = feature["dtype"] == "string"
                frame[name] = value if is_text else np.asarray(value, feature["dtype"]).reshape(feature["shape"])
            thinned.add_frame(frame)
        thinned.save_episode(parallel_encoding=False)
    thinned.finalize()
