"""The language of prompts: a part of a plan in words. docs/conditioning.md is its manual.

    PICK A           the plan begins so; what follows is open
    PICK _ S1        `_` is one symbol that the planner decides
    ... STACK red    `...` is any number of them, also none: the plan ends with STACK red
    PICK A ... S3    it begins with PICK A and ends with S3
    ... AUX ...      AUX is somewhere
    7:PICK B         PICK is at position 7 and B at 8, counted from 1
    -2:STACK         STACK is the last symbol but one
    STACK red PAD    PAD ends the plan
    PICK A from S1   `from` and `to` are only there to be read

A prompt with `...` before a word does not say where in the plan that word is: where the plan ends is the planner's
choice, too. So a prompt is a list of placements, and the planner draws one (`choose_placement`).
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import torch
from torch import Generator, Tensor

from .vocabulary import FREE, FREE_SYMBOL, PAD_ID, Vocabulary

FREE_WORD = "_"
ANY_NUMBER = "..."
FILLER_WORDS = ("FROM", "TO")
"""Ignored, unless they are symbols."""
MAX_PLACEMENTS = 10_000
"""More ways to place a prompt than this are refused; each further part without a place multiplies them."""
MAX_TRIED = 10 * MAX_PLACEMENTS
"""The same way may come up more than once."""


@dataclass
class Part:
    """Words of a prompt that follow each other without a gap.

    Attributes:
        ids: a token id, or FREE_SYMBOL, for each word; without PAD.
        start: the first word's position, from 0; negative: from the end of the plan; None: anywhere after the part
            before.
        said: its first word, and where in the prompt that stands.
        ends: whether the plan ends with it, as PAD says.
    """

    ids: list[int]
    start: int | None
    said: str
    ends: bool = False


def encode_prompt(prompt: str, vocabulary: Vocabulary, length: int) -> Tensor:
    """All ways to place a prompt in a plan of up to `length` symbols: (C, length) int64, C >= 1.

    Each is a row of token ids, FREE where the planner decides, FREE_SYMBOL where it decides on anything but PAD, and
    PAD from the end of the plan on where the prompt says how the plan ends.

    Raises:
        ValueError: an unknown symbol, an impossible position, or a prompt that does not fit.

    Example:
        >>> encode_prompt("PICK _ S1", Vocabulary(["PAD", "A", "PICK", "S1"]), length=4)
        tensor([[ 2, -2,  3, -1]])
        >>> encode_prompt("... S1", Vocabulary(["PAD", "A", "PICK", "S1"]), length=3)
        tensor([[ 3,  0,  0],
                [-2,  3,  0],
                [-2, -2,  3]])
    """
    parts = _parse(prompt, vocabulary)
    for part in parts:
        if part.start is not None and not -length <= part.start < length + part.ends:
            raise ValueError(f"{part.said} is outside of a plan of {length} symbols")
    ways = list(islice(_placements(parts, length), MAX_TRIED + 1))
    rows = list(dict.fromkeys(ways))
    if not rows:
        fits = (any(_placements(parts[: number + 1], length)) for number in range(len(parts)))
        said = next(part.said for part, fit in zip(parts, fits, strict=True) if not fit)
        raise ValueError(
            f"the prompt '{prompt}' does not fit into a plan of {length} symbols: there is no room for what begins "
            f"with {said}, after what comes before it"
        )
    if len(ways) > MAX_TRIED or len(rows) > MAX_PLACEMENTS:
        raise ValueError(
            f"the prompt '{prompt}' can be placed in too many ways: give positions by number, as in 7:PICK"
        )
    return torch.tensor(rows)


def place_prompts(
    texts: Sequence[str],
    vocabulary: Vocabulary,
    length: int,
    device: torch.device,
    ask: Callable[[Tensor], Tensor],
    generator: Generator | None = None,
) -> Tensor:
    """Token ids of a prompt in words for each sample of a batch: (B, H_d).

    Args:
        texts: B prompts.
        vocabulary: of the planner.
        length: H_d.
        device: of the token ids.
        ask: from what is given in any case, (B, H_d) token ids, to a planner's scores of all symbols (B, H_d, m). It
            is asked only if the words do not say where they stand.
        generator: source of randomness; None: PyTorch's global one.

    Raises:
        ValueError: see `encode_prompt`.
    """
    encoded = {text: encode_prompt(text, vocabulary, length).to(device) for text in set(texts)}
    placements = [encoded[text] for text in texts]
    if all(len(ways) == 1 for ways in placements):
        return torch.cat(placements)
    scores = ask(torch.stack([shared_tokens(ways) for ways in placements]))
    drawn = zip(placements, scores, strict=True)
    return torch.stack([choose_placement(ways, logits, generator) for ways, logits in drawn])


def shared_tokens(placements: Tensor) -> Tensor:
    """What all placements (C, H) agree on, FREE elsewhere: (H,)."""
    agreed = (placements == placements[0]).all(dim=0)
    return torch.where(agreed, placements[0], FREE)


def choose_placement(placements: Tensor, logits: Tensor, generator: Generator | None = None) -> Tensor:
    """Draw a placement by its probability: (C, H) -> (H,).

    The probability is the product of those of the given tokens, those that all placements share aside, up to the
    first PAD, which decides where the plan ends.

    Args:
        placements: as `encode_prompt` makes them.
        logits: (H, m) scores of the symbols, with the shared tokens given.
        generator: source of randomness; None: PyTorch's global one.
    """
    is_pad = placements == PAD_ID
    after_first_pad = is_pad & is_pad.roll(1, dims=1)
    after_first_pad[:, 0] = False
    counted = (placements >= PAD_ID) & (shared_tokens(placements) < PAD_ID) & ~after_first_pad
    log_probabilities = logits.float().log_softmax(dim=-1)[torch.arange(len(logits)), placements.clamp(min=0)]
    scores = torch.where(counted, log_probabilities, 0.0).sum(dim=1)
    return placements[torch.multinomial(scores.softmax(dim=0), 1, generator=generator).item()]


def _parse(prompt: str, vocabulary: Vocabulary) -> list[Part]:
    """The parts of a prompt, in order."""
    spaced = re.sub(r"\.\.\.|…", f" {ANY_NUMBER} ", prompt)
    words = re.sub(r"(?<=\d)\s*:\s*", ":", spaced).split()
    parts: list[Part] = []
    start: int | None = 0  # of the next part
    begins = True  # whether the next word begins a part
    for place, word in enumerate(words, start=1):
        where = f"(word {place} of the prompt)"
        said = f"'{word}' {where}"
        if word == ANY_NUMBER:
            start, begins = None, True
            continue
        numbered = re.fullmatch(r"([+-]?\d+):(.+)", word)
        if numbered:
            start, begins = _position(int(numbered[1]), said), True
            word = numbered[2]
            if word == ANY_NUMBER:
                raise ValueError(f"{said}: a position is that of a symbol, or of '{FREE_WORD}'")
        token = _token_id(word, where, vocabulary)
        if token is None:
            continue
        if begins:
            parts.append(Part([], start, said))
            begins = False
        if token == PAD_ID:
            parts[-1].ends = True
        elif any(part.ends for part in parts):
            raise ValueError(f"{said} comes after {vocabulary.symbols[PAD_ID]}, where the plan has ended")
        else:
            parts[-1].ids.append(token)
    if parts and parts[-1].start is None and not parts[-1].ids:
        parts.pop()  # `... PAD`: that a plan ends somewhere says nothing
    elif parts and parts[-1].start is None and (not begins or parts[-1].ends):
        parts[-1].start = -len(parts[-1].ids)
    return parts


def _position(number: int, said: str) -> int:
    """A position as it is written, 1, 2, ... or ..., -2, -1, as an index."""
    if number == 0:
        raise ValueError(f"{said}: positions count from 1, or from the end from -1")
    return number - 1 if number > 0 else number


def _token_id(word: str, where: str, vocabulary: Vocabulary) -> int | None:
    """The token id of a word, FREE_SYMBOL, or None for a filler word."""
    if word == FREE_WORD:
        return FREE_SYMBOL
    if word in vocabulary:
        return vocabulary.token_id(word)
    if word.upper() in FILLER_WORDS:
        return None
    raise ValueError(
        f"unknown symbol '{word}' {where}; the symbols are {' '.join(vocabulary.symbols)}, "
        f"'{FREE_WORD}' leaves one open and '{ANY_NUMBER}' any number"
    )


def _placements(parts: Sequence[Part], length: int) -> Iterator[tuple[int, ...]]:
    """Rows of token ids, one for each way to place the parts; some may come twice."""
    says_the_end = any(part.start is not None and part.start < 0 for part in parts)
    is_symbol = says_the_end or any(part.ends for part in parts)  # what comes before the end, wherever nothing is said
    for plan_length in range(1, length + 1) if says_the_end else (length,):
        for starts in _starts(parts, plan_length):
            row = [FREE_SYMBOL if is_symbol else FREE] * plan_length + [PAD_ID] * (length - plan_length)
            for part, start in zip(parts, starts, strict=True):
                stop = start + len(part.ids)
                row[start:stop] = part.ids
                if part.ends:
                    row[stop:] = [PAD_ID] * (length - stop)
            yield tuple(row)


def _starts(parts: Sequence[Part], plan_length: int) -> Iterator[tuple[int, ...]]:
    """Where each part begins, without overlaps, in their order."""
    places: list[range] = []  # for each part, as far as those after it leave room
    end = plan_length
    for part in reversed(parts):
        latest = end - len(part.ids)
        if part.start is None:
            places.insert(0, range(latest + 1))
        else:
            start = part.start if part.start >= 0 else plan_length + part.start
            if start > latest or (part.ends and part.start < 0 and start != latest):
                return
            places.insert(0, range(start, start + 1))
        end = places[0].stop - 1
    yield from _in_order(places, [len(part.ids) for part in parts], 0)


def _in_order(places: Sequence[range], sizes: Sequence[int], earliest: int) -> Iterator[tuple[int, ...]]:
    """One start from each of some places, from `earliest` on, so that what begins there does not overlap."""
    if not places:
        yield ()
        return
    for start in places[0]:
        if start >= earliest:
            for others in _in_order(places[1:], sizes[1:], start + sizes[0]):
                yield (start, *others)
