"""`hdp/XArmArrangeBlocks-v0`: put a block into each of three slots, whichever block (paper, "Arrange Blocks")."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from .plan_rules import Observation, read_moves
from .scene import BLOCK_HALF_SIZE, BLUE, GREEN, GREY, RED, add_block, add_slot
from .task import PAD, PlanningTask, equal_steps
from .xarm_env import POSE_NAMES, STATE_NAMES, XArmEnv, pose_names

# All lengths in metres.
BLOCKS = ("A", "B", "C")
SLOTS = ("S1", "S2", "S3")
COLOURS = (RED, GREEN, BLUE)
SLOT_CENTRES = np.array([(0.42, 0.2), (0.42, 0.0), (0.42, -0.2)])
"""In a row from left to right as the robot sees it."""
SLOT_HALF_SIZE = 0.05
START_LOW, START_HIGH = np.array([0.28, -0.28]), np.array([0.52, 0.28])
"""Blocks start anywhere in this rectangle, in a slot or not."""
FINGER_CLEARANCE = np.array([0.045, 0.09])
"""Blocks start at least this far apart along x or along y: room for the open fingers of the gripper."""

MOVES = 3
TOKENS_PER_MOVE = 5
KEY_POSES_PER_MOVE = 8
FPS = 1


def xarm_arrange_blocks_task(robot: str = "primitive") -> PlanningTask:
    """The task's facts: 3 moves, each of 5 tokens and 8 key poses of one waypoint."""
    return PlanningTask(
        gym_id="hdp/XArmArrangeBlocks-v0",
        parameters={"robot": robot},
        instruction="Put one of the 3 blocks into each of the 3 slots.",
        vocabulary=(PAD, *BLOCKS, "PICK", "PLACE", *SLOTS),
        horizon=MOVES * KEY_POSES_PER_MOVE + 1,
        symbolic_horizon=MOVES * TOKENS_PER_MOVE,
        state_names=STATE_NAMES,
        environment_state_names=pose_names(BLOCKS),
        action_names=STATE_NAMES,
        fps=FPS,
        robot_type="xarm7",
        step_ends=equal_steps(MOVES, TOKENS_PER_MOVE, KEY_POSES_PER_MOVE),
        check_plan=check_plan,
    )


def check_plan(symbols: Sequence[str], observation: Observation) -> list[str]:
    """What is wrong with a plan: PICK block PLACE block slot, each slot gets a block, and at each slot there is room.

    Room for the open gripper beside the other blocks (`clear`); one outside the slot may take it, too.
    """
    where = observation["environment_state"].reshape(len(BLOCKS), len(POSE_NAMES))[:, :2].copy()
    moves, complaints = read_moves(symbols, (["PICK"], BLOCKS, ["PLACE"], BLOCKS, SLOTS))
    for number, (_, block, _, placed, slot) in enumerate(moves, start=1):
        if placed != block:
            complaints.append(f"move {number} picks {block}, but places {placed}")
        centre = SLOT_CENTRES[SLOTS.index(slot)]
        complaints += [
            f"move {number} places {placed} in {slot}, where {other} leaves no room for the open gripper"
            for other, position in zip(BLOCKS, where, strict=True)
            if other != placed and not clear(centre, position[None])
        ]
        where[BLOCKS.index(placed)] = centre
    filled = (np.abs(SLOT_CENTRES[:, None] - where[None]).max(axis=2) <= SLOT_HALF_SIZE).any(axis=1)
    return complaints + [f"no block ends in {slot}" for slot, full in zip(SLOTS, filled, strict=True) if not full]


class XArmArrangeBlocksEnv(XArmEnv):
    """Three blocks anywhere on the table, and three slots that want a block each.

    The score is the fraction of slots in which a block lies, let go. See `XArmEnv` for actions,
    observations and arguments.
    """

    facts = staticmethod(xarm_arrange_blocks_task)
    object_names = BLOCKS
    camera_position = np.array([1.10, 0.0, 0.62])
    camera_target = np.array([0.37, 0.0, 0.05])

    def add_objects(self, spec: mujoco.MjSpec) -> None:
        for centre in SLOT_CENTRES:
            add_slot(spec, centre, SLOT_HALF_SIZE, GREY)
        for name, colour in zip(BLOCKS, COLOURS, strict=True):
            add_block(spec, name, colour)

    def draw_start(self, options: dict[str, Any]) -> np.ndarray:
        """Uniform over the places at which the gripper can take each block; takes no options."""
        positions = self.np_random.uniform(START_LOW, START_HIGH, size=(len(BLOCKS), 2))
        while not all(clear(positions[i], np.delete(positions, i, axis=0)) for i in range(len(BLOCKS))):
            positions = self.np_random.uniform(START_LOW, START_HIGH, size=(len(BLOCKS), 2))
        return np.column_stack([positions, np.full(len(BLOCKS), BLOCK_HALF_SIZE)])

    def score(self) -> float:
        """Fraction of slots that hold a block which lies on the table, let go by the gripper."""
        on_table = np.array([self.lies_on_table(name) for name in BLOCKS])
        offsets = np.abs(SLOT_CENTRES[:, None] - self.object_poses()[None, :, :2]).max(axis=2)
        return float(((offsets <= SLOT_HALF_SIZE) & on_table).any(axis=1).mean())


def clear(place: np.ndarray, blocks: np.ndarray) -> bool:
    """Whether the gripper can open at a place (2,) without touching blocks (n, 2), all in metres."""
    return bool((np.abs(blocks - place) >= FINGER_CLEARANCE).any(axis=1).all())
