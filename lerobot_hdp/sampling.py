"""The way back: from noise and masks to a plan (paper, Algorithm 2), free or with a part of the plan given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import torch
from torch import Generator, Tensor

from .denoiser import Denoise
from .plan import PlanPrompt
from .processes import GaussianProcess, MaskedProcess, Process, SymbolProcess
from .processes.base import expand_to
from .vocabulary import PAD_ID


class DenoisingState(NamedTuple):
    """The plan after a number of steps.

    Attributes:
        motion: (B, H_c, D) partly denoised motion.
        tokens: (B, H_d) partly unmasked token ids, None where no symbols are modelled.
        token_probabilities: (B, H_d) the probability with which each token was drawn; 1 where given, 0 where masked;
            (B, 0) where no tokens are drawn.
    """

    motion: Tensor
    tokens: Tensor | None
    token_probabilities: Tensor


@dataclass
class Stream:
    """One of the two processes on its way back, around what is given of it.

    Attributes:
        process: the process.
        value: (B, H, ...) where it is.
        levels: (num_steps + 1,) the levels it passes.
        clean: the given part; None: nothing is given.
        given: broadcastable against `clean`, bool, which of it is given.
        shared_level: the levels are those of the other process, too, and stay what they are where everything is given.
            Otherwise a sample of which everything is given stays clean (k = 0).
    """

    process: Process
    value: Tensor
    levels: Tensor
    clean: Tensor | None = None
    given: Tensor | None = None
    shared_level: bool = False

    def __post_init__(self):
        if self.given is None or self.shared_level:
            self.all_given = torch.zeros(len(self.value), dtype=torch.bool, device=self.value.device)
        else:
            self.all_given = self.given.flatten(1).all(dim=1)

    @classmethod
    def start(
        cls,
        process: Process,
        shape: tuple[int, ...],
        num_steps: int,
        clean: Tensor | None = None,
        given: Tensor | None = None,
        *,
        device: torch.device,
        shared_level: bool,
        generator: Generator | None,
    ) -> Self:
        """A process where its way back begins: fully corrupted, but for what is given."""
        levels = process.levels(num_steps).to(device)
        stream = cls(process, process.prior(shape, device, generator), levels, clean, given, shared_level)
        stream.set_given(0, generator)
        return stream

    def level(self, step: int) -> Tensor:
        """The level before a step, as the denoiser is told of it: (B,)."""
        return self.process.told_level(self.value, self.levels[step]).masked_fill(self.all_given, 0.0)

    def set_given(self, step: int, generator: Generator | None) -> None:
        """Put the given part into the value as it looks before a step."""
        if self.clean is not None and self.given is not None:
            shown = self.process.show_given(self.clean, self.level(step), generator)
            self.value = torch.where(expand_to(self.given, self.value), shown, self.value)

    def advance(self, step: int, prediction: Tensor, generator: Generator | None) -> None:
        """Take a reverse step."""
        levels = self.levels[step], self.levels[step + 1]
        self.value = self.process.reverse_step(self.value, prediction, *levels, generator)
        self.set_given(step + 1, generator)


@dataclass
class SymbolStream(Stream):
    """The symbols' process on its way back.

    Attributes:
        token_probabilities: see `DenoisingState`.
        not_pad: (B, H_d) bool, where the masked process draws no PAD; None: it may be anywhere.
    """

    process: SymbolProcess
    not_pad: Tensor | None = None

    def __post_init__(self):
        super().__post_init__()
        self.draws_tokens = isinstance(self.process, MaskedProcess)
        shape = self.value.shape if self.draws_tokens else (len(self.value), 0)
        self.token_probabilities = torch.zeros(shape, device=self.value.device)
        if self.draws_tokens and self.given is not None:
            self.token_probabilities = self.given.float()

    @property
    def tokens(self) -> Tensor:
        """What the value stands for, masks included: (B, H_d)."""
        return self.process.tokens(self.value)

    def advance(self, step: int, prediction: Tensor, generator: Generator | None) -> None:
        if self.draws_tokens and self.not_pad is not None:
            prediction[..., PAD_ID] = prediction[..., PAD_ID].masked_fill(self.not_pad, -torch.inf)
        before = self.value
        super().advance(step, prediction, generator)
        if self.draws_tokens:
            drawn = _token_probabilities(prediction, self.value)
            self.token_probabilities = torch.where(self.value == before, self.token_probabilities, drawn)


@torch.no_grad()
def sample_plan(
    denoise: Denoise,
    motion_process: GaussianProcess,
    symbol_process: SymbolProcess | None,
    motion_shape: tuple[int, int, int],
    *,
    symbolic_horizon: int,
    device: torch.device,
    num_steps: int,
    symbol_lead: float = 0.0,
    shared_level: bool = False,
    prompt: PlanPrompt | None = None,
    generator: Generator | None = None,
    on_step: Callable[[int, DenoisingState], None] | None = None,
) -> DenoisingState:
    """Algorithm 2: denoise the motion and unmask the symbols in the same steps, each seeing the other.

    What the prompt gives stays fixed at every step. Given tokens are seen clean; a given action (or one-hot symbol)
    is seen with the noise of the current level, as in training. Where all symbols or the whole motion of a sample are
    given, its k_d or k_c is 0, unless the two share one level. PAD fills the end of a plan only: before a given symbol,
    the masked process draws none.

    Args:
        denoise: the denoiser, with its observation.
        motion_process, symbol_process: the processes; without the latter the motion alone is sampled (Diffuser).
        motion_shape: (B, H_c, D).
        symbolic_horizon: H_d.
        device: where the plan is made.
        num_steps: number of calls of the denoiser.
        symbol_lead: share of them in which the motion stays pure noise, while the symbols are denoised; less than 1.
        shared_level: whether k_d is always k_c.
        prompt: the part of the plan that is given.
        generator: source of all randomness; None: PyTorch's global one.
        on_step: called after each step with its number and the state, and before the first with 0.
    """
    prompt = prompt or PlanPrompt()
    can_lead = symbol_process is not None and not shared_level
    lead = _steps_ahead(prompt, symbol_lead, num_steps) if can_lead else 0

    how: dict[str, Any] = {"device": device, "shared_level": shared_level, "generator": generator}
    given = prompt.actions, prompt.actions_mask
    motion = Stream.start(motion_process, motion_shape, num_steps - lead, *given, **how)
    symbols = None
    if symbol_process is not None:
        shape, given = (motion_shape[0], symbolic_horizon), (prompt.token_ids, prompt.tokens_mask)
        symbols = SymbolStream.start(symbol_process, shape, num_steps, *given, **how)
        symbols.not_pad = prompt.not_pad
    nothing = torch.zeros(motion_shape[0], 0, device=device)
    clean = torch.zeros(motion_shape[0], device=device)

    def state() -> DenoisingState:
        if symbols is None:
            return DenoisingState(motion.value, None, nothing)
        return DenoisingState(motion.value, symbols.tokens, symbols.token_probabilities)

    if on_step is not None:
        on_step(0, state())
    for i in range(num_steps):
        j = max(i - lead, 0)  # the motion's step
        k_c, k_d = motion.level(j), clean if symbols is None else symbols.level(i)
        prediction = denoise(motion.value, None if symbols is None else symbols.value, k_c, k_d)
        if i >= lead:
            motion.advance(j, prediction.motion, generator)
        if symbols is not None:
            assert prediction.symbols is not None
            symbols.advance(i, prediction.symbols, generator)
        if on_step is not None:
            on_step(i + 1, state())
    return state()


def _steps_ahead(prompt: PlanPrompt, symbol_lead: float, num_steps: int) -> int:
    """How many steps the symbols are ahead of the motion.

    None where they have something to follow, a part of the motion that pure noise would hide, or, in the whole batch,
    nothing to decide.
    """
    gives_motion = prompt.actions_mask is not None and bool(prompt.actions_mask.any())
    if gives_motion or (prompt.tokens_mask is not None and bool(prompt.tokens_mask.all())):
        return 0
    return int(symbol_lead * num_steps)


def _token_probabilities(logits: Tensor, tokens: Tensor) -> Tensor:
    """The probability that logits (B, H, m) give to tokens (B, H); arbitrary for masked ones: (B, H)."""
    symbols = tokens.clamp(max=logits.shape[-1] - 1)
    return logits.float().softmax(dim=-1).gather(-1, symbols[..., None]).squeeze(-1)
