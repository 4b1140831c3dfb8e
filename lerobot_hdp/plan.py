"""What a caller of the planner gives and gets."""

from dataclasses import dataclass

import torch
from torch import Tensor

from .vocabulary import FREE, Vocabulary


@dataclass(frozen=True)
class PlanPrompt:
    """The part of a plan that is given; the planner finds the rest.

    Attributes:
        token_ids: (B, H_d) int64 token ids, FREE (-1) where the planner decides. None: all symbols are free.
        actions: (B, H_c, D) normalised actions. None: the whole motion is free.
        actions_given: (B, H_c) bool, which of `actions` are given. None: all of them.
    """

    token_ids: Tensor | None = None
    actions: Tensor | None = None
    actions_given: Tensor | None = None

    def __post_init__(self):
        if self.actions is None and self.actions_given is not None:
            raise ValueError("actions_given says which actions are given, but there are no actions")

    @property
    def tokens_mask(self) -> Tensor | None:
        """(B, H_d) bool, which tokens are given; None: none of them."""
        return None if self.token_ids is None else self.token_ids != FREE

    @property
    def actions_mask(self) -> Tensor | None:
        """(B, H_c, 1) bool, which actions are given; None: none of them."""
        if self.actions is None:
            return None
        if self.actions_given is None:
            return torch.ones_like(self.actions[..., :1], dtype=torch.bool)
        return self.actions_given[..., None]


@dataclass(frozen=True)
class Plan:
    """A motion and the symbolic plan behind it.

    Attributes:
        actions: (B, H_c, D) actions, normalised like all that a LeRobot policy returns; its postprocessor
            gives them their units back.
        token_ids: (B, H_d) int64 token ids. None from a planner that models no symbols.
        token_probabilities: (B, H_d) the probability with which each token was drawn; 1 where it was given. (B, 0)
            from a planner that draws none: it models no symbols, or continuous ones.
        vocabulary: what the token ids mean.
    """

    actions: Tensor
    token_ids: Tensor | None = None
    token_probabilities: Tensor | None = None
    vocabulary: Vocabulary | None = None

    def symbols(self, index: int = 0) -> list[str]:
        """The symbolic plan of one sample in words, without PAD."""
        if self.token_ids is None or self.vocabulary is None:
            return []
        return self.vocabulary.decode(self.token_ids[index])
