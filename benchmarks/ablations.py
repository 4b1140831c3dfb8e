"""What helps HDP to learn: one setting changed at a time, with the same samples seen, on 2D sorting.

python -m benchmarks.ablations              # runs what is missing, then writes docs/ablations.md
python -m benchmarks.ablations --list       # says what is finished and what is not

A cell (see cells.py) is one variant of the `mini` preset's planner, trained with one seed; its learning curve goes to
`benchmarks/results/ablations/<cell>.json`. A finished cell is never run again, an interrupted one goes on. The page
holds all finished cells, whatever was chosen to be run.
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
BLOCKS = (3, 4)
SEEDS = (0, 1)
NOISE = {"prediction_type": "epsilon", "optimizer_lr": 5e-4}
"""Noise prediction, at the learning rate of the preset `mini_epsilon`."""
OF_THE_PAPERS_TABLES = {"default": "mini", "prediction_type=epsilon, symbol_loss_weight=1/30": "mini_epsilon"}
"""Variants that are cells of `benchmarks.paper` already, and of which preset."""
CHANGES: dict[str, dict[str, Any]] = {
    "prediction_type=epsilon": NOISE,
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
    "state_encoder_hidden_dim=256, observation_weight_std=2": {
        "state_encoder_hidden_dim": 256,
        "observation_weight_std": 2.0,
    },
    "optimizer_lr=5e-4": {"optimizer_lr": 5e-4},
    "optimizer_lr=2e-3": {"optimizer_lr": 2e-3},
    "optimizer_lr=2e-3, symbol_loss_weight=1/1000": {"optimizer_lr": 2e-3, "symbol_loss_weight": 1 / 1000},
    # Joint's loss as one mean over one continuous variable: with three blocks, 36 symbols of 10 components beside 37
    # actions of 3 weigh 36 * 10 / (37 * 3).
    "type=joint_diffuser, symbol_loss_weight=3.2": {"type": "joint_diffuser", "symbol_loss_weight": 3.2},
    "type=separate_diffuser, symbol_loss_weight=3.2": {"type": "separate_diffuser", "symbol_loss_weight": 3.2},
}
VARIANTS = (*OF_THE_PAPERS_TABLES, *CHANGES)
WHAT_FOLLOWS = """
So the `default` preset predicts the clean motion, has a condition token for each object, made by large initial
weights, masks by the linear schedule, has no dropout, trains on whole plans and does not give symbols more weight
than 1/300 (1/1000 is not clearly better: it is ahead at one learning rate and behind at the other). Two settings make
no difference here: rotary positions, which stay off, and the moving average of the weights, which stays on, as in
Diffusion Policy.

The learning rate matters most. This small network learns best at 2e-3: set `--policy.optimizer_lr=2e-3` for networks
of a width around 128. The preset's 1e-3 is meant for its width of 256, where half the rate is the rule of thumb (a
rate that falls with the width: Yang et al. 2022, "Tensor Programs V"); it has not been compared there, for want of a
GPU. The tables of [results](results.md) and [planners](planner_comparison.md) have 1e-3 for all planners, and 5e-4
where the noise is predicted; so have the two rows of `prediction_type=epsilon` here, which change two settings.
"""


def variant_of(name: str, n_blocks: int, seed: int) -> Cell:
    """The cell of a variant, a number of blocks and a seed."""
    cell = make_cell(OF_THE_PAPERS_TABLES.get(name, "mini"), f"block_sorting_2d_{n_blocks}_blocks", "hdp", seed)
    if name in OF_THE_PAPERS_TABLES:
        return cell
    return replace(
        cell,
        group="ablations",
        name=f"{n_blocks}_blocks_{name.replace(', ', '_').replace('/', '_')}_seed{seed}",
        policy={**cell.policy, **CHANGES[name]},
        facts={"variant": name},
    )


def write_page() -> None:
    """The table of all finished cells."""
    cells = {choice: variant_of(*choice) for choice in product(VARIANTS, BLOCKS, SEEDS)}
    scores: dict[tuple[str, int], list[float]] = defaultdict(list)
    for (variant, n_blocks, _), cell in cells.items():
        if content := read_result(cell):
            rates = [point["success_rate"] for point in content["result"]["curve"][-cell.average_last :]]
            scores[variant, n_blocks].append(100 * mean(rates))
    first, steps = next(iter(cells.values())), {n_blocks: cell.steps for (_, n_blocks, _), cell in cells.items()}
    budgets = " and ".join(f"{steps[n]:,} steps with {n} blocks" for n in BLOCKS)
    rows = [
        [f"`{variant}`", *(", ".join(f"{score:.0f}" for score in scores[variant, n]) or "not run" for n in BLOCKS)]
        for variant in VARIANTS
    ]
    PAGE.write_text(
        "# What helps HDP to learn\n\n"
        f"Success in % in the middle of learning: {budgets}, of {first.batch_size} samples each. For each seed, the "
        f"mean over the last {first.average_last} evaluations of {first.starts} fresh starts, whose 95 % interval "
        f"reaches about 5 points to each side. One setting of the `default` preset is changed at a time. 2D sorting, "
        f"{first.demonstrations} demonstrations, {first.policy['num_layers']} layers of width {first.policy['width']}. "
        "`python -m benchmarks.ablations`\n\n"
        + markdown_table(["setting", *(f"{n} blocks" for n in BLOCKS)], rows)
        + WHAT_FOLLOWS
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n_blocks", type=int, nargs="+", default=BLOCKS, choices=BLOCKS)
    parser.add_argument("--variants", nargs="+", default=VARIANTS, choices=VARIANTS)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, choices=SEEDS)
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
    write_page()


if __name__ == "__main__":
    main()
