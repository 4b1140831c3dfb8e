"""What helps HDP to learn: one setting changed at a time, with the same samples seen, on 2D sorting.

python -m benchmarks.ablations              # runs what is missing, then writes docs/ablations.md
python -m benchmarks.ablations --list       # says what is finished and what is not

A cell (see cells.py) is one variant of the `mini` preset's HDP, trained with one seed; its learning curve goes to
`benchmarks/results/ablations/<cell>.json`. A finished cell is never run again, an interrupted one goes on.
"""

import argparse
from collections import defaultdict
from dataclasses import replace
from itertools import product
from statistics import mean
from typing import Any

from .cells import Cell, read_result, run_cells
from .pages import DOCS, markdown_table
from .paper.presets import make_cell

PAGE = DOCS / "ablations.md"
STEPS = 1500
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "prediction_type=epsilon": {"prediction_type": "epsilon"},
    "prediction_type=epsilon, symbol_loss_weight=1/30": {"prediction_type": "epsilon", "symbol_loss_weight": 1 / 30},
    "prediction_type=v_prediction": {"prediction_type": "v_prediction"},
    "symbol_loss_weight=1/30": {"symbol_loss_weight": 1 / 30},
    "symbol_loss_weight=1/1000": {"symbol_loss_weight": 1 / 1000},
    "rotary=true": {"rotary": True},
    "mask_schedule=cosine": {"mask_schedule": "cosine"},
    "ema_max_decay=0": {"ema_max_decay": 0.0},
    "dropout=0.1": {"dropout": 0.1},
    "dropout=0.3": {"dropout": 0.3},
    "plan_from=any_frame": {"plan_from": "any_frame"},
    "object_tokens=false": {"object_tokens": False},
    "observation_weight_std=0.02": {"observation_weight_std": 0.02},
}


def variant_of(name: str, n_blocks: int, seed: int) -> Cell:
    """The cell of a variant, a number of blocks and a seed."""
    cell = make_cell("mini", f"block_sorting_2d_{n_blocks}_blocks", "hdp", seed)
    return replace(
        cell,
        group="ablations",
        name=f"{n_blocks}_blocks_{name.replace(', ', '_').replace('/', '_')}_seed{seed}",
        steps=STEPS,
        policy={**cell.policy, **VARIANTS[name]},
        facts={"variant": name, "n_blocks": n_blocks},
    )


def write_page(cells: list[Cell]) -> None:
    """The table of all finished cells."""
    scores: dict[tuple[str, int], list[float]] = defaultdict(list)
    for cell in cells:
        if content := read_result(cell):
            result = content["result"]
            rates = [point["success_rate"] for point in result["curve"][-cell.average_last :]]
            scores[result["variant"], result["n_blocks"]].append(100 * mean(rates))
    blocks, cell = sorted({cell.facts["n_blocks"] for cell in cells}), cells[0]
    page = "# What helps HDP to learn\n\n"
    page += (
        f"Success in % after {cell.steps} steps of {cell.batch_size} samples, the mean over the last "
        f"{cell.average_last} evaluations of {cell.starts} fresh starts, for each seed; one setting of the `default` "
        f"preset changed at a time. 2D sorting, {cell.demonstrations} demonstrations, {cell.policy['num_layers']} "
        f"layers of width {cell.policy['width']}. `python -m benchmarks.ablations`\n\n"
    )
    rows = [
        [f"`{variant}`", *(", ".join(f"{score:.0f}" for score in scores[variant, n]) or "not run" for n in blocks)]
        for variant in VARIANTS
    ]
    page += markdown_table(["setting", *(f"{n} blocks" for n in blocks)], rows)
    PAGE.write_text(page)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_blocks", type=int, nargs="+", default=[3, 4])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    cells = [variant_of(*choice) for choice in product(options.variants, options.n_blocks, options.seeds)]
    cells.sort(key=lambda cell: cell.seed)
    if options.list:
        for cell in cells:
            print(f"{cell.name:75} {cell.state()}")
        return
    run_cells(cells, options.processes)
    write_page(cells)


if __name__ == "__main__":
    main()
