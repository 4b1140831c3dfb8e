"""Fill the paper's tables cell by cell, on whatever hardware is there.

    python -m benchmarks.paper --preset mini --tasks xarm_arrange_blocks --methods hdp diffuser --seeds 0 1 2
    python -m benchmarks.paper --list           # what is missing, in the order worth doing
    python -m benchmarks.paper --report         # docs/results.md, from benchmarks/results/paper/

A cell is one preset, task, method and seed: it records its demonstrations, trains with `hdp-train`, evaluates fresh
starts at regular intervals, and writes `benchmarks/results/paper/<preset>/<cell>.json`. A finished cell is never run
again, an interrupted one goes on. `--pack` and `--unpack` are for machines without a checkout, see packing.py.
"""

import argparse
import shlex
from pathlib import Path

from ..cells import run_cells
from .packing import export, join_files, pack, packed_cells, unpack
from .presets import METHODS, PRESETS, TASKS, make_cells
from .report import write_report


def main() -> None:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.paper", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--preset", nargs="+", dest="presets", choices=PRESETS, help="`default`; --list knows all")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=TASKS, help="those that the preset has")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument(
        "--packed", action="store_true", help="the cells of the packed folder that is the working folder"
    )
    parser.add_argument("--budget_minutes", type=float, help="stop with checkpoints when it is spent")
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument(
        "--train_flags",
        type=shlex.split,
        default=[],
        help='further ones of hdp-train, for this machine: --train_flags="--policy.compile_model=true"',
    )
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--list", action="store_true", help="say what is finished and what is missing")
    action.add_argument("--report", action="store_true", help="write docs/results.md")
    action.add_argument("--pack", type=Path, metavar="FOLDER", help="put what the missing cells need into a new folder")
    action.add_argument("--unpack", type=Path, metavar="FOLDER", help="take over what was run there")
    action.add_argument(
        "--export", type=Path, metavar="FOLDER", help="write the finished planners as small checkpoints"
    )
    action.add_argument("--join", type=Path, metavar="FOLDER", help="join the files of such a checkpoint")
    parser.add_argument("--max_file_size", default="5GB", help="of --export, e.g. 15MB")
    options = parser.parse_args()

    presets = options.presets or (list(PRESETS) if options.list else ["default"])
    chosen = presets, options.tasks, options.methods, options.seeds
    cells = packed_cells() if options.packed else make_cells(*chosen)
    if not (cells or options.packed or options.report or options.unpack or options.join):
        parser.error("no preset that is chosen has such a task, or the method cannot do it")
    if options.list:
        for cell in cells:
            print(f"{cell.group.removeprefix('paper/') + '/' + cell.name:60} {cell.state()}")
    elif options.report:
        print(*write_report(), sep="\n")
    elif options.pack:
        pack([cell for cell in cells if cell.state() != "finished"], options.pack)
    elif options.unpack:
        unpack(options.unpack)
    elif options.export:
        for cell in cells:
            target = options.export / cell.facts["preset"] / cell.name
            if cell.state() == "finished" and cell.last_checkpoint and not target.exists():
                export(cell.last_checkpoint, target, options.max_file_size)
                print(target)
    elif options.join:
        join_files(options.join)
    else:
        run_cells(cells, options.processes, options.budget_minutes, options.train_flags)


if __name__ == "__main__":
    main()
