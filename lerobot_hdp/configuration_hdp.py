"""Everything that can be set about the planner."""

import logging
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, ClassVar

from draccus.utils import ParsingError
from lerobot.configs import NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_PREFIX, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from torchvision.models import get_model_weights

from .optimizer import OPTIMIZERS, FusedAdamWConfig, MuonAdamWConfig
from .precision import bfloat16_is_fast
from .processes.gaussian import PREDICTION_TYPES
from .processes.masked import MASK_SCHEDULES
from .prompt import encode_prompt
from .vocabulary import Vocabulary

OBS_SYMBOLIC_PLAN = f"{OBS_PREFIX}symbolic_plan"
"""Dataset column with the plan's token ids; from an environment, the plan's prompt. It has this name because LeRobot
keeps only `observation.*` columns."""

VISION_BACKBONES = ["resnet18", "resnet34", "resnet50", "resnet101", "resnet152"]
BACKBONE_STRIDE = 32
"""Pixels from one cell of its feature maps to the next."""
RGB = 3
"""Channels of an image."""
NARROWEST_WIDTH = 4
"""Two sines and two cosines of a diffusion step."""
SAMPLERS = ["ddpm", "ddim", "confidence"]

AT_LEAST_1 = ["num_layers", "num_heads", "width", "num_train_timesteps", "horizon", "symbolic_horizon"]
AT_LEAST_1 += ["n_action_steps", "num_inference_steps", "num_candidates", "spatial_softmax_num_keypoints"]

PRESETS: dict[str, dict[str, Any]] = {
    # What measures best.
    "default": {
        "prediction_type": "sample",
        "dropout": 0.0,
        "rotary": True,
        "object_tokens": True,
        "observation_weight_std": 0.5,
        "symbol_loss_weight": 1 / 300,
        "optimizer_type": "muon",
        "optimizer_lr": 1e-3,
        "scheduler_warmup_steps": 100,
        "sampler": "confidence",
        "symbol_lead": 0.5,
        "num_inference_steps": 10,
    },
    # The paper's values (Table "Transformer architecture hyperparameters" and those of Diffusion Policy, on which
    # it builds). Its symbolic horizon is longer than a plan needs: set `symbolic_horizon` to the table's H_d.
    "paper": {
        "prediction_type": "epsilon",
        "dropout": 0.3,
        "rotary": False,
        "object_tokens": False,
        "observation_weight_std": 0.02,
        "symbol_loss_weight": 1 / 30,
        "optimizer_type": "adamw",
        "optimizer_lr": 1e-4,
        "scheduler_warmup_steps": 1000,
        "sampler": "ddpm",
        "symbol_lead": 0.0,
    },
}
"""Values of the fields that are None until a preset fills them."""


@PreTrainedConfig.register_subclass("hdp")
@dataclass
class HDPConfig(PreTrainedConfig):
    """Configuration of the Hybrid Diffusion Planner.

    What the planner needs to know of the data comes from the dataset: sizes, vocabulary, normalisation. `hdp-train`
    looks up the horizon, too; to `lerobot-train` it has to be said, which asks for it before it opens the dataset.

    Attributes:
        preset: `default` (measures best) or `paper` (the paper's values). It fills the fields below that are None;
            what is set explicitly stays. A checkpoint has all of them set: there it changes nothing.

        horizon: number of actions in a plan (H_c): the length of the dataset's longest episode, for which None stands
            with `hdp-train`.
        symbolic_horizon: number of tokens in a plan (H_d). None: that of the dataset. Longer: filled with PAD.
        n_action_steps: actions that are executed before the next plan is made, with `plan_from=any_frame`. None: the
            whole plan, open loop.
        plan_from: `episode_start` trains on the whole plan at the first frame of each episode, `any_frame` on what
            remains of the plan at any frame; both hold the last action where an episode ends before the plan does.
            With `episode_start`, `lerobot-train` leaves out episodes shorter than the horizon; `hdp-train` does not.
        vocabulary: the symbols, PAD first; read from the dataset.

        num_layers, num_heads, width, dropout: the transformer; `width` is the size of a token.
        rotary: rotary position embedding in self-attention, beside the learned vectors of the positions. It tells the
            symbols which part of the motion is theirs.
        object_tokens: True makes a condition token of each object in `observation.environment_state` (its components
            are named `object.component` in the dataset) and one of each other observation, such as an image; False
            makes one of all.
        observation_token_sizes: how many numbers become each condition token; follows from the dataset.
        state_encoder_hidden_dim: hidden units of the MLP that makes a condition token; 0: a linear layer makes it.
        observation_weight_std: size of the initial weights that the observations meet first. Small ones are Diffusion
            Policy's; with them, fine differences in position are learned late.
        vision_backbone, pretrained_backbone_weights, spatial_softmax_num_keypoints, resize_shape: the encoder of each
            camera's images, that of LeRobot's `diffusion` policy, without its crops: a ResNet, torchvision's weights to
            start from (such as `ResNet18_Weights.IMAGENET1K_V1`; None: it is trained from scratch), the number of
            keypoints, and the size (height, width) to which images of any size are resized before, None: not at all.
        num_train_timesteps: N, steps of the Gaussian process.
        prediction_type: what is predicted of the motion: `epsilon` (the noise), `sample` (the clean motion) or
            `v_prediction`.
        symbol_loss_weight: lambda, weight of the symbols' loss beside the motion's. The paper's 1/30 balances it
            against the error of the noise; that of the clean motion is about ten times smaller.
        mask_schedule: how often training draws each level of masking: `linear`, all alike, or `cosine`, high ones more
            often and with less weight.
        lead_share: share of the training samples whose motion is pure noise beside symbols at any level, as it is while
            the symbols lead (`symbol_lead`). There the planner decides which of several plans it makes, with nothing to
            go by but the observation; independent levels show it next to no such samples. Used with 4,000
            demonstrations; with few, the planner may learn by heart which plan belongs to which start.
        observation_noise: standard deviation, in metres or what else they are in, of noise that training adds to the
            poses in `observation.environment_state` beside a motion of pure noise, and less the clearer the motion is
            (conditioning augmentation: Ho et al. 2022, "Cascaded Diffusion Models"). Where the plan is decided, starts
            then look alike that differ by less, so that the planner cannot learn by heart which of a few
            demonstrations belongs to which; where the motion takes shape, it sees the poses as they are.
        ema_power, ema_max_decay: the weights that plan are an exponential moving average with the decay
            min(1 - (1 + update)^-ema_power, ema_max_decay), as in Diffusion Policy. `ema_max_decay` 0 switches it off.

        sampler: how a plan is drawn. `ddpm` is the paper's: noise in every step of the motion, symbols revealed at
            random. `ddim` draws the motion's noise at the start only. `confidence` does so too, and reveals symbols as
            soon as the planner is sure of them, which needs far fewer steps.
        confidence_threshold: how probable a symbol must be for the `confidence` sampler to reveal it. What a step
            reveals is drawn independently, so that a low threshold makes plans that contradict themselves.
        symbol_lead: share of the network calls in which the symbols are denoised beside a motion that is still pure
            noise. Without a lead, few steps let the motion choose a plan of its own before the symbols have made
            up theirs. There is none where a part of the motion is given, or all symbols of a whole batch.
        num_inference_steps: network calls for a plan (of HD and CHD for each level); N where the preset says nothing
            else.
        prompt: a part of every plan, in words (prompt.py, docs/conditioning.md). None: what the environment asks for.
        num_candidates: plans that are drawn for each observation, of which the most likely is executed.

        compile_model, compile_mode: run the denoiser through `torch.compile`.
        dtype: `float32`, or `bfloat16` for autocast: of all in training, of the denoiser in planning. A CPU that has no
            instructions for it computes in float32.

        action_feature_names: of the actions' components, read from the dataset: `lerobot-rollout` puts them into the
            robot's order.

        optimizer_type: `muon` updates the matrices between hidden layers by Muon and the rest by AdamW (optimizer.py),
            `adamw` all by AdamW.
        optimizer_*, scheduler_*: of these, with a linear warm-up and a cosine decay to the last step. The preset's
            learning rate is one for the network that is the default; smaller ones, as in `configs/`, learn faster with
            3e-3, which was too much for it in arranging (docs/tasks/xarm_arrange_blocks.md).
            `optimizer_lr_backbone`: of the images' encoders, updated by AdamW, whose `optimizer_betas` and
            `optimizer_eps` are; `optimizer_momentum`: of Muon; `optimizer_fused`: AdamW updates all parameters in one
            kernel; None: on CUDA.

    Raises:
        ParsingError: a value that cannot be. It is draccus' own error, because LeRobot's commands hide the message of
            a ValueError behind "Couldn't instantiate class".
    """

    symbol_process: ClassVar[str | None] = "masked"
    """How symbols are corrupted: `masked` tokens, `gaussian` noise on one-hot vectors, None: there are none."""
    shared_level: ClassVar[bool] = False
    """Whether motion and symbols are always corrupted equally strongly (k_d = k_c), or independently."""

    takes_images: ClassVar[bool] = True
    """Whether images can be observed. Those of the dataset are, if `input_features` does not choose."""

    planned_modalities: ClassVar[tuple[str, ...]] = ("ACTION",)
    """Kinds of features that are denoised, and so must be normalised to [-1, 1]."""

    preset: str = "default"

    horizon: int | None = None
    symbolic_horizon: int | None = None
    n_action_steps: int | None = None
    plan_from: str = "episode_start"
    vocabulary: list[str] | None = None

    num_layers: int = 8
    num_heads: int = 4
    width: int = 256
    dropout: float | None = None
    rotary: bool | None = None
    object_tokens: bool | None = None
    observation_token_sizes: list[int] | None = None
    state_encoder_hidden_dim: int = 0
    observation_weight_std: float | None = None
    vision_backbone: str = "resnet18"
    pretrained_backbone_weights: str | None = None
    spatial_softmax_num_keypoints: int = 32
    resize_shape: tuple[int, int] | None = None
    num_train_timesteps: int = 100
    prediction_type: str | None = None
    symbol_loss_weight: float | None = None
    mask_schedule: str = "linear"
    lead_share: float = 0.0
    observation_noise: float = 0.0
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999

    sampler: str | None = None
    confidence_threshold: float = 0.95
    symbol_lead: float | None = None
    num_inference_steps: int | None = None
    prompt: str | None = None
    num_candidates: int = 1

    compile_model: bool = False
    compile_mode: str = "default"
    dtype: str = "float32"
    action_feature_names: list[str] | None = None

    optimizer_type: str | None = None
    optimizer_lr: float | None = None
    optimizer_lr_backbone: float = 1e-4
    optimizer_betas: tuple[float, float] = (0.9, 0.95)
    optimizer_eps: float = 1e-8
    optimizer_momentum: float = 0.95
    optimizer_weight_decay: float = 1e-3
    optimizer_grad_clip_norm: float = 10.0
    optimizer_fused: bool | None = None
    scheduler_warmup_steps: int | None = None

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )

    def __post_init__(self):
        super().__post_init__()
        self._observations_are_chosen = bool(self.input_features)  # else LeRobot lists all that a dataset has
        _check_choice("preset", self.preset, list(PRESETS))
        for name, value in PRESETS[self.preset].items():
            if getattr(self, name) is None:
                setattr(self, name, value)
        if self.num_inference_steps is None:
            self.num_inference_steps = self.num_train_timesteps
        self._check_values()
        self._check_combinations()
        if self.dtype == "bfloat16" and not bfloat16_is_fast(self.device):
            message = f"{self.device} has no bfloat16 instructions here: computing in float32, which is faster"
            warnings.warn(message, stacklevel=3)  # of whoever made the configuration, above the dataclass's own code
            self.dtype = "float32"

    def _check_values(self) -> None:
        """Whether each value can be, by itself."""
        _check_choice("plan_from", self.plan_from, ["episode_start", "any_frame"])
        _check_choice("prediction_type", self.prediction_type, PREDICTION_TYPES)
        _check_choice("sampler", self.sampler, SAMPLERS)
        _check_choice("optimizer_type", self.optimizer_type, OPTIMIZERS)
        _check_choice("mask_schedule", self.mask_schedule, MASK_SCHEDULES)
        _check_choice("vision_backbone", self.vision_backbone, VISION_BACKBONES)
        _check_choice("dtype", self.dtype, ["float32", "bfloat16"])
        for name in AT_LEAST_1:
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ParsingError(f"{name} must be at least 1, got {value}")
        for name in ("observation_noise", "state_encoder_hidden_dim"):
            if getattr(self, name) < 0:
                raise ParsingError(f"{name} must be at least 0, got {getattr(self, name)}")
        for name in ("dropout", "confidence_threshold", "lead_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ParsingError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if not 0 <= self.symbol_lead < 1:
            raise ParsingError(f"symbol_lead must be at least 0 and less than 1, got {self.symbol_lead}")
        if self.resize_shape is not None and min(self.resize_shape) < 1:
            raise ParsingError(f"resize_shape is a height and a width of at least 1, got {self.resize_shape}")
        if self.use_amp:
            raise ParsingError(
                "use_amp is for policies without a dtype: set use_amp=false, and dtype=bfloat16 for speed"
            )
        if self.n_obs_steps != 1:
            raise ParsingError(f"the planner sees one observation: n_obs_steps must be 1, got {self.n_obs_steps}")
        for modality in self.planned_modalities:
            if self.normalization_mapping.get(modality) is not NormalizationMode.MIN_MAX:
                raise ParsingError(f"what is planned lies in [-1, 1]: normalization_mapping needs {modality}: MIN_MAX")

    def _check_combinations(self) -> None:
        """Whether the values go with each other."""
        if self.pretrained_backbone_weights is not None:
            choices = [str(weights) for weights in get_model_weights(self.vision_backbone)]
            _check_choice("pretrained_backbone_weights", self.pretrained_backbone_weights, choices)
        if self.lead_share and (self.symbol_process is None or self.shared_level):
            raise ParsingError("lead_share is about symbols with a level of their own, which this planner has not")
        if self.observation_noise and "ENV" in self.planned_modalities:
            raise ParsingError(f"observation_noise is not for planners of type {self.type}, whose plans are poses")
        if self.observation_noise and self.normalization_mapping.get("ENV") is not NormalizationMode.MIN_MAX:
            raise ParsingError("observation_noise knows the units of poses with normalization_mapping ENV: MIN_MAX")
        if self.width % self.num_heads or self.width % 2 or self.width < NARROWEST_WIDTH:
            raise ParsingError(
                f"width must be even, divisible by {self.num_heads=} and at least {NARROWEST_WIDTH}, got {self.width}"
            )
        if self.rotary and self.width // self.num_heads % 2:
            raise ParsingError(
                f"rotary embedding needs an even width / num_heads, got {self.width} / {self.num_heads}: "
                "choose another width, or rotary=false"
            )
        if self.horizon and self.n_action_steps and self.n_action_steps != self.horizon:
            if self.n_action_steps > self.horizon:
                raise ParsingError(f"n_action_steps={self.n_action_steps} is more than the plan has ({self.horizon=})")
            if self.plans_whole_episodes:
                raise ParsingError(
                    f"n_action_steps={self.n_action_steps} of {self.horizon} plans again in the middle of an episode, "
                    "which a planner of whole episodes has not seen: train with plan_from=any_frame, or leave it out"
                )
        if self.num_inference_steps > self.num_train_timesteps:
            raise ParsingError(
                f"num_inference_steps={self.num_inference_steps} is more than {self.num_train_timesteps=}, the number "
                "of noise levels that the weights learn"
            )
        if self.prompt and self.vocabulary and self.symbolic_horizon:
            try:
                encode_prompt(self.prompt, Vocabulary(self.vocabulary), self.symbolic_horizon)
            except ValueError as error:
                raise ParsingError(str(error)) from error

    def set_dataset_feature_metadata(self, features: dict[str, dict]) -> None:
        """Take over what the dataset says about itself. LeRobot calls this before it builds the policy.

        Raises:
            ValueError: the dataset has no symbolic plans, they do not fit, or they speak another vocabulary; or weights
                would be loaded without the settings that they were trained with.
        """
        if self.pretrained_path is not None and self.observation_token_sizes is None:
            raise ValueError(
                "--policy.pretrained_path takes the weights of a checkpoint, and none of the settings that give them "
                f"their meaning: leave out --policy.type, and train on with --policy.path={self.pretrained_path}"
            )
        self.input_features.pop(OBS_SYMBOLIC_PLAN, None)  # token ids are no numbers to normalise
        if not self._observations_are_chosen:
            self._leave_out_other_observations()
        for key, feature in self.image_features.items():
            if not self.observes_camera(key, feature):
                what = "images" if not self.takes_images else "images but of three colours, named observation.*"
                logging.warning("%s is left out: a planner of type %s takes no %s", key, self.type, what)
                del self.input_features[key]
        if self.pretrained_path is None:
            _check_chosen(self.input_features, dataset_to_policy_features(features))
        if self.image_features:
            logging.info("Observed through a %s each: %s", self.vision_backbone, ", ".join(self.image_features))
        if OBS_ENV_STATE not in self.input_features and not self.image_features:
            logging.warning("There is no %s: the planner does not see where the objects are", OBS_ENV_STATE)
        if self.observation_token_sizes is None:
            self.observation_token_sizes = self._token_sizes(features)
        if self.symbol_process is not None:
            self._set_symbols(features)
        velocities = [name for name in features.get(ACTION, {}).get("names") or [] if str(name).endswith(".vel")]
        if velocities and self.plans_whole_episodes:
            logging.warning(
                "The actions %s are velocities. When a plan has ended, its last action is held: end episodes at rest, "
                "and runs with the plan.", ", ".join(velocities),
            )  # fmt: skip

    def _leave_out_other_observations(self) -> None:
        """Of what is neither a state, nor poses, nor an image, LeRobot's robots and environments hand over nothing."""
        others = [key for key in self.input_features if key not in (OBS_STATE, OBS_ENV_STATE, *self.image_features)]
        for key in others:
            logging.warning("%s is left out: to observe it, name it in --policy.input_features", key)
            del self.input_features[key]

    def observes_camera(self, key: str, feature: PolicyFeature) -> bool:
        """Whether the planner takes a camera of a dataset, by its name and its shape (channels, height, width)."""
        is_chosen = not self.input_features or key in self.input_features
        return self.takes_images and is_chosen and key.startswith(OBS_PREFIX) and feature.shape[0] == RGB

    def _token_sizes(self, features: dict[str, dict]) -> list[int]:
        """Sizes of the condition tokens, see `object_tokens`."""
        lengths = {key: math.prod(feature.shape) for key, feature in self.input_features.items()}
        lengths |= dict.fromkeys(self.image_features, 2 * self.spatial_softmax_num_keypoints)
        if not self.object_tokens:
            return [sum(lengths.values())]
        sizes = []
        for key, length in lengths.items():
            names = features.get(key, {}).get("names")
            names_components = key == OBS_ENV_STATE and isinstance(names, list) and len(names) == length
            sizes += _object_sizes(names) if names_components else [length]
        return sizes

    def _set_symbols(self, features: dict[str, dict]) -> None:
        if OBS_SYMBOLIC_PLAN not in features:
            raise ValueError(
                f"the dataset has no column '{OBS_SYMBOLIC_PLAN}'. Add one (docs/own_dataset.md), or train "
                "on the motion alone with --policy.type=diffuser."
            )
        feature = features[OBS_SYMBOLIC_PLAN]
        symbols = (feature.get("info") or {}).get("vocabulary")
        if not symbols:
            raise ValueError(f"meta/info.json names no vocabulary under features['{OBS_SYMBOLIC_PLAN}']['info']")
        if self.vocabulary is not None and list(symbols) != list(self.vocabulary):
            raise ValueError(
                f"the dataset's vocabulary {' '.join(symbols)} is not the checkpoint's {' '.join(self.vocabulary)}"
            )
        self.vocabulary = list(symbols)
        plan_length = feature["shape"][0]
        if self.symbolic_horizon is None:
            self.symbolic_horizon = plan_length
        elif self.symbolic_horizon < plan_length:
            raise ValueError(
                f"symbolic_horizon={self.symbolic_horizon} is shorter than the dataset's plans of {plan_length} tokens"
            )

    def validate_features(self) -> None:
        if not self.input_features:
            raise ValueError("the planner has nothing to observe: the dataset has no column that it can take")
        if self.action_feature is None:
            raise ValueError("the dataset has no column 'action'")
        if self.observation_noise and OBS_ENV_STATE not in self.input_features:
            raise ValueError(f"observation_noise is added to {OBS_ENV_STATE}, which is not observed")
        for key, feature in self.image_features.items():
            height, width = self.resize_shape or feature.shape[1:]
            if min(height, width) <= BACKBONE_STRIDE:
                raise ValueError(
                    f"{key} has {height} x {width} pixels, of which the image encoder sees one row or column of cells: "
                    f"record more than {BACKBONE_STRIDE} either way, enlarge them with --policy.resize_shape, or "
                    "observe something else with --policy.input_features"
                )
        symbols_known = self.vocabulary is not None and self.symbolic_horizon is not None
        if self.observation_token_sizes is None or (self.symbol_process is not None and not symbols_known):
            raise ValueError("a planner learns its sizes and its vocabulary from a dataset: train it before use")

    def set_horizon(self, horizon: int) -> None:
        """Set a horizon that was left open, and what follows from it.

        Raises:
            ParsingError: it does not go with the other values.
        """
        self.horizon = horizon
        self.__post_init__()

    @property
    def plans_whole_episodes(self) -> bool:
        """Whether a plan is a whole episode, from its first frame; else what is left of one, from any frame."""
        return self.plan_from == "episode_start"

    @property
    def drop_n_last_frames(self) -> int:
        """Frames at an episode's end that no training sample starts from: for LeRobot's sampler."""
        return self._known_horizon - 1 if self.plans_whole_episodes else 0

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self._known_horizon))

    @property
    def reward_delta_indices(self) -> None:
        return None

    @property
    def _known_horizon(self) -> int:
        if self.horizon is None:
            raise ValueError(
                "--policy.horizon is missing: the number of frames of the dataset's longest episode, which hdp-train "
                "looks up"
            )
        return self.horizon

    def get_optimizer_preset(self) -> FusedAdamWConfig:
        options: dict[str, Any] = {
            "lr": self.optimizer_lr,
            "betas": self.optimizer_betas,
            "eps": self.optimizer_eps,
            "weight_decay": self.optimizer_weight_decay,
            "grad_clip_norm": self.optimizer_grad_clip_norm,
            "fused": self.optimizer_fused,
        }
        if self.optimizer_type == "muon":
            return MuonAdamWConfig(**options, momentum=self.optimizer_momentum)
        return FusedAdamWConfig(**options)

    def get_scheduler_preset(self) -> CosineAnnealingWithWarmupSchedulerConfig:
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=self.scheduler_warmup_steps)


def _check_chosen(chosen: dict[str, PolicyFeature], known: dict[str, PolicyFeature]) -> None:
    """Refuse observations that a user chose and a dataset, whose columns are known, does not have."""
    known = {key: feature for key, feature in known.items() if key.startswith(OBS_PREFIX) and key != OBS_SYMBOLIC_PLAN}
    for key, feature in chosen.items():
        if key not in known:
            raise ValueError(f"input_features names {key}, which the dataset does not have; it has {', '.join(known)}")
        said, found = ((value.type.value, *value.shape) for value in (feature, known[key]))
        if said != found:
            raise ValueError(f"input_features says that {key} is {said}, in the dataset it is {found}")


def _object_sizes(names: Iterable[str]) -> list[int]:
    """How many consecutive components belong to each object; they are named `object.component`.

    Example:
        >>> _object_sizes(["red.x", "red.y", "blue.x", "blue.y"])
        [2, 2]
    """
    return [len(list(group)) for _, group in groupby(names, key=lambda name: name.rpartition(".")[0])]


def _check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ParsingError(f"{name} must be one of {choices}, got {value!r}")
