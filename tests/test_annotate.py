"""A dataset without symbolic plans gets some, and a planner trains on it."""

import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import merge_datasets, remove_feature

from dataset_tools.annotate import add_symbolic_plans
from dataset_tools.demonstration import PlanStep
from lerobot_hdp import HDPConfig
from lerobot_hdp.scripts import hdp_train

from .conftest import HORIZON, N_EPISODES, call_command

PICK, PLACE = PlanStep(("PICK", "CUP"), 8), PlanStep(("PLACE", "CUP", "TRAY"), 15)


@pytest.fixture(scope="module")
def without_plans(dataset_root, tmp_path_factory) -> LeRobotDataset:
    dataset = LeRobotDataset("test/sorting", root=dataset_root, video_backend="pyav")
    root = tmp_path_factory.mktemp("datasets") / "without"
    return remove_feature(dataset, "observation.symbolic_plan", output_dir=root, repo_id="test/without")


def test_a_planner_trains_on_plans_that_were_written_afterwards(without_plans, tmp_path):
    plans = [[PICK, PLACE], *[[PICK]] * (without_plans.meta.total_episodes - 1)]
    with_plans = add_symbolic_plans(without_plans, plans, "test/with", tmp_path / "with")

    first = [with_plans[frame]["observation.symbolic_plan"].tolist() for frame in (0, 7, 8, 15)]
    vocabulary = with_plans.meta.features["observation.symbolic_plan"]["info"]["vocabulary"]
    assert vocabulary == ["PAD", "CUP", "PICK", "PLACE", "TRAY"]
    assert first == [[2, 1, 3, 1, 4], [2, 1, 3, 1, 4], [3, 1, 4, 0, 0], [0] * 5]
    assert with_plans[HORIZON]["observation.symbolic_plan"].tolist() == [2, 1, 0, 0, 0]

    flags = ["--dataset.repo_id=test/with", f"--dataset.root={tmp_path / 'with'}", "--dataset.video_backend=pyav"]
    flags += ["--policy.type=hdp", f"--policy.horizon={HORIZON}", "--policy.num_layers=1", "--policy.width=32"]
    flags += ["--policy.push_to_hub=false", "--batch_size=2", "--steps=1", "--env_eval_freq=0"]
    call_command(hdp_train.main, *flags, f"--output_dir={tmp_path / 'run'}")
    trained = HDPConfig.from_pretrained(tmp_path / "run/checkpoints/last/pretrained_model")
    assert (trained.vocabulary, trained.symbolic_horizon) == (vocabulary, 5)


def test_a_vocabulary_can_be_given(without_plans, tmp_path):
    plans, vocabulary = [[PICK]] * without_plans.meta.total_episodes, ["PAD", "PICK", "PLACE", "CUP"]
    with_plans = add_symbolic_plans(without_plans, plans, "test/with", tmp_path / "with", vocabulary)
    assert with_plans[0]["observation.symbolic_plan"].tolist() == [1, 3]
    assert with_plans.meta.features["observation.symbolic_plan"]["info"]["vocabulary"] == vocabulary


def test_datasets_with_the_same_vocabulary_and_symbolic_horizon_can_be_merged(without_plans, tmp_path):
    known = {"vocabulary": ["PAD", "PICK", "PLACE", "CUP", "TRAY"], "symbolic_horizon": 6}
    parts = [
        add_symbolic_plans(without_plans, [plan] * N_EPISODES, f"test/{name}", tmp_path / name, **known)
        for name, plan in (("short", [PICK]), ("long", [PICK, PLACE]))
    ]
    merged = merge_datasets(parts, output_repo_id="test/merged", output_dir=tmp_path / "merged")
    first = [merged[episode * HORIZON]["observation.symbolic_plan"].tolist() for episode in (0, N_EPISODES)]
    assert first == [[1, 3, 0, 0, 0, 0], [1, 3, 2, 3, 4, 0]]
    with pytest.raises(ValueError, match="a plan of 5 symbols does not fit a symbolic horizon of 4"):
        add_symbolic_plans(
            without_plans, [[PICK, PLACE]] * N_EPISODES, "test/with", tmp_path / "with", symbolic_horizon=4
        )
    assert not (tmp_path / "with").exists()


@pytest.mark.parametrize(
    ("word", "vocabulary", "message"),
    [("RED CUP", None, "'RED CUP' cannot be a symbol"), ("MUG", ["PAD", "CUP", "PICK"], "has no MUG")],
)
def test_a_word_that_is_no_symbol_is_refused(without_plans, tmp_path, word, vocabulary, message):
    plans = [[PICK, PlanStep((word,), 15)]] * without_plans.meta.total_episodes
    with pytest.raises(ValueError, match=message):
        add_symbolic_plans(without_plans, plans, "test/with", tmp_path / "with", vocabulary)
    assert not (tmp_path / "with").exists()


def test_every_episode_needs_a_plan(without_plans, tmp_path):
    with pytest.raises(ValueError, match=r"there are 1 plans for \d+ episodes"):
        add_symbolic_plans(without_plans, [[PICK]], "test/with", tmp_path / "with")


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ([PLACE, PICK], r"stops of episode 1 must strictly increase within 1..19, got \[15, 8\]"),
        ([PICK, PICK], "stops of episode 1"),
        ([PICK._replace(stop=0)], "stops of episode 1"),
        ([PICK, PLACE._replace(stop=HORIZON + 1)], "stops of episode 1"),
        ([PICK, PlanStep(("PLACE", "PAD"), HORIZON)], "a step of episode 1 has the word PAD"),
        ([PlanStep("PICK", 8)], "a step of episode 1 is the text 'PICK' instead of a tuple of words"),
    ],
)
def test_a_plan_that_no_episode_can_have_is_refused(without_plans, tmp_path, plan, message):
    plans = [[PICK]] * without_plans.meta.total_episodes
    plans[1] = plan
    with pytest.raises(ValueError, match=message):
        add_symbolic_plans(without_plans, plans, "test/with", tmp_path / "with")
    assert not (tmp_path / "with").exists()


def test_plans_without_a_step_and_a_folder_that_is_taken_are_refused(without_plans, tmp_path):
    empty = [[]] * without_plans.meta.total_episodes
    with pytest.raises(ValueError, match="no plan has a step"):
        add_symbolic_plans(without_plans, empty, "test/with", tmp_path / "with", ["PAD", "PICK"])
    assert not (tmp_path / "with").exists()
    (tmp_path / "taken").mkdir()
    with pytest.raises(FileExistsError, match="exists already"):
        add_symbolic_plans(without_plans, [[PICK]] * len(empty), "test/with", tmp_path / "taken")
    assert (tmp_path / "taken").exists()
