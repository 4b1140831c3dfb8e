"""What an expert hands to the recorder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium as gym
import numpy as np


class PlanStep(NamedTuple):
    """One move of a plan.

    Attributes:
        symbols: the move in words, e.g. `("PICK", "A", "S1", "PLACE", "A", "AUX")`.
        stop: index of the first waypoint after the move; from that frame on the step is done.
    """

    symbols: tuple[str, ...]
    stop: int


@dataclass(frozen=True)
class Demonstration:
    """A motion and the plan behind it.

    Attributes:
        waypoints: (horizon, action size) float32 actions, in the task's units.
        steps: the plan, in the order of execution.
    """

    waypoints: np.ndarray
    steps: tuple[PlanStep, ...]

    def remaining_symbols(self, frame: int) -> list[str]:
        """The symbols of the steps that are not yet done at a frame."""
        return [symbol for step in self.steps if step.stop > frame for symbol in step.symbols]

    def remaining_token_ids(self, frame: int, vocabulary: Sequence[str], symbolic_horizon: int) -> np.ndarray:
        """The same as token ids, positions in the vocabulary, filled with 0 (PAD): (symbolic_horizon,) int64."""
        ids = [vocabulary.index(symbol) for symbol in self.remaining_symbols(frame)]
        return np.array(ids + [0] * (symbolic_horizon - len(ids)), dtype=np.int64)


Expert = Callable[[gym.Env, np.random.Generator], Demonstration]
"""Looks at an environment that was just reset and demonstrates the whole episode; the generator decides between
equally good choices."""


def expert_generator(seed: int) -> np.random.Generator:
    """The expert's own random numbers, for an environment that was reset with the same seed.

    Seeded with the bare seed, they would be those that the reset drew, and the choices would follow from the start.
    """
    return np.random.default_rng([seed, 1])


def hold_last_waypoint(waypoints: list[np.ndarray], horizon: int) -> np.ndarray:
    """Stack waypoints and repeat the last until the horizon is reached: (horizon, action size) float32.

    Raises:
        ValueError: there are more waypoints than the horizon has room for.
    """
    if len(waypoints) > horizon:
        raise ValueError(f"a demonstration of {len(waypoints)} waypoints does not fit a horizon of {horizon}")
    padded = waypoints + [waypoints[-1]] * (horizon - len(waypoints))
    return np.asarray(padded, dtype=np.float32)
