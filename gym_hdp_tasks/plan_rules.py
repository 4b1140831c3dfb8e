"""What is wrong with a symbolic plan, in words: each task's own rules, checked on the symbols alone.

A checker takes the symbols of a plan, without PAD, and the observation that it was made from. It returns complaints;
a valid plan has none. It says nothing about the motion.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

Observation = Mapping[str, np.ndarray]
"""As the environment gives it, in its units: `environment_state`, ..."""
Form = Sequence[Collection[str]]
"""The symbols that are allowed at each position of a move."""


def read_moves(symbols: Sequence[str], form: Form) -> tuple[list[tuple[str, ...]], list[str]]:
    """Cut a plan into moves of one form: those before the first that has another form, and a complaint about it."""
    moves: list[tuple[str, ...]] = []
    for start in range(0, len(symbols), len(form)):
        words = tuple(symbols[start : start + len(form)])
        for position, allowed in enumerate(form):
            word = words[position] if position < len(words) else None
            if word not in allowed:
                found = "the plan ends" if word is None else f"'{word}' stands"
                choices = " or ".join(allowed)
                return moves, [f"move {len(moves) + 1}, word {position + 1}: {found} where {choices} should"]
        moves.append(words)
    return moves, []


def check_sorting_plan(symbols: Sequence[str], start: Mapping[str, str], slots: Sequence[str]) -> list[str]:
    """PICK block slot PLACE block slot: a block is where it is picked, goes to a free slot, and all end at home.

    Args:
        symbols: the plan.
        start: the slot in which each block starts, in the order of the blocks.
        slots: the homes of the blocks, in the same order, and the auxiliary slot.
    """
    blocks, where = list(start), dict(start)
    moves, complaints = read_moves(symbols, (["PICK"], blocks, slots, ["PLACE"], blocks, slots))
    for number, (_, block, origin, _, placed, target) in enumerate(moves, start=1):
        if where[block] != origin:
            complaints.append(f"move {number} picks {block} from {origin}, but {block} is in {where[block]}")
        if placed != block:
            complaints.append(f"move {number} picks {block}, but places {placed}")
        complaints += [
            f"move {number} places {placed} in {target}, where {other} is"
            for other in blocks
            if other != placed and where[other] == target
        ]
        where[placed] = target
    homes = zip(blocks, slots, strict=False)
    complaints += [f"{block} ends in {where[block]} instead of {home}" for block, home in homes if where[block] != home]
    return complaints


def slots_of_blocks(positions: np.ndarray, centres: np.ndarray, slots: Sequence[str]) -> list[str]:
    """The slot nearest to each block; positions (n, 2) and centres (m, 2) in metres."""
    distances = np.linalg.norm(np.asarray(positions)[:, None] - centres[None], axis=-1)
    return [slots[nearest] for nearest in distances.argmin(axis=1)]
