"""How many different plans a planner makes where many are equally good, for each way of sampling.

    python -m benchmarks.plan_variety checkpoints/xarm_tool_use

For checkpoints of XArmToolUse, whose demonstrations choose one of 36 plans uniformly, whatever the start: six orders of
dragging times six of stacking. Symbolic plans are counted; none is executed. Adds to
`benchmarks/results/plan_variety.json`, and writes docs/few_steps.md.
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from . import few_step_planning
from .evaluation import load, make_plans
from .machine import describe_run


def effective_number(plans: Sequence[Sequence[str]]) -> float:
    """The exponential of the entropy of their frequencies: n for n plans that are equally frequent."""
    shares = np.array(list(Counter(map(tuple, plans)).values())) / len(plans)
    return math.exp(-(shares * np.log(shares)).sum())


def measure(checkpoint: Path, way: str, calls: int, starts: int) -> dict[str, Any]:
    """Plan for some fresh starts, one plan each."""
    options = few_step_planning.WAYS[way]
    subject = load(checkpoint, starts, first_seed=few_step_planning.FIRST_SEED, num_inference_steps=calls, **options)
    plans, check = make_plans(subject).symbols, subject.make_env().unwrapped.planning_task.check_plan
    valid = [not check(*pair) for pair in zip(plans, subject.observations, strict=True)]
    return {
        "planner": subject.policy.config.type,
        "way": way,
        "calls": calls,
        "starts": starts,
        "valid": round(float(np.mean(valid)), 4),
        "effective_number": round(effective_number(plans), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path, help="folders `pretrained_model`")
    parser.add_argument("--ways", nargs="+", choices=few_step_planning.WAYS, default=["ddim"])
    parser.add_argument("--calls", nargs="+", type=int, default=[10])
    parser.add_argument("--starts", type=int, default=1000)
    options = parser.parse_args()
    run, file = describe_run(), few_step_planning.VARIETY_FILE
    results = json.loads(file.read_text()) if file.exists() else {}
    for checkpoint in options.checkpoints:
        for way in options.ways:
            for calls in options.calls:
                result = measure(checkpoint, way, calls, options.starts)
                results[f"{result['planner']}, {way}, {calls} calls"] = {"run": run, "result": result}
                print(result, flush=True)
                file.write_text(json.dumps(results, indent=2) + "\n")
    few_step_planning.write_page()


if __name__ == "__main__":
    main()
