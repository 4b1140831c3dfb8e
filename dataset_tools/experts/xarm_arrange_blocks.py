"""The expert for `hdp/XArmArrangeBlocks-v0`."""

from itertools import permutations, product

import gymnasium as gym
import numpy as np

from dataset_tools.demonstration import Demonstration, PlanStep, hold_last_waypoint
from gym_hdp_tasks.scene import BLOCK_HALF_SIZE
from gym_hdp_tasks.xarm_arrange_blocks import BLOCKS, SLOT_CENTRES, SLOTS, XArmArrangeBlocksEnv, clear

from .pick_and_place import pick_and_place

CARRY_HEIGHT = 0.12
"""In metres: a carried block passes well above the others."""

Moves = tuple[tuple[int, int], ...]
"""(block, slot it goes to), in the order of execution."""


def arrange_blocks(env: gym.Env, rng: np.random.Generator) -> Demonstration:
    """Random matching of blocks to slots in random order, uniform over those that can be done.

    The first waypoint is where the tool already is.
    """
    sim: XArmArrangeBlocksEnv = env.unwrapped  # type: ignore[assignment]
    positions = sim.object_poses()[:, :3]
    choices = possible_moves(positions[:, :2])

    waypoints = [np.array([*sim.tool_position(), sim.gripper_opening()])]
    steps = []
    for block, slot in choices[rng.integers(len(choices))]:
        target = np.array([*SLOT_CENTRES[slot], BLOCK_HALF_SIZE])
        waypoints += list(pick_and_place(positions[block], target, CARRY_HEIGHT))
        symbols = ("PICK", BLOCKS[block], "PLACE", BLOCKS[block], SLOTS[slot])
        steps.append(PlanStep(symbols, stop=len(waypoints)))
    return Demonstration(hold_last_waypoint(waypoints, sim.planning_task.horizon), tuple(steps))


def possible_moves(positions: np.ndarray) -> list[Moves]:
    """The orders and matchings, of all 36, that never put a block where another one leaves the open gripper no room.

    Since no block takes that room at two slots, there is always one.

    Args:
        positions: (3, 2) of the blocks, in metres.
    """

    def possible(moves: Moves) -> bool:
        now = positions.copy()
        for block, slot in moves:
            if not clear(SLOT_CENTRES[slot], np.delete(now, block, axis=0)):
                return False
            now[block] = SLOT_CENTRES[slot]
        return True

    indices = range(len(BLOCKS))
    orders = product(permutations(indices), permutations(indices))
    return [moves for blocks, slots in orders if possible(moves := tuple(zip(blocks, slots, strict=True)))]
