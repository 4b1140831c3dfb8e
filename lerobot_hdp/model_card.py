"""What a planner's card on the Hub says beside what LeRobot writes on every card."""

from huggingface_hub import ModelCard
from lerobot.envs import EnvConfig

from .configuration_hdp import HDPConfig

SUMMARIES = {
    "hdp": "Hybrid Diffusion Planner (Høeg et al. 2026): denoises a robot motion and the symbolic plan behind it at "
    "once, so that the two agree.",
    "diffuser": "Diffuser (Janner et al. 2022): denoises a robot motion, without symbols.",
    "joint_diffuser": "Joint Diffuser: denoises a robot motion and one-hot symbols as one continuous variable.",
    "separate_diffuser": "Separate Diffuser: denoises a robot motion and one-hot symbols, each at its own level.",
    "hd": "Hierarchical Diffuser (Chen et al. 2024): plans sub-goals, then the segments between them.",
    "chd": "Coupled hierarchical planner: denoises sub-goals and segments together, each seeing the other.",
}


def describe_planner(card: ModelCard, config: HDPConfig, fps: int | None, env: EnvConfig | None = None) -> ModelCard:
    """Say below the card's title what the planner is, what it needs and how it is asked for a plan.

    Args:
        card: as LeRobot makes it.
        config: of the planner, complete with what the dataset says.
        fps: actions a second in its dataset, where that is known.
        env: that of its training configuration. In one of ours, `hdp-plan` draws and executes plans.
    """
    where = config.repo_id or "<repository>"
    lines = [
        SUMMARIES.get(config.type, f"A planner of type `{config.type}`."),
        f"From one observation it plans {config.horizon} actions, in {config.num_inference_steps} network "
        f"calls{' of each level' if config.type in ('hd', 'chd') else ''}. " + _say_what_is_executed(config, fps),
        "LeRobot knows this policy when the plugin `lerobot_policy_hdp` is installed.",
    ]
    if config.symbol_process is not None:
        _, *symbols = config.vocabulary or ["PAD"]
        words = " ".join(f"`{symbol}`" for symbol in symbols)
        # A plan may not begin with this symbol. Planners of Gaussian symbols must be told its position.
        prompt = f"... {symbols[0]} ..." if config.symbol_process == "masked" else f"2:{symbols[0]}"
        lines += [
            f"Symbols, at most {config.symbolic_horizon} in a plan: {words}. A part of the plan may be given in these "
            f'words, and the planner adds the rest: `--policy.prompt="{prompt}"`.',
        ]
    if env is not None and env.type == "hdp":
        lines += [
            "A plan, in words and pictures, and its execution:",
            f"```bash\nhdp-plan --policy.path={where} --seed=1\n```",
        ]
    title, rest = card.text.split("# ", 1)[1].split("\n", 1)
    card.text = "\n\n".join([f"# {title}", *lines]) + "\n" + rest
    return card


def _say_what_is_executed(config: HDPConfig, fps: int | None) -> str:
    if not config.plans_whole_episodes:
        return f"The robot executes {config.n_action_steps or 'all'} of them before it plans again."
    rate = f"at {fps} a second (`lerobot-rollout --fps={fps}`)" if fps else "at the rate of the dataset"
    return f"They are a whole episode, executed {rate} without another look; then the last one is held."
