"""The way back: from noise and masks to a plan (paper, Algorithm 2), free or with a part of the plan given."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from .denoiser import Prediction
from .plan import PlanPrompt
from .processes import GaussianProcess, MaskedProcess

Denoise = Callable[[Tensor, Tensor | None, Tensor, Tensor], Prediction]
"""(motion (B, H_c, D), tokens (B, H_d), k_c (B,), k_d (B,)) -> Prediction, for a fixed observation."""


class DenoisingState(NamedTuple):
    """The plan after a number of steps.

    Attributes:
        motion: (B, H_c, D) partly denoised motion.
        tokens: (B, H_d) partly unmasked token ids, None where no symbols are modelled.
        token_probabilities: (B, H_d) the probability with which each token was drawn; 1 where given, 0 where masked.
    """

    motion: Tensor
    tokens: Tensor | None
    token_probabilities: Tensor | None


@torch.no_grad()
def sample_plan(
    denoise: Denoise,
    motion_process: GaussianProcess,
    symbol_process: MaskedProcess | None,
    motion_shape: tuple[int, int, int],
    symbolic_horizon: int,
    device: torch.device,
    num_steps: int,
    prompt: PlanPrompt | None = None,
    generator: Generator | None = None,
    on_step: Callable[[int, DenoisingState], None] | None = None,
) -> DenoisingState:
    """Algorithm 2: denoise the motion and unmask the symbols in the same steps, each seeing the other.

    What the prompt gives stays fixed at every step. Given symbols are seen clean; a given action is seen with the
    noise of the current level, as in training, and clean (k_c = 0) where the whole motion is given.

    Args:
        denoise: the denoiser, with its observation.
        motion_process, symbol_process: the processes; without the latter the motion alone is sampled (Diffuser).
        motion_shape: (B, H_c, D).
        symbolic_horizon: H_d.
        device: where the plan is made.
        num_steps: number of calls of the denoiser.
        prompt: the part of the plan that is given.
        generator: source of all randomness; None: PyTorch's global one.
        on_step: called after each step with its index and the state, and once before the first with index 0.
    """
    batch_size = motion_shape[0]
    prompt = prompt or PlanPrompt()
    motion_levels = motion_process.levels(num_steps).to(device)
    motion = motion_process.prior(motion_shape, device, generator)
    actions_given = _actions_given(prompt)
    whole_motion_given = actions_given is not None and bool(actions_given.all())
    if whole_motion_given:
        motion_levels = torch.zeros_like(motion_levels)

    tokens = probabilities = None
    all_tokens_given = False
    symbol_levels = torch.zeros(num_steps + 1, device=device)
    if symbol_process is not None:
        tokens = symbol_process.prior((batch_size, symbolic_horizon), device, generator)
        probabilities = torch.zeros(tokens.shape, device=device)
        symbol_levels = symbol_process.levels(num_steps).to(device)
        if prompt.token_ids is not None:
            tokens = torch.where(prompt.tokens_given, prompt.token_ids, tokens)
            probabilities = prompt.tokens_given.to(probabilities.dtype)
            all_tokens_given = bool(prompt.tokens_given.all())
            if all_tokens_given:
                symbol_levels = torch.zeros_like(symbol_levels)

    motion = _give_actions(motion, motion_process, motion_levels[0], prompt, actions_given, generator)
    if on_step is not None:
        on_step(0, DenoisingState(motion, tokens, probabilities))
    for i in range(num_steps):
        k_c, k_d = motion_levels[i], symbol_levels[i]
        prediction = denoise(motion, tokens, k_c.expand(batch_size), k_d.expand(batch_size))
        if not whole_motion_given:
            next_k_c = motion_levels[i + 1]
            motion = motion_process.reverse_step(motion, prediction.motion, k_c, next_k_c, generator)
            motion = _give_actions(motion, motion_process, next_k_c, prompt, actions_given, generator)
        if symbol_process is not None and not all_tokens_given:
            before, logits = tokens, prediction.logits
            tokens = symbol_process.reverse_step(before, logits, k_d, symbol_levels[i + 1], generator)
            drawn = logits.float().softmax(dim=-1).gather(-1, tokens.clamp(max=logits.shape[-1] - 1)[..., None])
            probabilities = torch.where(tokens != before, drawn.squeeze(-1), probabilities)
        if on_step is not None:
            on_step(i + 1, DenoisingState(motion, tokens, probabilities))
    return DenoisingState(motion, tokens, probabilities)


def _actions_given(prompt: PlanPrompt) -> Tensor | None:
    """(B, H_c) bool, or None where no action is given."""
    if prompt.actions is None:
        return None
    if prompt.actions_given is None:
        return torch.ones(prompt.actions.shape[:2], dtype=torch.bool, device=prompt.actions.device)
    return prompt.actions_given


def _give_actions(
    motion: Tensor,
    process: GaussianProcess,
    level: Tensor,
    prompt: PlanPrompt,
    given: Tensor | None,
    generator: Generator | None,
) -> Tensor:
    """Put the prompt's actions, at the noise of the level, into a motion."""
    if given is None:
        return motion
    noisy = process.corrupt(prompt.actions, level.expand(len(motion)), generator).value
    return torch.where(given[..., None], noisy, motion)
