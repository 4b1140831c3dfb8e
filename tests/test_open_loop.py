"""Scoring many plans at once gives what stepping gives."""

import json
import sys

import gymnasium as gym
import numpy as np
import pytest

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.experts import EXPERTS
from gym_hdp_tasks.open_loop import execute_plans, main

GYM_ID = "hdp/XArmArrangeBlocks-v0"
SEEDS = [11, 12, 13, 14]


@pytest.fixture(scope="module")
def plans():
    """The expert's plan for a seed, every second one shaken until it fails."""
    env, rng = gym.make(GYM_ID, disable_env_checker=True), np.random.default_rng(0)
    plans = []
    for seed in SEEDS:
        env.reset(seed=seed)
        plans.append(EXPERTS[GYM_ID](env, rng).waypoints)
    plans = np.stack(plans)
    plans[1::2] += rng.normal(0, 0.05, plans[1::2].shape)
    return plans


def stepped_outcomes(plans):
    env = gym.make(GYM_ID, disable_env_checker=True)
    outcomes = []
    for seed, plan in zip(SEEDS, plans, strict=True):
        env.reset(seed=seed)
        outcomes.append([env.step(action)[-1] for action in plan][-1])
    return outcomes


@pytest.mark.parametrize("num_threads", [1, 3])
def test_outcomes_are_those_of_stepping_the_environment(plans, num_threads):
    outcomes = execute_plans(GYM_ID, SEEDS, plans, num_threads)
    assert outcomes == stepped_outcomes(plans)
    assert outcomes[0]["is_success"]
    assert not all(outcome["is_success"] for outcome in outcomes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda plans: plans[:, :-1], "shape"),
        (lambda plans: plans[:-1], "shape"),
        (lambda plans: plans[..., :3], "shape"),
        (lambda plans: np.where(plans > 0.3, np.nan, plans), "NaN"),
    ],
)
def test_plans_that_do_not_fit_the_task_are_refused(plans, change, message):
    with pytest.raises(ValueError, match=message):
        execute_plans(GYM_ID, SEEDS, change(plans))


def test_a_task_without_physics_is_refused():
    with pytest.raises(ValueError, match="no X-Arm task"):
        execute_plans("hdp/BlockSorting2D-v0", [0], np.zeros((1, 109, 3)))


def test_the_command_prints_scores_as_json(plans, tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "plans.npz", seeds=SEEDS, plans=plans)
    monkeypatch.setattr(sys, "argv", ["open_loop", "XArmArrangeBlocks-v0", f"{tmp_path}/plans.npz", "--num_threads=1"])
    main()
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert scores == [outcome["score"] for outcome in stepped_outcomes(plans)]


def test_a_broken_file_is_an_error_of_one_line(tmp_path, monkeypatch):
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 not a zip file")
    monkeypatch.setattr(sys, "argv", ["open_loop", "XArmArrangeBlocks-v0", str(tmp_path / "broken.npz")])
    with pytest.raises(SystemExit, match=r"^open_loop: [^\n]+$"):
        main()


@pytest.mark.parametrize("seeds", [np.zeros((2, 1), int), np.array([11.9, 3.0]), np.zeros(0, int)])
def test_seeds_that_are_none_are_refused(plans, tmp_path, monkeypatch, seeds):
    np.savez(tmp_path / "plans.npz", seeds=seeds, plans=plans[: len(seeds)])
    monkeypatch.setattr(sys, "argv", ["open_loop", "XArmArrangeBlocks-v0", str(tmp_path / "plans.npz")])
    with pytest.raises(SystemExit, match=r"^open_loop: `seeds` must be \(B,\) integers, at least one, got"):
        main()


def test_a_file_of_one_array_is_refused(tmp_path, monkeypatch):
    np.save(tmp_path / "plans.npy", np.zeros((1, 25, 4)))
    monkeypatch.setattr(sys, "argv", ["open_loop", "XArmArrangeBlocks-v0", str(tmp_path / "plans.npy")])
    with pytest.raises(SystemExit, match=r"^open_loop: .*plans.npy is one array, not an .npz file[^\n]*$"):
        main()
