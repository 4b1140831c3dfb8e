"""The expert for `hdp/BlockSorting2D-v0`."""

import gymnasium as gym
import numpy as np

from dataset_tools.demonstration import Demonstration, PlanStep, hold_last_waypoint
from gym_hdp_tasks.block_sorting_2d import BlockSorting2DEnv, block_name, slot_name

from .cycle_sort import cycle_sort

OPEN, CLOSED = 1.0, 0.0
LANE_Y = -0.12
"""The gripper travels in front of the slots, at this y, in metres."""


def sort_blocks_2d(env: gym.Env, rng: np.random.Generator) -> Demonstration:
    """Cycle sort; each move is 6 key poses, reached in `waypoints_per_pose` straight steps each.

    The first waypoint is where the gripper already is. Blocks are placed in the middle of a slot.
    """
    sim: BlockSorting2DEnv = env.unwrapped  # type: ignore[assignment]
    n_blocks, task = sim.n_blocks, sim.planning_task
    waypoints_per_pose = task.parameters["waypoints_per_pose"]

    blocks = sim.blocks.copy()
    distances = np.linalg.norm(blocks[:, None] - sim.slots[None, :n_blocks], axis=-1)
    order = np.argsort(distances.argmin(axis=1)).tolist()

    pose = np.array([*sim.gripper, sim.opening])
    waypoints, steps = [pose], []
    for block, origin, destination in cycle_sort(order, rng):
        target = sim.slots[destination]
        for key_pose in _move_key_poses(blocks[block], target):
            fractions = np.arange(1, waypoints_per_pose + 1)[:, None] / waypoints_per_pose
            waypoints += list(pose + fractions * (key_pose - pose))
            pose = key_pose
        blocks[block] = target
        name = block_name(block)
        symbols = ("PICK", name, slot_name(origin, n_blocks), "PLACE", name, slot_name(destination, n_blocks))
        steps.append(PlanStep(symbols, stop=len(waypoints)))
    return Demonstration(hold_last_waypoint(waypoints, task.horizon), tuple(steps))


def _move_key_poses(origin: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Approach, reach, grasp, carry, set down, release: (6, 3) rows of x, y in metres and opening."""
    return np.array(
        [
            (origin[0], LANE_Y, OPEN),
            (*origin, OPEN),
            (*origin, CLOSED),
            (target[0], LANE_Y, CLOSED),
            (*target, CLOSED),
            (*target, OPEN),
        ]
    )
