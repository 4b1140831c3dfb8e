"""The table and the learning curves of `benchmarks.planner_comparison`, from the results of its cells."""

import json
from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import mean
from typing import Any, NamedTuple

from .cells import all_runs, points_that_count, read_result
from .machine import RESULTS
from .pages import DOCS, LABELS, markdown_table, plot_curves
from .paper.presets import METHODS, make_cells

PAGE, PLOT = DOCS / "planner_comparison.md", DOCS / "images" / "planner_comparison.svg"
SAMPLERS_FILE = RESULTS / "planner_samplers.json"
PRESETS = ("mini", "mini_epsilon")
TASKS = ("block_sorting_2d_2_blocks", "block_sorting_2d_3_blocks")
SEEDS = (0, 1)
PREDICTED = {"mini": "the clean motion is predicted", "mini_epsilon": "the noise is predicted"}
NOTES = {
    "mini_epsilon": " Half the learning rate; the weight of HDP's symbols in its loss is the paper's, Joint's and "
    "Separate's is the one above and was not tuned again."
}


class Panel(NamedTuple):
    """The cells that are compared with each other."""

    n_blocks: int
    preset: str

    @property
    def title(self) -> str:
        return f"{self.n_blocks} blocks, {PREDICTED[self.preset]}"


def at_the_end(result: dict[str, Any], figure: str) -> float:
    """A figure's mean over the last evaluations of one cell."""
    return mean(point[figure] for point in points_that_count(result))


def rows(planners: dict[str, list[dict[str, Any]]]) -> Iterable[Sequence[str]]:
    """The rows of a panel's table."""
    for planner, seeds in planners.items():
        success = [at_the_end(result, "success_rate") for result in seeds]
        yield (
            LABELS[planner],
            f"{seeds[0]['parameters']:,}",
            str(len(seeds)),
            f"{100 * mean(success):.1f} %",
            ", ".join(f"{100 * rate:.1f} %" for rate in success),
            f"{mean(at_the_end(result, 'mean_score') for result in seeds):.2f}",
            _valid_plans(seeds),
        )


def _valid_plans(seeds: Sequence[dict[str, Any]]) -> str:
    """Of the plans at the end, how many have a valid symbolic plan; of a planner that models symbols."""
    if "valid_plans" not in seeds[0]["curve"][-1]:
        return ""
    return f"{100 * mean(at_the_end(result, 'valid_plans') / result['starts'] for result in seeds):.0f} %"


def samplers_section() -> list[str]:
    """The same planners with each sampler."""
    if not SAMPLERS_FILE.exists():
        return []
    content = json.loads(SAMPLERS_FILE.read_text())
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in content["results"]:
        found[result["planner"], result["sampler"]].append(result)
    rows = [
        (
            LABELS[planner],
            f"`{sampler}`",
            *(
                ", ".join(f"{100 * result[figure] / scale:.0f} %" for result in seeds if figure in result)
                for figure, scale in (("success_rate", 1), ("valid_plans", content["starts"]))
            ),
        )
        for (planner, sampler), seeds in found.items()
    ]
    header = ("planner", "sampler", "success of each seed", "valid symbolic plans")
    return [
        "",
        "## What the sampler contributes",
        "",
        f"The last checkpoints of three blocks, the clean motion predicted: {content['starts']} starts, those of the "
        "last evaluation above. HDP's own sampler, `confidence`, reveals symbols in the order of its confidence; with "
        "`ddim` and `ddpm` it reveals them at random, as in the paper (Eq. 6). For the other planners, `confidence` is "
        f"`ddim`. `{content['run']['command']}`",
        "",
        markdown_table(header, rows).rstrip(),
    ]


def write_page() -> None:
    """Write the page and the plot of the cells that are finished."""
    cells = make_cells(list(PRESETS), list(TASKS), list(METHODS), list(SEEDS))
    panels: dict[Panel, dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    settings, commits = {}, set()
    for cell in sorted(cells, key=lambda cell: METHODS.index(cell.policy["type"])):
        if content := read_result(cell):
            panel = Panel(cell.env["n_blocks"], cell.facts["preset"])
            panels[panel][cell.policy["type"]].append(content["result"])
            settings[panel] = cell
            commits |= {run["git_commit"] for run in all_runs(content)}
    if not panels:
        raise SystemExit("no cell of the comparison is finished yet")
    panels = dict(sorted(panels.items()))
    lines = [
        "# The planners on 2D sorting",
        "",
        "Written by `python -m benchmarks.planner_comparison` from the files in `benchmarks/results/paper/mini*/` "
        f"(code of {', '.join(sorted(commits))}). What each planner models is on [its own page](planners.md).",
        "",
        "Success and mean score are means over the last evaluations of every seed, each on fresh starts that are the "
        "same for all planners. Parameters are those of the networks that are trained.",
        "",
        f"![Success over training]({PLOT.relative_to(DOCS)})",
    ]
    header = ("planner", "parameters", "seeds", "success", "each seed", "mean score", "valid symbolic plans")
    for panel, planners in panels.items():
        cell, calls = settings[panel], next(iter(planners.values()))[0]["network_calls_per_plan"]
        lines += [
            "",
            f"## {panel.title[0].upper()}{panel.title[1:]}",
            "",
            f"{cell.steps} steps of {cell.batch_size} samples, {cell.demonstrations} demonstrations; {calls} network "
            f"calls for a plan (and level); {cell.starts} starts an evaluation, the last {cell.average_last} count."
            + NOTES.get(panel.preset, ""),
            "",
            markdown_table(header, rows(planners)).rstrip(),
        ]
    PAGE.write_text("\n".join([*lines, *samplers_section()]) + "\n")
    curves = {
        panel.title: {planner: [result["curve"] for result in seeds] for planner, seeds in planners.items()}
        for panel, planners in panels.items()
    }
    plot_curves(curves, PLOT)
