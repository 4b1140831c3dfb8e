"""`hdp-record`: the data contract, interruptions, and what cannot be recorded."""

import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
from draccus.utils import ParsingError
from huggingface_hub import DatasetCard
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.io_utils import load_info
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from benchmarks import cells, checkpoints, few_step_planning
from benchmarks.paper.presets import PRESETS
from dataset_tools import record as recorder
from dataset_tools import record_on_cluster as cluster
from dataset_tools.demonstration import Demonstration
from dataset_tools.experts import EXPERTS
from dataset_tools.interruption import TERMINATION, one_process
from dataset_tools.record import (
    RECORDING_PATH,
    RecordConfig,
    RecordDatasetConfig,
    demonstrate,
    episode_seed,
    merge_shards,
    plan_shards,
    record,
    record_shard,
    shard_starts,
)
from dataset_tools.replay import load_recording, replay
from gym_hdp_tasks.env_config import HDPEnv

from .conftest import HORIZON, N_EPISODES, TASK_FLAGS, call_command, run_command


def columns(root: Path) -> dict[str, np.ndarray]:
    dataset = LeRobotDataset("test/sorting", root=root, video_backend="pyav").hf_dataset.with_format("numpy")
    return {key: np.stack(dataset[key]) for key in dataset.column_names}


def assert_same_dataset(first: Path, second: Path) -> None:
    one, other = columns(first), columns(second)
    assert one.keys() == other.keys()
    assert all(np.array_equal(one[key], other[key]) for key in one)


@pytest.fixture(scope="module")
def recorded(dataset_root):
    return columns(dataset_root)


def test_writes_the_data_contract(dataset_root, recorded):
    features = json.loads((dataset_root / "meta/info.json").read_text())["features"]
    expected = {
        "observation.state": ("float32", [3]),
        "observation.environment_state": ("float32", [4]),
        "action": ("float32", [3]),
        "observation.symbolic_plan": ("int64", [18]),
        "next.reward": ("float32", [1]),
        "next.success": ("bool", [1]),
        "next.done": ("bool", [1]),
    }
    assert {key: (features[key]["dtype"], features[key]["shape"]) for key in expected} == expected
    assert len(recorded["action"]) == N_EPISODES * HORIZON


def test_a_dataset_explains_itself(dataset_root):
    info = json.loads((dataset_root / "meta/info.json").read_text())["features"]["observation.symbolic_plan"]["info"]
    assert info["vocabulary"] == ["PAD", "A", "B", "PICK", "PLACE", "S1", "S2", "AUX"]
    assert info["gym_id"] == "hdp/BlockSorting2D-v0"
    assert info["parameters"] == {"n_blocks": 2, "waypoints_per_pose": 1}
    recording = json.loads((dataset_root / RECORDING_PATH).read_text())
    assert recording == {"seed": 0, "num_episodes": N_EPISODES, "failed_attempts": {}}


def test_episodes_are_whole_and_successful(recorded):
    by_episode = {key: value.reshape(N_EPISODES, HORIZON, -1) for key, value in recorded.items()}
    last = np.zeros(HORIZON)
    last[-1] = 1
    for key in ("next.reward", "next.success", "next.done"):
        assert (by_episode[key][..., 0] == last).all()
    assert np.array_equal(by_episode["action"][:, 0], by_episode["observation.state"][:, 0])
    assert len(np.unique(by_episode["observation.environment_state"][:, 0], axis=0)) == N_EPISODES


def test_the_plan_column_is_what_remains(recorded):
    plans = recorded["observation.symbolic_plan"].reshape(N_EPISODES, HORIZON, 18)
    assert ((plans != 0).sum(axis=2) == np.repeat([18, 12, 6], [7, 6, 6])).all()
    assert np.array_equal(plans[:, 7, :12], plans[:, 0, 6:])


def test_the_card_shows_a_plan_in_words_and_names_the_paper(dataset_root):
    card = (dataset_root / "README.md").read_text()
    assert "**Paper:** https://doi.org/10.1109/LRA.2026.3664616" in card
    assert "PICK" in card
    assert "PLACE" in card
    assert "hybrid-diffusion-planning" in card


def test_recorded_actions_replay_to_the_recorded_score(dataset):
    recording = load_recording(dataset)
    assert replay(recording) == recording.scores.tolist() == [1.0] * N_EPISODES


def test_some_episodes_of_a_recording_replay_from_their_own_seeds(dataset_root):
    some = load_recording(LeRobotDataset("test/sorting", root=dataset_root, episodes=[7, 3], video_backend="pyav"))
    assert some.seeds == [episode_seed(0, 3), episode_seed(0, 7)]
    assert replay(some) == some.scores.tolist() == [1.0, 1.0]


def test_a_recording_that_was_edited_does_not_replay_from_wrong_seeds(dataset, tmp_path):
    shorter = delete_episodes(dataset, [0], output_dir=tmp_path / "shorter", repo_id="test/shorter")
    with pytest.raises(ValueError, match="which seeds its episodes have is not known"):
        load_recording(shorter)


def test_a_recording_with_further_episodes_does_not_replay(dataset_root, tmp_path):
    copy = shutil.copytree(dataset_root, tmp_path / "copy")
    recording = json.loads((copy / RECORDING_PATH).read_text())
    (copy / RECORDING_PATH).write_text(json.dumps({**recording, "num_episodes": N_EPISODES - 1}))
    with pytest.raises(ValueError, match=f"has {N_EPISODES} episodes and was recorded with {N_EPISODES - 1}"):
        load_recording(LeRobotDataset("test/sorting", root=copy, video_backend="pyav"))


def test_recordings_from_different_seeds_can_be_merged(tmp_path):
    parts = [record(replace(config_of(2, tmp_path / f"seed_{seed}"), seed=seed)) for seed in (1, 2)]
    merged = merge_datasets(parts, output_repo_id="test/merged", output_dir=tmp_path / "merged")
    starts = columns(merged.root)["observation.environment_state"].reshape(4, -1)
    assert len(np.unique(starts, axis=0)) == 4
    with pytest.raises(ValueError, match="which seeds its episodes have is not known"):
        load_recording(merged)


def test_the_command_records_the_same_dataset_with_two_processes(dataset_root, tmp_path):
    root = tmp_path / "two_workers"
    flags = ("--dataset.repo_id=test/sorting", f"--dataset.root={root}", f"--dataset.num_episodes={N_EPISODES}")
    run_command("hdp-record", "--env.type=hdp", *TASK_FLAGS, *flags, "--num_workers=2")
    assert_same_dataset(dataset_root, root)
    for file in (RECORDING_PATH, "meta/info.json"):
        assert json.loads((root / file).read_text()) == json.loads((dataset_root / file).read_text())


def test_a_cluster_engine_records_the_same_dataset_also_when_it_was_killed(dataset_root, tmp_path, monkeypatch):
    root = tmp_path / "cluster"
    flags = ("--dataset.repo_id=test/sorting", f"--dataset.root={root}", f"--dataset.num_episodes={N_EPISODES}")
    command = ("-m", "dataset_tools.record_on_cluster", "--env.type", "hdp", *TASK_FLAGS, *flags)
    process = subprocess.Popen([sys.executable, *command, "--num_workers=2"], stderr=subprocess.DEVNULL)
    while not list(tmp_path.glob("cluster.partial/*.done")):
        assert process.poll() is None
        time.sleep(0.01)
    servers = psutil.Process(process.pid).children()
    workers = [worker for server in servers for worker in server.children()]
    process.kill()
    _, still_running = psutil.wait_procs(workers, timeout=20)
    assert len(workers) == 2
    assert not still_running
    for server in servers:  # one of them, which does nothing, outlives the engine
        with contextlib.suppress(psutil.NoSuchProcess):
            server.kill()
    assert not root.exists()
    monkeypatch.setattr(cluster, "exit_when_terminated", lambda: None)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    call_command(cluster.main, *command[2:])
    assert_same_dataset(dataset_root, root)
    assert not root.with_name("cluster.partial").exists()


def test_a_cluster_engine_that_is_interrupted_says_what_goes_on(tmp_path, monkeypatch):
    def interrupted(env, rng):
        raise KeyboardInterrupt

    monkeypatch.setitem(EXPERTS, "hdp/BlockSorting2D-v0", interrupted)
    monkeypatch.setattr(cluster, "exit_when_terminated", lambda: None)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with pytest.raises(SystemExit, match="record_on_cluster: interrupted; the same command goes on"):
        call_command(cluster.main, *flags_of(2, tmp_path / "stopped"))


def test_a_slurm_job_records_a_shard(tmp_path, monkeypatch):
    """Submitted to a Slurm that only gives out job numbers; the test does what the first job would."""
    for name, answer in (("sbatch", "Submitted batch job 42"), ("scontrol", "node1")):
        (tmp_path / name).write_text(f"#!/bin/sh\necho {answer}\n")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    root = tmp_path / "slurm"
    flags = ("--dataset.repo_id=test/slurm", f"--dataset.root={root}", "--dataset.num_episodes=2")
    run_command("python", "-m", "dataset_tools.record_on_cluster", *TASK_FLAGS, *flags, "--slurm.partition=cpu")
    shard = root.with_name("slurm.partial") / "episodes_000000"
    assert not shard.exists()
    for name, value in (("SLURM_ARRAY_TASK_ID", "0"), ("SLURM_NODELIST", "node1"), ("SLURM_JOB_ID", "42")):
        monkeypatch.setenv(name, value)
    run_command("launch_pickled_pipeline", root.with_name("slurm.logs") / "record" / "executor.pik")
    assert load_info(shard).total_episodes == 1


@pytest.mark.parametrize("module", [recorder, cluster])
def test_environments_that_are_not_of_this_package_cannot_be_recorded(monkeypatch, module):
    monkeypatch.setattr(module, "exit_when_terminated", lambda: None)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    with pytest.raises(SystemExit, match=r"--env.type=aloha has no experts, only --env.type=hdp has$"):
        call_command(module.main, "--dataset.repo_id=t/t", "--env.type=aloha")


def test_all_workers_have_work_in_a_short_recording_or_the_command_says_so(tmp_path, caplog):
    assert all(len(shard_starts(n)) >= min(n, 8) for n in range(1, 500))
    config = RecordConfig(RecordDatasetConfig("test/few", tmp_path / "few", num_episodes=3), num_workers=4)
    assert len(plan_shards(config)) == 3
    assert [record.message for record in caplog.records] == ["only 3 of 4 workers have work: 3 episodes are few"]


def config_of(num_episodes: int, root: Path) -> RecordConfig:
    return RecordConfig(RecordDatasetConfig("t/t", root, num_episodes), HDPEnv(n_blocks=2, waypoints_per_pose=1))


def flags_of(num_episodes: int, root: Path) -> tuple[str, ...]:
    return (*TASK_FLAGS, "--dataset.repo_id=t/t", f"--dataset.root={root}", f"--dataset.num_episodes={num_episodes}")


INTERRUPTED = 40
"""Episodes of a recording that is long enough to be interrupted: eight shards of five."""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("datasets") / "uninterrupted"
    record(config_of(INTERRUPTED, root))
    return root


@pytest.mark.parametrize(
    ("signal_number", "num_workers"),
    [(signal.SIGKILL, 1), (signal.SIGKILL, 2), (signal.SIGINT, 2)],
)
def test_an_interrupted_recording_goes_on_where_it_stopped(uninterrupted, tmp_path, signal_number, num_workers):
    config, flags = config_of(INTERRUPTED, tmp_path / "stopped"), flags_of(INTERRUPTED, tmp_path / "stopped")
    command = [Path(sys.executable).with_name("hdp-record"), *flags, f"--num_workers={num_workers}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    first_shard_done = tmp_path / "stopped.partial" / "episodes_000000.done"
    while not first_shard_done.exists():
        assert process.poll() is None
        time.sleep(0.01)
    workers = psutil.Process(process.pid).children(recursive=True)
    if signal_number == signal.SIGINT:
        os.killpg(process.pid, signal_number)  # as a terminal does
    else:
        process.send_signal(signal_number)
    process.wait(timeout=20)
    _, still_running = psutil.wait_procs(workers, timeout=20)
    assert not still_running
    assert not (tmp_path / "stopped").exists()
    shards = [done.with_suffix("") for done in first_shard_done.parent.glob("*.done")]
    if signal_number != signal.SIGKILL:
        assert {path for path in first_shard_done.parent.iterdir() if path.is_dir()} == set(shards), "a shard is lost"
    assert load_info(first_shard_done.with_suffix("")).total_episodes == 5
    assert sum(load_info(shard).total_episodes for shard in shards) < INTERRUPTED

    with pytest.raises(FileExistsError, match="--resume=true"):
        record(config)
    record(replace(config, resume=True))
    assert_same_dataset(tmp_path / "stopped", uninterrupted)
    assert json.loads((config.root / RECORDING_PATH).read_text())["num_episodes"] == INTERRUPTED
    assert not config.partial_root.exists()


def test_a_worker_that_is_killed_ends_the_recording_with_one_line(tmp_path):
    """As when memory runs out."""
    flags = flags_of(200, tmp_path / "stopped")
    command = [Path(sys.executable).with_name("hdp-record"), *flags, "--num_workers=2"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while not list((tmp_path / "stopped.partial").glob("*.done")):
        assert process.poll() is None
        time.sleep(0.01)
    workers = [worker for child in psutil.Process(process.pid).children() for worker in child.children()]
    workers[0].kill()  # the children are servers of Python's, the workers theirs
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "Traceback" not in stderr
    assert "hdp-record: a worker ended" in stderr.splitlines()[-1]


def test_no_recorded_start_is_one_that_is_evaluated():
    recorded = {
        episode_seed(seed, episode, attempt) for seed in (0, 1, 2) for episode in range(4_000) for attempt in (0, 1)
    }
    firsts = (0, cells.FIRST_EVALUATION_SEED, few_step_planning.FIRST_SEED, checkpoints.FIRST_SEED)
    most = max(preset.evaluations * preset.starts for preset in PRESETS.values())
    assert not recorded & {first + number for first in firsts for number in range(most)}


def test_the_command_goes_on_with_an_interrupted_recording_only_when_told_to(tmp_path, monkeypatch):
    config, flags = config_of(2, tmp_path / "stopped"), flags_of(2, tmp_path / "stopped")
    first_shard, _ = plan_shards(config)
    record_shard(config, first_shard)
    with pytest.raises(ValueError, match=r"stopped\.partial has 1 of 2 episodes: go on with --resume=true"):
        merge_shards(config, [first_shard])
    monkeypatch.setattr(recorder, "exit_when_terminated", lambda: None)
    with pytest.raises(SystemExit, match="--resume=true") as end:
        call_command(recorder.main, *flags)
    assert "\n" not in end.value.code
    call_command(recorder.main, *flags, "--resume=true")
    assert load_info(config.root).total_episodes == 2
    assert not config.partial_root.exists()


def test_a_dataset_is_recorded_by_one_process_at_a_time(tmp_path, monkeypatch):
    config, flags = config_of(2, tmp_path / "sorting"), flags_of(2, tmp_path / "sorting")
    monkeypatch.setattr(recorder, "exit_when_terminated", lambda: None)
    with (
        one_process(config.lock_file, "records it"),
        pytest.raises(SystemExit, match=r"another process records .*: wait"),
    ):
        call_command(recorder.main, *flags, "--resume=true")
    assert not config.partial_root.exists()
    call_command(recorder.main, *flags)
    assert [path.name for path in tmp_path.iterdir()] == ["sorting"]


def test_a_recording_that_another_process_has_ended_meanwhile_is_not_repeated(tmp_path, monkeypatch):
    config = replace(config_of(2, tmp_path / "sorting"), resume=True)
    elsewhere, recorded = recorder.one_process, []

    def another_was_faster(*arguments):
        if not recorded:
            recorded.append(True)
            record(config)
        return elsewhere(*arguments)

    monkeypatch.setattr(recorder, "one_process", another_was_faster)
    assert record(config).num_episodes == 2
    assert [path.name for path in tmp_path.iterdir()] == ["sorting"]


def test_a_shard_is_recorded_by_one_process_at_a_time(tmp_path):
    """Another job of a cluster has it, which no lock on the whole recording keeps away."""
    config = config_of(2, tmp_path / "sorting")
    [shard, *_] = plan_shards(config)
    with (
        one_process(shard.lock_file, "records it"),
        pytest.raises(BlockingIOError, match=r"another process records episodes 0 to \d+ of .*sorting: wait"),
    ):
        recorder.record_shard(config, shard)
    assert not shard.root.exists()


def test_an_interrupted_recording_goes_on_with_the_same_settings_only(tmp_path):
    config = config_of(2, tmp_path / "stopped")
    plan_shards(config)
    for other in (
        replace(config, seed=1),
        replace(config, env=HDPEnv(n_blocks=3, waypoints_per_pose=1)),
        replace(config, dataset=replace(config.dataset, num_episodes=3)),
    ):
        with pytest.raises(ValueError, match="has other settings than this command"):
            record(replace(other, resume=True))
    settings = config.partial_root / "settings.json"
    written = settings.stat().st_mtime_ns
    plan_shards(replace(config, resume=True))
    assert settings.stat().st_mtime_ns == written
    settings.write_text("")
    with pytest.raises(ValueError, match=r"settings\.json is damaged .*: delete it if"):
        plan_shards(replace(config, resume=True))


@pytest.fixture
def not_ignored():
    """What tells a process to stop does so, also under `nohup`; as before afterwards."""
    handlers = {number: signal.signal(number, signal.SIG_DFL) for number in TERMINATION}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("not_ignored")
@pytest.mark.parametrize(
    ("signal_number", "exception"),
    [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit), (signal.SIGHUP, SystemExit)],
)
def test_a_signal_while_an_episode_is_written_waits_for_it(tmp_path, monkeypatch, capsys, signal_number, exception):
    monkeypatch.setattr(recorder, "FEWEST_SHARDS", 1)
    config, save_episode = config_of(5, tmp_path / "stopped"), LeRobotDataset.save_episode

    def save_while_the_signal_comes(dataset):
        if dataset.meta.total_episodes == 2:
            signal.raise_signal(signal_number)
        save_episode(dataset)

    recorder.exit_when_terminated()
    with monkeypatch.context() as patch:
        patch.setattr(LeRobotDataset, "save_episode", save_while_the_signal_comes)
        with pytest.raises(exception):
            record(config)
    assert load_info(tmp_path / "stopped.partial/episodes_000000").total_episodes == 3
    assert record(replace(config, resume=True)).num_episodes == 5
    *_, bar = (part for part in capsys.readouterr().err.split("\r") if part.startswith("Recording"))
    assert " 5/5 " in bar


@pytest.mark.usefixtures("not_ignored")
def test_under_nohup_a_recording_outlives_its_terminal():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    recorder.exit_when_terminated()
    signal.raise_signal(signal.SIGHUP)


@pytest.fixture
def to_upload(tmp_path, monkeypatch) -> RecordConfig:
    """A recording of two episodes that is to be uploaded; there is a login."""
    monkeypatch.setattr(recorder, "get_token", lambda: "token")
    dataset = RecordDatasetConfig("test/uploaded", tmp_path / "uploaded", num_episodes=2, push_to_hub=True)
    return RecordConfig(dataset, HDPEnv(n_blocks=2, waypoints_per_pose=1))


def test_an_upload_without_a_login_is_refused_before_anything_is_recorded(to_upload, monkeypatch):
    monkeypatch.setattr(recorder, "get_token", lambda: None)
    with pytest.raises(ParsingError, match="hf auth login"):
        replace(to_upload)


def test_a_failed_upload_is_tried_again_on_what_was_recorded(to_upload, monkeypatch):
    to_upload = replace(to_upload, dataset=replace(to_upload.dataset, private=True, tags=["mine"]))
    uploads = []

    def upload(dataset, tags, private, **_):
        uploads.append((dataset.num_episodes, tags[-1], private))
        if len(uploads) == 1:
            raise RuntimeError("no network\n\ntry later")

    monkeypatch.setattr(LeRobotDataset, "push_to_hub", upload)
    with pytest.raises(OSError, match=r"with --resume=true repeats it \(no network try later\)"):
        record(to_upload)
    with pytest.raises(FileExistsError, match="finish it with --resume=true"):
        record(to_upload)
    monkeypatch.setattr(recorder, "demonstrate", None)
    assert record(replace(to_upload, resume=True)).num_episodes == 2
    assert uploads == [(2, "mine", True)] * 2
    assert "mine" in DatasetCard.load(to_upload.root / "README.md").data.tags


def test_a_recording_that_was_killed_after_its_last_step_but_one_is_finished(to_upload):
    config = replace(to_upload, dataset=replace(to_upload.dataset, push_to_hub=False))
    record(config)
    with pytest.raises(FileExistsError, match="delete it"):
        record(config)
    config.partial_root.mkdir()  # the last step removes it
    with pytest.raises(FileExistsError, match="finish it with --resume=true"):
        record(config)
    assert record(replace(config, resume=True)).num_episodes == 2
    assert not config.partial_root.exists()


def test_another_recording_is_not_taken_for_this_one(to_upload):
    dataset = replace(to_upload.dataset, push_to_hub=False)
    config = replace(to_upload, dataset=dataset, resume=True)
    record(config)
    for other in (
        replace(config, seed=1),
        replace(config, env=HDPEnv(n_blocks=3)),
        replace(config, dataset=replace(dataset, num_episodes=3)),
        replace(config, dataset=replace(dataset, language=True)),
    ):
        with pytest.raises(FileExistsError, match="holds something else"):
            record(other)


def test_failed_demonstrations_are_dropped_and_counted_also_across_an_interruption(tmp_path, monkeypatch, capsys):
    """An expert that now and then forgets to open the gripper at the end."""
    expert, calls = EXPERTS["hdp/BlockSorting2D-v0"], itertools.count()
    monkeypatch.setattr(recorder, "FEWEST_SHARDS", 1)

    def careless(env, rng):
        if next(calls) == 8:
            raise KeyboardInterrupt
        demonstration = expert(env, rng)
        if rng.random() < 0.4:
            demonstration.waypoints[-1, 2] = 0.0
        return demonstration

    monkeypatch.setitem(EXPERTS, "hdp/BlockSorting2D-v0", careless)
    config = RecordConfig(
        dataset=RecordDatasetConfig(repo_id="test/careless", root=tmp_path / "careless", num_episodes=10),
        env=HDPEnv(n_blocks=2, waypoints_per_pose=1),
    )
    with pytest.raises(KeyboardInterrupt):
        record(config)
    done_before = load_info(config.partial_root / "episodes_000000").total_episodes
    dataset = record(replace(config, resume=True))
    failed = json.loads((dataset.root / RECORDING_PATH).read_text())["failed_attempts"]
    assert dataset.num_episodes == 10
    assert columns(tmp_path / "careless")["next.success"].reshape(10, HORIZON)[:, -1].all()
    assert min(map(int, failed)) < done_before <= max(map(int, failed))
    assert replay(load_recording(dataset)) == [1.0] * 10
    assert f"dropped {sum(failed.values())} of {10 + sum(failed.values())}" in capsys.readouterr().out


def with_step(demonstration: Demonstration, **changes) -> Demonstration:
    *steps, last = demonstration.steps
    return replace(demonstration, steps=(*steps, last._replace(**changes)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda it: replace(it, waypoints=np.zeros_like(it.waypoints)), "failed 100 times in a row"),
        (
            lambda it: replace(it, waypoints=it.waypoints[:-1]),
            f"{HORIZON - 1} waypoints, hdp/BlockSorting2D-v0 {HORIZON}",
        ),
        (lambda it: with_step(it, stop=99), "the stops of the expert's plan must strictly increase within 1..19"),
        (
            lambda it: with_step(it, stop=18),
            r"end at \(\(6, 7\), \(12, 13\), \(18, 18\)\), those of hdp/BlockSorting2D-v0 at",
        ),
        (
            lambda it: with_step(it, symbols=("PICK", "A", "S1", "PLACE", "A", "S1")),
            "plan is none of .*: move 3 picks A",
        ),
        (lambda it: with_step(it, symbols=("PICK", "C")), "the vocabulary PAD A B PICK PLACE S1 S2 AUX has no C"),
        (lambda it: with_step(it, symbols=("PICK",) * 9), "a plan of 21 symbols does not fit a symbolic horizon of 18"),
    ],
)
def test_an_expert_that_does_not_do_the_task_is_an_error(tmp_path, monkeypatch, change, message):
    expert = EXPERTS["hdp/BlockSorting2D-v0"]
    monkeypatch.setitem(EXPERTS, "hdp/BlockSorting2D-v0", lambda env, rng: change(expert(env, rng)))
    with pytest.raises(ValueError, match=message):
        record(config_of(2, tmp_path / "useless"))


def test_the_steps_of_a_task_that_states_no_time_end_when_the_expert_says():
    env = gym.make("hdp/BlockSorting2D-v0", disable_env_checker=True, n_blocks=2, waypoints_per_pose=1).unwrapped
    env.planning_task = replace(env.planning_task, step_ends=None)
    expert = EXPERTS["hdp/BlockSorting2D-v0"]
    later = demonstrate(env, lambda env, rng: with_step(expert(env, rng), stop=18), 0, HDPEnv().features_map)
    left = (later.columns["observation.symbolic_plan"] != 0).sum(axis=1)
    assert later.succeeded
    assert left.tolist() == [18] * 7 + [12] * 6 + [6] * 5 + [0]


def test_a_task_without_an_expert_is_not_recorded(tmp_path, monkeypatch):
    monkeypatch.delitem(EXPERTS, "hdp/BlockSorting2D-v0")
    with pytest.raises(ValueError, match="hdp/BlockSorting2D-v0 has no expert in dataset_tools/experts"):
        record(config_of(2, tmp_path / "useless"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--env.task=Juggling-v0", "is not a task of --env.type=hdp"),
        ("--env.n_blocks=1", "n_blocks must be in [2, 8]"),
        ("--dataset.num_episodes=0", "must be at least 1"),
        ("--seed=-1", "--seed must be at least 0, got -1"),
        ("--dataset.root=/dev/null/dataset", "Not a directory"),
        ("--dataset.root=.", "exists already: delete it, or choose another"),
    ],
)
def test_bad_flags_are_one_line_and_leave_nothing_behind(tmp_path, monkeypatch, flag, message):
    monkeypatch.chdir(tmp_path)
    flags = ("--dataset.repo_id=t/t", f"--dataset.root={tmp_path / 'nothing'}", flag)
    monkeypatch.setattr(sys, "argv", ["hdp-record", *flags])
    monkeypatch.setattr(recorder, "exit_when_terminated", lambda: None)
    with pytest.raises(SystemExit) as end:
        recorder.main()
    assert end.value.code.startswith("hdp-record: ")
    assert message in end.value.code
    assert "\n" not in end.value.code
    assert list(tmp_path.iterdir()) == []


def test_an_existing_dataset_is_not_overwritten(dataset_root, monkeypatch):
    before = (dataset_root / "meta/info.json").read_bytes()
    flags = (*TASK_FLAGS, "--dataset.repo_id=test/sorting", f"--dataset.root={dataset_root}")
    monkeypatch.setattr(recorder, "exit_when_terminated", lambda: None)
    with pytest.raises(SystemExit, match="exists already"):
        call_command(recorder.main, *flags)
    assert (dataset_root / "meta/info.json").read_bytes() == before
