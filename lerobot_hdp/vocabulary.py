"""The symbols of a plan and their token ids."""

import re
from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

PAD_ID = 0
"""Token id that fills the end of a plan that is shorter than the symbolic horizon."""
FREE = -1
"""Token id, in a prompt, of a position that the planner decides."""
FREE_SYMBOL = -2
"""The same, where the plan has not ended: any symbol but PAD."""


class Vocabulary:
    """Symbols in words <-> token ids.

    The id of a symbol is its position; symbol 0 fills the end of a plan that is shorter than the symbolic horizon.
    The mask of the masked process, with the id `len(vocabulary)`, is no symbol: it is neither read nor printed, and no
    plan holds it.

    Example:
        >>> vocabulary = Vocabulary(["PAD", "A", "B", "PICK"])
        >>> vocabulary.encode("PICK B", length=4)
        tensor([3, 2, 0, 0])
        >>> vocabulary.decode([3, 2, 0, 0])
        ['PICK', 'B']
    """

    def __init__(self, symbols: Sequence[str]):
        if len(symbols) < 2 or len({symbol.upper() for symbol in symbols}) != len(symbols):
            raise ValueError(f"a vocabulary is PAD and at least one more symbol, each once; got {list(symbols)}")
        if symbols[PAD_ID].upper() != "PAD":
            raise ValueError(f"the first symbol of a vocabulary is PAD, which ends plans; got {list(symbols)}")
        for symbol in symbols:
            if not re.fullmatch(r"[^\s:…]+", symbol) or symbol == "_" or "..." in symbol:
                raise ValueError(
                    f"{symbol!r} cannot be a symbol: prompts name one by a word without spaces, ':' or '...'"
                )
        self.symbols = tuple(symbols)
        self._ids = {symbol.upper(): i for i, symbol in enumerate(self.symbols)}

    def __len__(self) -> int:
        return len(self.symbols)

    def __contains__(self, word: str) -> bool:
        return word.upper() in self._ids

    def token_id(self, word: str) -> int:
        """The id of a symbol; case does not matter."""
        return self._ids[word.upper()]

    def encode(self, plan: str | Sequence[str], length: int) -> Tensor:
        """A whole plan as token ids, filled with PAD: (length,) int64.

        Args:
            plan: symbols, or one string of symbols with spaces between them; case does not matter.

        Raises:
            ValueError: an unknown symbol, or more symbols than `length`.
        """
        words = plan.split() if isinstance(plan, str) else list(plan)
        if len(words) > length:
            raise ValueError(f"{len(words)} symbols do not fit into a plan of {length}")
        ids = torch.full((length,), PAD_ID, dtype=torch.int64)
        for position, word in enumerate(words):
            if word not in self:
                raise ValueError(
                    f"unknown symbol {word!r} at position {position + 1}; the symbols are {' '.join(self.symbols)}"
                )
            ids[position] = self.token_id(word)
        return ids

    def decode(self, ids: Iterable[int] | Tensor) -> list[str]:
        """The symbols of a plan, without the PAD at its end.

        Raises:
            ValueError: an id that is no symbol's.
        """
        ids = ids.tolist() if isinstance(ids, Tensor) else [int(i) for i in ids]
        while ids and ids[-1] == PAD_ID:
            ids.pop()
        for position, i in enumerate(ids):
            if not 0 <= i < len(self):
                raise ValueError(f"token id {i} at position {position} is none of the {len(self)} symbols")
        return [self.symbols[i] for i in ids]
