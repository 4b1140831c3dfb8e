"""What helps HDP to learn: one setting changed at a time, or two, with the same samples seen.

python -m benchmarks.ablations              # runs what is missing, then writes docs/ablations.md
python -m benchmarks.ablations --list       # says what is finished and what is not
python -m benchmarks.ablations --report     # writes the page alone

A cell (see cells.py) is one variant of a preset's planner, `mini`'s or `small`'s, trained with one seed; its learning
curve goes to `benchmarks/results/ablations/<cell>.json`. A finished cell is never run again, an interrupted one goes
on. The page holds all finished cells, whatever was chosen to be run.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import product
from statistics import mean
from typing import Any

from lerobot.configs import PreTrainedConfig

from .cells import Cell, points_that_count, read_result, run_cells
from .pages import DOCS, markdown_table
from .paper.presets import complete, exists, make_cell

PAGE = DOCS / "ablations.md"
TASKS = {
    "3_blocks": "block_sorting_2d_3_blocks",
    "4_blocks": "block_sorting_2d_4_blocks",
    "sorting": "xarm_sorting",
    "arrange": "xarm_arrange_blocks",
    "tool_use": "xarm_tool_use",
}
"""What a cell's name begins with, and the task of the preset."""
SEEDS = (0, 1, 2)
NOISE = {"prediction_type": "epsilon", "optimizer_lr": 5e-4}
"""Noise prediction, at the learning rate of the preset `mini_epsilon`."""
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
    "rotary=true, state_encoder_hidden_dim=256, observation_weight_std=2": {
        "rotary": True,
        "state_encoder_hidden_dim": 256,
        "observation_weight_std": 2.0,
    },
    "rotary=true, optimizer_lr=2e-3": {"rotary": True, "optimizer_lr": 2e-3},
    "optimizer_lr=5e-4": {"optimizer_lr": 5e-4},
    "optimizer_lr=2e-3": {"optimizer_lr": 2e-3},
    "optimizer_lr=2e-3, symbol_loss_weight=1/1000": {"optimizer_lr": 2e-3, "symbol_loss_weight": 1 / 1000},
    # Joint's loss as one mean over one continuous variable: with three blocks, 36 symbols of 10 components beside 37
    # actions of 3 weigh 36 * 10 / (37 * 3).
    "type=joint_diffuser, symbol_loss_weight=3.2": {"type": "joint_diffuser", "symbol_loss_weight": 3.2},
    "type=separate_diffuser, symbol_loss_weight=3.2": {"type": "separate_diffuser", "symbol_loss_weight": 3.2},
}
"""Of the planner of `mini`."""


@dataclass(frozen=True)
class Variant:
    """A planner of the paper's tables, with one change or two; with none, it is a cell of these.

    Attributes:
        preset, method: of the planner.
        changes: of its options.
        steps, demonstrations: times those of the preset.
    """

    preset: str
    changes: dict[str, Any] = field(default_factory=dict)
    method: str = "hdp"
    steps: int = 1
    demonstrations: int = 1

    def base(self, task: str, seed: int) -> Cell:
        return make_cell(self.preset, TASKS[task], self.method, seed)

    def cell(self, name: str, task: str, seed: int) -> Cell:
        """The cell of one of `TASKS` and a seed.

        Raises:
            KeyError: the preset has no such task.
        """
        base = self.base(task, seed)
        if not self.changes and self.steps == self.demonstrations == 1:
            return base
        return replace(
            base,
            group="ablations",
            name=f"{task}_{name.replace(', ', '_').replace('/', '_')}_seed{seed}",
            policy=complete({**base.policy, **self.changes}, base.env),
            demonstrations=self.demonstrations * base.demonstrations,
            steps=self.steps * base.steps,
            facts={"variant": name},
        )


EARLIER = {
    "rotary=false": Variant("mini"),
    "prediction_type=epsilon, symbol_loss_weight=1/30": Variant("mini_epsilon"),
    **{name: Variant("mini", changes) for name, changes in CHANGES.items()},
}
TODAYS = {
    "unchanged": Variant("small"),
    "dtype=float32": Variant("small", {"dtype": "float32"}),
    "lead_share=0": Variant("small", {"lead_share": 0.0}),
    # HDP but for the symbols' process, whose loss has a scale of its own.
    "type=separate_diffuser": Variant("small", {"type": "separate_diffuser", "symbol_loss_weight": 0.1}),
    "steps=2x": Variant("small", steps=2),
    "demonstrations=4x": Variant("small", demonstrations=4),
    "optimizer_weight_decay=0.3": Variant("small", {"optimizer_weight_decay": 0.3}),
    "observation_noise=0.02": Variant("small", {"observation_noise": 0.02}),
    "observation_noise=0.02, optimizer_weight_decay=0.3": Variant(
        "small", {"observation_noise": 0.02, "optimizer_weight_decay": 0.3}
    ),
    "observation_noise=0.02, steps=2x": Variant("small", {"observation_noise": 0.02}, steps=2),
    "separate_diffuser": Variant("small", method="separate_diffuser"),
    "separate_diffuser, demonstrations=4x": Variant("small", method="separate_diffuser", demonstrations=4),
    "separate_diffuser, observation_noise=0.02": Variant("small", {"observation_noise": 0.02}, "separate_diffuser"),
    "separate_diffuser, observation_noise=0.02, steps=2x": Variant(
        "small", {"observation_noise": 0.02}, "separate_diffuser", steps=2
    ),
}
OF_DIFFUSER = {
    "diffuser": Variant("small", method="diffuser"),
    "diffuser, optimizer_lr=1e-3": Variant("small", {"optimizer_lr": 1e-3}, "diffuser"),
    "diffuser, steps=2x": Variant("small", method="diffuser", steps=2),
    "diffuser, demonstrations=4x": Variant("small", method="diffuser", demonstrations=4),
    "diffuser, observation_noise=0.02": Variant("small", {"observation_noise": 0.02}, "diffuser"),
    "diffuser, observation_noise=0.02, steps=2x": Variant("small", {"observation_noise": 0.02}, "diffuser", steps=2),
}
OF_LARGE_DIFFUSER = {
    "large diffuser": Variant("default", method="diffuser"),
    "large diffuser, optimizer_lr=1e-3": Variant("default", {"optimizer_lr": 1e-3}, "diffuser"),
}
VARIANTS = {**EARLIER, **TODAYS, **OF_DIFFUSER, **OF_LARGE_DIFFUSER}
WHAT_FOLLOWS = """
The first row was the base when this table was begun. What has become the `default` preset since:

**Rotary positions** tell the symbols which part of the motion is theirs. Over the whole curve of ten evaluations, tool
use has 71 % on average where learned positions have 61 %
([rotary](../benchmarks/results/ablations/tool_use_rotary=true_seed0.json),
[learned](../benchmarks/results/paper/mini/xarm_tool_use_hdp_seed0.json)), and arranging 77 % where they have 67 %
([rotary](../benchmarks/results/ablations/arrange_rotary=true_seed0.json),
[learned](../benchmarks/results/paper/mini/xarm_arrange_blocks_hdp_seed0.json)), one seed each. In sorting they do no
harm at a learning rate of 1e-3, and are behind at 2e-3.

**Muon** for the hidden layers, with rotary positions and a learning rate of 3e-3, is the largest step since the clean
motion. Muon alone was not measured. The [results](results.md) of the preset `small` have all three, and those of `mini`
have none: sorting four blocks, 76 % where `mini` has 16 %, after as many samples, with a network of about the same
size. (Rotary positions alone have 19 % in the table. HDP of `small` also has symbols that lead, in 10 network calls
where `mini` has 20, and a higher `confidence_threshold`. Separate Diffuser, which has neither of these, goes from 18 to
58 %.)

**lead_share** shows the planner more samples whose motion is pure noise, where the symbols decide which plan it makes.
In arranging that is what is left to learn: which slot another block leaves no room to reach. `small` has it in
arranging, with 4,000 demonstrations, and loses 7 points [without it](#todays-preset). It is no part of the preset: with
fewer demonstrations it was not measured, and a planner that often sees nothing but the start may learn by heart which
plan belongs to which.

What is left of the failures in arranging is the plan itself, which takes a slot where another block leaves no room for
the open gripper: [results](results.md) counts them.

For the rest, the preset predicts the clean motion, has a condition token for each object, made by large initial
weights, masks by the linear schedule, has no dropout, trains on whole plans and does not give symbols more weight than
1/300 (1/1000 is ahead at one learning rate and behind at the other). The moving average of the weights makes no
difference that two seeds could show, and stays on, as in Diffusion Policy. Training on plans from any frame shows each
start once in a plan's length: with five times the steps,
[two blocks are learned](../benchmarks/results/replanning.json).

**Four blocks**, with one seed, are far from learned at this budget with AdamW. What falls far behind with three blocks
does so with four: predicting the noise or the velocity, more weight for the symbols, dropout, plans from any frame.

**An MLP** in place of the linear layer that makes the condition tokens (`state_encoder_hidden_dim`) does no harm, and
shows no gain that two seeds could tell from chance. It is off by default.

All rows but those that name another have AdamW at 1e-3; the two of `prediction_type=epsilon` have 5e-4, and so change
two settings. At the preset's width of 256 the learning rate has been compared in
[arranging](tasks/xarm_arrange_blocks.md#a-planner-trained-on-it), and, together with the threshold, in sorting four
blocks: [58 %](../benchmarks/results/learning_rate/block_sorting_2d_4_blocks_3e-3.json) at 3e-3 and 0.8,
[69 %](../benchmarks/results/paper/default/block_sorting_2d_4_blocks_hdp_seed0.json) at 1e-3 and 0.95. How much of that
is the learning rate's is not known: the threshold alone gave the small network 8 points ([few steps](few_steps.md)).
All planners in the table reveal symbols at a `confidence_threshold` of 0.8; the preset's is 0.95 now
([few steps](few_steps.md)).

## Today's preset

The planners of [`small`](results.md), and what one change makes of them. (`lead_share` is 0 but in arranging.
`type=separate_diffuser` is HDP but for the process of its symbols, which is Gaussian, and the weight of their loss;
`steps=2x` is trained twice as long. With 200 demonstrations of four blocks, that makes HDP's motions more precise, and
its symbols learn the demonstrations by heart: valid plans fall from 93 of 100 in the middle to 68 in the end.)

What helps is more demonstrations; or, with the same ones, `observation_noise`, by which starts look alike that differ
by less than about two centimetres while the plan is decided. At the end of the training, 93 and 99 of 100 plans are
valid with it (two seeds), with more weight decay, too, 98, with that alone 87, and without either 81 to 89 (three
seeds). Then training twice as long pays: of the last five evaluations, all plans are valid in three, and 96 of 100 or
more in the others. Separate gains nothing from it in as many steps: 68 of 100 plans are valid with it, and 67 to 76
without (three seeds); after twice as many, 87, 91 and 82 in the last three evaluations. In tool use, HDP has 100 % with
it as without; in arranging, from 4,000 demonstrations, 94 % where it has 98 and 99 without (two seeds), and fails by
its plan alone: which slot another block leaves no room to reach may be a matter of centimetres. So no preset has it.
(All that has noise or weight decay was trained in float32, the others in bfloat16, which made waypoints and poses
coarser than it does now. `dtype=float32` is that alone: it gains nothing, and 86 of 100 plans are valid with it.)

"""
ABOUT_DIFFUSER = """
## Would other settings make Diffuser better?

All settings were chosen by HDP's success. These are Diffuser's, as in [`small`](results.md), and at a lower learning
rate, which makes it better nowhere by the same seed. (Twice the steps and more demonstrations are listed once they were
run.)

"""
ABOUT_LARGE_DIFFUSER = """
At the paper's network size, sorting and tool use have the learning rate of the small network, 3e-3, and arranging has
1e-3. A lower one in sorting and tool use is still to be run.

"""


def variants(names: Iterable[str], tasks: Iterable[str], seeds: Iterable[int]) -> dict[tuple[str, str, int], Cell]:
    """The cells of these variants, tasks and seeds, of those tasks where the variant's preset has what is changed."""
    found = {}
    for name, task, seed in product(names, tasks, seeds):
        variant = VARIANTS[name]
        if not exists(variant.method, variant.preset, TASKS[task]):
            continue
        cell, base = variant.cell(name, task, seed), variant.base(task, seed)
        of_another_size = (variant.steps, variant.demonstrations) != (1, 1)
        if cell == base or of_another_size or _settings(cell) != _settings(base):
            found[name, task, seed] = cell
    return found


def _settings(cell: Cell) -> tuple[PreTrainedConfig, str | None]:
    """All of a planner's; the type of its numbers by itself, which depends on the CPU, too."""
    return _config(cell), cell.policy.get("dtype")


def _config(cell: Cell) -> PreTrainedConfig:
    options = dict(cell.policy)
    return PreTrainedConfig.get_choice_class(options.pop("type"))(**options, device="cpu")


def write_page() -> None:
    """The tables of all finished cells."""
    cells = variants(VARIANTS, TASKS, SEEDS)
    scores: dict[tuple[str, str], list[float]] = defaultdict(list)
    for (variant, task, _), cell in cells.items():
        if content := read_result(cell):
            rates = [point["success_rate"] for point in points_that_count(content["result"])]
            scores[variant, task].append(100 * mean(rates))

    def table(names: Iterable[str]) -> str:
        first, *_ = names
        tasks = [task for task in TASKS if any(scores[name, task] for name in names)]
        rows = [
            [f"`{name}`", *(_each(scores[name, task]) for task in tasks)]
            for name in names
            if any(scores[name, task] for task in tasks)
        ]
        budget = markdown_table(
            ["task", "demonstrations", "steps", "samples a step", "layers", "width"],
            (_budget(cells[first, task, SEEDS[0]]) for task in tasks),
        )
        return f"{budget}\n{markdown_table(['setting', *(TASKS[task] for task in tasks)], rows)}"

    spread = max(max(seeds) - min(seeds) for seeds in scores.values() if seeds)
    base = cells["rotary=false", "3_blocks", SEEDS[0]]
    PAGE.write_text(
        "# What helps HDP to learn\n\n"
        f"Success in % in the middle of learning; for each seed, the mean over the last {base.average_last} "
        f"evaluations of {base.starts} fresh starts, whose 95 % interval reaches about 5 points to each side; "
        f"two seeds of one setting differ by up to {spread:.0f} points. The "
        "first row has learned positions alone and AdamW; in the others, what is named is changed. "
        "`python -m benchmarks.ablations`\n\n"
        + table(EARLIER)
        + WHAT_FOLLOWS
        + table(TODAYS)
        + ABOUT_DIFFUSER
        + table(OF_DIFFUSER)
        + ABOUT_LARGE_DIFFUSER
        + table(OF_LARGE_DIFFUSER)
    )


def _each(seeds: list[float]) -> str:
    return ", ".join(f"{score:.0f}" for score in seeds) or "not run"


def _budget(cell: Cell) -> list[str]:
    config = _config(cell)
    numbers = (cell.demonstrations, cell.steps, cell.batch_size, config.num_layers, config.width)
    return [cell.facts["task_name"], *(f"{number:,}" for number in numbers)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=tuple(TASKS), choices=tuple(TASKS))
    parser.add_argument("--variants", nargs="+", default=tuple(VARIANTS), choices=tuple(VARIANTS))
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS, choices=SEEDS)
    parser.add_argument("--processes", type=int, default=1, help="cells at a time, which share the cores")
    parser.add_argument("--list", action="store_true", help="say what is finished and what is missing")
    parser.add_argument("--report", action="store_true", help="write the page alone")
    options = parser.parse_args()
    cells = sorted(variants(options.variants, options.tasks, options.seeds).values(), key=lambda cell: cell.seed)
    if options.list:
        for cell in cells:
            print(f"{cell.name:75} {cell.state()}")
        return
    if not options.report:
        run_cells(cells, options.processes)
    write_page()


if __name__ == "__main__":
    main()
