"""The Gaussian process over the motion (paper, Eq. 1-3): DDPM, Ho et al. 2020; its sampler also covers DDIM, Song
et al. 2021.

With alpha_bar(k) falling from 1 (clean) to about 0 over N training steps:

    Eq. 1   q(A^k | A^0) = N(sqrt(alpha_bar(k)) A^0, (1 - alpha_bar(k)) I)
    Eq. 2   L = || target - prediction ||^2, where the target is the noise (the paper), the clean motion, or v
    Eq. 3   p(A^s | A^k) = q(A^s | A^k, A^0 = predicted clean motion), s < k
"""

import math

import torch
from torch import Generator, Tensor

from .base import Corrupted, expand_to

PREDICTION_TYPES = ("epsilon", "sample", "v_prediction")
MAX_BETA = 0.999


def squared_cosine_alpha_bar(num_train_timesteps: int) -> Tensor:
    """alpha_bar at step 0 (clean) to N, of Nichol & Dhariwal's squared cosine schedule: (N + 1,)."""

    def f(t: float) -> float:
        return math.cos((t + 0.008) / 1.008 * math.pi / 2) ** 2

    n = num_train_timesteps
    betas = [min(1 - f((i + 1) / n) / f(i / n), MAX_BETA) for i in range(n)]
    return torch.cat([torch.ones(1), 1 - torch.tensor(betas, dtype=torch.float64)]).cumprod(dim=0).float()


class GaussianProcess:
    """DDPM over (B, H, D) values that are normalised to [-1, 1].

    Level k in [0, 1] stands for step round(k N) of the N training steps.

    Args:
        num_train_timesteps: N.
        prediction_type: what the denoiser predicts: the noise, the clean sample, or v = sqrt(alpha_bar) noise -
            sqrt(1 - alpha_bar) sample (Salimans & Ho 2022).
        eta: noise of a reverse step: 1 is DDPM's posterior variance, 0 the deterministic DDIM.
    """

    def __init__(self, num_train_timesteps: int, prediction_type: str, eta: float = 1.0):
        if prediction_type not in PREDICTION_TYPES:
            raise ValueError(f"prediction_type must be one of {PREDICTION_TYPES}, got {prediction_type!r}")
        self.num_train_timesteps = num_train_timesteps
        self.prediction_type = prediction_type
        self.eta = eta
        self._alpha_bar = squared_cosine_alpha_bar(num_train_timesteps)

    def alpha_bar(self, level: Tensor) -> Tensor:
        """alpha_bar(k), with the shape and the device of the level."""
        if self._alpha_bar.device != level.device:
            self._alpha_bar = self._alpha_bar.to(level.device)
        return self._alpha_bar[(level * self.num_train_timesteps).round().long()]

    def sample_level(self, batch_size: int, device: torch.device, generator: Generator | None = None) -> Tensor:
        step = torch.randint(1, self.num_train_timesteps + 1, (batch_size,), device=device, generator=generator)
        return step / self.num_train_timesteps

    def corrupt(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Corrupted:
        noise = torch.randn(clean.shape, device=clean.device, dtype=clean.dtype, generator=generator)
        return self.add_noise(clean, noise, level)

    def add_noise(self, clean: Tensor, noise: Tensor, level: Tensor) -> Corrupted:
        """Eq. 1, with standard normal noise that is given."""
        signal, scale = self._signal_and_noise_scale(level, clean)
        match self.prediction_type:
            case "epsilon":
                target = noise
            case "sample":
                target = clean
            case _:  # v_prediction
                target = signal * noise - scale * clean
        return Corrupted(value=signal * clean + scale * noise, target=target, level=level)

    def loss(self, prediction: Tensor, corrupted: Corrupted) -> Tensor:
        """Mean squared error of each sample (Eq. 2): (B,)."""
        return (prediction.float() - corrupted.target.float()).square().flatten(1).mean(dim=1)

    def prior(self, shape: tuple[int, ...], device: torch.device, generator: Generator | None = None) -> Tensor:
        return torch.randn(shape, device=device, generator=generator)

    def show_given(self, clean: Tensor, level: Tensor, generator: Generator | None = None) -> Tensor:
        """With the noise of the level, as the rest of the motion has it."""
        return self.corrupt(clean, level, generator).value

    def levels(self, num_steps: int) -> Tensor:
        """Evenly spaced training steps.

        Raises:
            ValueError: there are not so many.
        """
        if not 1 <= num_steps <= self.num_train_timesteps:
            raise ValueError(f"a plan takes 1 to {self.num_train_timesteps} network calls, got {num_steps}")
        steps = torch.linspace(self.num_train_timesteps, 0, num_steps + 1).round()
        return steps / self.num_train_timesteps

    def told_level(self, value: Tensor, level: Tensor) -> Tensor:
        return level.expand(len(value))

    def predicted_sample(self, value: Tensor, prediction: Tensor, level: Tensor) -> Tensor:
        """The clean motion that a prediction stands for, clipped to [-1, 1]: like `value`."""
        signal, scale = self._signal_and_noise_scale(level, value)
        match self.prediction_type:
            case "epsilon":
                sample = (value - scale * prediction) / signal
            case "sample":
                sample = prediction
            case _:  # v_prediction
                sample = signal * value - scale * prediction
        return sample.clamp(-1.0, 1.0)

    def reverse_step(
        self, value: Tensor, prediction: Tensor, level: Tensor, next_level: Tensor, generator: Generator | None = None
    ) -> Tensor:
        """Eq. 3, for any two levels (Song et al. 2021, Eq. 12 and 16)."""
        sample = self.predicted_sample(value, prediction, level)
        signal, scale = self._signal_and_noise_scale(level, value)
        next_signal, next_scale = self._signal_and_noise_scale(next_level, value)
        noise_direction = (value - signal * sample) / scale
        sigma = self.eta * (next_scale / scale) * (1 - (signal / next_signal).square()).sqrt()
        mean = next_signal * sample + (next_scale.square() - sigma.square()).clamp(min=0).sqrt() * noise_direction
        noise = torch.randn(value.shape, device=value.device, dtype=value.dtype, generator=generator)
        return mean + sigma * noise

    def _signal_and_noise_scale(self, level: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """sqrt(alpha_bar) and sqrt(1 - alpha_bar), broadcastable against the value."""
        alpha_bar = expand_to(self.alpha_bar(level), value)
        return alpha_bar.sqrt(), (1 - alpha_bar).sqrt()
