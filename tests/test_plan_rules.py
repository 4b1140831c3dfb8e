"""What the tasks know of their plans: which are valid, and when each step ends."""

import gymnasium as gym
import pytest

import gym_hdp_tasks  # noqa: F401 (registers the tasks)
from dataset_tools.demonstration import expert_generator
from dataset_tools.experts import EXPERTS

SORTING = ("hdp/BlockSorting2D-v0", {"n_blocks": 3, "waypoints_per_pose": 2})
TASKS = [SORTING, *((gym_id, {}) for gym_id in EXPERTS if "XArm" in gym_id)]
# B starts in the place of A, A in that of B.
SWAP = "PICK B S1 PLACE B AUX PICK A S2 PLACE A S1 PICK B AUX PLACE B S2"
TOOL_USE = "DRAG RED DRAG BLUE DRAG GREEN STACK BLUE STACK GREEN STACK RED"


def start(gym_id, seed=0, **kwargs):
    env = gym.make(gym_id, disable_env_checker=True, **kwargs.pop("parameters", {}))
    observation, _ = env.reset(seed=seed, **kwargs)
    return env, observation


def complaints(gym_id, plan, **kwargs):
    env, observation = start(gym_id, **kwargs)
    return env.unwrapped.planning_task.check_plan(plan.split(), observation)


@pytest.mark.parametrize(("gym_id", "parameters"), TASKS, ids=lambda value: value if isinstance(value, str) else "")
def test_the_experts_plans_are_valid_and_keep_the_tasks_time(gym_id, parameters):
    for seed in range(15):
        env, observation = start(gym_id, seed, parameters=parameters)
        task = env.unwrapped.planning_task
        demonstration = EXPERTS[gym_id](env, expert_generator(seed))
        assert task.check_plan(demonstration.remaining_symbols(0), observation) == []
        tokens, ends = 0, []
        for step in demonstration.steps:
            tokens += len(step.symbols)
            ends.append((tokens, step.stop))
        assert task.step_ends[: len(ends)] == tuple(ends)


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (SWAP, []),
        (SWAP.replace("PICK A S2", "PICK A S1"), ["move 2 picks A from S1, but A is in S2"]),
        (SWAP.replace("PLACE A S1", "PLACE C S1"), ["move 2 picks A, but places C"]),
        (SWAP.replace("PLACE A S1", "PLACE A S3"), ["move 2 places A in S3, where C is", "A ends in S3 instead of S1"]),
        (SWAP.removesuffix("PICK B AUX PLACE B S2"), ["B ends in AUX instead of S2"]),
        (SWAP.removesuffix(" S2"), ["move 3, word 6: the plan ends where S1 or S2 or S3 or AUX should"]),
        (SWAP.replace("PLACE A S1", "A PLACE S1"), ["move 2, word 4: 'A' stands where PLACE should"]),
    ],
)
@pytest.mark.parametrize("gym_id", ["hdp/BlockSorting2D-v0", "hdp/XArmSorting-v0"])
def test_what_is_wrong_with_a_plan_that_sorts(gym_id, plan, expected):
    found = complaints(gym_id, plan, options={"order": [1, 0, 2]})
    assert set(expected) <= set(found)
    assert bool(found) == bool(expected)


def test_what_is_wrong_with_a_plan_that_arranges():
    env, observation = start("hdp/XArmArrangeBlocks-v0")
    task = env.unwrapped.planning_task
    plan = EXPERTS["hdp/XArmArrangeBlocks-v0"](env, expert_generator(0)).remaining_symbols(0)
    twice = [*plan[:-1], plan[4]]
    found = task.check_plan(twice, observation)
    assert f"move 3 places {plan[13]} in {plan[4]}, where {plan[3]} leaves no room for the open gripper" in found
    assert found[-1].startswith("no block ends in S")
    assert task.check_plan(plan[:10], observation) != []
    another = [*plan[:3], plan[6], *plan[4:]]
    assert f"move 1 picks {plan[1]}, but places {plan[6]}" in task.check_plan(another, observation)


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (TOOL_USE, []),
        (TOOL_USE.replace("DRAG BLUE ", ""), ["move 3: STACK BLUE comes before DRAG BLUE"]),
        (TOOL_USE.replace("STACK GREEN ", ""), ["GREEN is never stacked"]),
        (
            "DRAG RED STACK RED DRAG BLUE DRAG GREEN STACK BLUE STACK GREEN",
            ["move 2: STACK RED comes while the hook is still needed"],
        ),
        (TOOL_USE + " STACK RED", ["move 7: STACK RED comes a second time"]),
        (TOOL_USE + " RED", ["move 7, word 1: 'RED' stands where DRAG or STACK should"]),
    ],
)
def test_what_is_wrong_with_a_plan_that_uses_the_tool(plan, expected):
    assert complaints("hdp/XArmToolUse-v0", plan) == expected


def test_red_on_top_wants_red_last():
    plan = "DRAG RED DRAG BLUE DRAG GREEN STACK RED STACK GREEN STACK BLUE"
    assert complaints("hdp/XArmToolUse-v0", plan) == []
    assert complaints("hdp/XArmToolUseRedOnTop-v0", plan) == ["BLUE is stacked last instead of RED"]
