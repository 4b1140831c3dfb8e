"""What helps HDP to learn: one setting changed at a time, with the same samples seen, on 2D sorting.

python -m benchmarks.ablations              # runs what is missing, then writes docs/ablations.md
python -m benchmarks.ablations --list       # says what is finished and what is not

A cell is one variant, trained with one seed as `benchmarks.planner_comparison` trains; its learning curve goes to
`benchmarks/results/ablations/<cell>.json`. A finished cell is never run again, an interrupted one goes on.
"""

import argparse
import json
import multiprocessing
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from statistics import mean
from typing import Any

from . import planner_comparison
from .machine import describe_run
from .planner_comparison import Cell, Protocol, run_cell, state_of

RESULTS = Path(__file__).parent / "results" / "ablations"
PAGE = Path(__file__).parents[1] / "docs" / "ablations.md"
PROTOCOL = Protocol(network={"num_layers": 4, "width": 128, "dtype": "bfloat16"})
LAST = 3
"""Evaluations at the end of a learning curve that make the table's figures."""
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "prediction_type=epsilon": {"prediction_type": "epsilon"},
    "prediction_type=epsilon, symbol_loss_weight=1/30": {"prediction_type": "epsilon", "symbol_loss_weight": 1 / 30},
    "prediction_type=v_prediction": {"prediction_type": "v_prediction"},
    "symbol_loss_weight=1/30": {"symbol_loss_weight": 1 / 30},
    "symbol_loss_weight=1/1000": {"symbol_loss_weight": 1 / 1000},
    "ema_max_decay=0": {"ema_max_decay": 0.0},
    "dropout=0.1": {"dropout": 0.1},
    "dropout=0.3": {"dropout": 0.3},
    "plan_from=any_frame": {"plan_from": "any_frame"},
    "object_tokens=false": {"object_tokens": False},
    "observation_weight_std=0.02": {"observation_weight_std": 0.02},
}


@dataclass(frozen=True)
class AblationCell(Cell):
    """A variant of HDP, trained once."""

    variant: str = "default"

    @property
    def name(self) -> str:
        variant = self.variant.replace(", ", "_").replace("/", "_")
        return f"{self.n_blocks}_blocks_{variant}_seed{self.seed}"

    @property
    def result_file(self) -> Path:
        return RESULTS / f"{self.name}.json"

    @property
    def checkpoint(self) -> Path:
        return planner_comparison.WORK.with_name("ablations") / self.name

    def policy_options(self, protocol: Protocol) -> dict[str, Any]:
        return {**protocol.network, **VARIANTS[self.variant]}


def write_page(cells: list[AblationCell]) -> None:
    """The table of all finished cells."""
    scores: dict[tuple[str, int], list[float]] = defaultdict(list)
    for cell in cells:
        if cell.result_file.exists():
            curve = json.loads(cell.result_file.read_text())["result"]["curve"]
            scores[cell.variant, cell.n_blocks].append(100 * mean(point["success_rate"] for point in curve[-LAST:]))
    blocks = sorted({cell.n_blocks for cell in cells})
    page = "# What helps HDP to learn\n\n"
    page += (
        f"Success in % after {PROTOCOL.steps} steps of {PROTOCOL.batch_size} samples, the mean over the last {LAST} "
        f"evaluations of {PROTOCOL.starts} fresh starts, for each seed; one setting of the `default` preset changed at "
        f"a time. 2D sorting, {PROTOCOL.num_episodes} demonstrations, 4 layers of width 128. "
        "`python -m benchmarks.ablations`\n\n"
    )
    page += f"| setting | {' | '.join(f'{n} blocks' for n in blocks)} |\n|---|{'---|' * len(blocks)}\n"
    for variant in VARIANTS:
        row = [", ".join(f"{score:.0f}" for score in scores[variant, n]) or "not run" for n in blocks]
        page += f"| `{variant}` | {' | '.join(row)} |\n"
    PAGE.write_text(page)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_blocks", type=int, nargs="+", default=[3, 4])
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, each on one core")
    parser.add_argument("--list", action="store_true")
    options = parser.parse_args()
    cells = [
        AblationCell(n_blocks, VARIANTS[variant].get("prediction_type", "sample"), "hdp", seed, variant)
        for n_blocks, seed, variant in product(options.n_blocks, options.seeds, options.variants)
    ]
    if options.list:
        for cell in cells:
            print(f"{cell.name:75} {state_of(cell)}")
        return
    run_facts, context = describe_run(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.processes, mp_context=context) as executor:
        missing = [cell for cell in cells if not cell.result_file.exists()]
        for future in [executor.submit(run_cell, cell, PROTOCOL, run_facts) for cell in missing]:
            future.result()
    write_page(cells)


if __name__ == "__main__":
    main()
