"""Fill the paper's tables cell by cell, on whatever hardware is there.

    python -m benchmarks.paper --preset mini --tasks xarm_arrange_blocks --methods hdp diffuser --seeds 0 1 2
    python -m benchmarks.paper --list           # what is missing, in the order worth doing

A cell is one preset, task, method and seed: it records its demonstrations, trains with `hdp-train`, evaluates fresh
starts at regular intervals, and writes `benchmarks/results/paper/<preset>/<cell>.json`. A finished cell is never run
again, an interrupted one goes on.
"""

import argparse

from ..cells import run_cells
from .presets import METHODS, PRESETS, TASKS, make_cells


def main() -> None:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", nargs="+", dest="presets", choices=PRESETS, default=["default"])
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, help="those that the preset has")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--budget_minutes", type=float, help="stop with checkpoints when it is spent")
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument("--list", action="store_true", help="say what is finished and what is missing")
    options = parser.parse_args()

    cells = make_cells(options.presets, options.tasks, options.methods, options.seeds)
    if options.list:
        for cell in cells:
            print(f"{cell.group.removeprefix('paper/') + '/' + cell.name:60} {cell.state()}")
    else:
        run_cells(cells, options.processes, options.budget_minutes)


if __name__ == "__main__":
    main()
