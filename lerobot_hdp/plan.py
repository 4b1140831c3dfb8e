"""What a caller of the planner gives and gets."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .vocabulary import FREE, FREE_SYMBOL, PAD_ID, Vocabulary

PlanCheck = Callable[[int, list[str]], list[str]]
"""(index of the sample, its plan in words) -> complaints about the plan, in words; none about a valid one."""

StepEnds = Sequence[tuple[int, int]]
"""(tokens, waypoints) until which each step of a plan lasts, e.g. ((6, 7), (12, 13)): the first step is the tokens 0
to 5 and the waypoints 0 to 6. Tasks whose demonstrations all keep the same time know it (`PlanningTask.step_ends`)."""
TOKENS_PER_ROW = 6
"""Where a plan is written and its steps are not known."""


@dataclass(frozen=True)
class PlanPrompt:
    """The part of a plan that is given; the planner finds the rest.

    Attributes:
        token_ids: (B, H_d) int64 token ids, FREE (-1) where the planner decides, FREE_SYMBOL (-2) where it decides
            among the symbols other than PAD (with the masked process; others may draw PAD). FREE before a given PAD is
            a plan that ends there or earlier. None: all symbols are free.
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
        return None if self.token_ids is None else self.token_ids >= PAD_ID

    @property
    def not_pad(self) -> Tensor | None:
        """(B, H_d) bool, where no PAD is to be drawn, which only fills the end of a plan; None: it may be anywhere."""
        if self.token_ids is None:
            return None
        symbol_from_here_on = (self.token_ids > PAD_ID).flip(1).cummax(dim=1).values.flip(1)
        return symbol_from_here_on | (self.token_ids == FREE_SYMBOL)

    @property
    def actions_mask(self) -> Tensor | None:
        """(B, H_c, 1) bool, which actions are given; None: none of them."""
        if self.actions is None:
            return None
        if self.actions_given is None:
            return torch.ones_like(self.actions[..., :1], dtype=torch.bool)
        return self.actions_given[..., None]

    @property
    def gives_part_of_motion(self) -> bool:
        """Whether, in any sample, some actions are given, but not all."""
        if self.actions_given is None:
            return False
        return bool((self.actions_given.any(dim=1) & ~self.actions_given.all(dim=1)).any())

    def check(
        self, motion_shape: tuple[int, int, int], symbolic_horizon: int | None, vocabulary: Vocabulary | None
    ) -> None:
        """Refuse what does not fit a planner.

        Args:
            motion_shape: (B, H_c, D).
            symbolic_horizon: H_d.
            vocabulary: of the planner; None where it models no symbols.

        Raises:
            ValueError: a tensor of another shape or type, unknown token ids, or NaN.
        """
        if self.token_ids is not None:
            if vocabulary is None:
                raise ValueError("this planner models no symbols: it takes no symbolic prompt")
            _check_tensor("token_ids", self.token_ids, (motion_shape[0], symbolic_horizon), torch.int64)
            size = len(vocabulary)
            if ((self.token_ids < FREE_SYMBOL) | (self.token_ids >= size)).any():
                raise ValueError(f"token_ids must be in [0, {size - 1}], or {FREE} or {FREE_SYMBOL}, see PlanPrompt")
        if self.actions is not None:
            _check_tensor("actions", self.actions, motion_shape, torch.float32)
            if not self.actions.isfinite().all():
                raise ValueError("actions hold NaN or infinity")
        if self.actions_given is not None:
            _check_tensor("actions_given", self.actions_given, motion_shape[:2], torch.bool)

    def repeat(self, times: int) -> "PlanPrompt":
        """Each sample's prompt `times` times, one after the other: (B times, ...)."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return PlanPrompt(**{name: _repeat(value, times) for name, value in given.items()})

    def to(self, device: torch.device) -> "PlanPrompt":
        """The same on a device."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return PlanPrompt(**{name: None if value is None else value.to(device) for name, value in given.items()})


def _check_tensor(name: str, tensor: Tensor, shape: tuple[int | None, ...], dtype: torch.dtype) -> None:
    if tuple(tensor.shape) != shape or tensor.dtype != dtype:
        raise ValueError(
            f"{name} must have the shape {shape} and the type {dtype}, got {tuple(tensor.shape)} and {tensor.dtype}"
        )


def _repeat(value: Tensor | None, times: int) -> Tensor | None:
    return None if value is None else value.repeat_interleave(times, dim=0)


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
        tokens_given: (B, H_d) bool, which tokens the prompt gave; None: none of them.
        scores: (B,) the score by which the plan was kept (`candidates.score_plans`); None: there was no choice.
        candidate: (B,) the number of the candidate that was kept; None: there was no choice.
    """

    actions: Tensor
    token_ids: Tensor | None = None
    token_probabilities: Tensor | None = None
    vocabulary: Vocabulary | None = None
    tokens_given: Tensor | None = None
    scores: Tensor | None = None
    candidate: Tensor | None = None

    def symbols(self, index: int = 0) -> list[str]:
        """The symbolic plan of one sample in words, without PAD."""
        if self.token_ids is None or self.vocabulary is None:
            return []
        return self.vocabulary.decode(self.token_ids[index])

    def select(self, samples: Tensor | slice) -> "Plan":
        """The plans of some of the samples."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        tensors: dict[str, Any] = {name: value[samples] for name, value in values.items() if isinstance(value, Tensor)}
        return replace(self, **tensors)

    def validate(self, check: PlanCheck) -> list[list[str]]:
        """What is wrong with the symbolic plan of each sample, in words: B lists, empty for a valid plan.

        Args:
            check: the task's checker, with the observations, e.g.
                `lambda i, symbols: task.check_plan(symbols, observations[i])`.
        """
        return [check(index, self.symbols(index)) for index in range(len(self.actions))]

    def describe(self, index: int = 0, step_ends: StepEnds | None = None) -> str:
        """The plan of one sample as text: a line for each step, with the probability of each token.

        Args:
            index: of the sample.
            step_ends: the tokens and waypoints of each step, to say which waypoints it covers; None: `TOKENS_PER_ROW`
                to a line, without waypoints.
        """
        words = self.symbols(index)
        if not words:
            return "(no symbols)"
        tokens = words
        if self.token_probabilities is not None and self.token_probabilities.shape[1]:
            drawn = zip(words, self.token_probabilities[index].tolist(), strict=False)
            tokens = [f"{word} {probability:.2f}" for word, probability in drawn]
        lines = []
        for row in plan_rows(len(tokens), self.actions.shape[1], step_ends):
            line = "  ".join(tokens[row.tokens])
            if step_ends is not None:
                during = row.waypoints
                when = f"waypoints {during.start}-{during.stop - 1}" if during else "after the motion"
                line = f"{when:18}{line}"
            lines.append(line)
        return "\n".join(lines)

    def __str__(self) -> str:
        return "\n\n".join(self.describe(index) for index in range(len(self.actions)))


class PlanRow(NamedTuple):
    """A line of a plan that is written or drawn.

    Attributes:
        tokens: its tokens.
        waypoints: of its step; None: not known, or it comes after the motion.
    """

    tokens: slice
    waypoints: slice | None


def plan_rows(num_tokens: int, horizon: int, step_ends: StepEnds | None = None) -> list[PlanRow]:
    """The lines in which a plan is written: one for each step, and one for what follows the last.

    Args:
        num_tokens: of the plan, without PAD at its end.
        horizon: H_c; a planner of short motions plans steps that come after its motion, too.
        step_ends: the tokens and waypoints of each step; None: `TOKENS_PER_ROW` to a line.
    """
    if step_ends is None:
        starts = range(0, num_tokens, TOKENS_PER_ROW)
        return [PlanRow(slice(start, min(start + TOKENS_PER_ROW, num_tokens)), None) for start in starts]
    rows = []
    for (start, first), (stop, end) in pairwise([(0, 0), *step_ends, (num_tokens, 0)]):
        stop, end = min(stop, num_tokens), min(end, horizon)
        if start < stop:
            rows.append(PlanRow(slice(start, stop), slice(first, end) if first < end else None))
    return rows
