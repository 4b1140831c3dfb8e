"""Dataset or environment batch <-> what the planner sees."""

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import NormalizationMode, PipelineFeatureType, PolicyFeature
from lerobot.processor import (
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStepRegistry,
)
from lerobot.processor.factory import make_default_policy_processor_steps, make_policy_processor_pipelines
from torch import Tensor

from .configuration_hdp import OBS_SYMBOLIC_PLAN, HDPConfig
from .vocabulary import FREE, FREE_SYMBOL, PAD_ID

NARROWEST_RANGE = 0.1
"""What `widen_narrow_ranges` leaves of the widest range."""
RANGE_OF_CONSTANT = 1.0
"""What it takes for half of the range of an observation that never varies."""
BRIGHTEST = 2.0
"""Of an image in [0, 1], with room for what resizing and augmentation add."""


@ProcessorStepRegistry.register(name="hdp_observation_shapes")
@dataclass
class ObservationShapesProcessorStep(ObservationProcessorStep):
    """Refuse observations that are not those that the planner was trained on.

    Attributes:
        shapes: of each observation; None is any size. LeRobot stores what has one component as a number, of which
            nothing is said here.

    Raises:
        ValueError: an observation is missing, is no tensor, has another shape, or is an image of whole numbers or, on
            a CPU, far above 1.
    """

    shapes: dict[str, list[int | None]] = field(default_factory=dict)

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        for key, shape in self.shapes.items():
            if key not in observation:
                raise ValueError(f"the planner was trained on {key}, which is not observed here")
            if not isinstance(observation[key], Tensor):
                kind = type(observation[key]).__name__
                raise ValueError(f"{key} is a {kind}: make it a torch.Tensor, float32, which LeRobot's processors read")
            if len(shape) == len("chw"):
                _check_image(key, observation[key])
            found = list(observation[key].shape[-len(shape) :])
            fits = all(wanted in (None, size) for wanted, size in zip(shape, found, strict=False))
            if shape != [1] and not (fits and len(found) == len(shape)):
                raise ValueError(f"the planner was trained on {key} of shape {shape}, here it has {found}")
        return observation

    def get_config(self) -> dict[str, Any]:
        return {"shapes": self.shapes}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def _check_image(key: str, image: Tensor) -> None:
    remedy = "make it float32 in [0, 1], as image.float() / 255"
    if image.dtype == torch.uint8:
        raise ValueError(f"{key} is uint8: {remedy}")
    # On a GPU the host would wait for the answer at every training step.
    if image.device.type == "cpu" and image.numel() and (brightest := image.max().item()) > BRIGHTEST:
        raise ValueError(f"{key} has values of up to {brightest:g}: {remedy}")


@ProcessorStepRegistry.register(name="hdp_symbolic_plan")
@dataclass
class SymbolicPlanProcessorStep(ObservationProcessorStep):
    """Make `observation.symbolic_plan` what the planner expects: (B, symbolic_horizon) int64 token ids.

    Plans from a dataset are filled with PAD up to the planner's horizon. Prompts from an environment may hold FREE
    (-1), and one that ends with it is filled with it. A planner without symbols never sees the column.

    Attributes:
        symbolic_horizon: H_d; None: the planner models no symbols.
        vocabulary_size: m.

    Raises:
        ValueError: a plan that is empty, too long or, on a CPU, holds a token id that is no symbol's.
    """

    symbolic_horizon: int | None = None
    vocabulary_size: int = 0

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        plan = observation.pop(OBS_SYMBOLIC_PLAN, None)
        if plan is None or self.symbolic_horizon is None:
            return observation
        plan = torch.as_tensor(plan).long()  # LeRobot hands what an environment observes over as floats
        if plan.ndim == 1:  # one sample; or a batch of plans of one token, which LeRobot stores as numbers
            plan = plan.unsqueeze(1 if self.symbolic_horizon == 1 else 0)
        if not 0 < plan.shape[1] <= self.symbolic_horizon:
            raise ValueError(f"a plan has 1 to {self.symbolic_horizon} tokens, got {plan.shape[1]}")
        unknown = (plan < FREE_SYMBOL) | (plan >= self.vocabulary_size)
        # On a GPU the host would wait for the answer at every training step; its kernels check the ids themselves.
        if plan.device.type == "cpu" and unknown.any():
            raise ValueError(
                f"{OBS_SYMBOLIC_PLAN} holds the token id {plan[unknown][0].item()}, which is none of the "
                f"{self.vocabulary_size} symbols"
            )
        # What follows a whole plan is PAD; what follows a prompt that leaves its last token open is open, too.
        filling = torch.where(plan[:, -1:] < PAD_ID, FREE, PAD_ID).expand(-1, self.symbolic_horizon - plan.shape[1])
        observation[OBS_SYMBOLIC_PLAN] = torch.cat([plan, filling], dim=1)
        return observation

    def get_config(self) -> dict[str, Any]:
        return {"symbolic_horizon": self.symbolic_horizon, "vocabulary_size": self.vocabulary_size}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def make_hdp_pre_post_processors(
    config: HDPConfig, dataset_stats: dict[str, dict[str, Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]], PolicyProcessorPipeline[PolicyAction, PolicyAction]
]:
    """LeRobot's default processors, after a look at the observations, and the symbolic plan as token ids."""
    dataset_stats = {key: dict(bounds) for key, bounds in (dataset_stats or {}).items()}
    widen_narrow_ranges(config, dataset_stats)
    steps = make_default_policy_processor_steps(config, dataset_stats)
    shapes = {key: list(feature.shape) for key, feature in config.input_features.items()}
    if config.resize_shape is not None:
        shapes |= {key: [feature.shape[0], None, None] for key, feature in config.image_features.items()}
    symbolic_plan = SymbolicPlanProcessorStep(
        symbolic_horizon=config.symbolic_horizon if config.symbol_process else None,
        vocabulary_size=len(config.vocabulary or []),
    )
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            ObservationShapesProcessorStep(shapes),
            symbolic_plan,
            steps.to_device,
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )  # fmt: skip


def widen_narrow_ranges(config: HDPConfig, stats: dict[str, dict[str, Any]]) -> None:
    """Give each component of an observation at least a tenth of the range of that observation's widest, in place.

    Where plans begin, some components never vary, as the orientation of blocks that stand upright. Over all frames they
    have a tiny range, that of contacts; scaled by it to [-1, 1], a turn by a tenth of a degree would be far beyond all
    that the planner has seen. It takes the components of an observation to be in comparable units: metres and radians,
    but not metres and degrees. An observation of which nothing varies gets a range of one unit to each side.

    Args:
        config: says what is observed, and which of it is normalised by its range.
        stats: of a dataset; the `min` and `max` of observations are changed.
    """
    for key, feature in config.input_features.items():
        if config.normalization_mapping.get(feature.type.value) is not NormalizationMode.MIN_MAX or key not in stats:
            continue
        low, high = (np.asarray(stats[key][bound]) for bound in ("min", "max"))
        middle, half = (low + high) / 2, (high - low) / 2
        narrowest = NARROWEST_RANGE * half.max() or RANGE_OF_CONSTANT
        narrow = half < narrowest
        stats[key]["min"] = np.where(narrow, middle - narrowest, low)
        stats[key]["max"] = np.where(narrow, middle + narrowest, high)
        if half.max() == 0:
            logging.warning("%s is the same in all frames", key)
        elif (half < 0.99 * narrowest).any():  # not widened before
            logging.info(
                "%s: components %s vary by less than a tenth of the widest one's range, %.3g, and are normalised by a "
                "tenth of it. If they are in other units than it, put them into an observation of their own.",
                key, np.flatnonzero(narrow).tolist(), 2 * half.max(),
            )  # fmt: skip
