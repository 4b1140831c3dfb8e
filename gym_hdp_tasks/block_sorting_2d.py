"""`hdp/BlockSorting2D-v0`: sort blocks in the plane with one auxiliary slot.

The smallest task on which a long motion needs a plan. The plan's language knows slots only, so that a plan exchanges
two blocks by way of the auxiliary one. Kinematic and exact: a failure is the planner's and never the physics'.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import gymnasium as gym
import numpy as np

from .plan_rules import Observation, check_sorting_plan, slots_of_blocks
from .task import PAD, RENDER_MODES, PlanningTask, draw_order, equal_steps

# All lengths in metres.
SLOT_SPACING = 0.15
SLOT_HALF_SIZE = 0.06
BLOCK_HALF_SIZE = 0.02
START_OFFSET = 0.035
"""A block starts at most this far from its slot's centre, along x and along y."""
GRASP_RADIUS = 0.025
"""A closed gripper that holds nothing takes the nearest block whose centre is at most this far away."""
HOME = np.array([0.0, -0.12])
"""Where the gripper starts, give or take HOME_OFFSET along x and along y."""
HOME_OFFSET = 0.02
CLOSED_BELOW = 0.5
"""The gripper holds while its opening is below this."""

MIN_BLOCKS, MAX_BLOCKS = 2, 8
KEY_POSES_PER_MOVE = 6
FPS = 10

BLOCK_COLOURS = (
    (214, 69, 65), (65, 131, 215), (38, 166, 91), (244, 179, 80),
    (142, 68, 173), (27, 188, 155), (211, 84, 0), (108, 122, 137),
)  # fmt: skip


def block_name(block: int) -> str:
    """Symbol of a block: A, B, C, ..."""
    return chr(ord("A") + block)


def slot_name(slot: int, n_blocks: int) -> str:
    """Symbol of a slot: S1 is the place of A, S2 that of B, ...; the last slot is AUX."""
    return "AUX" if slot == n_blocks else f"S{slot + 1}"


def slot_centres(n_blocks: int) -> np.ndarray:
    """Centres of the slots in a row along x, the auxiliary one last: (n_blocks + 1, 2), in metres."""
    x = SLOT_SPACING * (np.arange(n_blocks + 1) - n_blocks / 2)
    return np.stack([x, np.zeros_like(x)], axis=1)


def block_sorting_2d_task(n_blocks: int = 3, waypoints_per_pose: int = 3) -> PlanningTask:
    """The task's facts for a number of blocks.

    The longest plan sorts by n_blocks - 1 exchanges of 3 moves each; a move has 6 tokens and 6 key poses.

    Raises:
        ValueError: `n_blocks` outside [2, 8] or `waypoints_per_pose` < 1.
    """
    if not MIN_BLOCKS <= n_blocks <= MAX_BLOCKS:
        raise ValueError(f"n_blocks must be in [{MIN_BLOCKS}, {MAX_BLOCKS}], got {n_blocks}")
    if waypoints_per_pose < 1:
        raise ValueError(f"waypoints_per_pose must be at least 1, got {waypoints_per_pose}")
    blocks = [block_name(block) for block in range(n_blocks)]
    slots = [slot_name(slot, n_blocks) for slot in range(n_blocks + 1)]
    most_moves = 3 * (n_blocks - 1)
    return PlanningTask(
        gym_id="hdp/BlockSorting2D-v0",
        parameters={"n_blocks": n_blocks, "waypoints_per_pose": waypoints_per_pose},
        instruction=f"Sort the {n_blocks} blocks into their own slots, using the auxiliary slot.",
        vocabulary=(PAD, *blocks, "PICK", "PLACE", *slots),
        horizon=most_moves * KEY_POSES_PER_MOVE * waypoints_per_pose + 1,
        symbolic_horizon=most_moves * 6,
        state_names=("x", "y", "gripper"),
        environment_state_names=tuple(f"{name}.{axis}" for name in blocks for axis in "xy"),
        action_names=("x", "y", "gripper"),
        fps=FPS,
        robot_type="gripper_2d",
        step_ends=equal_steps(most_moves, tokens=6, waypoints=KEY_POSES_PER_MOVE * waypoints_per_pose),
        check_plan=check_plan,
    )


def check_plan(symbols: Sequence[str], observation: Observation) -> list[str]:
    """What is wrong with a plan, see `check_sorting_plan`."""
    positions = observation["environment_state"].reshape(-1, 2)
    n_blocks = len(positions)
    slots = [slot_name(slot, n_blocks) for slot in range(n_blocks + 1)]
    start = slots_of_blocks(positions, slot_centres(n_blocks), slots)
    return check_sorting_plan(symbols, {block_name(i): slot for i, slot in enumerate(start)}, slots)


class BlockSorting2DEnv(gym.Env):
    """A gripper in the plane that sorts blocks.

    Observation: `agent_pos` (3,) gripper x, y in metres and opening in [0, 1]; `environment_state` (2 n_blocks,)
    x, y of each block in metres. Action (3,): where the gripper goes, and the opening that it has from there on.
    The gripper moves first, carrying what it holds, and opens or closes on arrival.

    An episode lasts `planning_task.horizon` steps. The reward is 0 until the last one, then the fraction of blocks
    in their own slot; `info["is_success"]` says whether that is all of them.

    Args:
        n_blocks: 2 to 8.
        waypoints_per_pose: density of the expert's motion (3 as in the paper); sets the episode's length.
        render_mode: None or `rgb_array`.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": FPS}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, n_blocks: int = 3, waypoints_per_pose: int = 3, render_mode: str | None = None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        self.planning_task = block_sorting_2d_task(n_blocks, waypoints_per_pose)
        self.render_mode = render_mode
        self.n_blocks = n_blocks
        self.slots = slot_centres(n_blocks)

        reach = np.array([self.slots[-1, 0] + 0.1, 0.2])
        self.workspace = np.stack([-reach, reach])
        self.action_low = np.array([*-reach, 0.0], np.float32)
        self.action_high = np.array([*reach, 1.0], np.float32)
        self.action_space = gym.spaces.Box(self.action_low, self.action_high, dtype=np.float32)
        self.observation_space = gym.spaces.Dict(
            agent_pos=gym.spaces.Box(self.action_low, self.action_high, dtype=np.float32),
            environment_state=gym.spaces.Box(
                np.tile(-reach, n_blocks).astype(np.float32), np.tile(reach, n_blocks).astype(np.float32)
            ),
        )

        # LeRobot reads these three from every environment.
        self.task = self.planning_task.gym_id
        self.task_description = self.planning_task.instruction
        self._max_episode_steps = self.planning_task.horizon

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Start with the blocks in a random unsorted order.

        Args:
            seed: seeds the environment's random generator.
            options: `{"order": [...]}` fixes the order: `order[slot]` is the block that starts in that slot.

        Raises:
            ValueError: the order is no permutation of the blocks.
        """
        super().reset(seed=seed)
        order = draw_order(self.np_random, self.n_blocks, options or {})
        offsets = self.np_random.uniform(-START_OFFSET, START_OFFSET, size=(self.n_blocks, 2))
        self.blocks = np.empty((self.n_blocks, 2))
        self.blocks[order] = self.slots[: self.n_blocks] + offsets
        self.gripper = HOME + self.np_random.uniform(-HOME_OFFSET, HOME_OFFSET, size=2)
        self.opening = 1.0
        self.held: int | None = None
        self.collided = np.zeros(self.n_blocks, dtype=bool)
        self.elapsed_steps = 0
        return self._observation(), self._info(clipped=False)

    def step(self, action: np.ndarray):
        """Move the gripper, then open or close it.

        Raises:
            ValueError: the action has the wrong shape, or holds NaN or infinity.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (3,) or not np.isfinite(action).all():
            raise ValueError(f"an action is 3 finite numbers (x, y, gripper), got {action.tolist()}")
        low, high = self.action_low, self.action_high
        clipped = bool(((action < low - 1e-6) | (action > high + 1e-6)).any())
        action = np.clip(action, low, high)

        self.gripper, self.opening = action[:2], float(action[2])
        if self.held is not None:
            self.blocks[self.held] = self.gripper
        if self.opening < CLOSED_BELOW:
            self._grasp()
        else:
            self._release()

        self.elapsed_steps += 1
        truncated = self.elapsed_steps >= self.planning_task.horizon
        reward = self.score() if truncated else 0.0
        return self._observation(), reward, False, truncated, self._info(clipped)

    def score(self) -> float:
        """Fraction of blocks that lie in their own slot, on free ground."""
        own_slot = np.abs(self.blocks - self.slots[: self.n_blocks]).max(axis=1) <= SLOT_HALF_SIZE
        placed = own_slot & ~self.collided
        if self.held is not None:
            placed[self.held] = False
        return float(placed.mean())

    def render(self) -> np.ndarray:
        """The scene from above: (height, width, 3) uint8."""
        return draw_scene(self)

    def world_to_pixels(self, points: np.ndarray) -> np.ndarray:
        """Pixel coordinates of points in the rendered image: (..., 2 or more) metres -> (..., 2) pixels."""
        x = (points[..., 0] - self.workspace[0, 0]) * PIXELS_PER_METRE
        y = (self.workspace[1, 1] - points[..., 1]) * PIXELS_PER_METRE
        return np.stack([x, y], axis=-1)

    def _grasp(self) -> None:
        if self.held is not None:
            return
        distances = np.linalg.norm(self.blocks - self.gripper, axis=1)
        nearest = int(distances.argmin())
        if distances[nearest] <= GRASP_RADIUS:
            self.held = nearest
            self.collided[nearest] = False

    def _release(self) -> None:
        if self.held is None:
            return
        others = np.delete(self.blocks, self.held, axis=0)
        overlap = np.abs(others - self.blocks[self.held]).max(axis=1) < 2 * BLOCK_HALF_SIZE
        self.collided[self.held] = bool(overlap.any())
        self.held = None

    def _observation(self) -> dict[str, np.ndarray]:
        return {
            "agent_pos": np.array([*self.gripper, self.opening], dtype=np.float32),
            "environment_state": self.blocks.flatten().astype(np.float32),
        }

    def _info(self, clipped: bool) -> dict[str, Any]:
        # LeRobot counts a success at any step, so there is none before the last.
        ended = self.elapsed_steps >= self.planning_task.horizon
        score = self.score()
        return {"is_success": ended and score == 1.0, "score": score, "action_clipped": clipped}


PIXELS_PER_METRE = 800
BACKGROUND, INK, GRIPPER_COLOUR = (250, 249, 246), (60, 60, 60), (40, 40, 40)


def draw_scene(env: BlockSorting2DEnv) -> np.ndarray:
    """Slots tinted like the block that belongs there, blocks with their letter, the gripper as two fingers."""
    width, height = (np.diff(env.workspace, axis=0)[0] * PIXELS_PER_METRE).round().astype(int) // 2 * 2
    image = np.full((height, width, 3), BACKGROUND, dtype=np.uint8)

    def box(centre: np.ndarray, half_size, colour, thickness: int) -> None:
        corner, opposite = env.world_to_pixels(np.stack([centre - half_size, centre + half_size])).round().astype(int)
        cv2.rectangle(image, corner.tolist(), opposite.tolist(), colour, thickness, cv2.LINE_AA)

    def text(centre: np.ndarray, words: str, scale: float, colour) -> None:
        (text_width, text_height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_DUPLEX, scale, 1)
        x, y = env.world_to_pixels(centre).round().astype(int)
        origin = (int(x - text_width / 2), int(y + text_height / 2))
        cv2.putText(image, words, origin, cv2.FONT_HERSHEY_DUPLEX, scale, colour, 1, cv2.LINE_AA)

    for slot, centre in enumerate(env.slots):
        is_aux = slot == env.n_blocks
        colour = (150, 150, 150) if is_aux else BLOCK_COLOURS[slot]
        tint = tuple(int(255 - 0.15 * (255 - c)) for c in colour)
        box(centre, SLOT_HALF_SIZE, tint, cv2.FILLED)
        box(centre, SLOT_HALF_SIZE, colour, 2)
        text(centre + [0, SLOT_HALF_SIZE + 0.025], slot_name(slot, env.n_blocks), 0.6, INK)
    for block, centre in enumerate(env.blocks):
        box(centre, BLOCK_HALF_SIZE, BLOCK_COLOURS[block], cv2.FILLED)
        text(centre, block_name(block), 0.5, (255, 255, 255))
    gap = BLOCK_HALF_SIZE + 0.004 + 0.012 * env.opening
    for side in (-1, 1):
        box(env.gripper + [side * gap, 0], np.array([0.004, 0.018]), GRIPPER_COLOUR, cv2.FILLED)
    return image
