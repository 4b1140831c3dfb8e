"""`hdp-plan`: make one plan, print it in words, draw it, and execute it; or explain a recorded motion in words.

Example:
    hdp-plan --policy.path=outputs/train/run/checkpoints/last/pretrained_model --prompt="PICK B" --html=plan.html
    hdp-plan --policy.path=outputs/train/run/checkpoints/last/pretrained_model --explain=7
"""

import json
import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from textwrap import indent
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from draccus.utils import ParsingError
from lerobot import envs, policies  # noqa: F401 (registers LeRobot's own)
from lerobot.configs import PolicyFeature, PreTrainedConfig, parser
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from torch import Tensor

from lerobot_hdp.configuration_hdp import OBS_SYMBOLIC_PLAN, HDPConfig
from lerobot_hdp.drawing import MASK_WORD, PlanPicture, draw_plan, save_animation
from lerobot_hdp.lerobot_workarounds import read_metadata
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.page import PageState, PlanPage, write_page
from lerobot_hdp.plan import Plan, PlanPrompt, StepEnds, plan_rows
from lerobot_hdp.sampling import DenoisingState
from lerobot_hdp.vocabulary import Vocabulary

MOST_STATES = 40
"""Denoising steps that are drawn."""


@dataclass
class PlanConfig:
    """Options of `hdp-plan`.

    Attributes:
        policy: the planner, by `--policy.path=` (a checkpoint's `pretrained_model` folder or a Hub repository).
        env: the task. None: the one in the checkpoint's training configuration.
        seed: seed of the start and of the plan.
        prompt: a part of the plan in words, e.g. "PICK B ..." or "... STACK red" (docs/conditioning.md). None: what the
            policy's configuration or the environment asks for; "" is nothing.
        check: prefer, among `--policy.num_candidates` plans, those without complaints by the task's checker.
        output_dir: where the pictures go.
        html: file for a page with the plan, its execution and its denoising, to open in a browser. None: no page.
        explain: number of an episode of the dataset, whose motion is put into words; nothing is planned or drawn.
        dataset: the dataset. None: the one in the checkpoint's training configuration.
    """

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    seed: int = 0
    prompt: str | None = None
    check: bool = False
    output_dir: Path = Path("outputs/plan")
    html: Path | None = None
    explain: int | None = None
    dataset: DatasetConfig | None = None

    def __post_init__(self):
        path = parser.get_path_arg("policy")
        if not path:
            raise ValueError("--policy.path is missing: the checkpoint's pretrained_model folder")
        overrides = parser.get_cli_overrides("policy") or []
        self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        self.policy.pretrained_path = Path(path)
        if not any(override.startswith("--compile_model") for override in overrides):
            self.policy.compile_model = False  # it takes longer than a plan
        missing = self.env is None or (self.explain is not None and self.dataset is None)
        if missing and (trained := _train_config(path, self.policy.pretrained_revision)):
            self.env = self.env or trained.env
            self.dataset = self.dataset or trained.dataset
        if self.explain is None and self.env is None:
            raise ValueError(
                "the checkpoint names no simulated task: choose one with --env.type=hdp --env.task=...; without one, "
                "plan in Python (README) or explain a recorded motion with --explain"
            )
        if self.explain is not None and (self.prompt or self.html or self.check):
            raise ValueError("--explain goes without --prompt, --html and --check: nothing is planned")
        if self.html is not None and self.html.is_dir():
            raise ValueError(f"--html={self.html} is a folder: name a file in it, such as {self.html / 'plan.html'}")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        return ["policy"]


class Result(NamedTuple):
    """What became of a plan.

    Attributes:
        text: the plan in words, see `Plan.describe`.
        complaints: what the task's checker has against the symbols; None: the task has no checker.
        outcome: of the execution, in words.
        files: what was written, by what it is.
    """

    text: str
    complaints: list[str] | None
    outcome: str
    files: dict[str, Path]


class Recorder:
    """The plan at every denoising step, in the units and pixels of one environment.

    Attributes:
        states: of all candidates, after 0, 1, ... steps.
    """

    def __init__(self, env: gym.vector.VectorEnv, policy: HDPPolicy, unnormalise: Callable[[Tensor], np.ndarray]):
        self.env, self.policy, self.unnormalise = env, policy, unnormalise
        self.states: list[DenoisingState] = []

    def __call__(self, step: int, state: DenoisingState) -> None:
        self.states.append(state)

    def page_states(self, plan: Plan) -> list[PageState]:
        """Up to MOST_STATES of the steps of the candidate that was kept, and the plan itself."""
        kept = 0 if plan.candidate is None else int(plan.candidate[0])
        last = len(self.states) - 1
        length = max(len(plan.symbols()), 1)
        chosen = sorted({round(i) for i in np.linspace(0, last, min(MOST_STATES, last + 1))})
        states = [self._state(i, self.states[i].motion[kept], self.states[i].tokens, kept, length) for i in chosen]
        return [*states[:-1], self._state(last, plan.actions[0], plan.token_ids, 0, length)]

    def _state(self, step: int, motion: Tensor, tokens: Tensor | None, kept: int, length: int) -> PageState:
        actions = self.unnormalise(motion)
        words: list[str | None] = []
        if tokens is not None:
            shown = [*self.policy.vocabulary.symbols, None]
            words = [shown[i] for i in tokens[kept, :length].tolist()]
        return PageState(step, _project(self.env, actions), actions[:, -1], words)


def make_plan(config: PlanConfig) -> Result:
    """Plan once, draw the motion over the scene and the denoising, then execute the plan in the environment.

    Raises:
        ValueError: the policy is no planner of this package or one for another task, or the prompt does not fit.
    """
    set_seed(config.seed)
    policy, preprocessor, postprocessor = _load(config)
    if config.check and policy.config.num_candidates == 1:
        raise ValueError("--check=true chooses among candidates: set --policy.num_candidates to more than 1")
    if config.check and policy.vocabulary is None:
        raise ValueError("--check=true: this planner models no symbols, so there is no plan to check")
    if hasattr(config.env, "with_poses"):
        config.env = config.env.with_poses()  # for the task's checker of plans; a planner that sees takes no notice
    env_preprocessor, _ = make_env_pre_post_processors(config.env, config.policy)
    task = getattr(config.env, "planning_task", None)
    if task is not None:
        _check_task(policy.config, task)
    elif config.check:
        raise ValueError(f"--check=true: environments of type {config.env.type} come without a checker of plans")
    vector_envs = make_env(config.env, n_envs=1)
    try:
        env = next(iter(vector_envs[config.env.type].values()))
        observation, _ = env.reset(seed=config.seed)
        raw = {key: value[0] for key, value in observation.items() if isinstance(value, np.ndarray)}
        batch = preprocessor(env_preprocessor(preprocess_observation(observation)))

        def unnormalise(motion: Tensor) -> np.ndarray:
            return postprocessor(motion).numpy()

        def check(_: int, symbols: list[str]) -> list[str]:
            return task.check_plan(symbols, raw)

        recorder = Recorder(env, policy, unnormalise)
        plan = policy.plan(batch, config.prompt, on_step=recorder, check=check if config.check else None)
        start, states = env.call("render")[0], recorder.page_states(plan)
        given = [False] * len(states[-1].words)
        if plan.tokens_given is not None:
            given = plan.tokens_given[0, : len(given)].tolist()

        config.output_dir.mkdir(parents=True, exist_ok=True)
        step_ends = task.step_ends if task else None
        files = _draw(config, start, states, given, step_ends)
        outcome, frames = _execute(env, unnormalise(plan.actions[0]), render=config.html is not None)
        complaints = check(0, plan.symbols()) if task and policy.vocabulary else None
        if config.html is not None:
            probabilities = plan.token_probabilities[0, : len(given)].tolist()
            about = [outcome, f"seed {config.seed}", *(complaints or [])]
            if prompt := policy.config.prompt if config.prompt is None else config.prompt:
                about.insert(0, f"prompt: {prompt}")
            write_page(PlanPage(about, start, frames, states, probabilities, given, step_ends), config.html)
            files["page"] = config.html
        return Result(plan.describe(0, step_ends), complaints, outcome, files)
    finally:
        close_envs(vector_envs)


def explain(config: PlanConfig) -> str:
    """What a recorded motion does, in the planner's words, and what the dataset says that it does.

    Raises:
        ValueError: the planner has no symbols, or the dataset has no such episode, other observations, or another
            horizon.
    """
    set_seed(config.seed)
    policy, preprocessor, _ = _load(config)
    if policy.vocabulary is None:
        raise ValueError("this planner models no symbols: it cannot explain a motion")
    source = config.dataset
    if source is None:
        raise ValueError("the checkpoint names no dataset: choose one with --dataset.repo_id=... --dataset.root=...")
    windows = resolve_delta_timestamps(policy.config, read_metadata(source))
    where = {"root": source.root, "revision": source.revision}
    dataset = LeRobotDataset(source.repo_id, delta_timestamps=windows, video_backend="pyav", **where)
    features = dataset_to_policy_features(dataset.meta.features)
    for key, feature in {**policy.config.input_features, **policy.config.output_features}.items():
        shape = features[key].shape if key in features else None
        is_resized = policy.config.resize_shape is not None and key in policy.config.image_features
        if shape is None or (shape != feature.shape and not is_resized):
            raise ValueError(f"the planner knows {key} of shape {feature.shape}, the dataset has {shape or 'none'}")
    if not 0 <= config.explain < dataset.num_episodes:
        raise ValueError(f"--explain={config.explain}: the dataset has the episodes 0 to {dataset.num_episodes - 1}")
    episode = dataset.meta.episodes[config.explain]
    first, stop = episode["dataset_from_index"], episode["dataset_to_index"]
    if stop - first > policy.config.horizon:
        raise ValueError(f"the episode has {stop - first} frames, the planner's horizon is {policy.config.horizon}")
    item = dataset[first]
    batch = preprocessor({key: item[key][None] for key in (*policy.config.input_features, ACTION)})
    actions = batch[ACTION].reshape(1, policy.config.horizon, -1)  # LeRobot's are (B, H) where there is one component
    plan = policy.plan(batch, PlanPrompt(actions=actions))
    task = getattr(config.env, "planning_task", None)
    words = plan.describe(0, task.step_ends if task else None)
    return f"episode {config.explain}:\n{indent(words, '    ')}\n{_compare(plan.symbols(), dataset, item)}"


def _compare(symbols: list[str], dataset: LeRobotDataset, item: dict[str, Tensor]) -> str:
    """What the dataset says about a motion that was explained by symbols."""
    if OBS_SYMBOLIC_PLAN not in item:
        return "the dataset has no symbolic plans"
    vocabulary = Vocabulary(dataset.meta.features[OBS_SYMBOLIC_PLAN]["info"]["vocabulary"])
    recorded = vocabulary.decode(item[OBS_SYMBOLIC_PLAN])
    return "the recorded plan says the same" if recorded == symbols else f"recorded: {' '.join(recorded)}"


def _load(config: PlanConfig) -> tuple[HDPPolicy, PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """The planner, its preprocessor and its postprocessor."""
    path = config.policy.pretrained_path
    policy_class = get_policy_class(config.policy.type)
    if not issubclass(policy_class, HDPPolicy):
        raise ValueError(f"hdp-plan draws the plans of `hdp` policies, not of `{config.policy.type}`")
    revision = config.policy.pretrained_revision
    policy = policy_class.from_pretrained(path, config=config.policy, revision=revision).eval()
    device = {"device_processor": {"device": policy.config.device}}
    return policy, *make_pre_post_processors(config.policy, path, revision, preprocessor_overrides=device)


def _train_config(path: str, revision: str | None) -> TrainPipelineConfig | None:
    """What the planner was trained with; None for one that was saved or uploaded without it."""
    if Path(path).is_dir() and not (Path(path) / TRAIN_CONFIG_NAME).exists():
        return None
    try:
        return TrainPipelineConfig.from_pretrained(path, revision=revision)
    except FileNotFoundError:
        return None


def _check_task(planner: HDPConfig, task: Any) -> None:
    """Refuse a task (`planning_task` of an environment's configuration) for which the planner was not made."""
    features = planner.input_features
    facts = {
        "horizon": (planner.horizon if planner.plans_whole_episodes else None, task.horizon),
        "vocabulary": (planner.vocabulary and " ".join(planner.vocabulary), " ".join(task.vocabulary)),
        "number of state components": (_size(features, OBS_STATE), len(task.state_names)),
        "number of objects' components": (_size(features, OBS_ENV_STATE), len(task.environment_state_names)),
    }
    for fact, (planners, tasks) in facts.items():
        if planners is not None and planners != tasks:
            raise ValueError(f"the planner was trained for another task: its {fact} is {planners}, here it is {tasks}")


def _size(features: dict[str, PolicyFeature], key: str) -> int | None:
    return features[key].shape[0] if key in features else None


def _draw(
    config: PlanConfig, scene: np.ndarray, states: list[PageState], given: list[bool], step_ends: StepEnds | None
) -> dict[str, Path]:
    """Write `plan.png` and `denoising.gif`."""
    rows = plan_rows(len(states[-1].words), len(states[-1].path), step_ends)

    def picture(state: PageState, caption: str):
        words = [MASK_WORD if word is None else word for word in state.words]
        return draw_plan(PlanPicture(scene, state.path, state.gripper, words, rows, given, caption))

    files = {"picture": config.output_dir / "plan.png", "animation": config.output_dir / "denoising.gif"}
    picture(states[-1], f"plan from seed {config.seed}").save(files["picture"])
    frames = [picture(state, f"step {state.step} of {states[-1].step}") for state in states]
    save_animation(frames, files["animation"])
    return files


def _project(env: gym.vector.VectorEnv, actions: np.ndarray) -> np.ndarray:
    """Waypoints in the picture of the scene: (H, 2) pixels."""
    try:
        return env.call("world_to_pixels", actions)[0]
    except AttributeError as error:
        raise ValueError("this environment has no world_to_pixels(points): its plans cannot be drawn") from error


def _execute(env: gym.vector.VectorEnv, actions: np.ndarray, render: bool) -> tuple[str, list[np.ndarray]]:
    """Step through a plan: what came of it, in words, and the scene after each waypoint.

    There is no picture of the scene after an episode's last step: vector environments have reset by then.
    """
    frames: list[np.ndarray] = []
    for action in actions:
        _, reward, terminated, truncated, info = env.step(action[None])
        if terminated[0] or truncated[0]:
            is_success = info.get("final_info", info)["is_success"][0]
            return f"executed: score {reward[0]:.2f}, {'success' if is_success else 'failure'}", frames
        if render:
            frames.append(env.call("render")[0])
    return f"executed: {len(actions)} actions, after which the episode goes on", frames


def print_plan(result: Result) -> None:
    """The plan in words, what is wrong with it, what became of it, and where the files are."""
    print("plan:\n" + indent(result.text, "    "))
    if result.complaints is not None:
        print("checked: " + ("valid" if not result.complaints else "; ".join(result.complaints)))
    print(result.outcome)
    for name, path in result.files.items():
        print(f"{name}: {path}")


@parser.wrap()
def _main(config: PlanConfig) -> None:
    if config.explain is None:
        print_plan(make_plan(config))
    else:
        print(explain(config))


def main() -> None:
    """Entry point of `hdp-plan`: bad input is one line on stderr and exit status 1."""
    logging.getLogger().setLevel(logging.WARNING)
    register_third_party_plugins()
    sys.argv[1:] = _keep_prompt(sys.argv[1:])
    try:
        _main()
    except ParsingError as error:  # draccus wraps what happens while a checkpoint's configuration is read
        sys.exit(f"hdp-plan: {error.__cause__ or error}")
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"hdp-plan: {error}")


def _keep_prompt(arguments: list[str]) -> list[str]:
    """Quote the prompt: the parser reads values as YAML, to which `...` and `7: PICK` mean something."""
    kept, rest = [], iter(arguments)
    for argument in rest:
        name, equals, value = argument.partition("=")
        if name == "--prompt":
            argument = f"--prompt={json.dumps(value if equals else next(rest, ''))}"
        kept.append(argument)
    return kept


if __name__ == "__main__":
    main()
