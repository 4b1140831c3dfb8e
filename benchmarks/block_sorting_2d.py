"""Train on 2D sorting and evaluate fresh starts: HDP, and the motion alone beside it.

    python -m benchmarks.block_sorting_2d --n_blocks=3

Records the dataset if it is not there, runs `hdp-train --config_path=configs/block_sorting_2d_<n>_blocks.json` and
`lerobot-eval`, and writes `benchmarks/results/block_sorting_2d_<n>_blocks_<planner>.json`.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from pathlib import Path

from .machine import describe_run

RESULTS = Path(__file__).parent / "results"
OUTPUTS = Path("outputs/benchmarks")


def run(command: str, *arguments: str) -> float:
    """Run an installed command and return how long it took, in seconds."""
    start = time.perf_counter()
    subprocess.run([Path(sys.executable).with_name(command), *arguments], check=True)
    return time.perf_counter() - start


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % confidence interval of a success rate (Wilson 1927)."""
    z, rate = 1.96, successes / trials
    centre = rate + z * z / (2 * trials)
    spread = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    return tuple(round((centre + sign * spread) / (1 + z * z / trials), 4) for sign in (-1, 1))


def measure(planner: str, n_blocks: int, episodes: int, seed: int) -> dict[str, object]:
    """Train one planner and evaluate it."""
    config = f"configs/block_sorting_2d_{n_blocks}_blocks.json"
    task_flags = ("--env.task=BlockSorting2D-v0", f"--env.n_blocks={n_blocks}", "--env.waypoints_per_pose=1")
    dataset = Path(json.loads(Path(config).read_text())["dataset"]["root"])
    if not dataset.exists():
        run(
            "hdp-record",
            *task_flags,
            "--resume=true",
            f"--dataset.repo_id=local/{dataset.name}",
            f"--dataset.root={dataset}",
        )
    output = OUTPUTS / f"block_sorting_2d_{n_blocks}_blocks_{planner}_seed{seed}"
    train_s = run(
        "hdp-train",
        f"--config_path={config}",
        f"--policy.type={planner}",
        f"--output_dir={output}",
        f"--seed={seed}",
    )
    checkpoint = output / "checkpoints" / "last" / "pretrained_model"
    run(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=hdp",
        *task_flags,
        f"--eval.n_episodes={episodes}",
        "--eval.batch_size=50",
        "--eval.use_async_envs=false",
        f"--output_dir={output / 'eval'}",
    )
    scores = json.loads((output / "eval" / "eval_info.json").read_text())
    [task] = scores["per_task"]
    successes = sum(task["metrics"]["successes"])
    return {
        "planner": planner,
        "seed": seed,
        "train_minutes": round(train_s / 60, 1),
        "steps": json.loads((checkpoint / "train_config.json").read_text())["steps"],
        "episodes": episodes,
        "success_rate": successes / episodes,
        "success_rate_95": wilson_interval(successes, episodes),
        "mean_score": round(sum(task["metrics"]["sum_rewards"]) / episodes, 4),
    }


PLANNERS = ("hdp", "diffuser")
"""Policy types."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_blocks", type=int, default=3)
    parser.add_argument("--planners", nargs="+", choices=PLANNERS, default=PLANNERS)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    for name in options.planners:
        run_facts = describe_run()
        result = measure(name, options.n_blocks, options.episodes, options.seed)
        path = RESULTS / f"block_sorting_2d_{options.n_blocks}_blocks_{name}.json"
        path.write_text(json.dumps({"run": run_facts, "result": result}, indent=2) + "\n")
        print(path.read_text())


if __name__ == "__main__":
    main()
