"""All planners on 2D sorting with 2 and 3 blocks: the same demonstrations, samples, network size and starts.

python -m benchmarks.planner_comparison              # runs what is missing, then writes the table and the plot
python -m benchmarks.planner_comparison --report     # only writes the table and the plot (needs the extra `benchmarks`)

These are the cells of two blocks and three of `python -m benchmarks.paper --preset mini mini_epsilon` (`--list` says
which are finished): predicting the clean motion, as the `default` preset does, and the noise, as the paper does.
"""

import argparse

from .cells import run_cells
from .paper.presets import METHODS, make_cells
from .planner_report import write_report

PRESETS = ("mini", "mini_epsilon")
TASKS = ("block_sorting_2d_2_blocks", "block_sorting_2d_3_blocks")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    cells = make_cells(PRESETS, TASKS, METHODS, options.seeds)
    if not options.report:
        run_cells(cells, options.processes)
    write_report(cells)


if __name__ == "__main__":
    main()
