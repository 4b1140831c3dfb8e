"""The way back: from noise and masks to a plan (paper, Algorithm 2), free or with a part of the plan given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from .denoiser import Prediction
from .plan import PlanPrompt
from .processes import GaussianProcess, MaskedProcess, Process, SymbolProcess
from .processes.base import expand_to
from .vocabulary import PAD_ID

Denoise = Callable[[Tensor, Tensor | None, Tensor, Tensor], Prediction]
"""(motion (B, H_c, D), symbols (B, H_d, ...), k_c (B,), k_d (B,)) -> Prediction, for a fixed observation."""


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

    def start(
        process: Process, shape: tuple[int, ...], steps: int, clean: Tensor | None, given: Tensor | None
    ) -> Stream:
        prior = process.prior(shape, device, generator)
        stream = Stream(process, prior, process.levels(steps).to(device), clean, given, shared_level)
        stream.set_given(0, generator)
        return stream

    batch_size = motion_shape[0]
    motion = start(motion_process, motion_shape, num_steps - lead, prompt.actions, prompt.actions_mask)
    symbols: Stream | None = None
    tokens: Tensor | None = None
    probabilities = torch.zeros(batch_size, 0, device=device)
    k_d = torch.zeros(batch_size, device=device)
    not_pad = prompt.not_pad if isinstance(symbol_process, MaskedProcess) else None
    if symbol_process is not None:
        shape = batch_size, symbolic_horizon
        symbols = start(symbol_process, shape, num_steps, prompt.token_ids, prompt.tokens_mask)
        tokens = symbol_process.tokens(symbols.value)
        if isinstance(symbol_process, MaskedProcess):
            probabilities = (tokens != symbol_process.mask_id).float()

    if on_step is not None:
        on_step(0, DenoisingState(motion.value, tokens, probabilities))
    for i in range(num_steps):
        if symbols is not None:
            k_d = symbols.level(i)
        motion_step = max(i - lead, 0)
        prediction = denoise(motion.value, symbols.value if symbols else None, motion.level(motion_step), k_d)
        if i >= lead:
            motion.advance(motion_step, prediction.motion, generator)
        if symbols is not None:
            assert symbol_process is not None
            assert prediction.symbols is not None
            before, scores = symbols.value, prediction.symbols
            if not_pad is not None:
                scores[..., PAD_ID] = scores[..., PAD_ID].masked_fill(not_pad, -torch.inf)
            symbols.advance(i, scores, generator)
            tokens = symbol_process.tokens(symbols.value)
            if isinstance(symbol_process, MaskedProcess):
                drawn = _token_probabilities(scores, tokens)
                probabilities = torch.where(tokens == before, probabilities, drawn)
        if on_step is not None:
            on_step(i + 1, DenoisingState(motion.value, tokens, probabilities))
    return DenoisingState(motion.value, tokens, probabilities)


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
