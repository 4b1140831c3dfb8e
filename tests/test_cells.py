"""The cells of the benchmarks: what was done is never done again, and a figure never depends on an interruption."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, replace
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from safetensors.torch import load_file

from benchmarks import cells
from benchmarks.cells import Cell, Deadline, complete_checkpoints, num_parameters, run_cell, run_cells, start_training
from benchmarks.evaluation import load, make_plans
from benchmarks.pages import DOCS
from benchmarks.paper import packing, report
from benchmarks.paper.packing import CELLS, export, join_files, pack, unpack
from benchmarks.paper.presets import HIERARCHICAL, METHODS, PRESETS, TASKS, make_cell, make_cells
from benchmarks.planner_latency import make_planner
from lerobot_hdp.precision import bfloat16_is_fast

from .conftest import N_EPISODES, REPOSITORY


def make_tiny_cell(folder: Path, dataset_root: Path, monkeypatch: pytest.MonkeyPatch) -> Cell:
    """A tiny cell on the dataset of the test suite, with checkpoints and results in a folder."""
    monkeypatch.chdir(folder)  # where datasets and checkpoints go
    for module in (cells, packing):
        monkeypatch.setattr(module, "RESULTS", folder / "results")
    tiny = {"num_layers": 1, "num_heads": 2, "width": 32, "num_inference_steps": 3, "device": "cpu"}
    mini = make_cell("mini", "block_sorting_2d_2_blocks", "hdp", seed=0)
    tiny_cell = replace(
        mini,
        demonstrations=N_EPISODES,
        policy={**mini.policy, **tiny},
        steps=300,
        batch_size=10,
        evaluations=3,
        starts=2,
        average_last=2,
    )
    cells.DATASETS.mkdir(parents=True)
    tiny_cell.dataset_root.symlink_to(dataset_root)
    return tiny_cell


@pytest.fixture
def cell(dataset_root, tmp_path, monkeypatch) -> Cell:
    return make_tiny_cell(tmp_path, dataset_root, monkeypatch)


@pytest.fixture(scope="module")
def where_it_was_run(dataset_root, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as monkeypatch:
        run_cell(make_tiny_cell(folder, dataset_root, monkeypatch))
    return folder


@pytest.fixture
def finished(cell, where_it_was_run, tmp_path) -> Cell:
    """The same, run."""
    for folder in ("results", cells.WORK):
        shutil.copytree(where_it_was_run / folder, tmp_path / folder, symlinks=True)
    return cell


def content(cell: Cell) -> dict[str, Any]:
    return json.loads(cell.result_file.read_text())


def curve(cell: Cell) -> list[dict[str, Any]]:
    return content(cell)["result"]["curve"]


def test_a_cell_holds_its_learning_curve_and_keeps_its_last_checkpoint(finished):
    assert [point["step"] for point in curve(finished)] == [100, 200, 300]
    assert all(0 <= point["success_rate"] <= point["mean_score"] <= 1 for point in curve(finished))
    assert finished.state() == "finished"
    assert [path.name for path in complete_checkpoints(finished.folder)] == ["000300"]
    here = "bfloat16" if bfloat16_is_fast("cpu") else "float32"
    assert (content(finished)["result"]["policy"]["dtype"], content(finished)["result"]["computed_in"]) == (
        "bfloat16",
        here,
    )
    assert content(finished)["run"]["threads"] == 1


def test_a_cell_says_what_it_was_computed_in_where_it_is_finished_elsewhere(finished):
    config = finished.last_checkpoint / "config.json"
    saved = json.loads(config.read_text())
    for dtype in ("bfloat16", "float32"):
        config.write_text(json.dumps({**saved, "dtype": dtype}))
        finished.result_file.unlink()
        run_cell(finished)
        assert content(finished)["result"]["computed_in"] == dtype


def test_a_killed_training_goes_on_as_if_it_had_not_been(finished):
    killed = replace(finished, name="killed")
    killed.folder.mkdir(parents=True)
    training = start_training(killed, 1, Deadline(None))
    while not killed.last_checkpoint:
        assert training.is_alive()
        time.sleep(0.02)
    training.kill()
    training.join()
    (killed.folder / "train/checkpoints/last").unlink(missing_ok=True)  # as if killed while LeRobot moves it
    assert killed.state().startswith("trained ")
    run_cell(killed, train_flags=["--log_freq=7"])  # which changes nothing that is learned
    assert json.loads((killed.last_checkpoint / "train_config.json").read_text())["log_freq"] == 7
    assert curve(killed) == curve(finished)
    weights = [load_file(each.last_checkpoint / "model.safetensors") for each in (killed, finished)]
    assert all(torch.equal(tensor, weights[1][name]) for name, tensor in weights[0].items())


def test_failures_after_the_training_cost_no_training(finished, monkeypatch):
    """At the second of three evaluations, and when the result is written."""
    failing = replace(finished, name="failing")
    for name, failing_call in (("_evaluate", 2), ("result_of", 1)):
        function, calls = getattr(cells, name), []

        def fail_once(*arguments: Any, function=function, calls=calls, failing_call=failing_call) -> Any:
            calls.append(arguments)
            if len(calls) == failing_call:
                raise OSError("no space left on device")
            return function(*arguments)

        monkeypatch.setattr(cells, name, fail_once)
    for _ in range(2):
        with pytest.raises(OSError, match="no space"):
            run_cell(failing)
        assert failing.state() == "trained, not yet evaluated"
        monkeypatch.setattr(cells, "start_training", None)
    run_cell(failing)
    assert curve(failing) == curve(finished)
    assert len(content(failing)["earlier_runs"]) == 2


def test_killing_the_benchmark_ends_the_training(cell, tmp_path):
    long = replace(cell, name="long", steps=1_000_000)
    (tmp_path / CELLS).write_text(json.dumps([asdict(long)]))
    command = [sys.executable, "-m", "benchmarks.paper", "--packed"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as benchmark:
        log = long.folder / "train.log"
        while not (log.exists() and "Training" in log.read_text()):
            assert benchmark.poll() is None
            time.sleep(0.1)
        with pytest.raises(BlockingIOError, match="another process runs this cell"):
            run_cell(long)
        started = psutil.Process(benchmark.pid).children(recursive=True)
        assert started
        benchmark.kill()
    _, still_running = psutil.wait_procs(started, timeout=20)
    assert not still_running


def test_a_budget_ends_with_a_checkpoint_or_before_the_beginning(cell, capsys, monkeypatch):
    run_cells([cell], budget_minutes=0.0)
    assert f"{cell.name}: missing, no time left" in capsys.readouterr().out
    monkeypatch.setattr(cells, "SHORTEST_TRAINING_S", 0.0)
    long = replace(cell, steps=1_000_000)
    assert "out of time" in run_cell(long, 1, Deadline(0.1))
    assert 0 < long.last_step < long.steps


def test_a_finished_cell_is_not_run_again_and_must_be_what_it_says(finished, capsys):
    before = finished.result_file.read_text()
    run_cells([finished])
    assert finished.result_file.read_text() == before
    assert "1 of 1 are finished; to run one again, delete its file" in capsys.readouterr().out
    with pytest.raises(ValueError, match="was made with steps=300, not 400"):
        cells.read_result(replace(finished, steps=400))
    finished.result_file.unlink()
    for changes in ({"steps": 400}, {"starts": 3}, {"policy": {**finished.policy, "dropout": 0.1}}):
        with pytest.raises(ValueError, match="was begun with other settings"):
            run_cell(replace(finished, **changes))


def test_a_training_that_fails_names_its_log(cell, capsys):
    with pytest.raises(SystemExit, match=cell.name):
        run_cells([replace(cell, policy={**cell.policy, "width": 33})])
    assert str(cell.folder / "train.log") in capsys.readouterr().err


def test_cells_run_from_a_packed_folder_and_come_back(cell, tmp_path):
    cell = replace(cell, steps=20, evaluations=1, average_last=1)
    folder = tmp_path / "packed"
    pack([cell], folder)
    assert {found.metadata["Name"] for found in distributions(path=[str(folder)])} == {"lerobot_policy_hdp"}
    command = [sys.executable, "-m", "benchmarks.paper", "--packed"]
    subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, check=True)
    assert cell.state() == "missing"
    unpack(folder)
    assert cell.state() == "finished"
    assert json.loads(cell.result_file.read_text())["run"]["git_commit"] == (folder / "COMMIT").read_text().strip()
    assert cell.last_checkpoint is not None


def test_too_much_to_pack_is_said(cell, tmp_path, monkeypatch):
    monkeypatch.setattr(packing, "MAX_MIB", 0.01)
    with pytest.raises(ValueError, match=r"more than 0\.01: pack fewer tasks"):
        pack([cell], tmp_path / "packed")


def test_an_exported_planner_makes_the_same_plans(finished, tmp_path):
    checkpoint = finished.last_checkpoint
    export(checkpoint, tmp_path / "small")
    export(checkpoint, tmp_path / "in_parts", max_file_size="20KB")
    parts = sorted((tmp_path / "in_parts").glob("model*.safetensors"))
    assert len(parts) > 1
    join_files(tmp_path / "in_parts")
    whole = make_plans(load(checkpoint, starts=5)).motions
    for name in ("small", "in_parts"):
        weights = tmp_path / name / "model.safetensors"
        assert weights.stat().st_size < (checkpoint / "model.safetensors").stat().st_size / 3
        np.testing.assert_allclose(make_plans(load(tmp_path / name, starts=5)).motions, whole, atol=0.02)


def write_result(cell: Cell, scores: list[float], failures: int) -> None:
    """A results file with known figures: success is half the score."""
    outcome = {"valid_plans": 98, "failures": failures, "failures_with_valid_plan": min(failures, 1)}
    points = [{"step": i, "success_rate": score / 2, "mean_score": score, **outcome} for i, score in enumerate(scores)]
    facts = {"planner": cell.policy["type"], "train_s": 90.0, "samples_per_second": 7.0, "curve": points}
    result = {**cell.settings, **facts}
    run = {"gpu": None, "cpu": "Abacus", "cores": 2, "git_commit": "abc"}
    cell.result_file.parent.mkdir(parents=True, exist_ok=True)
    cell.result_file.write_text(json.dumps({"run": run, "result": result}))


def test_the_report_has_what_was_run_and_says_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(cells, "RESULTS", tmp_path)
    write_result(make_cell("mini", "xarm_sorting", "hdp", 0), [0.0] * 7 + [0.8, 0.9, 1.0], failures=3)
    write_result(make_cell("mini", "xarm_sorting", "hdp", 1), [0.0] * 7 + [0.9, 0.9, 0.9], failures=0)
    write_result(make_cell("mini", "xarm_sorting", "hdp", 2), [0.0] * 7 + [1.0, 1.0, 1.0], failures=0)
    write_result(make_cell("mini", "xarm_sorting", "diffuser", 0), [0.0] * 9 + [0.6], failures=0)
    for seed, score in enumerate((0.4, 0.5)):
        write_result(make_cell("mini", "xarm_sorting", "joint_diffuser", seed), [score] * 10, failures=0)
    page, *plots = report.write_report(tmp_path / "page.md")
    assert all(path.exists() for path in plots)
    text = page.read_text()
    # Means of the seeds 90, 90, 100: 93.3 +- 4.303 * 5.77 / sqrt(3); standard deviation of all evaluations 7.1.
    assert "| HDP | 86 % (5 %) | 93 % (7 %), 3 seeds: 79 to 100; success 47 % | 74 % (10 %) | missing |" in text
    assert "| Diffuser | 46 % (6 %) | 20 % (35 %), one seed; success 10 % |" in text
    assert "| Joint Diffuser | 42 % (5 %) | 45 % (5 %), seeds: 40, 50; success 22 % |" in text
    assert "| xarm_sorting, mini | 900 | 9 | 6 | 3 |" in text
    assert "| xarm_sorting, mini | 1.5 min, 7/s | 1.5 min, 7/s | 1.5 min, 7/s | missing |" in text
    assert "6 of 108 with `--preset mini`" in text


def test_the_committed_page_is_what_the_committed_results_make(tmp_path):
    page, *plots = report.write_report(tmp_path / "results.md")
    assert page.read_text() == (DOCS / "results.md").read_text()
    assert all((DOCS / "images" / plot.name).exists() for plot in plots)


def test_what_is_worth_most_comes_first():
    order = make_cells(list(PRESETS), list(TASKS), list(METHODS), [0, 1])
    names = [f"{cell.facts['preset']} {cell.facts['task_name']} {cell.policy['type']}" for cell in order]
    xarm = ("xarm_sorting", "xarm_arrange_blocks", "xarm_tool_use")
    assert names[:3] == [f"default {task} hdp" for task in xarm]
    assert names[3:6] == [f"default {task} diffuser" for task in xarm]
    assert names[6] == "paper xarm_sorting hdp"
    assert [cell.seed for cell in order] == sorted(cell.seed for cell in order)
    assert len({cell.result_file for cell in order}) == len(order)


def test_an_epoch_of_the_papers_sees_each_demonstration_once():
    cell = make_cell("paper", "xarm_sorting", "hdp", 0)
    assert cell.steps == 5_000 * 4  # 200 demonstrations: batches of 64, 64, 64 and 8
    assert cell.samples == 5_000 * 200


def test_planners_that_take_no_images_have_no_cells_of_them():
    cells = make_cells(["small", "paper"], ["xarm_sorting_images"], list(METHODS), [0])
    assert sorted({cell.policy["type"] for cell in cells}) == sorted(set(METHODS) - set(HIERARCHICAL))
    assert {cell.dataset_root.name for cell in cells} == {"XArmSorting_obs_type_pixels_camera_name_front_200_episodes"}


def test_cells_that_would_download_weights_are_not_packed(tmp_path):
    with pytest.raises(ValueError, match="xarm_sorting_images_hdp_seed0"):
        pack([make_cell("paper", "xarm_sorting_images", "hdp", 0)], tmp_path / "packed")
    assert not (tmp_path / "packed").exists()


@pytest.mark.parametrize(
    ("preset", "task"),
    [("mini", "block_sorting_2d_2_blocks"), ("mini", "block_sorting_2d_4_blocks"), ("default", "xarm_tool_use")],
)
def test_planners_that_are_compared_have_the_same_size(preset, task):
    sizes = []
    for method in set(METHODS) - set(HIERARCHICAL):
        cell = make_cell(preset, task, method, seed=0)
        options = {key: value for key, value in cell.policy.items() if key != "type"}
        sizes.append(num_parameters(make_planner(method, cell.env_config, **options, device="cpu")))
    assert max(sizes) <= 1.02 * min(sizes)
