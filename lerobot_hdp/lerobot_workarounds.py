"""Where a planner, or a command that loads one, changes LeRobot itself (0.6.1), with what would make it unnecessary.

`hdp-train` and `hdp-record` replace functions of LeRobot, too: scripts/hdp_train.py, dataset_tools/record.py.
"""

import logging
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lerobot.configs.default import DatasetConfig
    from lerobot.datasets import LeRobotDatasetMetadata


def read_metadata(source: "DatasetConfig") -> "LeRobotDatasetMetadata":
    """The metadata of a dataset, or one sentence about what is wrong.

    LeRobot looks for a dataset that is not in its folder on the Hub, and lets the user read how that failed.

    Raises:
        ValueError: it is in neither.
    """
    from httpx import HTTPError
    from lerobot.datasets import LeRobotDatasetMetadata  # not where the plugin is only discovered

    try:
        return LeRobotDatasetMetadata(
            source.repo_id, root=source.root, revision=source.revision, repo_type=source.repo_type
        )
    except (OSError, HTTPError) as error:
        where = "in LeRobot's cache" if source.root is None else f"in {source.root}"
        raise ValueError(
            f"the dataset {source.repo_id} is not {where}, nor to be had from the Hub: name another by "
            f"--dataset.repo_id and --dataset.root, or record it with hdp-record ({error})"
        ) from error


def keep_data_order_on_resume() -> None:
    """Let a resumed run go on in the epoch where it stopped.

    `lerobot-train` restores the sampler's epoch, but Accelerate's loader counts its epochs from 0 again and tells the
    sampler so: after the first epoch, a resumed run sees other data than an uninterrupted one. If what the loader says
    first is 0, the restored epoch is added to all that it says from then on.

    In a run on several processes, batches are the same only where batch size times processes divides the number of
    samples. To be removed with LeRobot pull request 4692, after which the loader says the right epoch.
    """
    from lerobot.datasets.sampler import EpisodeAwareSampler  # not where the plugin is only discovered

    set_epoch, load_state_dict = EpisodeAwareSampler.set_epoch, EpisodeAwareSampler.load_state_dict
    if getattr(set_epoch, "keeps_data_order", False):
        return

    def load_state_dict_and_remember(self: EpisodeAwareSampler, state: dict) -> None:
        load_state_dict(self, state)
        self._restored_epoch = state["epoch"]

    def set_shifted_epoch(self: EpisodeAwareSampler, epoch: int) -> None:
        if hasattr(self, "_restored_epoch"):
            self._epoch_shift = self._restored_epoch if epoch == 0 else 0
            del self._restored_epoch
        set_epoch(self, epoch + getattr(self, "_epoch_shift", 0))

    set_shifted_epoch.keeps_data_order = True  # type: ignore[attr-defined]
    EpisodeAwareSampler.load_state_dict = load_state_dict_and_remember
    EpisodeAwareSampler.set_epoch = set_shifted_epoch


def shorten_torchcodec_warning() -> None:
    """Say in one line, not a page, that torchcodec finds no FFmpeg.

    LeRobot tries torchcodec whenever it parses a training configuration, logs a traceback for each FFmpeg version
    that it does not find, and then uses PyAV. To be removed when it says so in one line itself.
    """
    for name in ("lerobot.utils.import_utils", "lerobot.datasets.video_utils"):
        logging.getLogger(name).addFilter(_Shorten())


class _Shorten(logging.Filter):
    def __init__(self):
        super().__init__()
        self.said = False

    def filter(self, record: logging.LogRecord) -> bool:
        if "libtorchcodec" not in record.getMessage():
            return True
        record.msg, record.args = "torchcodec finds no FFmpeg libraries; videos are decoded by PyAV instead.", ()
        first, self.said = not self.said, True
        return first
