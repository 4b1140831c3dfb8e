"""Success over the number of network calls for a plan, for each way of sampling, with one trained checkpoint.

    python -m benchmarks.few_step_planning checkpoints/xarm_arrange_blocks

All plan for the same fresh starts of the task that the checkpoint was trained for. Writes
`benchmarks/results/few_step_planning/<planner>_<task>.json`, and all results there to `docs/few_steps.md`.
"""

import argparse
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

from lerobot.configs.train import TrainPipelineConfig

from .evaluation import evaluate
from .machine import RESULTS, describe_run, write_json
from .pages import DOCS, markdown_table

FOLDER = RESULTS / "few_step_planning"
PAGE = DOCS / "few_steps.md"
FIRST_SEED = 2_000_000
WAYS: dict[str, dict[str, Any]] = {
    "ddpm": {"sampler": "ddpm", "symbol_lead": 0.0},
    "ddim": {"sampler": "ddim", "symbol_lead": 0.0},
    "confidence": {"sampler": "confidence", "symbol_lead": 0.0, "confidence_threshold": 0.95},
    "confidence, 0.8": {"sampler": "confidence", "symbol_lead": 0.0, "confidence_threshold": 0.8},
    "symbols lead": {"sampler": "confidence", "symbol_lead": 0.5, "confidence_threshold": 0.95},
    "symbols lead, 0.8": {"sampler": "confidence", "symbol_lead": 0.5, "confidence_threshold": 0.8},
    "symbols lead, 0.99": {"sampler": "confidence", "symbol_lead": 0.5, "confidence_threshold": 0.99},
}
PREAMBLE = """# Plans in few network calls

Success in % of fresh starts (95 % interval), over the network calls for a plan.

- `ddpm` is the paper's sampler, and `ddim` draws the motion's noise at the start only. (The paper does not say how many
  calls it uses; Diffusion Policy, on which it builds, uses 100.)
- `confidence` is DDIM for the motion, and symbols revealed as soon as the planner is sure of them: with
  `confidence_threshold=0.95`, or what is named instead. A low threshold reveals more symbols in a call, but these are
  drawn independently and may contradict each other. A planner that has learned its plans is sure of nearly all
  symbols, and the threshold makes no difference.
- *symbols lead* is the same with `symbol_lead=0.5`, the preset `default`: half of the calls reveal symbols beside a
  motion that is still pure noise, the other half denoise the motion. Without a lead, the motion may commit itself to a
  plan of its own before the symbols have made up theirs. With a lead, it has half of the calls: in arranging, 5 are
  too few then.

Each section names what made it, as the command was at that commit (today, ways of two words are quoted, `--ways ddpm
'symbols lead'`, `--samplers` is gone, and `confidence`, where the column has 0.8, meant that threshold); of the
checkpoints, those in `checkpoints/` were kept. Set `--policy.sampler`,
`--policy.confidence_threshold`, `--policy.symbol_lead` and `--policy.num_inference_steps`.

"""


def evaluate_way(checkpoint: Path, way: str, calls: int, starts: int) -> dict[str, Any]:
    """Plan and execute some fresh starts."""
    start = time.perf_counter()
    result = evaluate(checkpoint, starts, FIRST_SEED, num_inference_steps=calls, **WAYS[way])
    return {"way": way, "calls": calls, **result, "seconds": round(time.perf_counter() - start, 1)}


def write_page() -> None:
    """All results as tables, one for each task."""
    page = PREAMBLE
    for path in sorted(FOLDER.glob("*.json")):
        file = json.loads(path.read_text())
        result = file["result"]
        cells = {(point["way"], point["calls"]): point for point in result["curve"]}
        ways = [way for way in WAYS if any(key[0] == way for key in cells)]
        page += f"## `{result['planner']}`, {result['task']}\n\n"
        page += f"{result['starts']} starts, one checkpoint of {result['train_steps']} steps; "
        page += f"`{file['run']['command']}`, code of {file['run']['git_commit']}.\n\n"
        rows = [
            [str(calls), *(_percent(cells.get((way, calls))) for way in ways)]
            for calls in sorted({key[1] for key in cells})
        ]
        page += markdown_table(["calls", *ways], rows) + "\n"
    PAGE.write_text(page.rstrip() + "\n")


def _percent(point: dict[str, Any] | None) -> str:
    if point is None:
        return "not run"
    low, high = point["interval_95"]
    return f"{100 * point['success_rate']:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="a folder `pretrained_model` of a run with an environment")
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=["ddpm", "ddim", "confidence", "symbols lead"])
    parser.add_argument("--calls", nargs="+", type=int, default=[1, 2, 3, 4, 5, 7, 10, 20, 50, 100])
    parser.add_argument("--starts", type=int, default=200)
    options = parser.parse_args()

    train_config = TrainPipelineConfig.from_pretrained(options.checkpoint)
    env = train_config.env
    task = env.task.removesuffix("-v0") + (f"_{env.n_blocks}_blocks" if env.task == "BlockSorting2D-v0" else "")
    planner, run_facts = train_config.policy.type, describe_run()
    curve: list[dict[str, Any]] = []
    result = {
        "planner": planner,
        "task": task,
        "starts": options.starts,
        "train_steps": train_config.steps,
        "curve": curve,
    }
    file = FOLDER / f"{planner}_{task}.json"
    unfinished = file.with_suffix(".unfinished")
    for way, calls in product(options.ways, options.calls):
        curve.append(evaluate_way(options.checkpoint, way, calls, options.starts))
        print(curve[-1], flush=True)
        write_json(unfinished, {"run": run_facts, "result": result})
    unfinished.rename(file)
    write_page()


if __name__ == "__main__":
    main()
