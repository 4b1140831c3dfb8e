"""`hdp-plan`: make one plan, print it in words, draw it, and execute it.

Example:
    hdp-plan --policy.path=outputs/train/run/checkpoints/last/pretrained_model --seed=3 --prompt="PICK B"
"""

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from draccus.utils import ParsingError
from lerobot import envs, policies  # noqa: F401 (registers LeRobot's own)
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig, close_envs, make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.random_utils import set_seed
from torch import Tensor

from lerobot_hdp.drawing import MASK_WORD, PlanPicture, draw_plan, save_animation
from lerobot_hdp.modeling_hdp import HDPPolicy
from lerobot_hdp.plan import Plan, PlanPrompt
from lerobot_hdp.sampling import DenoisingState

WORDS_PER_ROW = 6
ANIMATION_FRAMES = 40


@dataclass
class PlanConfig:
    """Options of `hdp-plan`.

    Attributes:
        policy: the planner, by `--policy.path=` (a checkpoint's `pretrained_model` folder or a Hub repository).
        env: the task. None: the one in the checkpoint's training configuration.
        seed: seed of the start and of the plan.
        prompt: a part of the plan in words, e.g. "PICK B ..." or "... STACK red" (docs/conditioning.md).
        output_dir: where the pictures go.
    """

    policy: PreTrainedConfig | None = None
    env: EnvConfig | None = None
    seed: int = 0
    prompt: str = ""
    output_dir: Path = Path("outputs/plan")

    def __post_init__(self):
        path = parser.get_path_arg("policy")
        if not path:
            raise ValueError("--policy.path is missing: the checkpoint's pretrained_model folder")
        overrides = parser.get_cli_overrides("policy") or []
        self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        self.policy.pretrained_path = Path(path)
        if self.env is None:
            self.env = TrainPipelineConfig.from_pretrained(path).env
        if self.env is None:
            raise ValueError("the checkpoint names no task: choose one with --env.type=hdp --env.task=...")

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        return ["policy"]


class Result(NamedTuple):
    """What became of a plan.

    Attributes:
        symbols: the plan in words, without PAD.
        score: of the episode, in [0, 1].
        is_success: what the environment says.
        picture, animation: the files that were written.
    """

    symbols: list[str]
    score: float
    is_success: bool
    picture: Path
    animation: Path


def make_plan(config: PlanConfig) -> Result:
    """Plan once, draw the motion over the scene and the denoising, then execute the plan in the environment.

    Raises:
        ValueError: the policy is no planner of this package, or the prompt does not fit.
    """
    set_seed(config.seed)
    policy = make_policy(config.policy, env_cfg=config.env)
    if not isinstance(policy, HDPPolicy):
        raise ValueError(f"hdp-plan draws the plans of `hdp` policies, not of `{config.policy.type}`")
    policy.eval()
    preprocessor, postprocessor = make_pre_post_processors(
        config.policy,
        config.policy.pretrained_path,
        preprocessor_overrides={"device_processor": {"device": policy.config.device}},
    )
    env_preprocessor, _ = make_env_pre_post_processors(config.env, config.policy)
    vector_envs = make_env(config.env, n_envs=1)
    try:
        env = next(iter(vector_envs[config.env.type].values()))
        observation, _ = env.reset(seed=config.seed)
        batch = preprocessor(env_preprocessor(preprocess_observation(observation)))
        prompt = policy.read_prompt(batch, config.prompt or None)

        states: list[DenoisingState] = []
        plan = policy.plan(batch, prompt, on_step=lambda _, state: states.append(state))

        def unnormalise(motion: Tensor) -> np.ndarray:
            return postprocessor(motion[0]).numpy()

        config.output_dir.mkdir(parents=True, exist_ok=True)
        picture, animation = _draw(config, env, policy, plan, prompt, states, unnormalise)
        score, is_success = _execute(env, unnormalise(plan.actions))
        return Result(plan.symbols(), score, is_success, picture, animation)
    finally:
        close_envs(vector_envs)


def _draw(
    config: PlanConfig,
    env: gym.vector.VectorEnv,
    policy: HDPPolicy,
    plan: Plan,
    prompt: PlanPrompt,
    states: list[DenoisingState],
    unnormalise: Callable[[Tensor], np.ndarray],
) -> tuple[Path, Path]:
    """Write `plan.png` and `denoising.gif`, and say where they are."""
    scene = env.call("render")[0]
    length = max(len(plan.symbols()), 1)
    rows = -(-length // WORDS_PER_ROW) if policy.vocabulary else 0
    given = prompt.tokens_mask[0].tolist() if prompt.tokens_mask is not None else None

    def words(tokens: Tensor | None) -> list[str]:
        if tokens is None:
            return []
        shown = [*policy.vocabulary.symbols, MASK_WORD]
        return [shown[i] for i in tokens[0, :length].tolist()]

    def picture(motion: Tensor, tokens: Tensor | None, caption: str):
        actions = unnormalise(motion)
        path = _project(env, actions, scene)
        return draw_plan(PlanPicture(scene, path, actions[:, -1], words(tokens), given, caption), rows)

    last = len(states) - 1
    chosen = sorted({round(i) for i in np.linspace(0, last, min(ANIMATION_FRAMES, last + 1))})
    frames = [picture(states[i].motion, states[i].tokens, f"step {i} of {last}") for i in chosen]
    picture_file, animation_file = config.output_dir / "plan.png", config.output_dir / "denoising.gif"
    picture(plan.actions, plan.token_ids, f"plan from seed {config.seed}").save(picture_file)
    save_animation(frames, animation_file)
    return picture_file, animation_file


def _project(env: gym.vector.VectorEnv, actions: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """Waypoints in the picture of the scene: (H, 2) pixels."""
    try:
        return env.call("world_to_pixels", actions)[0]
    except AttributeError as error:
        raise ValueError("this environment has no world_to_pixels(points): its plans cannot be drawn") from error


def _execute(env: gym.vector.VectorEnv, actions: np.ndarray) -> tuple[float, bool]:
    """Step through a plan; the score and the success at its end."""
    for action in actions:
        _, reward, terminated, truncated, info = env.step(action[None])
        if terminated[0] or truncated[0]:
            final = info.get("final_info", info)
            return float(reward[0]), bool(final["is_success"][0])
    return float(reward[0]), bool(info["is_success"][0])


def print_plan(result: Result) -> None:
    """The plan in words, six to a line, and where the pictures are."""
    symbols = result.symbols
    print("plan:")
    for start in range(0, len(symbols), WORDS_PER_ROW):
        print("   ", " ".join(symbols[start : start + WORDS_PER_ROW]))
    if not symbols:
        print("    (no symbols)")
    print(f"executed: score {result.score:.2f}, {'success' if result.is_success else 'failure'}")
    print(f"picture: {result.picture}\nanimation: {result.animation}")


@parser.wrap()
def _main(config: PlanConfig) -> None:
    print_plan(make_plan(config))


def main() -> None:
    """Entry point of `hdp-plan`: bad input is one line on stderr and exit status 1."""
    logging.getLogger().setLevel(logging.WARNING)
    register_third_party_plugins()
    try:
        _main()
    except ParsingError as error:  # draccus wraps what happens while a checkpoint's configuration is read
        sys.exit(f"hdp-plan: {error.__cause__ or error}")
    except (ValueError, FileNotFoundError) as error:
        sys.exit(f"hdp-plan: {error}")


if __name__ == "__main__":
    main()
