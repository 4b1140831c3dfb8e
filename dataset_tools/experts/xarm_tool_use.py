"""The experts for `hdp/XArmToolUse-v0` and `hdp/XArmToolUseRedOnTop-v0`."""

import gymnasium as gym
import numpy as np

from dataset_tools.demonstration import Demonstration, PlanStep, hold_last_waypoint
from gym_hdp_tasks.scene import BLOCK_HALF_SIZE
from gym_hdp_tasks.xarm_tool_use import BAR_HALF_SIZE, BLOCKS, HOOK_LENGTH, TARGET, XArmToolUseEnv

from .pick_and_place import CLOSED, pick_and_place

# All lengths in metres.
HOOK_CARRY_HEIGHT = 0.10
STACK_CARRY_HEIGHT = 0.17
"""A carried block passes well above a stack of two."""
HOOK_CLEARANCE = 0.004
"""The hook floats this far above the table while it drags."""
SIDE_DISTANCE = 0.042
"""The shaft passes this far to the right of the block's centre."""
BEHIND_DISTANCE = 0.014
"""The hook is lowered this far behind the block."""
DRAGGED_X = 0.47
"""Where a dragged block ends."""
PULL_WAYPOINTS = 5


def drag_and_stack(env: gym.Env, rng: np.random.Generator) -> Demonstration:
    """Grasp the hook, drag the blocks in, lay the hook down, stack; both orders uniform and independent.

    The first waypoint is where the tool already is. The hook is grasped in the first move of the plan and laid down
    in the last one that drags.
    """
    return _demonstrate(env, rng.permutation(len(BLOCKS)), rng.permutation(len(BLOCKS)))


def drag_and_stack_red_last(env: gym.Env, rng: np.random.Generator) -> Demonstration:
    """As `drag_and_stack`, with red on top; the orders that this leaves are uniform."""
    drag_order, stack_order = rng.permutation(len(BLOCKS)), rng.permutation(len(BLOCKS))
    red = BLOCKS.index("RED")
    return _demonstrate(env, drag_order, np.append(stack_order[stack_order != red], red))


def _demonstrate(env: gym.Env, drag_order: np.ndarray, stack_order: np.ndarray) -> Demonstration:
    sim: XArmToolUseEnv = env.unwrapped  # type: ignore[assignment]
    *blocks, hook = sim.object_poses()[:, :3]
    grasp, lay_down = np.split(pick_and_place(hook, hook, HOOK_CARRY_HEIGHT), 2)

    waypoints = [np.array([*sim.tool_position(), sim.gripper_opening()]), *grasp]
    steps = []
    for block in drag_order:
        waypoints += list(_drag(blocks[block], grip_height=hook[2] + HOOK_CLEARANCE))
        steps.append(PlanStep(("DRAG", BLOCKS[block]), stop=len(waypoints)))
    waypoints += list(lay_down)
    steps[-1] = steps[-1]._replace(stop=len(waypoints))

    for level, block in enumerate(stack_order):
        origin = np.array([DRAGGED_X, blocks[block][1], BLOCK_HALF_SIZE])
        target = np.array([*TARGET, (2 * level + 1) * BLOCK_HALF_SIZE])
        waypoints += list(pick_and_place(origin, target, STACK_CARRY_HEIGHT))
        steps.append(PlanStep(("STACK", BLOCKS[block]), stop=len(waypoints)))
    return Demonstration(hold_last_waypoint(waypoints, sim.planning_task.horizon), tuple(steps))


def _drag(block: np.ndarray, grip_height: float) -> np.ndarray:
    """Above and behind the block, down, pull, free the hook, up: (PULL_WAYPOINTS + 4, 4) waypoints.

    Args:
        block: (3,) its centre, in metres.
        grip_height: z of the tool while it drags, in metres.
    """
    # From the tool to the block's centre, along x, when the bar touches the block's far side.
    reach = HOOK_LENGTH - BAR_HALF_SIZE[0] - BLOCK_HALF_SIZE
    y = block[1] - SIDE_DISTANCE
    behind, pulled = block[0] - reach + BEHIND_DISTANCE, DRAGGED_X - reach
    pull = behind + (pulled - behind) * np.arange(1, PULL_WAYPOINTS + 1) / PULL_WAYPOINTS
    freed = pulled + BEHIND_DISTANCE
    x = np.array([behind, behind, *pull, freed, freed])
    z = np.array([HOOK_CARRY_HEIGHT, *[grip_height] * (PULL_WAYPOINTS + 2), HOOK_CARRY_HEIGHT])
    return np.column_stack([x, np.full_like(x, y), z, np.full_like(x, CLOSED)])
