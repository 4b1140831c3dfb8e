"""What every task states about itself: its words, its sizes and its units."""

from dataclasses import dataclass, field
from typing import Any

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
    parameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.vocabulary[0] != PAD:
            raise ValueError(f"the first symbol of a vocabulary is {PAD}, got {self.vocabulary[0]!r}")
        if len(set(self.vocabulary)) != len(self.vocabulary):
            raise ValueError(f"a vocabulary names each symbol once, got {self.vocabulary}")
