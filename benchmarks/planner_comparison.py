"""All planners on 2D sorting with 2 and 3 blocks: the same demonstrations, samples, network size and starts.

python -m benchmarks.planner_comparison              # runs what is missing, then writes the table and the plot
python -m benchmarks.planner_comparison --report     # only writes the table and the plot (needs the extra `benchmarks`)
python -m benchmarks.planner_comparison --samplers   # the last checkpoints again, with each sampler; then the same

These are the cells of two blocks and three of `python -m benchmarks.paper --preset mini mini_epsilon` (`--list` says
which are finished): predicting the clean motion, as the `default` preset does, and the noise, as the paper does.
"""

import argparse
import json
from typing import Any

from lerobot_hdp.configuration_hdp import SAMPLERS

from .cells import FIRST_EVALUATION_SEED, Cell, run_cells
from .evaluation import evaluate
from .machine import describe_run, write_json
from .paper.presets import METHODS, make_cells
from .planner_report import PRESETS, SAMPLERS_FILE, SEEDS, TASKS, write_page


def compare_samplers(cells: list[Cell]) -> None:
    """Evaluate the last checkpoint of each cell with each sampler, at the starts of its own last evaluation."""
    run, results = describe_run(), []
    for cell in cells:
        planner = cell.policy["type"]
        for sampler in SAMPLERS:
            if sampler == "confidence" and planner != "hdp":
                continue  # that is ddim for planners without masked symbols
            checkpoint = cell.folder / "train" / "checkpoints" / "last" / "pretrained_model"
            first_seed = FIRST_EVALUATION_SEED + (cell.evaluations - 1) * cell.starts
            result: dict[str, Any] = {"planner": planner, "seed": cell.seed, "sampler": sampler}
            results.append(result | evaluate(checkpoint, cell.starts, first_seed, sampler=sampler))
            print(json.dumps(results[-1]), flush=True)
    facts = {"preset": cells[0].facts["preset"], "task": cells[0].facts["task_name"], "starts": cells[0].starts}
    write_json(SAMPLERS_FILE, {"run": run, **facts, "results": results})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, choices=SEEDS)
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--samplers", action="store_true")
    options = parser.parse_args()
    cells = make_cells(PRESETS, TASKS, METHODS, options.seeds)
    if options.samplers:
        compare_samplers(make_cells([PRESETS[0]], [TASKS[1]], METHODS, options.seeds))
    elif not options.report:
        run_cells(cells, options.processes)
    write_page()


if __name__ == "__main__":
    main()
