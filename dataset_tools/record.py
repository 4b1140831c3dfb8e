"""`hdp-record`: let an expert demonstrate a task and write a LeRobotDataset.

The dataset is recorded in shards of a few episodes, each a finished LeRobotDataset, by one or several processes, and
merged at the end. So an interrupted recording goes on where it stopped, and the result does not depend on the number
of processes: every episode has a seed of its own.
"""

import json
import logging
import multiprocessing
import os
import shutil
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import av
import datasets
import gymnasium as gym
import numpy as np
from draccus.utils import ParsingError
from huggingface_hub import get_token
from lerobot.configs import parser
from lerobot.datasets import dataset_writer
from lerobot.datasets.aggregate import aggregate_datasets
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.language import language_feature_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import INFO_PATH, create_lerobot_dataset_card
from lerobot.utils.constants import (
    ACTION,
    DEFAULT_FEATURES,
    DONE,
    HF_LEROBOT_HOME,
    OBS_ENV_STATE,
    OBS_IMAGES,
    OBS_STATE,
    REWARD,
    SUCCESS,
)
from tqdm import tqdm

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from gym_hdp_tasks import PlanningTask
from gym_hdp_tasks.env_config import HDPEnv

from .demonstration import Demonstration, Expert, check_steps, expert_generator
from .experts import EXPERTS
from .interruption import deferred_signals, end_with_parent, exit_when_terminated, one_process
from .language import SYMBOLIC_PLAN, write_language_columns

EPISODES_PER_SHARD = 25
"""At most. A short recording has smaller shards, ..."""
FEWEST_SHARDS = 8
"""... at least so many, so that all processes have work."""
RECORDING_PATH = "meta/hdp_recording.json"
"""What only one recording has, the seeds that its episodes follow from. LeRobot merges datasets with equal features, so
that it is not told there; what it edits or merges has no such file."""
MOST_ATTEMPTS = 100
"""Demonstrations of one episode that may fail."""


@dataclass
class RecordDatasetConfig:
    """What is recorded and where it goes.

    Attributes:
        repo_id: name of the dataset, `{hf_user}/{dataset_name}`.
        root: folder of the dataset. None: `$HF_LEROBOT_HOME/{repo_id}`.
        num_episodes: how many demonstrations.
        video: write camera images as videos; as lossless images inside the data files when false.
        language: write the plan as LeRobot's language columns too.
        push_to_hub: upload the dataset, with a card, when it is done.
        private: upload to a private repository. None: what the organisation's default is.
        tags: more tags for the card.
    """

    repo_id: str
    root: Path | None = None
    num_episodes: int = 200
    video: bool = True
    language: bool = False
    push_to_hub: bool = False
    private: bool | None = None
    tags: list[str] = field(default_factory=list)


@dataclass
class RecordConfig:
    """Options of `hdp-record`.

    Attributes:
        dataset: what is recorded and where it goes.
        env: the task, as for `lerobot-eval`; `--env.obs_type=pixels_agent_pos` records cameras in place of poses.
        seed: every start and every choice of the expert follow from it.
        num_workers: processes that record.
        resume: go on with a recording that was interrupted, or whose upload failed.

    Raises:
        ParsingError: a number is too small, or there is no login for the upload.
    """

    dataset: RecordDatasetConfig
    env: HDPEnv = field(default_factory=HDPEnv)
    seed: int = 0
    num_workers: int = 1
    resume: bool = False

    def __post_init__(self):
        if self.dataset.num_episodes < 1 or self.num_workers < 1:
            raise ParsingError("--dataset.num_episodes and --num_workers must be at least 1")
        if self.seed < 0:
            raise ParsingError(f"--seed must be at least 0, got {self.seed}")
        if self.dataset.push_to_hub and get_token() is None:
            raise ParsingError("--dataset.push_to_hub=true needs a login: run `hf auth login` first")

    @property
    def root(self) -> Path:
        return Path(self.dataset.root or HF_LEROBOT_HOME / self.dataset.repo_id).resolve()

    @property
    def partial_root(self) -> Path:
        """Folder of the shards, until they are merged."""
        return self.root.with_name(self.root.name + ".partial")

    @property
    def lock_file(self) -> Path:
        """Held by the process that records the dataset."""
        return self.root.with_name(self.root.name + ".lock")


class Episode(NamedTuple):
    """A demonstration as it was executed; the arrays have one row for each frame."""

    columns: dict[str, np.ndarray]

    @property
    def succeeded(self) -> bool:
        return bool(self.columns[SUCCESS][-1])


class Shard(NamedTuple):
    """A part of a recording: the episodes from `start` to before `stop`."""

    root: Path
    start: int
    stop: int

    @property
    def done_file(self) -> Path:
        """Exists when everything that the shard's folder holds was flushed to disk."""
        return self.root.with_suffix(".done")

    @property
    def lock_file(self) -> Path:
        """Held by the process that records the shard."""
        return self.root.with_suffix(".lock")


def episode_seed(seed: int, episode: int, attempt: int = 0) -> int:
    """The environment's seed for an episode of a recording; a failed attempt is followed by another one.

    It may be any number below 2^32. The recordings and the evaluations of the benchmarks have none in common.
    """
    return int(np.random.SeedSequence([seed, episode, attempt]).generate_state(1)[0])


def demonstrate(env: gym.Env, expert: Expert, seed: int, features_map: dict[str, str]) -> Episode:
    """Reset the environment, let the expert plan, and execute its plan to the end.

    Args:
        env: a task.
        expert: who solves it.
        seed: of the start, and of the expert's choices.
        features_map: what is recorded of an observation: its key in the environment (`pixels/front` is key `front` of
            the dictionary `pixels`) to the column.

    Raises:
        ValueError: the expert's waypoints are not as many as the task's horizon, or its plan is none of the task.
    """
    observation, _ = env.reset(seed=seed)
    demonstration = expert(env, expert_generator(seed))
    task: PlanningTask = env.unwrapped.planning_task  # type: ignore[attr-defined]
    _check_demonstration(demonstration, task, observation)
    frames = []
    for frame, action in enumerate(demonstration.waypoints):
        next_observation, score, terminated, truncated, info = env.step(action)
        frames.append(
            {
                **{column: _entry(observation, key) for key, column in features_map.items() if key != ACTION},
                ACTION: action,
                SYMBOLIC_PLAN: demonstration.remaining_token_ids(frame, task.vocabulary, task.symbolic_horizon),
                REWARD: np.float32([score]),
                SUCCESS: np.array([info["is_success"]]),
                DONE: np.array([terminated or truncated]),
            }
        )
        observation = next_observation
    columns = {key: np.stack([frame[key] for frame in frames]) for key in frames[0]}
    return Episode(columns)


def _check_demonstration(demonstration: Demonstration, task: PlanningTask, observation: dict[str, Any]) -> None:
    """Whether an expert's waypoints and its plan can be those of a task; its words only where poses are observed."""
    if len(demonstration.waypoints) != task.horizon:
        raise ValueError(f"the expert has {len(demonstration.waypoints)} waypoints, {task.gym_id} {task.horizon}")
    check_steps(demonstration.steps, task.horizon, "the expert's plan")
    demonstration.remaining_token_ids(0, task.vocabulary, task.symbolic_horizon)
    tokens = accumulate(len(step.symbols) for step in demonstration.steps)
    ends = tuple(zip(tokens, [step.stop for step in demonstration.steps], strict=True))
    if task.step_ends is not None and ends != task.step_ends[: len(ends)]:
        raise ValueError(f"the steps of the expert's plan end at {ends}, those of {task.gym_id} at {task.step_ends}")
    if "environment_state" in observation:
        complaints = task.check_plan(demonstration.remaining_symbols(0), observation)
        if complaints:
            raise ValueError(f"the expert's plan is none of {task.gym_id}: {'; '.join(complaints)}")


def _entry(observation: dict[str, Any], key: str) -> np.ndarray:
    """`observation["pixels"]["front"]` for the key `pixels/front`."""
    for part in key.split("/"):
        observation = observation[part]
    return observation  # type: ignore[return-value]


def dataset_features(config: RecordConfig) -> dict[str, dict[str, Any]]:
    """The columns of a task's dataset. What explains it travels in the symbolic plan's `info`."""
    task, env = config.env.planning_task, config.env

    def column(dtype: str, names: tuple[str, ...] | None, size: int | None = None, **more) -> dict[str, Any]:
        return {"dtype": dtype, "shape": (size or len(names),), "names": list(names) if names else None, **more}

    image = {
        "dtype": "video" if config.dataset.video else "image",
        "shape": (env.observation_height, env.observation_width, 3),
        "names": ["height", "width", "channels"],
    }
    columns = {
        OBS_STATE: column("float32", task.state_names),
        OBS_ENV_STATE: column("float32", task.environment_state_names),
        ACTION: column("float32", task.action_names),
    }
    return {
        **{name: image if name.startswith(OBS_IMAGES) else columns[name] for name in env.features_map.values()},
        SYMBOLIC_PLAN: column(
            "int64",
            None,
            task.symbolic_horizon,
            info={
                "vocabulary": list(task.vocabulary),
                "gym_id": task.gym_id,
                "parameters": task.parameters,
            },
        ),
        REWARD: column("float32", None, 1),
        SUCCESS: column("bool", None, 1),
        DONE: column("bool", None, 1),
    }


def attempt_episodes(config: RecordConfig, episodes: range) -> Iterator[tuple[int, int, Episode]]:
    """For each episode, by its index, attempts 0, 1, ... until one succeeds.

    Raises:
        ValueError: none does.
    """
    env = gym.make(config.env.gym_id, disable_env_checker=True, **config.env.gym_kwargs)
    expert = EXPERTS[config.env.gym_id]
    try:
        for index in episodes:
            for attempt in range(MOST_ATTEMPTS):
                episode = demonstrate(env, expert, episode_seed(config.seed, index, attempt), config.env.features_map)
                yield index, attempt, episode
                if episode.succeeded:
                    break
            else:
                raise ValueError(
                    f"the expert has failed {MOST_ATTEMPTS} times in a row (score {episode.columns[REWARD][-1, 0]:.2f} "
                    f"in the end) and does not solve {config.env.gym_id}"
                )
    finally:
        env.close()


def record_shard(config: RecordConfig, shard: Shard, progress: tqdm | None = None) -> None:
    """Record a shard, or what is missing of it.

    SIGTERM, SIGHUP and Ctrl-C wait for the episode that is recorded; after SIGKILL, the shard begins again.

    Raises:
        BlockingIOError: another process records it.
        InterruptedError: a signal has arrived, and its handler did not end the process.
    """
    with one_process(shard.lock_file, f"records episodes {shard.start} to {shard.stop - 1} of {config.root}"):
        if is_complete(shard):
            return
        with deferred_signals() as signals:
            _record_missing_episodes(config, shard, signals, progress)
        if signals:
            raise InterruptedError("interrupted; go on with --resume=true")


def _record_missing_episodes(config: RecordConfig, shard: Shard, signals: list[int], progress: tqdm | None) -> None:
    """Record what a shard lacks, at most to the end of the episode during which `signals` gets an entry."""
    dataset = _open_shard(config, shard)
    failed = failed_attempts(shard) if shard.done_file.exists() else {}
    shard.done_file.unlink(missing_ok=True)
    missing = range(shard.start + dataset.meta.total_episodes, shard.stop)
    writing = False
    try:
        for index, attempt, episode in attempt_episodes(config, missing):
            if episode.succeeded:
                writing = True
                _write(dataset, episode, config.env.planning_task.instruction)
                writing = False
                if attempt:
                    failed[index] = attempt
                if progress is not None:
                    progress.update()
            if signals:
                break
    finally:
        dataset.finalize()
        if writing or not dataset.meta.total_episodes:
            shutil.rmtree(shard.root)  # a half written episode may be in the data and not in the metadata
        else:
            _write_whole(shard.done_file, json.dumps(failed))


def _write_whole(file: Path, text: str) -> None:
    """Write a file at once, whatever interrupts."""
    unfinished = file.with_suffix(".unfinished")
    unfinished.write_text(text)
    unfinished.replace(file)


def _open_shard(config: RecordConfig, shard: Shard) -> LeRobotDataset:
    """A shard's dataset, to which episodes can be added."""
    datasets.disable_progress_bars()  # one for every episode otherwise
    av.logging.set_libav_level(av.logging.WARNING)
    os.environ.setdefault("SVT_LOG", "1")  # errors only, of the AV1 encoder
    dataset_writer.embed_images = _embed_images_if_any
    task = config.env.planning_task
    # Videos are encoded while an episode is written, frame by frame; the queue holds a whole one, so that none drops.
    options: dict[str, Any] = {
        "root": shard.root,
        "video_backend": "pyav",
        "streaming_encoding": True,
        "encoder_queue_maxsize": task.horizon,
        "encoder_threads": 1,
    }
    if shard.root.exists() and not shard.done_file.exists():
        shutil.rmtree(shard.root)  # killed while it was written: its files have no footers
    if shard.root.exists():
        return LeRobotDataset.resume(config.dataset.repo_id, **options)
    return LeRobotDataset.create(
        config.dataset.repo_id,
        fps=task.fps,
        features=dataset_features(config),
        robot_type=task.robot_type,
        use_videos=config.dataset.video,
        **options,
    )


def _write(dataset: LeRobotDataset, episode: Episode, instruction: str) -> None:
    for frame in range(len(episode.columns[ACTION])):
        dataset.add_frame({**{key: column[frame] for key, column in episode.columns.items()}, "task": instruction})
    dataset.save_episode()


_embed_images = dataset_writer.embed_images


def _embed_images_if_any(dataset: datasets.Dataset) -> datasets.Dataset:
    """LeRobot's `embed_images`, which takes as long as a third of the physics when there is nothing to embed.

    To be removed when LeRobot skips it for a dataset without images.
    """
    has_images = any(isinstance(feature, datasets.Image) for feature in dataset.features.values())
    return _embed_images(dataset) if has_images else dataset


def record(config: RecordConfig) -> LeRobotDataset:
    """Record a dataset as the configuration says.

    Raises:
        FileExistsError: the dataset's folder exists, or an interrupted recording does and `resume` is not set.
        ValueError: the environment cannot be made, nobody can demonstrate the task, or the interrupted recording had
            other settings.
        OSError: another process records this dataset, or the upload failed.
    """
    try:
        config.root.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise NotADirectoryError(f"Not a directory: {config.root.parent}; choose another --dataset.root") from error
    with one_process(config.lock_file, f"records {config.root}"):
        if (dataset := finish_earlier_recording(config)) is not None:
            return dataset
        try_environment(config)
        return _record(config)


def _record(config: RecordConfig) -> LeRobotDataset:
    shards = plan_shards(config)
    with tqdm(total=config.dataset.num_episodes, desc=f"Recording {config.env.task}", unit="episode") as progress:
        if config.num_workers == 1:
            for shard in shards:
                progress.update(recorded_episodes(shard))
                record_shard(config, shard, progress)
        else:
            context = multiprocessing.get_context("forkserver")
            # Workers import the rest themselves: MuJoCo opens a display when it is imported.
            context.set_forkserver_preload(["lerobot.datasets.lerobot_dataset"])
            with ProcessPoolExecutor(config.num_workers, context, initializer=end_with_parent) as executor:
                futures = {executor.submit(record_shard, config, shard): shard for shard in shards}
                try:
                    for future in as_completed(futures):
                        future.result()
                        progress.update(futures[future].stop - futures[future].start)
                except BaseException:
                    executor.shutdown(wait=False, cancel_futures=True)
                    for worker in multiprocessing.active_children():
                        worker.terminate()
                    raise

    return merge_shards(config, shards)


def merge_shards(config: RecordConfig, shards: list[Shard]) -> LeRobotDataset:
    """Make one dataset of the shards, remove them, and upload the dataset if that is wanted.

    Raises:
        ValueError: they are not all episodes of the recording.
        OSError: the upload failed.
    """
    failed = {episode: attempts for shard in shards for episode, attempts in failed_attempts(shard).items()}
    dataset = _merge(config, shards, failed)
    dropped, attempts = sum(failed.values()), config.dataset.num_episodes + sum(failed.values())
    print(
        f"{dataset.num_episodes} episodes in {config.root}; dropped {dropped} of {attempts} demonstrations that failed"
    )
    _upload_if_wanted(config, dataset)
    return dataset


def _upload_if_wanted(config: RecordConfig, dataset: LeRobotDataset) -> None:
    if not config.dataset.push_to_hub:
        return
    try:
        dataset.push_to_hub(private=config.dataset.private, **describe_dataset(config, dataset))
    except Exception as error:  # of the Hub's client, of HTTP, of the transfer: nothing is lost by any
        reason = " ".join(str(error).split())
        raise OSError(
            f"{config.root} is complete, but the upload failed; the command with --resume=true repeats it ({reason})"
        ) from error


def finish_earlier_recording(config: RecordConfig) -> LeRobotDataset | None:
    """The dataset, if it is there and `resume` is set: do what its recording had left to do, the upload in particular.

    Raises:
        FileExistsError: the dataset's folder exists, but `resume` is not set, or it holds something else.
        OSError: the upload failed.
    """
    if not config.root.exists():
        return None
    complete = _is_complete_dataset(config)
    if not config.resume:
        unfinished = complete and (config.dataset.push_to_hub or config.partial_root.exists())
        advice = "finish it with --resume=true" if unfinished else "delete it"
        raise FileExistsError(f"{config.root} exists already: {advice}, or choose another --dataset.root")
    if not complete:
        raise FileExistsError(
            f"{config.root} exists already and holds something else: to resume, use the flags that recorded it, or "
            "choose another --dataset.root"
        )
    shutil.rmtree(config.partial_root, ignore_errors=True)
    dataset = LeRobotDataset(config.dataset.repo_id, root=config.root, video_backend="pyav")
    print(f"{dataset.num_episodes} episodes in {config.root}, recorded earlier")
    _upload_if_wanted(config, dataset)
    return dataset


def _is_complete_dataset(config: RecordConfig) -> bool:
    """Whether the dataset's folder holds what the configuration asks for."""
    if not (config.root / INFO_PATH).exists():
        return False

    def columns(features: dict[str, dict[str, Any]]) -> dict[str, tuple]:
        own = features.keys() - DEFAULT_FEATURES.keys()
        return {name: (features[name]["dtype"], tuple(features[name]["shape"])) for name in own}

    info, wanted = load_info(config.root), dataset_features(config)
    language = language_feature_info() if config.dataset.language else {}
    if info.total_episodes != config.dataset.num_episodes or columns(info.features) != columns({**wanted, **language}):
        return False
    recording = config.root / RECORDING_PATH
    is_same_task = info.features[SYMBOLIC_PLAN].get("info") == wanted[SYMBOLIC_PLAN]["info"]
    return is_same_task and recording.exists() and json.loads(recording.read_text())["seed"] == config.seed


def try_environment(config: RecordConfig) -> None:
    """Find out whether episodes can start, before there is anything on disk.

    Raises:
        ValueError: nobody can demonstrate the task.
        OSError: images are wanted, and there is nothing to render with.
    """
    if config.env.gym_id not in EXPERTS:
        raise ValueError(f"{config.env.gym_id} has no expert in dataset_tools/experts/__init__.py")
    env = gym.make(config.env.gym_id, disable_env_checker=True, **config.env.gym_kwargs)
    try:
        env.reset(seed=0)
    finally:
        env.close()


def plan_shards(config: RecordConfig) -> list[Shard]:
    """The shards of a recording, in a folder beside the dataset's that remembers the settings.

    Raises:
        FileExistsError: the folder exists, and `resume` is not set.
        ValueError: it has other settings, or what it remembers is damaged.
    """
    partial, total = config.partial_root, config.dataset.num_episodes
    starts = shard_starts(total)
    settings = {
        "env": asdict(config.env),
        "seed": config.seed,
        "num_episodes": total,
        "episodes_per_shard": starts.step,
        "video": config.dataset.video,
    }
    settings = json.loads(json.dumps(settings, default=str))
    settings_file = partial / "settings.json"
    if partial.exists() and not config.resume:
        raise FileExistsError(f"{partial} holds an interrupted recording: go on with --resume=true, or delete it")
    if not settings_file.exists():
        partial.mkdir(parents=True, exist_ok=True)
        _write_whole(settings_file, json.dumps(settings, indent=2))
    elif _read_settings(settings_file) != settings:
        raise ValueError(f"{settings_file} has other settings than this command: use the same ones to resume")
    if len(starts) < config.num_workers:
        logging.warning(f"only {len(starts)} of {config.num_workers} workers have work: {total} episodes are few")
    return [Shard(partial / f"episodes_{start:06d}", start, min(start + starts.step, total)) for start in starts]


def _read_settings(file: Path) -> dict[str, Any]:
    try:
        return json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(
            f"{file} is damaged ({error}): delete it if the recording had the settings of this command, else its folder"
        ) from error


def shard_starts(num_episodes: int) -> range:
    """The first episodes of the shards; they do not depend on the number of processes, nor may the dataset."""
    return range(0, num_episodes, min(EPISODES_PER_SHARD, max(1, num_episodes // FEWEST_SHARDS)))


def recorded_episodes(shard: Shard) -> int:
    """How many episodes a shard on disk holds; one that was killed while it was written begins again."""
    return load_info(shard.root).total_episodes if shard.done_file.exists() else 0


def is_complete(shard: Shard) -> bool:
    """Whether a shard holds all of its episodes."""
    return recorded_episodes(shard) == shard.stop - shard.start


def failed_attempts(shard: Shard) -> dict[int, int]:
    """How many attempts failed, for the episodes of a shard on disk that needed more than one."""
    return {int(episode): attempts for episode, attempts in json.loads(shard.done_file.read_text()).items()}


def _merge(config: RecordConfig, shards: list[Shard], failed: dict[int, int]) -> LeRobotDataset:
    merged = config.partial_root / "merged"
    shutil.rmtree(merged, ignore_errors=True)
    repo_id = config.dataset.repo_id
    aggregate_datasets([repo_id] * len(shards), repo_id, roots=[shard.root for shard in shards], aggr_root=merged)

    if config.dataset.language:
        write_language_columns(merged, config.env.planning_task.vocabulary)
    recording = {"seed": config.seed, "num_episodes": config.dataset.num_episodes, "failed_attempts": failed}
    (merged / RECORDING_PATH).write_text(json.dumps(recording, indent=4, sort_keys=True))
    dataset = LeRobotDataset(repo_id, root=merged, video_backend="pyav")
    if dataset.num_episodes != config.dataset.num_episodes:
        raise ValueError(
            f"{config.partial_root} has {dataset.num_episodes} of {config.dataset.num_episodes} episodes: go on with "
            "--resume=true"
        )
    card = create_lerobot_dataset_card(dataset_info=dataset.meta.info, **describe_dataset(config, dataset))
    card.save(merged / "README.md")
    config.root.parent.mkdir(parents=True, exist_ok=True)
    merged.rename(config.root)
    shutil.rmtree(config.partial_root)
    return LeRobotDataset(repo_id, root=config.root, video_backend="pyav")


CARD_TAGS = ["hybrid-diffusion-planning", "symbolic-plan", "simulation"]
PAPER = "https://doi.org/10.1109/LRA.2026.3664616"


def describe_dataset(config: RecordConfig, dataset: LeRobotDataset) -> dict[str, Any]:
    """What the dataset's card says, on disk and on the Hub."""
    return {
        "tags": [*CARD_TAGS, *config.dataset.tags],
        "license": "apache-2.0",
        "paper": PAPER,
        "dataset_description": describe(config.env.planning_task, dataset),
    }


def describe(task: PlanningTask, dataset: LeRobotDataset) -> str:
    """The dataset card's description, with the plan of the first episode in words."""
    ids = dataset.hf_dataset[0][SYMBOLIC_PLAN].tolist()
    words = " ".join(task.vocabulary[i] for i in ids if i)
    return (
        f"{dataset.num_episodes} demonstrations of `{task.gym_id}` by a scripted expert: {task.instruction}\n\n"
        f"Each episode has {task.horizon} frames. `{SYMBOLIC_PLAN}` holds, at every frame, the token ids of the plan "
        f"that remains, filled with PAD. The whole plan of episode 0, in words:\n\n> {words}\n\n"
        f"The vocabulary, in the order of the ids: {', '.join(f'`{symbol}`' for symbol in task.vocabulary)}."
    )


def accept_env_type() -> None:
    """Take `--env.type=hdp`, which LeRobot's commands require, off the command line: there is no other type to record.

    Raises:
        ParsingError: it says another type.
    """
    env_type = parser.get_type_arg("env")
    if env_type not in (None, "hdp"):
        raise ParsingError(f"--env.type={env_type} has no experts, only --env.type=hdp has")
    sys.argv[1:] = parser.filter_arg("env.type", sys.argv[1:])


@parser.wrap()
def _main(config: RecordConfig) -> None:
    record(config)


def main() -> None:
    """Entry point of `hdp-record`: bad input is one line on stderr and exit status 1."""
    logging.getLogger("lerobot").setLevel(logging.WARNING)
    exit_when_terminated()
    try:
        accept_env_type()
        _main()
    except KeyboardInterrupt:
        sys.exit("hdp-record: interrupted; go on with --resume=true")
    except BrokenProcessPool:
        sys.exit(
            "hdp-record: a worker ended, for want of memory perhaps: go on with --resume=true and fewer --num_workers"
        )
    except (ParsingError, ValueError, OSError, ImportError) as error:
        sys.exit(f"hdp-record: {error}")


if __name__ == "__main__":
    main()
