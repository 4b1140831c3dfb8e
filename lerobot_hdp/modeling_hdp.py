"""The planner as a LeRobot policy."""

import json
import logging
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, NoReturn

import torch
from huggingface_hub import ModelCard
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE
from safetensors import SafetensorError
from torch import Generator, Tensor, nn

from .candidates import PARTIAL_MOTION_CANDIDATES, best_candidates, score_plans
from .configuration_hdp import OBS_SYMBOLIC_PLAN, HDPConfig
from .dataset_checks import check_episodes_fit, check_statistics, check_token_ids
from .denoiser import Denoise, Denoiser, Prediction
from .encoders import ImageEncoder, StateEncoder
from .lerobot_workarounds import keep_data_order_on_resume
from .model_card import describe_planner
from .moving_average import MovingAverage
from .optimizer import parameter_groups
from .plan import Plan, PlanCheck, PlanPrompt
from .processes import GaussianProcess, GaussianSymbolProcess, MaskedProcess, SymbolProcess
from .processor_hdp import widen_narrow_ranges
from .prompt import place_prompts
from .sampling import DenoisingState, sample_plan
from .training import TrainingNoise, add_pose_noise, mix_seeds, pose_noise_std, read_losses, training_loss
from .vocabulary import FREE, PAD_ID, Vocabulary

MEANING_OF_WEIGHTS = ("prediction_type", "rotary", "num_heads", "num_train_timesteps")
"""Settings that weights of the same shapes are nothing without: with another, they make plans that look like plans."""
CONDITION = "condition_tokens"
"""Where a batch holds its encoded observations, (B, n, width), while a plan is made from it."""


def _without_dropout[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Let a method of a policy plan without dropout, also in the middle of the policy's training."""

    @wraps(method)
    def in_eval_mode(*args: P.args, **kwargs: P.kwargs) -> R:
        network: nn.Module = args[0]._planning_network  # type: ignore[attr-defined]
        if not network.training:
            return method(*args, **kwargs)
        network.eval()
        try:
            return method(*args, **kwargs)
        finally:
            network.train()

    return in_eval_mode


class Planner(nn.Module):
    """The network that is trained: the observation's encoders and the denoiser."""

    def __init__(self, config: HDPConfig, symbol_states: int):
        super().__init__()
        self.encoder = StateEncoder(
            config.input_features,
            config.observation_token_sizes,
            config.width,
            config.observation_weight_std,
            config.state_encoder_hidden_dim,
        )
        self.image_encoder = None
        if config.image_features:
            self.image_encoder = ImageEncoder(
                config.image_features,
                group_norm=config.pretrained_backbone_weights is None,
                vision_backbone=config.vision_backbone,
                spatial_softmax_num_keypoints=config.spatial_softmax_num_keypoints,
                resize_shape=config.resize_shape,
            )
        self.denoiser = Denoiser(
            action_dim=config.action_feature.shape[0],
            horizon=config.horizon,
            observation_tokens=self.encoder.num_tokens,
            num_train_timesteps=config.num_train_timesteps,
            vocabulary_size=len(config.vocabulary) if symbol_states else 0,
            symbolic_horizon=config.symbolic_horizon if symbol_states else 0,
            symbol_states=symbol_states,
            shared_level=config.shared_level,
            num_layers=config.num_layers,
            num_heads=config.num_heads,
            width=config.width,
            dropout=config.dropout,
            rotary=config.rotary,
        )

    def encode(self, batch: dict[str, Tensor]) -> Tensor:
        """Preprocessed observations -> condition tokens (B, n, width)."""
        features = self.image_encoder(batch) if self.image_encoder is not None else {}
        return self.encoder({**batch, **features})

    @property
    def denoisers(self) -> list[Denoiser]:
        return [self.denoiser]


class HDPPolicy(PreTrainedPolicy):
    """Hybrid Diffusion Planner (Høeg et al. 2026): denoises a motion and the symbolic plan behind it at once.

    An open-loop planner: one observation, the whole plan, executed to its end.

    Args:
        config: the planner's configuration, complete with what the dataset says.
        dataset_stats: of the dataset that the policy is to be trained on. LeRobot normalises by the same ones; where a
            checkpoint is trained on, without another look at them, so that `widen_narrow_ranges` changes them here.
        dataset_meta: metadata of the dataset that the policy is to be trained on; its episodes are checked against
            the horizon. With it, a new policy's image encoders start from `pretrained_backbone_weights`; a checkpoint
            has weights of its own.
        cli_overrides: `from_pretrained` hands this over, too: flags that the configuration has read already.

    Attributes:
        last_plan: what `select_action` and `predict_action_chunk` are executing; None before the first plan, and after
            `reset`.

    Raises:
        TypeError: `from_pretrained` was given a setting by its name.
        ValueError: the configuration is another planner's, or incomplete, or does not fit the dataset.
    """

    config_class = HDPConfig
    name = "hdp"
    can_score = True
    """Whether it can say how likely a plan is, and so choose among candidates."""

    def __init__(
        self,
        config: HDPConfig,
        dataset_stats: Any = None,
        dataset_meta: Any = None,
        cli_overrides: Sequence[str] = (),
        **settings: Any,
    ):
        if settings:
            flags = [f"--{name}={value}" for name, value in settings.items()]
            raise TypeError(
                f"{type(self).__name__} has no argument {next(iter(settings))}; settings are given to from_pretrained "
                f"as on a command line: cli_overrides={flags}"
            )
        if config.type != self.name:
            raise ValueError(
                f"this is a planner of type {config.type}: load it by lerobot.policies.get_policy_class("
                f"'{config.type}').from_pretrained(...)"
            )
        super().__init__(config)
        config.validate_features()
        if dataset_stats is not None:
            check_statistics(config, dataset_stats)
            check_token_ids(config, dataset_stats)
            if config.pretrained_path is not None:
                widen_narrow_ranges(config, dataset_stats)
        if config.num_candidates > 1:
            self._check_can_score()
        if dataset_meta is not None:
            keep_data_order_on_resume()
            if config.plans_whole_episodes:
                check_episodes_fit(config, dataset_meta.episodes["length"])
            if dataset_meta.total_tasks > 1:
                logging.warning(
                    "The dataset has %d tasks, and the planner does not read which is asked for: tell them apart by "
                    "symbols and a prompt, or train a planner for each.", dataset_meta.total_tasks,
                )  # fmt: skip
        self.vocabulary = Vocabulary(config.vocabulary) if config.symbol_process else None
        self.motion_process, self.symbol_process = make_processes(config)

        self.planner = self._make_planner()
        is_new = dataset_meta is not None and config.pretrained_path is None
        if is_new and config.pretrained_backbone_weights and self.planner.image_encoder is not None:
            self.planner.image_encoder.load_backbones(config.vision_backbone, config.pretrained_backbone_weights)
        averages = config.ema_max_decay > 0
        self.ema = MovingAverage(self.planner, config.ema_power, config.ema_max_decay) if averages else None
        if config.compile_model:
            for network in (self.planner, *([self.ema.module] if self.ema else [])):
                for denoiser in network.denoisers:
                    denoiser.compile(mode=config.compile_mode)
        # Training noise is a function of these two, so that a resumed run goes on exactly as if never interrupted.
        self.register_buffer("noise_seed", torch.randint(2**31, ()))
        self.register_buffer("forward_calls", torch.tensor(0))
        self._seed_and_calls: tuple[int, int] | None = None
        self.pose_noise: Tensor | None
        noise = pose_noise_std(config, dataset_stats) if config.observation_noise and dataset_stats else None
        self.register_buffer("pose_noise", noise, persistent=False)
        self.register_load_state_dict_pre_hook(self._start_or_end_average)
        self.reset()

    def _make_planner(self) -> Planner:
        return Planner(self.config, self.symbol_process.num_states if self.symbol_process else 0)

    def get_optim_params(self) -> list[dict]:
        matrices = [matrix for denoiser in self.planner.denoisers for matrix in denoiser.hidden_matrices]
        for_muon = matrices if self.config.optimizer_type == "muon" else ()
        image_encoder = self.planner.image_encoder
        of_images = image_encoder.parameters() if image_encoder is not None else ()
        return parameter_groups(self.planner, for_muon, of_images, self.config.optimizer_lr_backbone)

    def reset(self) -> None:
        """Forget the plan in execution. To be called on `env.reset()`."""
        self.last_plan: Plan | None = None
        self._queue: deque[Tensor] = deque()
        self._last_action: Tensor | None = None

    def update(self) -> None:
        """Move the averaged weights, to be called after each optimiser step, as LeRobot does."""
        if self.ema is not None:
            self.ema.update(self.planner)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """The loss of Algorithm 1, see `training_loss`.

        Args:
            batch: preprocessed observations, `action` (B, H_c, D) and `observation.symbolic_plan` (B, H_d).

        Returns:
            The loss, and its two parts for logging.
        """
        if not self.training:
            if self._has_partial_plans(batch):
                warnings.warn(
                    "eval_loss says nothing of this planner: it is trained on whole plans, and evaluated in the middle "
                    "of episodes. Train with hdp-train, or with --policy.plan_from=any_frame.",
                    stacklevel=2,
                )
            # The same noise at every evaluation, so that their losses differ by the weights.
            return self._loss(batch, self._planning_network, TrainingNoise.seeded(self._device, 0))
        if self._seed_and_calls is None and self._has_partial_plans(batch):
            raise ValueError(
                "there are samples from the middle of episodes, as with --dataset.streaming=true; a planner of whole "
                "episodes needs --dataset.streaming=false, or --policy.plan_from=any_frame"
            )
        step = self._next_step()
        noise = TrainingNoise.seeded(self._device, *step)
        with torch.random.fork_rng(devices=self._cuda_devices):
            torch.manual_seed(mix_seeds(*step, 1 + noise.rank))  # of dropout
            return self._loss(batch, self.planner, noise)

    def _has_partial_plans(self, batch: dict[str, Tensor]) -> bool:
        """Whether a planner of whole episodes is shown samples from the middle of some.

        LeRobot evaluates the loss at every frame of the held-out episodes (`hdp-train`, where plans begin), and
        streams all frames of a dataset, whatever `drop_n_last_frames` says.
        """
        timestamp = batch.get("timestamp")
        if not self.config.plans_whole_episodes or timestamp is None:
            return False
        return bool((timestamp > 0).any())

    def _next_step(self) -> tuple[int, int]:
        """Count a training step: `noise_seed` and `forward_calls`.

        The two are kept as numbers, too, because reading them makes the host wait for the device. They are read at the
        first step, when a distributed run has sent its first process' buffers to the others.
        """
        seed, calls = self._seed_and_calls or (int(self.noise_seed), int(self.forward_calls))
        self._seed_and_calls = seed, calls + 1
        self.forward_calls += 1
        return self._seed_and_calls

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._seed_and_calls = None

    def _loss(
        self, batch: dict[str, Tensor], network: Planner, noise: TrainingNoise
    ) -> tuple[Tensor, dict[str, float]]:
        def denoise(motion: Tensor, symbols: Tensor | None, k_c: Tensor, k_d: Tensor) -> Prediction:
            observation = network.encode(self._with_pose_noise(batch, k_c, noise))
            return network.denoiser(motion, symbols, observation, k_c, k_d)

        loss, parts = training_loss(
            denoise,
            self.motion_process,
            self.symbol_process,
            self._motion(batch),
            batch[OBS_SYMBOLIC_PLAN] if self.symbol_process else None,
            noise,
            symbol_loss_weight=self.config.symbol_loss_weight,
            shared_level=self.config.shared_level,
            lead_share=self.config.lead_share,
        )
        return loss, read_losses(parts)

    def _motion(self, batch: dict[str, Tensor]) -> Tensor:
        """The actions, (B, H, D); LeRobot's are (B, H) where D is 1."""
        return batch[ACTION].reshape(len(batch[ACTION]), -1, *self.config.action_feature.shape)

    def _with_pose_noise(self, batch: dict[str, Tensor], k_c: Tensor, noise: TrainingNoise) -> dict[str, Tensor]:
        """A batch for training, with `observation_noise` on its poses."""
        if not (self.training and self.config.observation_noise):
            return batch
        if self.pose_noise is None:
            raise ValueError("observation_noise has the units of the poses: make the policy with dataset_stats")
        poses = add_pose_noise(batch[OBS_ENV_STATE], self.pose_noise, self.motion_process, k_c, noise)
        return {**batch, OBS_ENV_STATE: poses}

    @torch.no_grad()
    @_without_dropout
    def plan(
        self,
        batch: dict[str, Tensor],
        prompt: str | Sequence[str] | PlanPrompt | None = None,
        generator: Generator | None = None,
        on_step: Callable[[int, DenoisingState], None] | None = None,
        num_candidates: int | None = None,
        check: PlanCheck | None = None,
    ) -> Plan:
        """Algorithm 2: make a plan for each observation of a batch, from scratch or around a prompt.

        Args:
            batch: preprocessed observations.
            prompt: the part of the plan that is given, see `read_prompt`. Each candidate draws places of its own for
                words that say none.
            generator: source of all randomness, on the policy's device; None: PyTorch's global one.
            on_step: sees the half-done plan after each step, and all candidates of it: those of one observation follow
                each other.
            num_candidates: k plans are drawn for each observation, and the one that the model itself finds most
                likely is kept (`candidates.score_plans`). None: as the configuration says, and at least
                `PARTIAL_MOTION_CANDIDATES` where a part of the motion is given.
            check: the task's checker. The candidates with the fewest complaints are preferred to all others.

        Raises:
            ValueError: an observation with NaN or infinity, a prompt that does not fit, a checker with nothing to
                choose from, or several candidates from a planner that cannot score them.
        """
        batch = self._encode_once(batch)
        k = num_candidates
        if k is None:
            several = isinstance(prompt, PlanPrompt) and prompt.gives_part_of_motion and self.can_score
            k = max(self.config.num_candidates, PARTIAL_MOTION_CANDIDATES if several else 1)
        if k < 1:
            raise ValueError(f"num_candidates must be at least 1, got {k}")
        if k == 1:
            if check is not None:
                raise ValueError("a checker chooses among candidates: set num_candidates to more than 1")
            return self._sample(batch, self.read_prompt(batch, prompt, generator), generator, on_step)

        self._check_can_score()
        asked = [key for key in (OBS_SYMBOLIC_PLAN, CONDITION) if key in batch]
        repeated = {key: batch[key].repeat_interleave(k, dim=0) for key in asked}
        if isinstance(prompt, PlanPrompt):
            prompt.check(self._motion_shape(batch), self.config.symbolic_horizon, self.vocabulary)
            prompt = prompt.repeat(k)
        elif prompt is not None:
            prompt = [text for text in _one_text_each(prompt, self._batch_size(batch)) for _ in range(k)]
        plans = self._sample(repeated, self.read_prompt(repeated, prompt, generator), generator, on_step)
        scores = self.score(repeated, plans).unflatten(0, (-1, k))
        complaints = None
        if check is not None:
            about = plans.validate(lambda index, symbols: check(index // k, symbols))
            complaints = [[len(found) for found in about[start : start + k]] for start in range(0, len(about), k)]
        best = best_candidates(scores, complaints)
        samples = torch.arange(len(best), device=best.device)
        kept = plans.select(samples * k + best)
        return replace(kept, scores=scores[samples, best], candidate=best)

    @torch.no_grad()
    @_without_dropout
    def score(self, batch: dict[str, Tensor], plan: Plan) -> Tensor:
        """How likely a plan for each observation is under the model, up to scale: (B,), see `score_plans`.

        Raises:
            ValueError: this planner cannot say.
        """
        self._check_can_score()
        processes = self.motion_process, self.symbol_process
        return score_plans(self._denoiser(batch), *processes, plan.actions, plan.token_ids)

    def _check_can_score(self) -> None:
        if not self.can_score:
            raise ValueError(f"a planner of type {self.name} cannot score its plans: leave num_candidates at 1")

    @torch.no_grad()
    @_without_dropout
    def read_prompt(
        self,
        batch: dict[str, Tensor],
        prompt: str | Sequence[str] | PlanPrompt | None = None,
        generator: Generator | None = None,
    ) -> PlanPrompt:
        """What is given of each plan of a batch.

        It comes from the argument, else from the configuration (`--policy.prompt`), else from the environment, in
        `observation.symbolic_plan`. In a batch of a dataset that column holds the recorded plans; a plan in which
        nothing is left open is no prompt. Where words do not say their place in the plan ("... STACK red"), the planner
        draws one, by one call of the network.

        Args:
            batch: preprocessed observations.
            prompt: words (see prompt.py), the same for all samples or for each its own; or token ids and actions.
            generator: source of randomness; None: PyTorch's global one.

        Raises:
            ValueError: an observation that is missing or holds NaN or infinity, or a prompt that does not fit.
        """
        if CONDITION not in batch:
            self._check_observations(batch)
        if prompt is None:
            prompt = self.config.prompt
        if prompt is None and self.symbol_process is not None and OBS_SYMBOLIC_PLAN in batch:
            prompt = PlanPrompt(token_ids=_without_recorded_plans(batch[OBS_SYMBOLIC_PLAN]))
        if prompt is None:
            return PlanPrompt()
        if not isinstance(prompt, PlanPrompt):
            texts = _one_text_each(prompt, self._batch_size(batch))
            if self.vocabulary is None:
                if any(texts):
                    raise ValueError("this planner models no symbols: it takes no symbolic prompt")
                return PlanPrompt()
            ask = partial(self._ask_for_symbols, batch, generator)
            length = self.config.symbolic_horizon
            prompt = PlanPrompt(token_ids=place_prompts(texts, self.vocabulary, length, self._device, ask, generator))
        prompt = prompt.to(self._device)
        prompt.check(self._motion_shape(batch), self.config.symbolic_horizon, self.vocabulary)
        return prompt

    def _check_observations(self, batch: dict[str, Tensor]) -> None:
        for key in self.config.input_features:
            observed = _observed(batch, key)
            if observed.device.type != self._device.type:
                raise ValueError(
                    f"{key} is on {observed.device}, the planner on {self._device}: make the preprocessor with "
                    f'preprocessor_overrides={{"device_processor": {{"device": "{self._device}"}}}}'
                )
            if not torch.isfinite(observed).all():
                raise ValueError(f"{key} holds NaN or infinity: no plan can be made from it")

    def _encode_once(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """A batch with its condition tokens, for all that is asked of the denoiser about one plan."""
        self._check_observations(batch)
        return {**batch, CONDITION: self._planning_network.encode(batch)}

    def _ask_for_symbols(self, batch: dict[str, Tensor], generator: Generator | None, given: Tensor) -> Tensor:
        """Scores of all symbols where a plan begins, pure noise and masks, beside what is given: (B, H_d, m).

        Args:
            batch: preprocessed observations.
            generator: source of randomness.
            given: (B, H_d) token ids, masked where they are FREE or FREE_SYMBOL.
        """
        if not isinstance(self.symbol_process, MaskedProcess):
            raise ValueError(
                "this planner cannot decide where in a plan words stand, after '...' or from its end: number their "
                "positions from the start, as in 11:STACK"
            )
        free = given < PAD_ID
        motion = self.motion_process.prior(self._motion_shape(batch), self._device, generator)
        k_c, k_d = torch.ones(len(given), device=self._device), free.float().mean(dim=1)
        tokens = given.masked_fill(free, self.symbol_process.mask_id)
        return self._denoiser(batch)(motion, tokens, k_c, k_d).symbols

    def _sample(
        self,
        batch: dict[str, Tensor],
        prompt: PlanPrompt,
        generator: Generator | None,
        on_step: Callable[[int, DenoisingState], None] | None,
    ) -> Plan:
        motion, tokens, probabilities = sample_plan(
            self._denoiser(batch),
            self.motion_process,
            self.symbol_process,
            self._motion_shape(batch),
            symbolic_horizon=self.config.symbolic_horizon or 0,
            device=self._device,
            num_steps=self.config.num_inference_steps,
            symbol_lead=self.config.symbol_lead,
            shared_level=self.config.shared_level,
            prompt=prompt,
            generator=generator,
            on_step=on_step,
        )
        return Plan(motion, tokens, probabilities, self.vocabulary, prompt.tokens_mask)

    def _denoiser(self, batch: dict[str, Tensor]) -> Denoise:
        """The denoiser for the observations of a batch."""
        network = self._planning_network
        observation = batch[CONDITION] if CONDITION in batch else network.encode(batch)

        def denoise(motion: Tensor, symbols: Tensor | None, k_c: Tensor, k_d: Tensor) -> Prediction:
            with self._autocast():
                prediction = network.denoiser(motion, symbols, observation, k_c, k_d)
            return Prediction(*(None if part is None else part.float() for part in prediction))

        return denoise

    @torch.no_grad()
    def predict_action_chunk(
        self, batch: dict[str, Tensor], prompt: str | Sequence[str] | PlanPrompt | None = None, **kwargs: Any
    ) -> Tensor:
        """The actions that are executed before the next plan: (B, n_action_steps, D), all H_c where that is None.

        Args:
            batch, prompt: see `plan`. The plan stays in `last_plan`; the whole plan of one robot is logged in words.
            kwargs: what LeRobot hands to other policies.
        """
        self.last_plan = self.plan(batch, prompt)
        if self.vocabulary is not None and self.config.plans_whole_episodes and len(self.last_plan.actions) == 1:
            logging.info("The plan: %s", " ".join(self.last_plan.symbols()))
        return self.last_plan.actions[:, : self.config.n_action_steps]

    @torch.no_grad()
    def select_action(
        self, batch: dict[str, Tensor], prompt: str | Sequence[str] | PlanPrompt | None = None, **kwargs: Any
    ) -> Tensor:
        """The next action of the plan, normalised, after making one if there is none: (B, D).

        A planner of whole episodes plans once, and then holds the last action until `reset`.

        Args:
            batch, prompt: see `plan`. Both are read when a plan is made; the batch says how many robots there are.
            kwargs: what LeRobot hands to other policies.

        Raises:
            ValueError: the plan in execution is of another number of environments.

        Warns:
            UserWarning: it has come to the end of its plan.
        """
        self.eval()
        if self._last_action is not None and len(self._last_action) != self._batch_size(batch):
            raise ValueError(
                f"a plan for {len(self._last_action)} environments is being executed, and here are "
                f"{self._batch_size(batch)} observations: call reset() when other episodes begin"
            )
        if not self._queue and self._last_action is not None and self.config.plans_whole_episodes:
            warnings.warn(
                f"the plan of {self.config.horizon} actions has ended, and its last one is held: end the episode, and "
                "before the next one, call reset(). To plan again, train with --policy.plan_from=any_frame.",
                stacklevel=2,
            )
            return self._last_action
        if not self._queue:
            self._queue.extend(self.predict_action_chunk(batch, prompt).unbind(dim=1))
        self._last_action = self._queue.popleft()
        return self._last_action

    @property
    def _planning_network(self) -> Planner:
        """The averaged weights, where there are any: a training loop that never calls `update` makes none."""
        return self.planner if self.ema is None or not self.ema.updates else self.ema.module

    @property
    def _device(self) -> torch.device:
        return self.noise_seed.device

    def _autocast(self) -> torch.autocast:
        """For the denoiser in planning; in training, Accelerate has all of the planner compute so (`dtype`)."""
        return torch.autocast(self._device.type, torch.bfloat16, enabled=self.config.dtype == "bfloat16")

    @property
    def _cuda_devices(self) -> list[torch.device]:
        return [self._device] if self._device.type == "cuda" else []

    def _batch_size(self, batch: dict[str, Tensor]) -> int:
        return len(_observed(batch, CONDITION if CONDITION in batch else next(iter(self.config.input_features))))

    def _motion_shape(self, batch: dict[str, Tensor]) -> tuple[int, int, int]:
        """(B, H_c, D)."""
        return self._batch_size(batch), self.config.horizon, self.config.action_feature.shape[0]

    def generate_model_card(
        self,
        *args: Any,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> ModelCard:
        """The README.md that goes to the Hub with the weights: LeRobot's, and what this planner is."""
        card = super().generate_model_card(*args, cfg=cfg, dataset_meta=dataset_meta, **kwargs)
        return describe_planner(card, self.config, dataset_meta.fps if dataset_meta else None, cfg.env if cfg else None)

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse adapters.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            "a planner of a few million weights is trained on as a whole: leave out --peft. Adapters would be trained "
            "beside the average that plans, which a checkpoint of adapters does not hold."
        )

    def _start_or_end_average(self, _: nn.Module, state: dict[str, Tensor], prefix: str, *__: Any) -> None:
        """Let a planner that was saved without averaged weights be trained on with some, or the other way round.

        Without an average, the weights that plan are those that are trained: they start from the averaged ones.
        """
        network, average = f"{prefix}planner.", f"{prefix}ema."
        averaged = {name: value for name, value in state.items() if name.startswith(average)}
        if self.ema is None:
            begun = bool(averaged) and averaged[f"{average}n_averaged"] > 0
            for name, value in averaged.items():
                del state[name]
                if begun and name.startswith(f"{average}module."):
                    state[network + name.removeprefix(f"{average}module.")] = value
        elif not averaged:
            weights = {name.removeprefix(network): value for name, value in state.items() if name.startswith(network)}
            state |= {f"{average}module.{name}": value for name, value in weights.items()}
            state[f"{average}n_averaged"] = torch.zeros_like(self.ema.n_averaged)

    @classmethod
    def _load_as_safetensor(cls, model: "HDPPolicy", model_file: str, map_location: str, strict: bool) -> "HDPPolicy":
        """Load the whole checkpoint or none of it, as what it was: else it plans nonsense without a word."""
        settings = Path(model_file).with_name(CONFIG_NAME)
        saved = json.loads(settings.read_text()) if settings.exists() else {}
        for name in MEANING_OF_WEIGHTS:
            wanted = getattr(model.config, name)
            if (learned := saved.get(name, wanted)) != wanted:
                raise ValueError(
                    f"{name}={wanted} does not fit the weights in {model_file}, which have learned with {learned}: "
                    "leave it out, or train anew"
                )
        try:
            return super()._load_as_safetensor(model, model_file, map_location, strict=True)
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{model_file} is missing from the checkpoint") from error
        except RuntimeError as error:
            if "Error(s) in loading state_dict" not in str(error):
                raise
            first = next((line.strip() for line in str(error).splitlines()[1:] if line.strip()), str(error))
            raise ValueError(f"the settings do not fit the weights in {model_file}: {first}") from error
        except SafetensorError as error:
            raise ValueError(f"{model_file} is damaged or incomplete ({error}); copy the checkpoint again") from error


def make_processes(config: HDPConfig) -> tuple[GaussianProcess, SymbolProcess | None]:
    """The processes of the motion and of the symbols."""
    gaussian = (config.num_train_timesteps, config.prediction_type, 1.0 if config.sampler == "ddpm" else 0.0)
    motion = GaussianProcess(*gaussian)
    match config.symbol_process:
        case "masked":
            threshold = config.confidence_threshold if config.sampler == "confidence" else None
            return motion, MaskedProcess(len(config.vocabulary), threshold, config.mask_schedule)
        case "gaussian":
            return motion, GaussianSymbolProcess(len(config.vocabulary), *gaussian)
        case _:
            return motion, None


def _observed(batch: dict[str, Tensor], key: str) -> Tensor:
    """An observation of a batch."""
    if key not in batch:
        raise ValueError(f"the planner was trained on {key}, which is not observed here")
    return batch[key]


def _one_text_each(prompt: str | Sequence[str], batch_size: int) -> list[str]:
    """A prompt in words for each observation."""
    texts = [prompt] * batch_size if isinstance(prompt, str) else list(prompt)
    if not all(isinstance(text, str) for text in texts):
        raise TypeError("a prompt is a string, a list of one for each observation, or a PlanPrompt of token ids")
    if len(texts) != batch_size:
        raise ValueError(f"there are {len(texts)} prompts for {batch_size} observations")
    return texts


def _without_recorded_plans(token_ids: Tensor) -> Tensor:
    """Prompts (B, H_d), of which those that leave nothing open, as what a dataset has recorded, give nothing."""
    return token_ids.masked_fill((token_ids >= PAD_ID).all(dim=1, keepdim=True), FREE)
