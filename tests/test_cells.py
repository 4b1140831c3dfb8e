"""The cells of the benchmarks: what was done is never done again, and a figure never depends on an interruption."""

import json
import os
import re
import subprocess
import sys
import time
from dataclasses import asdict, replace
from importlib.metadata import distributions
from statistics import mean

import numpy as np
import pytest

from benchmarks import cells
from benchmarks.cells import Cell, num_parameters, run_cell, run_cells, start_training
from benchmarks.evaluation import load, make_plans
from benchmarks.machine import describe_run
from benchmarks.paper import packing, report
from benchmarks.paper.packing import export, join_files, pack, unpack
from benchmarks.paper.presets import HIERARCHICAL, METHODS, PRESETS, TASKS, make_cell, make_cells
from benchmarks.planner_latency import make_planner

from .conftest import N_EPISODES


@pytest.fixture
def cell(dataset_root, tmp_path, monkeypatch) -> Cell:
    """A tiny cell on the dataset of the test suite, with empty folders for checkpoints and results."""
    monkeypatch.chdir(tmp_path)  # where datasets and checkpoints go
    for module in (cells, packing):
        monkeypatch.setattr(module, "RESULTS", tmp_path / "results")
    cells.DATASETS.mkdir(parents=True)
    (cells.DATASETS / f"block_sorting_2d_2_blocks_{N_EPISODES}").symlink_to(dataset_root)
    tiny = {"num_layers": 1, "num_heads": 2, "width": 32, "num_inference_steps": 3, "device": "cpu"}
    mini = make_cell("mini", "block_sorting_2d_2_blocks", "hdp", seed=0)
    return replace(
        mini,
        demonstrations=N_EPISODES,
        policy={**mini.policy, **tiny},
        steps=300,
        batch_size=10,
        evaluations=3,
        starts=2,
        average_last=2,
    )


def curve(cell: Cell) -> list[dict]:
    return json.loads(cell.result_file.read_text())["result"]["curve"]


def test_a_killed_cell_goes_on_as_if_it_had_not_been(cell):
    run_cell(cell, {}, evaluate_meanwhile=True, deadline=None)
    assert [point["step"] for point in curve(cell)] == [100, 200, 300]
    assert all(0 <= point["success_rate"] <= point["mean_score"] <= 1 for point in curve(cell))
    assert cell.state() == "finished"
    assert [path.name for path in cell.checkpoints.iterdir() if not path.is_symlink()] == ["000300"]

    killed = replace(cell, name="killed")
    training = start_training(killed, None)
    while not killed.last_checkpoint.exists():
        assert training.is_alive()
        time.sleep(0.02)
    training.kill()
    training.join()
    assert re.fullmatch("stopped after step [12]00 of 300", killed.state())
    run_cell(killed, {}, evaluate_meanwhile=False, deadline=None)
    assert curve(killed) == curve(cell)


def test_cells_run_from_a_packed_folder_and_come_back(cell, tmp_path):
    folder = tmp_path / "packed"
    pack([cell], folder)
    assert {found.metadata["Name"] for found in distributions(path=[str(folder)])} == {"lerobot_policy_hdp"}
    run_cell_there = (
        "import json, sys; import benchmarks.cells as cells; from benchmarks.paper.packing import decompress\n"
        "decompress(); print(cells.__file__); cells.run_cell(cells.Cell(**json.loads(sys.argv[1])), {}, False, None)"
    )
    output = subprocess.run(
        [sys.executable, "-c", run_cell_there, json.dumps(asdict(cell))],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert str(folder / "benchmarks") in output
    assert cell.state() == "missing"
    unpack(folder)
    assert cell.state() == "finished"
    assert cell.last_checkpoint.exists()


def test_an_exported_planner_makes_the_same_plans(cell, tmp_path):
    run_cell(cell, {}, evaluate_meanwhile=False, deadline=None)
    export(cell.last_checkpoint, tmp_path / "small")
    export(cell.last_checkpoint, tmp_path / "in_parts", max_file_size="20KB")
    assert not (tmp_path / "in_parts/model.safetensors").exists()
    join_files(tmp_path / "in_parts")
    whole = make_plans(load(cell.last_checkpoint, starts=5)).motions
    for name in ("small", "in_parts"):
        weights = tmp_path / name / "model.safetensors"
        assert weights.stat().st_size < (cell.last_checkpoint / "model.safetensors").stat().st_size / 3
        np.testing.assert_allclose(make_plans(load(tmp_path / name, starts=5)).motions, whole, atol=0.02)


def test_the_report_has_what_was_run_and_says_what_is_missing(cell, tmp_path, monkeypatch):
    run_cell(cell, describe_run(), evaluate_meanwhile=False, deadline=None)
    run_cell(
        replace(cell, name=cell.name.replace("hdp", "diffuser"), policy={**cell.policy, "type": "diffuser"}),
        describe_run(),
        False,
        None,
    )
    monkeypatch.setattr(report, "DOCS", tmp_path)
    monkeypatch.setattr(report, "PAGE", tmp_path / "results.md")
    monkeypatch.setattr(report, "CURVES", tmp_path / "images" / "training_curves.svg")
    assert all(path.exists() for path in report.write_report())
    page = report.PAGE.read_text()
    counted = [100 * point["mean_score"] for point in curve(cell)[-2:]]
    row = next(line for line in page.splitlines() if line.startswith("| HDP |") and "86 %" not in line)
    assert row.startswith(f"| HDP | {mean(counted):.0f} % (")
    assert row.endswith("| missing | missing |")
    assert "| HDP | 86 % (5 %) | missing |" in page
    assert "| `--preset mini` | 2 |" in page


def test_a_finished_cell_is_not_run_again_and_a_budget_is_kept(cell, capsys):
    run_cells([cell], budget_minutes=0.0)
    assert f"{cell.name}: missing, no time left" in capsys.readouterr().out
    cell.result_file.parent.mkdir(parents=True)
    cell.result_file.write_text("{}")
    run_cells([cell])
    assert cell.result_file.read_text() == "{}"


def test_a_training_that_fails_names_its_log(cell):
    broken = replace(cell, policy={**cell.policy, "width": 33})
    with pytest.raises(SystemExit, match=r"train\.log"):
        run_cells([broken])


def test_the_first_seed_of_hdp_and_diffuser_comes_first():
    order = [
        (cell.facts["preset"], cell.seed, cell.policy["type"]) for cell in make_cells(PRESETS, TASKS, METHODS, [0, 1])
    ]
    seeds = [seed for _, seed, _ in order]
    assert seeds == sorted(seeds)
    default = [planner for preset, seed, planner in order if preset == "default" and seed == 0]
    assert default[:6] == ["hdp"] * 3 + ["diffuser"] * 3
    assert (
        len(set(order)) < len(order) == len({cell.result_file for cell in make_cells(PRESETS, TASKS, METHODS, [0, 1])})
    )


@pytest.mark.parametrize("task", ["block_sorting_2d_2_blocks", "block_sorting_2d_4_blocks", "xarm_tool_use"])
def test_planners_that_are_compared_have_the_same_size(task):
    sizes = []
    for method in set(METHODS) - set(HIERARCHICAL):
        cell = make_cell("mini", task, method, seed=0)
        options = {key: value for key, value in cell.policy.items() if key != "type"}
        sizes.append(num_parameters(make_planner(method, cell.env_config, **options, device="cpu")))
    assert max(sizes) <= 1.02 * min(sizes)
