"""What every task states about itself: its words, its sizes and its units."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .plan_rules import Observation

FRONT_CAMERA, WRIST_CAMERA = CAMERAS = ("front", "wrist")
"""By which an X-Arm task can observe."""
OBS_TYPES = {
    "state": ("agent_pos", "environment_state"),
    "pixels": ("pixels",),
    "pixels_agent_pos": ("pixels", "agent_pos"),
    "pixels_state": ("pixels", "agent_pos", "environment_state"),
}
"""What an X-Arm task can observe, to keys of the observation; `pixels` and `pixels_agent_pos` are LeRobot's names."""
ROBOTS = ("primitive", "menagerie")
"""`primitive` ships with this package; `menagerie` is MuJoCo Menagerie's `ufactory_xarm7` (extra `menagerie`)."""
RENDER_MODES = ("rgb_array",)
PAD = "PAD"
"""Symbol with id 0: fills a plan that is shorter than the symbolic horizon."""


@dataclass(frozen=True)
class PlanningTask:
    """The facts about a task that a dataset, a policy and an evaluation need to agree on.

    Attributes:
        gym_id: id for `gymnasium.make`, e.g. `hdp/BlockSorting2D-v0`.
        parameters: keyword arguments that, given to `gymnasium.make`, build this very task again.
        instruction: one plain-English sentence, LeRobot's `task`.
        vocabulary: the symbols of a plan; the position of a symbol is its token id, PAD is 0.
        horizon: number of actions in an episode (the paper's H_c).
        symbolic_horizon: number of tokens in a plan (the paper's H_d).
        state_names: components of `observation.state`.
        environment_state_names: components of `observation.environment_state`.
        action_names: components of `action`.
        fps: actions per second.
        robot_type: what LeRobot writes into the dataset's `robot_type`.
        check_plan: (symbols without PAD, observation) -> what is wrong with the plan, in words.
        step_ends: (tokens, waypoints) of a demonstration up to the end of each step: the first step is the tokens 0 to
            step_ends[0][0] - 1 and the waypoints 0 to step_ends[0][1] - 1. Every demonstration keeps this time. None:
            each has its own.
    """

    gym_id: str
    instruction: str
    vocabulary: tuple[str, ...]
    horizon: int
    symbolic_horizon: int
    state_names: tuple[str, ...]
    environment_state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    fps: int
    robot_type: str
    check_plan: Callable[[Sequence[str], Observation], list[str]] = field(compare=False)
    step_ends: tuple[tuple[int, int], ...] | None = None
    parameters: dict[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self):
        if self.vocabulary[0] != PAD:
            raise ValueError(f"the first symbol of a vocabulary is {PAD}, got {self.vocabulary[0]!r}")
        if len(set(self.vocabulary)) != len(self.vocabulary):
            raise ValueError(f"a vocabulary names each symbol once, got {self.vocabulary}")


def parse_camera_names(camera_name: str | Sequence[str]) -> tuple[str, ...]:
    """`front,wrist`, as LeRobot's environments name several cameras, or a sequence of names, as these names.

    Raises:
        ValueError: they are not some of `CAMERAS`, each once.
    """
    names = camera_name.split(",") if isinstance(camera_name, str) else camera_name
    names = tuple(name.strip() for name in names)
    if not 0 < len(names) == len(set(names) & set(CAMERAS)):
        raise ValueError(f"camera_name must be one of {CAMERAS}, or several, as front,wrist; got {camera_name!r}")
    return names


def check_image_size(observation_height: int, observation_width: int) -> None:
    """Whether observed images can have a size, in pixels.

    Raises:
        ValueError: they cannot.
    """
    if min(observation_height, observation_width) < 1:
        raise ValueError(
            "observation_height and observation_width must be at least 1 pixel, got "
            f"{observation_height} and {observation_width}"
        )


def draw_order(generator: np.random.Generator, n_blocks: int, options: Mapping[str, Any]) -> np.ndarray:
    """Which block starts in which slot of a sorting task: a random order, but never the sorted one.

    Args:
        generator: the environment's; it draws an order even where one is given, so that all else stays the same.
        n_blocks: how many there are.
        options: of `reset`; `{"order": [...]}` gives the order, which may be any.

    Returns:
        (n_blocks,) int64, the block in each slot.

    Raises:
        ValueError: what is given is no permutation of the blocks.
    """
    in_order = np.arange(n_blocks)
    order: np.ndarray = in_order
    while np.array_equal(order, in_order):
        order = generator.permutation(n_blocks)
    if "order" not in options:
        return order
    given = np.asarray(options["order"])
    if given.shape != (n_blocks,) or not np.array_equal(np.sort(given), in_order):
        raise ValueError(f"order must be a permutation of 0..{n_blocks - 1}, got {options['order']}")
    return given.astype(np.int64)


def equal_steps(steps: int, tokens: int, waypoints: int) -> tuple[tuple[int, int], ...]:
    """`step_ends` where each step has as many tokens and waypoints, after a first waypoint where the tool is."""
    return tuple((step * tokens, step * waypoints + 1) for step in range(1, steps + 1))
