"""`hdp/XArmSorting-v0`: sort three blocks into their slots with one auxiliary slot (paper, "X-Arm Sorting")."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from .plan_rules import Observation, check_sorting_plan, slots_of_blocks
from .scene import BLOCK_HALF_SIZE, BLUE, GREEN, GREY, RED, add_block, add_slot
from .task import PAD, PlanningTask, draw_order, equal_steps
from .xarm_env import POSE_NAMES, STATE_NAMES, XArmEnv, pose_names

# All lengths in metres.
BLOCKS = ("A", "B", "C")
SLOTS = ("S1", "S2", "S3", "AUX")
"""S1 is the place of A, S2 that of B, S3 that of C."""
COLOURS = (RED, GREEN, BLUE)
SLOT_CENTRES = np.array([(0.42, y) for y in (0.195, 0.065, -0.065, -0.195)])
"""In a row from left to right as the robot sees it."""
SLOT_HALF_SIZE = 0.05
START_OFFSET = 0.02
"""A block starts at most this far from its slot's centre, along x and along y."""

MOST_MOVES = 6
TOKENS_PER_MOVE = 6
KEY_POSES_PER_MOVE = 8
WAYPOINTS_PER_POSE = 3
FPS = 3


def xarm_sorting_task(robot: str = "primitive") -> PlanningTask:
    """The task's facts.

    Two exchanges of three moves sort any order; a move has 6 tokens and 8 key poses of 3 waypoints.
    """
    return PlanningTask(
        gym_id="hdp/XArmSorting-v0",
        parameters={"robot": robot},
        instruction="Sort the 3 blocks into their own slots, using the auxiliary slot.",
        vocabulary=(PAD, *BLOCKS, "PICK", "PLACE", *SLOTS),
        horizon=MOST_MOVES * KEY_POSES_PER_MOVE * WAYPOINTS_PER_POSE + 1,
        symbolic_horizon=MOST_MOVES * TOKENS_PER_MOVE,
        state_names=STATE_NAMES,
        environment_state_names=pose_names(BLOCKS),
        action_names=STATE_NAMES,
        fps=FPS,
        robot_type="xarm7",
        step_ends=equal_steps(MOST_MOVES, TOKENS_PER_MOVE, KEY_POSES_PER_MOVE * WAYPOINTS_PER_POSE),
        check_plan=check_plan,
    )


def check_plan(symbols: Sequence[str], observation: Observation) -> list[str]:
    """What is wrong with a plan, see `check_sorting_plan`."""
    positions = observation["environment_state"].reshape(len(BLOCKS), len(POSE_NAMES))[:, :2]
    start = slots_of_blocks(positions, SLOT_CENTRES, SLOTS)
    return check_sorting_plan(symbols, dict(zip(BLOCKS, start, strict=True)), SLOTS)


class XArmSortingEnv(XArmEnv):
    """Three blocks in random order in three slots; each belongs in its own, and a fourth slot is free.

    The score is the fraction of blocks that lie, let go, in their own slot. See `XArmEnv` for actions, observations
    and arguments.
    """

    facts = staticmethod(xarm_sorting_task)
    object_names = BLOCKS

    def add_objects(self, spec: mujoco.MjSpec) -> None:
        for centre, colour in zip(SLOT_CENTRES, (*COLOURS, GREY), strict=True):
            add_slot(spec, centre, SLOT_HALF_SIZE, colour)
        for name, colour in zip(BLOCKS, COLOURS, strict=True):
            add_block(spec, name, colour)

    def draw_start(self, options: dict[str, Any]) -> np.ndarray:
        """A random unsorted order, each block off its slot's centre by up to START_OFFSET.

        Args:
            options: `{"order": [...]}` fixes the order: `order[slot]` is the block that starts in that slot.

        Raises:
            ValueError: the order is no permutation of the blocks.
        """
        order = draw_order(self.np_random, len(BLOCKS), options)
        offsets = self.np_random.uniform(-START_OFFSET, START_OFFSET, size=(len(BLOCKS), 2))
        start = np.full((len(BLOCKS), 3), BLOCK_HALF_SIZE)
        start[order, :2] = SLOT_CENTRES[: len(BLOCKS)] + offsets
        return start

    def score(self) -> float:
        """Fraction of blocks that lie on the table in their own slot, let go by the gripper."""
        distances = np.abs(self.object_poses()[:, :2] - SLOT_CENTRES[: len(BLOCKS)]).max(axis=1)
        on_table = np.array([self.lies_on_table(name) for name in BLOCKS])
        return float((on_table & (distances <= SLOT_HALF_SIZE)).mean())
