"""How many different plans a planner makes where many are equally good, for each way of sampling.

    python -m benchmarks.plan_variety checkpoints/xarm_tool_use

For checkpoints of XArmToolUse, whose demonstrations choose one of 36 plans uniformly, whatever the start: six orders of
dragging times six of stacking. Symbolic plans are counted; none is executed. Adds to
`benchmarks/results/plan_variety.json`, and writes `docs/plan_variety.md`.
"""

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .evaluation import load, make_plans
from .few_step_planning import FIRST_SEED, WAYS
from .machine import RESULTS, describe_run, write_json
from .pages import DOCS, markdown_table

FILE = RESULTS / "plan_variety.json"
PAGE = DOCS / "plan_variety.md"
PREAMBLE = """# How many different plans

In tool use, the demonstrations choose one of 36 plans uniformly, whatever the start. A planner that has learned this
makes about 35 of them in the 1,000 starts of the table: the effective number is the exponential of the entropy of the
plans' shares, and less means that it prefers some. (More means that it also makes invalid ones.)

Revealing what the planner is surest of prefers plans that are a little more probable, most of all where symbols lead
and decide alone. That is part of what makes plans in few calls valid. Where variety counts, set
`--policy.symbol_lead=0`, or use `ddim` with more calls.

"""


def effective_number(plans: Sequence[Sequence[str]]) -> float:
    """The exponential of the entropy of their frequencies: n for n plans that are equally frequent."""
    shares = np.array(list(Counter(map(tuple, plans)).values())) / len(plans)
    return math.exp(-(shares * np.log(shares)).sum())


def measure(checkpoint: Path, way: str, calls: int, starts: int) -> dict[str, Any]:
    """Plan for some fresh starts, one plan each."""
    subject = load(checkpoint, starts, first_seed=FIRST_SEED, num_inference_steps=calls, **WAYS[way])
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


def write_page() -> None:
    """All results as one table."""
    contents = list(json.loads(FILE.read_text()).values())
    rows = [
        [
            f"`{result['planner']}`",
            result["way"],
            str(result["calls"]),
            f"{result['effective_number']:.1f}",
            f"{100 * result['valid']:.1f} %",
        ]
        for result in (content["result"] for content in contents)
    ]
    made_by = sorted({f"`{run['command']}`, code of {run['git_commit']}" for run in (c["run"] for c in contents)})
    table = markdown_table(["planner", "way", "calls", "effective number of plans", "valid"], rows)
    PAGE.write_text(PREAMBLE + table + "\n" + "\n\n".join(made_by) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", type=Path, help="folders `pretrained_model`")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["ddim"])
    parser.add_argument("--calls", nargs="+", type=int, default=[10])
    parser.add_argument("--starts", type=int, default=1000)
    options = parser.parse_args()
    run = describe_run()
    results = json.loads(FILE.read_text()) if FILE.exists() else {}
    for checkpoint in options.checkpoints:
        for way in options.ways:
            for calls in options.calls:
                result = measure(checkpoint, way, calls, options.starts)
                results[f"{result['planner']}, {way}, {calls} calls"] = {"run": run, "result": result}
                print(result, flush=True)
                write_json(FILE, results)
    write_page()


if __name__ == "__main__":
    main()
