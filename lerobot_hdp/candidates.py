"""Choose among several plans that were drawn for the same observation."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from .denoiser import Denoise
from .processes import Corrupted, GaussianProcess, MaskedProcess

MOTION_LEVELS = (0.25, 0.5, 0.75)
"""Levels at which the motion is denoised again to score it."""
SYMBOL_WEIGHT = 1 / 30
"""Of the symbols' loss beside the motion's: the paper's lambda. Measured from 1/1000 to 1: next to no difference."""
PARTIAL_MOTION_CANDIDATES = 8
"""How many plans are drawn around a part of a motion, unless the caller says. The given part is shown with the noise of
each step, so that a plan may have taken its course before that part can be seen (Trippe et al. 2023, "Diffusion
probabilistic modeling of protein backbones in 3D for the motif-scaffolding problem"); such a plan scores low."""
NOISE_SEED = 0
"""`score_plans` has the same noise for every plan: candidates differ by what they are, not by their luck."""


@torch.no_grad()
def score_plans(
    denoise: Denoise,
    motion_process: GaussianProcess,
    symbol_process: MaskedProcess | None,
    motion: Tensor,
    tokens: Tensor | None,
) -> Tensor:
    """How likely plans are under the model, up to scale: (B,), more is better. It knows nothing of the task.

    By log p(A_c, A_d | O) = log p(A_c | O) + log p(A_d | A_c, O), with minus the training loss in place of each term:
    the motion's at MOTION_LEVELS with all symbols masked, and the symbols', all of them masked, beside the clean
    motion. Four calls of the denoiser.

    Args:
        denoise: the denoiser, with B observations.
        motion_process, symbol_process: the processes; without the latter the motion alone is scored.
        motion: (B, H_c, D) normalised actions.
        tokens: (B, H_d) token ids.
    """
    generator = Generator(motion.device).manual_seed(NOISE_SEED)
    one = torch.ones(len(motion), device=motion.device)
    symbols = None
    if symbol_process and tokens is not None:
        symbols = Corrupted(symbol_process.prior(tuple(tokens.shape), tokens.device), tokens, one)
    hidden = symbols.value if symbols else None

    loss = torch.zeros_like(one)
    for level in MOTION_LEVELS:
        noise = torch.randn(motion.shape[1:], device=motion.device, generator=generator).expand_as(motion)
        noisy = motion_process.add_noise(motion, noise, level * one)
        prediction = denoise(noisy.value, hidden, level * one, one)
        loss += motion_process.loss(prediction.motion, noisy) / len(MOTION_LEVELS)
    if symbol_process and symbols:
        prediction = denoise(motion, hidden, 0 * one, one)
        assert prediction.symbols is not None
        loss += SYMBOL_WEIGHT * symbol_process.cross_entropy(prediction.symbols, symbols)
    return -loss


def best_candidates(scores: Tensor, complaints: Sequence[Sequence[int]] | None = None) -> Tensor:
    """The number of the best candidate of each sample: (B,).

    Args:
        scores: (B, k) from `score_plans`.
        complaints: B times k, how many there are about each candidate; those with the fewest come first.
    """
    if complaints is not None:
        counts = torch.tensor(complaints, device=scores.device)
        scores = scores.masked_fill(counts > counts.min(dim=1, keepdim=True).values, -torch.inf)
    return scores.argmax(dim=1)
