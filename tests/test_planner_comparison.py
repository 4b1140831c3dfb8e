"""The benchmark that compares the planners: what was done is never done again, and a figure never depends on it."""

import json
from dataclasses import replace

import pytest
import torch

from benchmarks import planner_comparison
from benchmarks.planner_comparison import Cell, Protocol, Training, check_sizes, run_cell, state_of

from .conftest import N_EPISODES

PROTOCOL = Protocol(
    num_episodes=N_EPISODES,
    steps=4,
    evaluate_every=2,
    starts=2,
    batch_size=10,
    network={"num_layers": 1, "num_heads": 2, "width": 32, "num_inference_steps": 3, "dropout": 0.2},
)


@pytest.fixture
def folders(dataset_root, tmp_path, monkeypatch):
    """The dataset of the test suite, and empty folders for checkpoints and results."""
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets/block_sorting_2d_2_blocks").symlink_to(dataset_root)
    for name in ("RESULTS", "WORK", "DATASETS"):
        monkeypatch.setattr(planner_comparison, name, tmp_path / name.lower())


def test_an_interrupted_cell_goes_on_as_if_it_had_not_been(folders):
    cell = Cell(2, "sample", "hdp", seed=0)
    whole = Training(cell, PROTOCOL)
    whole.train(2)
    whole.evaluate()
    whole.save()
    assert state_of(cell) == "stopped after step 2"
    resumed = Training(cell, PROTOCOL)
    for training in (whole, resumed):
        training.train(2)
    assert resumed.step == 4
    assert resumed.curve == whole.curve
    weights, same = whole.policy.state_dict(), resumed.policy.state_dict()
    assert all(torch.equal(weights[key], same[key]) for key in weights)


def test_a_finished_cell_holds_its_learning_curve(folders):
    cell = Cell(2, "epsilon", "diffuser", seed=1)
    assert state_of(cell) == "not begun"
    run_cell(cell, PROTOCOL, {})
    curve = json.loads(cell.result_file.read_text())["result"]["curve"]
    assert [point["step"] for point in curve] == [2, 4]
    assert all(0 <= point["success_rate"] <= point["mean_score"] <= 1 for point in curve)
    assert not cell.checkpoint.exists()
    assert state_of(cell) == "finished"


def test_planners_of_different_size_are_refused(folders):
    with pytest.raises(ValueError, match="differ by more than 2 %"):
        check_sizes([Cell(2, "sample", "hdp", seed=0)], replace(PROTOCOL, network={"num_layers": 1, "width": 32}))
