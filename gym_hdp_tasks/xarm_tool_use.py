"""`hdp/XArmToolUse-v0` and `hdp/XArmToolUseRedOnTop-v0`: drag three blocks within reach with a hook, then stack
them (paper, "Tool-use experiment" and "conditional plan coherence")."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from .plan_rules import Observation, read_moves
from .scene import BLOCK_HALF_SIZE, BLUE, GREEN, GREY, RED, add_block, add_slot
from .task import PAD, PlanningTask
from .xarm_env import REST_TOLERANCE, STATE_NAMES, XArmEnv, pose_names

# All lengths in metres.
BLOCKS = ("RED", "GREEN", "BLUE")
COLOURS = (RED, GREEN, BLUE)
HOOK = "hook"
TARGET = np.array([0.33, 0.0])
"""Centre of the area to stack on."""
TARGET_HALF_SIZE = 0.05
LANES = np.array([-0.16, 0.0, 0.16])
"""Blocks start at these y, one each, in random order, ..."""
LANE_OFFSET = 0.015
"""... give or take this, ..."""
BLOCK_START_X = (0.70, 0.76)
"""... and at an x in this interval: the nearest side of a block is 13 cm and more beyond the workspace of the tool."""
HOOK_START_LOW, HOOK_START_HIGH = np.array([0.29, -0.31]), np.array([0.33, -0.29])
"""The hook's handle starts in this rectangle, the shaft along x."""

HANDLE_HALF_SIZE = np.array([0.03, 0.012, 0.02])
HOOK_LENGTH = 0.26
"""From the middle of the handle to the middle of the bar at the end of the shaft."""
BAR_HALF_SIZE = np.array([0.006, 0.039, 0.012])
BAR_OFFSET = 0.033
"""Middle of the bar, to the left of the shaft (towards +y)."""
SHAFT_HALF_THICKNESS = 0.006
HANDLE_MASS, SHAFT_MASS, BAR_MASS = 0.03, 0.009, 0.006
"""In kilograms."""

TOKENS_PER_MOVE = 2
HORIZON = 61
SYMBOLIC_HORIZON = 15
"""Six moves take 12 tokens; the paper's table has 15."""
STEP_ENDS = ((2, 14), (4, 23), (6, 36), (8, 44), (10, 52), (12, 60))
"""Of a demonstration: the hook is grasped in the first move and laid down in the third, hence the longer ones."""
FPS = 1

OPEN = -1
"""In a plan prompt: the planner decides this token."""


def xarm_tool_use_task(robot: str = "primitive") -> PlanningTask:
    """The task's facts."""
    return PlanningTask(
        gym_id="hdp/XArmToolUse-v0",
        parameters={"robot": robot},
        instruction="Drag the 3 blocks within reach with the hook, then stack them on the target.",
        vocabulary=(PAD, *BLOCKS, "DRAG", "STACK"),
        horizon=HORIZON,
        symbolic_horizon=SYMBOLIC_HORIZON,
        state_names=STATE_NAMES,
        environment_state_names=pose_names((*BLOCKS, HOOK)),
        action_names=STATE_NAMES,
        fps=FPS,
        robot_type="xarm7",
        step_ends=STEP_ENDS,
        check_plan=check_plan,
    )


def xarm_tool_use_red_on_top_task(robot: str = "primitive") -> PlanningTask:
    """The facts of the variant with a plan prompt, in which red is stacked last."""
    return replace(
        xarm_tool_use_task(robot),
        gym_id="hdp/XArmToolUseRedOnTop-v0",
        instruction="Drag the 3 blocks within reach with the hook, then stack them on the target, red on top.",
        check_plan=partial(check_plan, top_block="RED"),
    )


def check_plan(symbols: Sequence[str], observation: Observation, top_block: str | None = None) -> list[str]:
    """What is wrong with a plan: each block is dragged once; when the hook is laid down, each is stacked once.

    Args:
        symbols: the plan.
        observation: is not looked at; every start allows the same plans.
        top_block: the block that has to be stacked last; None: any.
    """
    moves, complaints = read_moves(symbols, (["DRAG", "STACK"], BLOCKS))
    for number, (verb, block) in enumerate(moves, start=1):
        before = moves[: number - 1]
        if (verb, block) in before:
            complaints.append(f"move {number}: {verb} {block} comes a second time")
        if verb == "STACK" and ("DRAG", block) not in before:
            complaints.append(f"move {number}: STACK {block} comes before DRAG {block}")
        elif verb == "STACK" and any(later == "DRAG" for later, _ in moves[number:]):
            complaints.append(f"move {number}: STACK {block} comes while the hook is still needed")
    complaints += [f"{block} is never stacked" for block in BLOCKS if ("STACK", block) not in moves]
    stacked = [block for verb, block in moves if verb == "STACK"]
    if top_block and stacked and stacked[-1] != top_block:
        complaints.append(f"{stacked[-1]} is stacked last instead of {top_block}")
    return complaints


class XArmToolUseEnv(XArmEnv):
    """Three blocks out of reach, a hook within reach, and an area to stack the blocks on.

    The score is 1/3 for each block of the stack. `info["all_stacked"]` and `info["top_block"]` (None without a
    stack) say what the stack looks like. See `XArmEnv` for actions, observations and arguments.
    """

    facts = staticmethod(xarm_tool_use_task)
    object_names = (*BLOCKS, HOOK)
    camera_position = np.array([1.28, 0.0, 0.76])
    camera_target = np.array([0.45, 0.0, 0.03])

    def add_objects(self, spec: mujoco.MjSpec) -> None:
        add_slot(spec, TARGET, TARGET_HALF_SIZE, GREY)
        for name, colour in zip(BLOCKS, COLOURS, strict=True):
            add_block(spec, name, colour)
        add_hook(spec)

    def draw_start(self, options: dict[str, Any]) -> np.ndarray:
        """Each block in a lane of its own, in random order, and the hook to the right; takes no options."""
        lanes = self.np_random.permutation(LANES)
        x = self.np_random.uniform(*BLOCK_START_X, size=len(BLOCKS))
        y = lanes + self.np_random.uniform(-LANE_OFFSET, LANE_OFFSET, size=len(BLOCKS))
        blocks = np.column_stack([x, y, np.full(len(BLOCKS), BLOCK_HALF_SIZE)])
        handle = self.np_random.uniform(HOOK_START_LOW, HOOK_START_HIGH)
        return np.array([*blocks, (*handle, HANDLE_HALF_SIZE[2])])

    def stack(self) -> tuple[str, ...]:
        """The blocks of the highest stack on the target, let go by the gripper, from bottom to top."""
        positions = dict(zip(BLOCKS, self.object_poses()[:, :3], strict=False))
        bases = [
            name
            for name, position in positions.items()
            if self.lies_on_table(name) and np.abs(position[:2] - TARGET).max() <= TARGET_HALF_SIZE
        ]
        return max((self._tower(base, positions) for base in bases), key=len, default=())

    def score(self) -> float:
        """1/3 for each block of the stack."""
        return len(self.stack()) / len(BLOCKS)

    def _tower(self, base: str, positions: dict[str, np.ndarray]) -> tuple[str, ...]:
        """The blocks that stand on a base, it included: each centre over the block below, and one block higher."""
        tower = [base]
        for name in sorted(positions, key=lambda name: positions[name][2]):
            across, height = np.split(positions[name] - positions[tower[-1]], [2])
            supported = abs(height[0] - 2 * BLOCK_HALF_SIZE) <= REST_TOLERANCE
            if supported and np.abs(across).max() <= BLOCK_HALF_SIZE and not self.touched_by_robot(name):
                tower.append(name)
        return tuple(tower)

    def _info(self, clipped: bool) -> dict[str, Any]:
        stack = self.stack()
        return super()._info(clipped) | {
            "all_stacked": len(stack) == len(BLOCKS),
            "top_block": stack[-1] if stack else None,
        }


class XArmToolUseRedOnTopEnv(XArmToolUseEnv):
    """Tool use in which the observation asks for a plan's end, `STACK RED`.

    Observation: beside the others `symbolic_plan` (15,) int64, a plan prompt of token ids in which OPEN (-1) leaves
    a token to the planner. It speaks of the plan of the whole episode, and is the same at every step: for planners that
    plan once. The score is 1 when all blocks are stacked and red is on top, else 0.
    """

    facts = staticmethod(xarm_tool_use_red_on_top_task)

    def score(self) -> float:
        """1 when all blocks are stacked with red on top, else 0."""
        stack = self.stack()
        return float(len(stack) == len(BLOCKS) and stack[-1] == "RED")

    def plan_prompt(self) -> np.ndarray:
        """Token ids of the prompt: OPEN but for the last move, `STACK RED`, and PAD after it: (15,) int64."""
        token_id = self.planning_task.vocabulary.index
        prompt = np.full(SYMBOLIC_HORIZON, OPEN, dtype=np.int64)
        end = 2 * len(BLOCKS) * TOKENS_PER_MOVE
        prompt[end - TOKENS_PER_MOVE : end] = token_id("STACK"), token_id("RED")
        prompt[end:] = token_id(PAD)
        return prompt

    def _observation_spaces(self) -> dict[str, gym.Space]:
        last_id = len(self.planning_task.vocabulary) - 1
        prompt = gym.spaces.Box(OPEN, last_id, (SYMBOLIC_HORIZON,), np.int64)
        return super()._observation_spaces() | {"symbolic_plan": prompt}

    def _observation(self) -> dict[str, Any]:
        return super()._observation() | {"symbolic_plan": self.plan_prompt()}


def add_hook(spec: mujoco.MjSpec) -> None:
    """A handle to grasp, a shaft along +x, and a bar at its end towards +y; all flat on the table."""
    body = spec.worldbody.add_body(name=HOOK)
    body.add_freejoint(name=HOOK)
    bottom = -HANDLE_HALF_SIZE[2]
    shaft_half_length = (HOOK_LENGTH - HANDLE_HALF_SIZE[0]) / 2
    shaft_half_size = (shaft_half_length, SHAFT_HALF_THICKNESS, SHAFT_HALF_THICKNESS)
    shaft_pos = (HOOK_LENGTH - shaft_half_length, 0, bottom + SHAFT_HALF_THICKNESS)
    bar_pos = (HOOK_LENGTH, BAR_OFFSET, bottom + BAR_HALF_SIZE[2])
    for size, pos, mass, shade in (
        (HANDLE_HALF_SIZE, (0, 0, 0), HANDLE_MASS, 0.35),
        (shaft_half_size, shaft_pos, SHAFT_MASS, 0.45),
        (BAR_HALF_SIZE, bar_pos, BAR_MASS, 0.45),
    ):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=pos,
            mass=mass,
            rgba=(0.95, 0.65 * shade / 0.45, 0.15, 1),
            contype=1,
            conaffinity=3,
            friction=(0.4, 0.005, 0.0001),
        )
