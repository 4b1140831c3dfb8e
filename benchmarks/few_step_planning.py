"""Success over the number of network calls for a plan, for each sampler, with one trained checkpoint.

    python -m benchmarks.few_step_planning outputs/train/sorting/checkpoints/last/pretrained_model

Every sampler plans for the same fresh starts of the task that the checkpoint was trained for, in LeRobot's own
evaluation. Writes `benchmarks/results/few_step_planning/<planner>_<task>.json`, and all results there to
`docs/few_steps.md`.
"""

import argparse
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy_all
from lerobot.utils.random_utils import set_seed

from gym_hdp_tasks.env_config import HDPEnv
from lerobot_hdp.configuration_hdp import SAMPLERS

from .evaluation import load_policy, wilson_interval
from .machine import RESULTS, describe_run
from .pages import DOCS, markdown_table

FOLDER = RESULTS / "few_step_planning"
PAGE = DOCS / "few_steps.md"
FIRST_SEED = 2_000_000
PREAMBLE = """# Plans in few network calls

Success in % of fresh starts (95 % interval), over the network calls for a plan. `ddpm` is the paper's sampler,
which uses 100 calls; `confidence` is the `default` preset's: DDIM for the motion, and symbols revealed as soon as the
planner is sure of them. Set `--policy.sampler` and `--policy.num_inference_steps`.

"""


def evaluate(checkpoint: Path, env: HDPEnv, sampler: str, calls: int, episodes: int) -> dict[str, Any]:
    """Plan and execute `episodes` starts at once."""
    policy, *processors = load_policy(checkpoint, sampler=sampler, num_inference_steps=calls)
    set_seed(0)
    environments = make_env(env, n_envs=episodes)
    start = time.perf_counter()
    info = eval_policy_all(
        environments,
        policy,
        *make_env_pre_post_processors(env, policy.config),
        *processors,
        n_episodes=episodes,
        start_seed=FIRST_SEED,
    )["overall"]
    close_envs(environments)
    return {
        "sampler": sampler,
        "calls": calls,
        "success_rate": info["pc_success"] / 100,
        "success_rate_95": wilson_interval(round(info["pc_success"] * episodes / 100), episodes),
        "mean_score": round(info["avg_sum_reward"], 4),
        "seconds": round(time.perf_counter() - start, 1),
    }


def write_page() -> None:
    """All results as tables, one for each task."""
    page = PREAMBLE
    for path in sorted(FOLDER.glob("*.json")):
        file = json.loads(path.read_text())
        result = file["result"]
        cells = {(point["sampler"], point["calls"]): point for point in result["curve"]}
        samplers = [sampler for sampler in SAMPLERS if any(key[0] == sampler for key in cells)]
        page += f"## `{result['planner']}`, {result['task']}\n\n"
        page += f"{result['episodes']} starts, one checkpoint of {result['train_steps']} steps; "
        page += f"`{file['run']['command']}`, code of {file['run']['git_commit']}.\n\n"
        rows = [
            [str(calls), *(_percent(cells.get((sampler, calls))) for sampler in samplers)]
            for calls in sorted({key[1] for key in cells})
        ]
        page += markdown_table(["calls", *(f"`{sampler}`" for sampler in samplers)], rows) + "\n"
    PAGE.write_text(page.rstrip() + "\n")


def _percent(point: dict[str, Any] | None) -> str:
    if point is None:
        return "not run"
    low, high = point["success_rate_95"]
    return f"{100 * point['success_rate']:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a folder `pretrained_model` of a run with an environment")
    parser.add_argument("--samplers", nargs="+", choices=SAMPLERS, default=SAMPLERS)
    parser.add_argument("--calls", nargs="+", type=int, default=[1, 2, 3, 4, 5, 7, 10, 20, 50, 100])
    parser.add_argument("--episodes", type=int, default=200)
    options = parser.parse_args()

    train_config = TrainPipelineConfig.from_pretrained(options.checkpoint)
    env = train_config.env
    task = env.task.removesuffix("-v0") + (f"_{env.n_blocks}_blocks" if env.task == "BlockSorting2D-v0" else "")
    planner, run_facts = train_config.policy.type, describe_run()
    curve: list[dict[str, Any]] = []
    result = {
        "planner": planner,
        "task": task,
        "episodes": options.episodes,
        "train_steps": train_config.steps,
        "curve": curve,
    }
    FOLDER.mkdir(parents=True, exist_ok=True)
    file = FOLDER / f"{planner}_{task}.json"
    unfinished = file.with_suffix(".unfinished")
    for sampler, calls in product(options.samplers, options.calls):
        curve.append(evaluate(options.checkpoint, env, sampler, calls, options.episodes))
        print(curve[-1], flush=True)
        unfinished.write_text(json.dumps({"run": run_facts, "result": result}, indent=2) + "\n")
    unfinished.rename(file)
    write_page()


if __name__ == "__main__":
    with torch.no_grad():
        main()
