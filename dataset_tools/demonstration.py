"""What an expert hands to the recorder."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
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
        """The same as token ids, positions in the vocabulary, filled with 0 (PAD): (symbolic_horizon,) int64.

        Raises:
            ValueError: a symbol is not in the vocabulary, or there are more than symbolic_horizon.
        """
        symbols = self.remaining_symbols(frame)
        if unknown := set(symbols).difference(vocabulary):
            raise ValueError(f"the vocabulary {' '.join(vocabulary)} has no {', '.join(sorted(unknown))}")
        if len(symbols) > symbolic_horizon:
            raise ValueError(f"a plan of {len(symbols)} symbols does not fit a symbolic horizon of {symbolic_horizon}")
        ids = [vocabulary.index(symbol) for symbol in symbols]
        return np.array(ids + [0] * (symbolic_horizon - len(ids)), dtype=np.int64)


def check_steps(steps: Sequence[PlanStep], length: int, whose: str) -> None:
    """Whether the steps of a plan can be those of an episode.

    Args:
        steps: in the order of execution.
        length: frames of the episode.
        whose: they are, for the error.

    Raises:
        ValueError: a step is a text, or they are not done one after the other between the first frame and the end.
    """
    if texts := [step.symbols for step in steps if isinstance(step.symbols, str)]:
        raise ValueError(f"a step of {whose} is the text {texts[0]!r} instead of a tuple of words")
    stops = [step.stop for step in steps]
    if any(stop <= earlier for earlier, stop in pairwise([0, *stops])) or max(stops, default=0) > length:
        raise ValueError(f"the stops of {whose} must strictly increase within 1..{length}, got {stops}")


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
