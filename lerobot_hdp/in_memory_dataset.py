"""A LeRobotDataset held in memory as tensors, which gives whole batches at once.

LeRobot reads a batch item by item: with a horizon of 145 actions, one item takes several milliseconds. Here, a batch is
one gather in each column. PyTorch's data loader asks for it through `__getitems__`.
"""

import math
from collections.abc import Collection, Iterable, Iterator
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.language import LANGUAGE_COLUMNS
from lerobot.datasets.video_utils import decode_video_frames
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map
from tqdm import tqdm

SUPPORTED_DTYPES = ("float", "int", "uint", "bool", "string", "image", "video")
"""How the names of the types begin that a column in memory can have."""


class Batch(dict):
    """A batch that is collated already. A data loader gets it as a list of this one, see `collate`."""


def collate(batches: list[Batch], *, collate_fn_map: Any = None) -> Batch:
    """The batch of a list of one."""
    [batch] = batches
    return batch


default_collate_fn_map[Batch] = collate


class InMemoryDataset(LeRobotDataset):
    """A LeRobotDataset that gives the same samples from memory: `dataset.__getitems__(indices)`.

    Cameras are decoded once and kept as uint8.

    Args:
        dataset: what to load; `unsupported(dataset, leave_out)` must be None.
        leave_out: cameras that the samples need not have.
        first_images_only: hold each camera's first image of each episode alone, for samples that begin there.

    Raises:
        ValueError: it cannot be held in memory.
    """

    def __init__(self, dataset: LeRobotDataset, leave_out: Collection[str] = (), first_images_only: bool = False):
        vars(self).update(vars(dataset))
        if (reason := unsupported(dataset, leave_out)) is not None:
            raise ValueError(f"{dataset.repo_id} cannot be held in memory: {reason}")
        self._cameras = [key for key in self.meta.camera_keys if key not in leave_out]
        self._columns, self._words = _read_columns(dataset, leave_out)
        episodes, inverse, lengths = self._columns["episode_index"].unique_consecutive(
            return_inverse=True, return_counts=True
        )
        ends = lengths.cumsum(0)
        self._first, self._last = (ends - lengths)[inverse], (ends - 1)[inverse]
        held = ends - lengths if first_images_only else torch.arange(len(inverse))
        self._image_of_frame = torch.full_like(inverse, -1).scatter(0, held, torch.arange(len(held)))
        timestamps = self._columns["timestamp"][held].split(inverse[held].bincount().tolist())
        seconds = {episode: times.tolist() for episode, times in zip(episodes.tolist(), timestamps, strict=True)}
        for key in self._cameras:
            in_videos = key in self.meta.video_keys
            images = _decode_videos(dataset, key, seconds) if in_videos else _read_images(dataset, key, held)
            self._columns[key] = _join(len(held), images)
        self._offsets = {key: torch.tensor(deltas) for key, deltas in (self.reader.delta_indices or {}).items()}
        self._tasks = list(self.meta.tasks.index)

    def __getitems__(self, indices: list[int]) -> list[Batch]:
        """The samples of some frames, collated: each column (B, ...), or (B, T, ...) where it has delta timestamps.

        Raises:
            ValueError: an image is not held.
        """
        rows = torch.tensor(indices)
        first, last = self._first[rows, None], self._last[rows, None]
        batch = Batch({key: [words[i] for i in indices] for key, words in self._words.items()})
        for key, column in self._columns.items():
            if key not in self._offsets:
                batch[key] = column[self._place(key, rows)]
                continue
            window = rows[:, None] + self._offsets[key]
            batch[key] = column[self._place(key, torch.minimum(torch.maximum(window, first), last))]
            batch[f"{key}_is_pad"] = (window < first) | (window > last)
            if key in self.meta.video_keys and window.shape[1] == 1:
                batch[key] = batch[key].squeeze(1)  # as LeRobot has it
        self._finish_images(batch)
        batch["task"] = [self._tasks[i] for i in batch["task_index"].tolist()]
        return [batch]

    def _place(self, key: str, frames: Tensor) -> Tensor:
        """Where a column has what it holds of some frames."""
        if key not in self._cameras:
            return frames
        places = self._image_of_frame[frames]
        if (places < 0).any():
            raise ValueError(f"of {key}, the first image of each episode alone is held in memory")
        return places

    def _finish_images(self, batch: Batch) -> None:
        """uint8 to float where LeRobot has it so, and the image transforms, sample by sample as LeRobot draws them."""
        for key in self._cameras:
            if key in self.meta.image_keys or not self._return_uint8:
                batch[key] = batch[key].float() / 255
        if self.image_transforms is not None:
            samples = zip(*(batch[key] for key in self._cameras), strict=True)
            images = [[self.image_transforms(image) for image in sample] for sample in samples]
            batch.update(zip(self._cameras, map(torch.stack, zip(*images, strict=True)), strict=True))


def unsupported(dataset: LeRobotDataset, leave_out: Collection[str] = ()) -> str | None:
    """Why a dataset cannot be held in memory, in words; None if it can."""
    if not isinstance(dataset, LeRobotDataset):
        return "it is streamed"
    for key, feature in _held_features(dataset, leave_out).items():
        if key in dataset.meta.depth_keys:
            return f"{key} holds depth maps"
        if not feature["dtype"].startswith(SUPPORTED_DTYPES):
            return f"{key} holds values of type {feature['dtype']}"
    return None


def memory_needed(dataset: LeRobotDataset, leave_out: Collection[str] = (), first_images_only: bool = False) -> int:
    """Bytes that the dataset takes as tensors; see `InMemoryDataset`."""
    images = dataset.num_episodes if first_images_only else dataset.num_frames
    needed = 0
    for key, feature in _held_features(dataset, leave_out).items():
        numbers = math.prod(feature["shape"])
        if key in dataset.meta.camera_keys:
            needed += numbers * images
        elif feature["dtype"] != "string":
            needed += numbers * dataset.num_frames * (8 if "int" in feature["dtype"] else 4)
    return needed


def _held_features(dataset: LeRobotDataset, leave_out: Collection[str]) -> dict[str, dict[str, Any]]:
    """The features that a batch has: not what is left out, nor language, which LeRobot leaves out of a batch, too."""
    features = dataset.meta.features.items()
    return {key: feature for key, feature in features if key not in leave_out and key not in LANGUAGE_COLUMNS}


def _read_columns(
    dataset: LeRobotDataset, leave_out: Collection[str]
) -> tuple[dict[str, Tensor], dict[str, list[str]]]:
    """Columns of the dataset's table as tensors (N, ...), of the types that LeRobot makes them; and those of words.

    Images are not among them.
    """
    table = dataset.hf_dataset.with_format(None)
    columns, words = {}, {}
    held = _held_features(dataset, [*leave_out, *dataset.meta.camera_keys])
    for key in table.column_names:
        if key not in held:
            continue
        if held[key]["dtype"] == "string":
            words[key] = table[key][:]
        else:
            values = np.stack(table.select_columns(key).with_format("numpy")[:][key])
            kind = {"f": np.float32, "i": np.int64, "u": np.int64, "b": np.bool_}[values.dtype.kind]
            columns[key] = torch.from_numpy(values.astype(kind))
    return columns, words


def _read_images(dataset: LeRobotDataset, key: str, frames: Tensor) -> Iterator[Tensor]:
    """A camera's images in some frames, where they are in the dataset's table: (1, C, H, W) uint8 each."""
    rows = dataset.hf_dataset.with_format(None).select_columns(key).select(frames.tolist())
    for row in tqdm(rows, desc=f"Decoding {key}", unit="image"):
        yield torch.from_numpy(np.atleast_3d(np.array(row[key]))).permute(2, 0, 1)[None]


def _decode_videos(dataset: LeRobotDataset, key: str, seconds: dict[int, list[float]]) -> Iterator[Tensor]:
    """Frames of a camera in each episode: (n, C, H, W) uint8.

    Args:
        dataset: where the videos are.
        key: of the camera.
        seconds: for each episode, the timestamps of the frames, from its beginning.
    """
    for index, timestamps in tqdm(seconds.items(), desc=f"Decoding {key}", unit="episode"):
        first = dataset.meta.episodes[index][f"videos/{key}/from_timestamp"]
        path = dataset.root / dataset.meta.get_video_file_path(index, key)
        moments = [first + timestamp for timestamp in timestamps]
        yield decode_video_frames(path, moments, dataset.tolerance_s, dataset._video_backend, return_uint8=True)


def _join(length: int, parts: Iterable[Tensor]) -> Tensor:
    """Parts (n, ...) one after another: (length, ...). Unlike `torch.cat`, it never holds all of them twice."""
    joined, stop = torch.empty(0), 0
    for part in parts:
        if stop == 0:
            joined = torch.empty(length, *part.shape[1:], dtype=part.dtype)
        start, stop = stop, stop + len(part)
        joined[start:stop] = part
    return joined
