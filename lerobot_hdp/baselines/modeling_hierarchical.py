"""Hierarchical Diffuser and Coupled Hierarchical Diffuser as LeRobot policies.

Shapes: B samples, M segments of K actions of size D, sub-goals of size S. A sub-goal is all that is observed, in one
vector.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from ..denoiser import Denoiser, Prediction
from ..encoders import StateEncoder
from ..modeling_hdp import HDPPolicy
from ..plan import Plan, PlanPrompt
from ..sampling import DenoisingState, Stream, sample_plan
from ..training import TrainingNoise, read_losses
from .configuration_hierarchical import CoupledHierarchicalDiffuserConfig, HierarchicalDiffuserConfig


class HierarchicalPlanner(nn.Module):
    """Two denoisers, of sub-goals and of segments, and the encoders of what each is conditioned on."""

    image_encoder = None

    def __init__(self, config: HierarchicalDiffuserConfig):
        super().__init__()
        observed = config.observation_token_sizes
        segment_size = config.subgoal_interval * config.action_feature.shape[0]

        def encoder(token_sizes: list[int]) -> StateEncoder:
            return StateEncoder(
                ["state"], token_sizes, config.width, config.observation_weight_std, config.state_encoder_hidden_dim
            )

        def denoiser(value_size: int, horizon: int, condition_tokens: int) -> Denoiser:
            return Denoiser(
                action_dim=value_size,
                horizon=horizon,
                observation_tokens=condition_tokens,
                num_train_timesteps=config.num_train_timesteps,
                vocabulary_size=0,
                symbolic_horizon=0,
                symbol_states=0,
                shared_level=config.shared_level,
                num_layers=config.num_layers,
                num_heads=config.num_heads,
                width=config.width,
                dropout=config.dropout,
                rotary=config.rotary,
            )

        self.encode_observation = encoder(observed)
        self.encode_ends = encoder([*observed, *observed])
        self.encode_segments = encoder([segment_size] * config.num_segments) if config.coupled else None
        high_tokens = len(observed) + (config.num_segments if config.coupled else 0)
        self.high = denoiser(sum(observed), config.num_segments, high_tokens)
        self.low = denoiser(config.action_feature.shape[0], config.subgoal_interval, 2 * len(observed))

    def denoise_subgoals(self, subgoals: Tensor, state: Tensor, level: Tensor, segments: Tensor | None) -> Tensor:
        """The high level's prediction.

        Args:
            subgoals: (B, M, S) noisy sub-goals.
            state: (B, S) what is observed now.
            level: (B,).
            segments: (B M, K, D) noisy segments, where the levels are coupled.
        """
        condition = self.encode_observation({"state": state})
        if self.encode_segments is not None:
            feedback = self.encode_segments({"state": segments.reshape(len(state), -1)})
            condition = torch.cat([condition, feedback], dim=1)
        return self.high(subgoals, None, condition, level, level).motion

    def denoise_segments(self, segments: Tensor, state: Tensor, subgoals: Tensor, level: Tensor) -> Tensor:
        """The low level's prediction.

        Args:
            segments: (B M, K, D) noisy segments.
            state: (B, S) what is observed now, where the first segment begins.
            subgoals: (B, M, S) where each segment ends and the next one begins.
            level: (B M,).
        """
        points = torch.cat([state[:, None], subgoals], dim=1)
        ends = torch.cat([points[:, :-1], points[:, 1:]], dim=-1).flatten(0, 1)
        return self.low(segments, None, self.encode_ends({"state": ends}), level, level).motion

    @property
    def denoisers(self) -> list[Denoiser]:
        return [self.high, self.low]


class HierarchicalDiffuserPolicy(HDPPolicy):
    """Plans sub-goals, then the segments between them."""

    config_class = HierarchicalDiffuserConfig
    name = "hd"
    can_score = False

    def _make_planner(self) -> HierarchicalPlanner:
        return HierarchicalPlanner(self.config)

    def _encode_once(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """As it is: each level has encoders of its own, of what it is conditioned on."""
        return batch

    def _states(self, batch: dict[str, Tensor]) -> Tensor:
        """What is observed now and, in training, the sub-goals: (B, 1 or 1 + M, S)."""
        sizes = {key: math.prod(feature.shape) for key, feature in self.config.input_features.items()}
        return torch.cat([batch[key].reshape(len(batch[key]), -1, size) for key, size in sizes.items()], dim=-1)

    def _to_segments(self, motion: Tensor) -> Tensor:
        """(B, M K, ...) -> (B M, K, ...)."""
        return motion.unflatten(1, (self.config.num_segments, self.config.subgoal_interval)).flatten(0, 1)

    def _to_motion(self, segments: Tensor) -> Tensor:
        """(B M, K, D) -> (B, H_c, D)."""
        return segments.unflatten(0, (-1, self.config.num_segments)).flatten(1, 2)[:, : self.config.horizon]

    def _segments_prompt(self, prompt: PlanPrompt | None) -> PlanPrompt:
        """The given part of the motion, cut into segments."""
        if prompt is None or prompt.actions is None:
            return PlanPrompt()
        missing = self.config.num_segments * self.config.subgoal_interval - self.config.horizon
        given = F.pad(prompt.actions_mask.expand_as(prompt.actions[..., :1]), (0, 0, 0, missing))
        actions = F.pad(prompt.actions, (0, 0, 0, missing))
        return PlanPrompt(actions=self._to_segments(actions), actions_given=self._to_segments(given)[..., 0])

    def _loss(
        self, batch: dict[str, Tensor], network: HierarchicalPlanner, noise: TrainingNoise
    ) -> tuple[Tensor, dict[str, float]]:
        """Each level's squared error; the low level is trained on the demonstration's own sub-goals."""
        process = self.motion_process
        states, segments = self._states(batch), self._to_segments(self._motion(batch))
        state, subgoals = states[:, 0], states[:, 1:]

        noisy_subgoals = noise.corrupt(process, subgoals, noise.level(process, len(subgoals)))
        prediction = network.denoise_subgoals(noisy_subgoals.value, state, noisy_subgoals.level, None)
        subgoal_loss = process.loss(prediction, noisy_subgoals).mean()

        noisy_segments = noise.corrupt(process, segments, noise.level(process, len(segments)))
        prediction = network.denoise_segments(noisy_segments.value, state, subgoals, noisy_segments.level)
        motion_loss = process.loss(prediction, noisy_segments).mean()
        return subgoal_loss + motion_loss, read_losses({"subgoal_loss": subgoal_loss, "motion_loss": motion_loss})

    def _sample(
        self,
        batch: dict[str, Tensor],
        prompt: PlanPrompt | None,
        generator: Generator | None,
        on_step: Callable[[int, DenoisingState], None] | None,
    ) -> Plan:
        """`on_step` sees the steps of the low level."""
        network, state = self._planning_network, self._states(batch)[:, 0]
        batch_size, _, action_dim = self._motion_shape(batch)
        config, device = self.config, state.device

        def sample(denoise: Callable[[Tensor, Tensor], Tensor], shape: tuple[int, int, int], **kwargs) -> Tensor:
            def denoise_alone(value: Tensor, _: None, level: Tensor, __: Tensor) -> Prediction:
                with self._autocast():
                    return Prediction(denoise(value, level).float(), None)

            process, steps = self.motion_process, self.config.num_inference_steps
            return sample_plan(
                denoise_alone,
                process,
                None,
                shape,
                symbolic_horizon=0,
                device=device,
                num_steps=steps,
                generator=generator,
                **kwargs,
            ).motion

        subgoals = sample(
            lambda value, level: network.denoise_subgoals(value, state, level, None),
            (batch_size, config.num_segments, state.shape[1]),
        )
        segments = sample(
            lambda value, level: network.denoise_segments(value, state, subgoals, level),
            (batch_size * config.num_segments, config.subgoal_interval, action_dim),
            prompt=self._segments_prompt(prompt),
            on_step=None if on_step is None else lambda step, low: on_step(step, self._show(low.motion)),
        )
        return Plan(*self._show(segments))

    def _show(self, segments: Tensor) -> DenoisingState:
        """Segments as a plan without symbols."""
        motion = self._to_motion(segments)
        return DenoisingState(motion, None, torch.zeros(len(motion), 0, device=motion.device))


class CoupledHierarchicalDiffuserPolicy(HierarchicalDiffuserPolicy):
    """Denoises sub-goals and segments together, each seeing the other."""

    config_class = CoupledHierarchicalDiffuserConfig
    name = "chd"

    def _loss(
        self, batch: dict[str, Tensor], network: HierarchicalPlanner, noise: TrainingNoise
    ) -> tuple[Tensor, dict[str, float]]:
        """Each level's squared error, at the same step k, each conditioned on the other as in planning."""
        process = self.motion_process
        states, segments = self._states(batch), self._to_segments(self._motion(batch))
        state, subgoals = states[:, 0], states[:, 1:]
        level = noise.level(process, len(state))
        noisy_subgoals = noise.corrupt(process, subgoals, level)
        noisy_segments = noise.corrupt(process, segments, level.repeat_interleave(self.config.num_segments))
        high, low = self._denoise_both(network, noisy_subgoals.value, noisy_segments.value, state, level)
        subgoal_loss = process.loss(high, noisy_subgoals).mean()
        motion_loss = process.loss(low, noisy_segments).mean()
        return subgoal_loss + motion_loss, read_losses({"subgoal_loss": subgoal_loss, "motion_loss": motion_loss})

    def _denoise_both(
        self, network: HierarchicalPlanner, subgoals: Tensor, segments: Tensor, state: Tensor, level: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The predictions of both levels.

        The high level sees the noisy segments, the low level the sub-goals that the high level now has in mind: its
        prediction of the clean ones. The low level's loss does not train the high level.

        Args:
            network: the planner.
            subgoals: (B, M, S) noisy sub-goals.
            segments: (B M, K, D) noisy segments.
            state: (B, S) what is observed now.
            level: (B,) of both.
        """
        # A copy: a CUDA graph's output is overwritten when the next one runs.
        high = network.denoise_subgoals(subgoals, state, level, segments).clone()
        current = self.motion_process.predicted_sample(subgoals, high.detach().float(), level)
        low = network.denoise_segments(segments, state, current, level.repeat_interleave(self.config.num_segments))
        return high, low

    def _sample(
        self,
        batch: dict[str, Tensor],
        prompt: PlanPrompt | None,
        generator: Generator | None,
        on_step: Callable[[int, DenoisingState], None] | None,
    ) -> Plan:
        network, state = self._planning_network, self._states(batch)[:, 0]
        batch_size, _, action_dim = self._motion_shape(batch)
        config, process, device = self.config, self.motion_process, state.device
        how: dict[str, Any] = {"device": device, "shared_level": True, "generator": generator}
        steps, given = config.num_inference_steps, self._segments_prompt(prompt)
        subgoals = Stream.start(process, (batch_size, config.num_segments, state.shape[1]), steps, **how)
        shape = batch_size * config.num_segments, config.subgoal_interval, action_dim
        segments = Stream.start(process, shape, steps, given.actions, given.actions_mask, **how)
        if on_step is not None:
            on_step(0, self._show(segments.value))
        for i in range(steps):
            with self._autocast():
                high, low = self._denoise_both(network, subgoals.value, segments.value, state, subgoals.level(i))
            subgoals.advance(i, high.float(), generator)
            segments.advance(i, low.float(), generator)
            if on_step is not None:
                on_step(i + 1, self._show(segments.value))
        return Plan(*self._show(segments.value))
