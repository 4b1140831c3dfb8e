"""Functions timed in turns, in a random order in each round, so that whatever else the machine does falls on all."""

import random
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any


def timed(function: Callable[[], Any]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def take_turns(
    functions: dict[str, Callable[[], Any]],
    rounds: int,
    after_round: Callable[[dict[str, list[float]]], None] = lambda _: None,
) -> dict[str, list[float]]:
    """Seconds that each function takes in each round, after a first call that warms up.

    Args:
        after_round: sees what is known after each round, so that an interruption loses nothing.
    """
    for function in functions.values():
        function()
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name in random.sample(list(functions), len(functions)):
            times[name].append(timed(functions[name]))
        after_round(times)
    return times


def quartiles(values: Sequence[float]) -> list[float]:
    """First quartile, median and third quartile, to four digits; of one value, itself."""
    if len(values) == 1:
        values = [*values, *values]
    return [float(f"{value:.4g}") for value in statistics.quantiles(values, n=4, method="inclusive")]


def quartiles_of_ratio(numerators: Sequence[float], denominators: Sequence[float]) -> list[float]:
    """Of the ratios of the two, round by round."""
    return quartiles([one / other for one, other in zip(numerators, denominators, strict=True)])


def compare(functions: dict[str, Callable[[], Any]], rounds: int, reference: str) -> dict[str, dict[str, list[float]]]:
    """Milliseconds of each function, and the ratio over the reference in the same round, as quartiles."""
    times = take_turns(functions, rounds)
    return {
        name: {
            "ms": quartiles([1000 * seconds for seconds in own]),
            "ratio": quartiles_of_ratio(own, times[reference]),
        }
        for name, own in times.items()
    }
