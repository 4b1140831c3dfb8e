"""The benchmarks can be started, say how, and have written the pages that are committed."""

import importlib
import json
import pkgutil
import shutil

import pytest

import benchmarks
from benchmarks import conditioning, task_pages, training_step
from benchmarks.__main__ import PAGES

from .conftest import REPOSITORY

SHIPPED = REPOSITORY / "checkpoints"
MODULES = sorted({module.name for module in pkgutil.iter_modules(benchmarks.__path__)} - {"__main__"})


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_can_be_imported_and_states_its_command(name):
    module = importlib.import_module(f"benchmarks.{name}")
    if hasattr(module, "main"):
        assert f"python -m benchmarks.{name}" in module.__doc__
    if hasattr(module, "write_page"):
        assert module.write_page.__module__.removeprefix("benchmarks.") in PAGES


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_what_the_committed_results_make(name, tmp_path, monkeypatch):
    module = importlib.import_module(f"benchmarks.{name}")
    committed, written = module.PAGE, tmp_path / module.PAGE.name
    shutil.copy(committed, written)  # of some, only a part is written
    monkeypatch.setattr(module, "PAGE", written)
    monkeypatch.setattr(module, "plot_curves", lambda *_: None, raising=False)
    module.write_page()
    assert written.read_text() == committed.read_text()


def test_the_tasks_pages_are_what_the_committed_results_make(tmp_path, monkeypatch):
    committed = task_pages.FOLDER
    shutil.copytree(committed, tmp_path / "tasks")
    monkeypatch.setattr(task_pages, "FOLDER", tmp_path / "tasks")
    task_pages.main()
    for name in (*task_pages.PAGES, "xarm.md"):
        assert (tmp_path / "tasks" / name).read_text() == (committed / name).read_text()


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("planner_latency", ["--rounds=2", "--batch_sizes", "1", "--num_layers=1", "--width=32"]),
        ("growth", ["--rounds=2", "--horizons", "37", "--blocks", "2", "--batch_size=2"]),
        ("few_step_planning", [f"{SHIPPED}/xarm_arrange_blocks", "--starts=2", "--calls", "2", "--ways", "ddpm"]),
        ("plan_variety", [f"{SHIPPED}/xarm_tool_use", "--starts=2"]),
        ("doing_nothing", ["--starts=2", "--tasks", "xarm_arrange_blocks"]),
    ],
)
def test_a_benchmark_runs(name, arguments, tmp_path, monkeypatch, capsys):
    module = importlib.import_module(f"benchmarks.{name}")
    for place in ("FILE", "FILES", "FOLDER", "PAGE"):
        if hasattr(module, place):
            monkeypatch.setattr(module, place, tmp_path / getattr(module, place).name)
    monkeypatch.setattr("sys.argv", [name, *arguments])
    module.main()
    [result] = tmp_path.rglob("*.json")
    assert "git_commit" in result.read_text()
    assert all(page.stat().st_size > 500 for page in tmp_path.glob("*.md"))


def test_a_training_that_is_timed_is_known_after_each_round(
    dataset_root, accelerate_begins_anew, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(training_step, "FILE", tmp_path / "steps.json")
    size = ["--horizon=19", "--symbolic_horizon=18", "--num_layers=1", "--width=16", "--batch_size=4"]
    chosen = ["--device=cpu", "--settings", "float32", "Muon", "--steps=1", "--rounds=2"]
    monkeypatch.setattr("sys.argv", ["training_step", f"--root={dataset_root}", *size, *chosen])
    training_step.main()
    said = capsys.readouterr().out
    assert said.index("1 of 2 rounds: float32") < said.index("2 of 2 rounds: float32")
    result = json.loads(training_step.FILE.read_text())["result"]
    assert result["rounds"] == 2
    assert all(0 < low <= middle <= high for low, middle, high in result["ms"].values())


def test_adherence_counts_the_plans_that_do_what_they_are_asked_for(tmp_path, monkeypatch):
    arguments = ["--checkpoints", f"{SHIPPED}/xarm_tool_use", "--starts=2", f"--results={tmp_path}"]
    monkeypatch.setattr("sys.argv", ["conditioning", "adherence", *arguments])
    conditioning.main()
    [result] = json.loads((tmp_path / "adherence_XArmToolUseRedOnTop.json").read_text())["results"]
    assert result["with_prompt"]["adherence"]["rate"] == 1
    assert result["without_prompt"]["adherence"]["rate"] < 1
