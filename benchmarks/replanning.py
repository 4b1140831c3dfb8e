"""Success of a planner that plans again and again, over the actions that are executed of each plan.

    hdp-train --config_path=configs/block_sorting_2d_2_blocks.json --policy.plan_from=any_frame --steps=5000 \
      --policy.dtype=bfloat16 --output_dir=outputs/train/any_frame
    python -m benchmarks.replanning outputs/train/any_frame/checkpoints/last/pretrained_model

By `lerobot-eval`, on the same fresh starts of sorting in the plane. Writes `benchmarks/results/replanning.json`.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from lerobot.configs.train import TrainPipelineConfig

from .evaluation import wilson_interval
from .machine import RESULTS, describe_run, write_json

FILE = RESULTS / "replanning.json"
FIRST_SEED = 2_000_000


def evaluate_replanning(checkpoint: Path, env_flags: list[str], actions: int, starts: int) -> dict[str, float]:
    """What `lerobot-eval` finds, in a process of its own, when some actions of each plan are executed."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            Path(sys.executable).with_name("lerobot-eval"),
            f"--policy.path={checkpoint}",
            f"--policy.n_action_steps={actions}",
            *env_flags,
            f"--eval.n_episodes={starts}",
            f"--eval.batch_size={starts}",
            "--eval.use_async_envs=false",
            f"--seed={FIRST_SEED}",
            f"--output_dir={folder}",
        ]
        subprocess.run(command, check=True)
        found = json.loads((Path(folder) / "eval_info.json").read_text())["overall"]
    successes = round(starts * found["pc_success"] / 100)
    return {
        "actions_of_each_plan": actions,
        "success_rate": successes / starts,
        "interval_95": wilson_interval(successes, starts),
        "mean_score": found["avg_max_reward"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a folder `pretrained_model`, trained with plan_from=any_frame")
    parser.add_argument("--actions", nargs="+", type=int, default=[19, 12, 6, 3, 1])
    parser.add_argument("--starts", type=int, default=200)
    options = parser.parse_args()

    config = TrainPipelineConfig.from_pretrained(options.checkpoint)
    task = {name: getattr(config.env, name) for name in ("type", "task", "n_blocks", "waypoints_per_pose")}
    env_flags = [f"--env.{name}={value}" for name, value in task.items()]
    run = describe_run()
    curve = [evaluate_replanning(options.checkpoint, env_flags, actions, options.starts) for actions in options.actions]
    training = {"steps": config.steps, "batch_size": config.batch_size, "policy": config.policy.type}
    training |= {name: getattr(config.policy, name) for name in ("plan_from", "horizon", "num_layers", "width")}
    result = {"env": task, "training": training, "starts": options.starts, "curve": curve}
    write_json(FILE, {"run": run, "result": result})
    print(json.dumps(curve, indent=2))


if __name__ == "__main__":
    main()
