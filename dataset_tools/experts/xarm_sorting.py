"""The expert for `hdp/XArmSorting-v0`."""

import gymnasium as gym
import numpy as np

from dataset_tools.demonstration import Demonstration, PlanStep, hold_last_waypoint
from gym_hdp_tasks.scene import BLOCK_HALF_SIZE
from gym_hdp_tasks.xarm_sorting import BLOCKS, SLOT_CENTRES, SLOTS, WAYPOINTS_PER_POSE, XArmSortingEnv

from .cycle_sort import cycle_sort
from .pick_and_place import pick_and_place

CARRY_HEIGHT = 0.12
"""In metres: a carried block passes well above the others."""


def sort_blocks(env: gym.Env, rng: np.random.Generator) -> Demonstration:
    """Cycle sort; each move is 8 key poses, reached in `WAYPOINTS_PER_POSE` straight steps each.

    The first waypoint is where the tool already is. Blocks are placed in the middle of a slot.
    """
    sim: XArmSortingEnv = env.unwrapped  # type: ignore[assignment]
    positions = sim.object_poses()[:, :3]
    distances = np.linalg.norm(positions[:, None, :2] - SLOT_CENTRES[None, : len(BLOCKS)], axis=-1)
    order = np.argsort(distances.argmin(axis=1)).tolist()

    pose = np.array([*sim.tool_position(), sim.gripper_opening()])
    waypoints, steps = [pose], []
    for block, origin, destination in cycle_sort(order, rng):
        target = np.array([*SLOT_CENTRES[destination], BLOCK_HALF_SIZE])
        for key_pose in pick_and_place(positions[block], target, CARRY_HEIGHT):
            fractions = np.arange(1, WAYPOINTS_PER_POSE + 1)[:, None] / WAYPOINTS_PER_POSE
            waypoints += list(pose + fractions * (key_pose - pose))
            pose = key_pose
        positions[block] = target
        name = BLOCKS[block]
        symbols = ("PICK", name, SLOTS[origin], "PLACE", name, SLOTS[destination])
        steps.append(PlanStep(symbols, stop=len(waypoints)))
    return Demonstration(hold_last_waypoint(waypoints, sim.planning_task.horizon), tuple(steps))
