"""The planners on two levels: sub-goals, and the segments of the motion between them."""

import math
from dataclasses import dataclass
from typing import ClassVar

from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig

from ..configuration_hdp import HDPConfig


@PreTrainedConfig.register_subclass("hd")
@dataclass
class HierarchicalDiffuserConfig(HDPConfig):
    """Hierarchical Diffuser (Chen et al. 2024, "Simple Hierarchical Planning with Diffusion").

    The high level is a diffuser of sub-goals: every K-th observation of the demonstration. The low level is a diffuser
    of segments: the K actions from one sub-goal to the next. It is trained on the demonstration's own sub-goals, and
    plans between those of the high level, all segments in one batch.

    Where this differs from their paper: neither level is guided by a value function, as there is none; segments hold
    actions only, like all planners here, not the states between sub-goals; what a level is conditioned on (the
    observation; a segment's two sub-goals) is attended to, like HDP's observation, not in-painted. docs/planners.md has
    the rest.

    Attributes:
        subgoal_interval: K. None: the square root of the horizon, so that both levels are about equally long.
    """

    symbol_process = None
    takes_images = False
    coupled: ClassVar[bool] = False
    """Whether both levels are denoised together."""

    planned_modalities = ("ACTION", "STATE", "ENV")

    subgoal_interval: int | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.subgoal_interval is None and self.horizon is not None:
            self.subgoal_interval = round(math.sqrt(self.horizon))
        if self.subgoal_interval is not None and self.subgoal_interval < 1:
            raise ParsingError(f"subgoal_interval must be at least 1, got {self.subgoal_interval}")

    @property
    def num_segments(self) -> int:
        """The last segment ends at or after the horizon; there, LeRobot repeats an episode's last frame."""
        return math.ceil(self._known_horizon / self.subgoal_interval)

    @property
    def observation_delta_indices(self) -> list[int]:
        """The observation now, and the sub-goals: LeRobot loads just these frames."""
        return [segment * self.subgoal_interval for segment in range(self.num_segments + 1)]

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.num_segments * self.subgoal_interval))


@PreTrainedConfig.register_subclass("chd")
@dataclass
class CoupledHierarchicalDiffuserConfig(HierarchicalDiffuserConfig):
    """Coupled Hierarchical Diffuser (Hao et al. 2025, "CHD: Coupled Hierarchical Diffusion for Long-Horizon Tasks").

    Sub-goals and segments are one diffusion process with one step k: at every step the low level is conditioned on the
    high level's current sub-goals, and the high level on the low level's current segments, so that sub-goals correct
    themselves while they are sampled.

    After their abstract, in which the low level's feedback passes through a classifier that both levels share. There is
    nothing to train one on here, so the feedback is learned: the high level's denoiser attends to a token of each noisy
    segment. The choices are ours, see docs/planners.md.
    """

    coupled = True
