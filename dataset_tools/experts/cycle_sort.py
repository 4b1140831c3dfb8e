"""Cycle sort with one auxiliary place (paper, "X-Arm Sorting")."""

import numpy as np

Move = tuple[int, int, int]
"""(block, place it is picked from, place it goes to)"""


def cycles(order: list[int]) -> list[list[int]]:
    """The cycles, of two blocks or more, of the permutation that sorts `order`.

    Args:
        order: order[place] is the block that lies there; block b belongs to place b.
    """
    found, seen = [], set()
    for start in range(len(order)):
        cycle, place = [], start
        while place not in seen:
            seen.add(place)
            cycle.append(order[place])
            place = order[place]
        if len(cycle) > 1:
            found.append(cycle)
    return found


def cycle_sort(order: list[int], rng: np.random.Generator) -> list[Move]:
    """Sort by exchanging two blocks at a time by way of the auxiliary place, which has the index len(order).

    Which cycle comes first and with which of its blocks are uniform random choices. An exchange takes three moves
    and brings at least one block home, so that n blocks need at most 3 (n - 1) moves.

    Args:
        order: order[place] is the block that lies there; block b belongs to place b.
        rng: decides between the choices.
    """
    order, auxiliary, moves = list(order), len(order), []
    while remaining := cycles(order):
        cycle = set(remaining[rng.integers(len(remaining))])
        while unsorted := sorted(block for block in cycle if order[block] != block):
            block = unsorted[rng.integers(len(unsorted))]
            place, home = order.index(block), block
            occupant = order[home]
            moves += [(occupant, home, auxiliary), (block, place, home), (occupant, auxiliary, place)]
            order[home], order[place] = block, occupant
    return moves
