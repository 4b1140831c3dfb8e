"""Train planners by a train config and evaluate them on fresh starts, with the commands that users have.

    python -m benchmarks.train_and_evaluate configs/xarm_sorting.json --planners hdp --name mini \\
        --policy.num_layers=4 --policy.width=128 --steps=3000

Records the config's dataset if it is not there, runs `hdp-train` and `lerobot-eval`, and writes
`benchmarks/results/<config>_<name>_<planner>.json`. Further flags go to `hdp-train`.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from .evaluation import wilson_interval
from .machine import RESULTS, describe_run

OUTPUTS = Path("outputs/benchmarks")


def run(command: str, *arguments: str) -> float:
    """Run an installed command and return how long it took, in seconds."""
    start = time.perf_counter()
    subprocess.run([Path(sys.executable).with_name(command), *arguments], check=True)
    return time.perf_counter() - start


def measure(config: Path, name: str, planner: str, episodes: int, seed: int, flags: list[str]) -> dict[str, Any]:
    """Train one planner and evaluate it.

    Args:
        config: a train config with a dataset and an environment.
        name: of the run, and of its folder.
        planner: policy type.
        episodes: fresh starts; a multiple of 50, or fewer.
        seed: of the training; the evaluation has LeRobot's.
        flags: more flags for `hdp-train`.
    """
    settings = json.loads(config.read_text())
    task_flags = [f"--env.{key}={value}" for key, value in settings["env"].items() if key != "type"]
    dataset = Path(settings["dataset"]["root"])
    if not dataset.exists():
        run(
            "hdp-record",
            *task_flags,
            "--resume=true",
            "--num_workers=2",
            f"--dataset.repo_id={settings['dataset']['repo_id']}",
            f"--dataset.root={dataset}",
        )
    output = OUTPUTS / f"{name}_{planner}_seed{seed}"
    checkpoint = output / "checkpoints" / "last" / "pretrained_model"
    resumed, flags_file = checkpoint.exists(), output.with_suffix(".flags.json")
    if resumed and json.loads(flags_file.read_text()) != flags:
        raise ValueError(f"{output} was trained with other flags: delete it, or choose another --name")
    flags_file.parent.mkdir(parents=True, exist_ok=True)
    flags_file.write_text(json.dumps(flags))
    if resumed:
        train_flags = ["--resume=true", f"--config_path={checkpoint / 'train_config.json'}"]
    else:
        train_flags = [f"--config_path={config}", f"--policy.type={planner}", f"--output_dir={output}", *flags]
        train_flags += [f"--seed={seed}"]
    train_s = run("hdp-train", *train_flags)
    run(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--env.type=hdp",
        *task_flags,
        f"--eval.n_episodes={episodes}",
        f"--eval.batch_size={min(episodes, 50)}",
        "--eval.use_async_envs=false",
        f"--output_dir={output / 'eval'}",
    )
    scores = json.loads((output / "eval" / "eval_info.json").read_text())
    [task] = scores["per_task"]
    successes = sum(task["metrics"]["successes"])
    return {
        "planner": planner,
        "seed": seed,
        "train_minutes": None if resumed else round(train_s / 60, 1),
        "steps": json.loads((checkpoint / "train_config.json").read_text())["steps"],
        "demonstrations": json.loads((dataset / "meta" / "info.json").read_text())["total_episodes"],
        "flags": flags,
        "episodes": episodes,
        "success_rate": successes / episodes,
        "success_rate_95": wilson_interval(successes, episodes),
        "mean_score": round(sum(task["metrics"]["sum_rewards"]) / episodes, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("--name", help="of a variant that other flags make of the config")
    parser.add_argument("--planners", nargs="+", default=["hdp", "diffuser"])
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1000)
    options, flags = parser.parse_known_args()
    name = options.config.stem + (f"_{options.name}" if options.name else "")
    for planner in options.planners:
        run_facts = describe_run()
        result = measure(options.config, name, planner, options.episodes, options.seed, flags)
        path = RESULTS / f"{name}_{planner}.json"
        path.write_text(json.dumps({"run": run_facts, "result": result}, indent=2) + "\n")
        print(path.read_text())


if __name__ == "__main__":
    main()
