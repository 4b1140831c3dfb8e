"""The masked process over the symbols (paper, Eq. 4-6): MD4, Shi et al. 2024.

Each token is masked independently with probability k, so that alpha(k) = 1 - k:

    Eq. 4   q(A^k | A^0): a token is e_m with probability k, else what it was
    Eq. 5   L = sum over masked positions of w(k) cross_entropy, with w(k) = -alpha'(k) / (1 - alpha(k)) = 1 / k
    Eq. 6   p(A^s | A^k): a masked token is revealed with probability gamma = (alpha(s) - alpha(k)) / (1 - alpha(k))
            = (k - s) / k, its value drawn from the predicted categorical; what is revealed stays

Eq. 6 draws the tokens of one step independently of each other, so that few steps make plans that contradict themselves.
With a confidence threshold, a step reveals only what follows from what is there already: tokens whose drawn value is
more probable than the threshold, and the surest one in any case (parallel decoding of Wu et al. 2025, "Fast-dLLM").

A schedule k(u) of time u, uniform in (0, 1], is what training draws k from. The loss stays the same integral (MD4,
section 3): the weight of Eq. 5 becomes k'(u) / k, which is 1 / k with the linear schedule k = u, and
pi/2 sqrt(1 - k^2) / k with MD4's cosine schedule k = cos(pi/2 (1 - u)).
"""

import math

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from .base import Corrupted, expand_to

MASK_SCHEDULES = ("linear", "cosine")
MIN_LEVEL = 1e-3
"""Training keeps k off 0, where the weight 1 / k has no bound."""


class MaskedProcess:
    """MD4 over (B, H) token ids.

    Args:
        vocabulary_size: m, the number of symbols; the mask e_m has the id m.
        confidence_threshold: reveal tokens by their probability; None: by Eq. 6.
        schedule: `linear` or `cosine`, how often training draws each level.
    """

    def __init__(self, vocabulary_size: int, confidence_threshold: float | None = None, schedule: str = "linear"):
        self.confidence_threshold = confidence_threshold
        self.schedule = schedule
        self.vocabulary_size = vocabulary_size
        self.mask_id = vocabulary_size
        self.num_states = vocabulary_size + 1

    def sample_level(self, batch_size: int, device: torch.device, generator: Generator | None = None) -> Tensor:
        """Low-discrepancy sampling (Kingma et al. 2021): one level in each of B equal parts of (0, 1]."""
        offsets = torch.randperm(batch_size, device=device, generator=generator)
        uniform = (torch.rand(1, device=device, generator=generator) + offsets) / batch_size
        if self.schedule == "cosine":
            uniform = torch.sin(math.pi / 2 * uniform)
        return MIN_LEVEL + (1 - MIN_LEVEL) * uniform

    def corrupt(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Corrupted:
        uniform = torch.rand(clean.shape, device=clean.device, generator=generator)
        masked = uniform < expand_to(level, clean)
        return Corrupted(value=clean.masked_fill(masked, self.mask_id), target=clean, level=level)

    def loss(self, prediction: Tensor, corrupted: Corrupted) -> Tensor:
        """Weighted cross-entropy of each sample (Eq. 5): (B,).

        Args:
            prediction: (B, H, m) logits.
        """
        k = corrupted.level
        slope = math.pi / 2 * (1 - k.square()).clamp(min=0).sqrt() if self.schedule == "cosine" else 1.0  # k'(u)
        return slope / k * self.cross_entropy(prediction, corrupted)

    def cross_entropy(self, prediction: Tensor, corrupted: Corrupted) -> Tensor:
        """Sum over the masked positions of each sample: (B,). For its arguments see `loss`."""
        each = F.cross_entropy(prediction.float().transpose(1, 2), corrupted.target, reduction="none")
        return (each * (corrupted.value == self.mask_id)).sum(dim=1)

    def prior(self, shape: tuple[int, ...], device: torch.device, generator: Generator | None = None) -> Tensor:
        return torch.full(shape, self.mask_id, dtype=torch.int64, device=device)

    def show_given(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Tensor:
        """Clean: in training, too, some symbols are clean at every level below 1."""
        return clean

    def tokens(self, value: Tensor) -> Tensor:
        return value

    def levels(self, num_steps: int) -> Tensor:
        """cos(pi i / 2N): few tokens are revealed at first, many at the end (Chang et al. 2022)."""
        levels = torch.cos(torch.arange(num_steps + 1) * (math.pi / (2 * num_steps)))
        levels[-1] = 0.0
        return levels

    def told_level(self, value: Tensor, level: Tensor) -> Tensor:
        """The scheduled level; with a confidence threshold, the fraction of tokens that are still masked."""
        if self.confidence_threshold is None:
            return level.expand(len(value))
        return (value == self.mask_id).float().mean(dim=1)

    def reverse_step(
        self, value: Tensor, prediction: Tensor, level: Tensor, next_level: Tensor, generator: Generator | None = None
    ) -> Tensor:
        """Eq. 6, or by confidence; then the levels count only in that level 0 reveals everything."""
        probabilities = prediction.float().softmax(dim=-1)
        masked = value == self.mask_id
        if self.confidence_threshold is None:
            uniform = torch.rand(value.shape, device=value.device, generator=generator)
            drawn = _draw(probabilities, generator)
            return torch.where(masked & (uniform < (level - next_level) / level), drawn, value)
        drawn = _draw(probabilities, generator)
        confidence = probabilities.gather(-1, drawn[..., None]).squeeze(-1).masked_fill(~masked, -1.0)
        surest = confidence == confidence.amax(dim=1, keepdim=True)
        revealed = masked & (surest | (confidence > self.confidence_threshold) | (next_level == 0))
        return torch.where(revealed, drawn, value)


def _draw(probabilities: Tensor, generator: Generator | None) -> Tensor:
    """A token from each categorical distribution: (B, H, m) -> (B, H).

    The symbol whose exponential clock, of rate p, rings first; `torch.multinomial` draws so too, but first makes the
    host wait for the device, to check the probabilities.
    """
    return (probabilities / torch.empty_like(probabilities).exponential_(generator=generator)).argmax(dim=-1)
