"""The table and the learning curves of `benchmarks.planner_comparison`, from the results of its cells."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import mean
from typing import Any, NamedTuple

from .cells import Cell, read_result
from .pages import DOCS, LABELS, markdown_table, plot_curves
from .paper.presets import METHODS

TABLE, PLOT = DOCS / "planner_comparison.md", DOCS / "images" / "planner_comparison.svg"
PREDICTED = {"mini": "the clean motion is predicted", "mini_epsilon": "the noise is predicted"}


class Panel(NamedTuple):
    """The cells that are compared with each other."""

    n_blocks: int
    preset: str

    @property
    def title(self) -> str:
        return f"{self.n_blocks} blocks, {PREDICTED[self.preset]}"


def at_the_end(result: dict[str, Any], figure: str) -> float:
    """A figure's mean over the last evaluations of one cell."""
    return mean(point[figure] for point in result["curve"][-result["average_last"] :])


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
            f"{mean(result['train_s'] for result in seeds) / 60:.1f} min",
        )


def write_report(cells: Sequence[Cell]) -> None:
    """Write the page and the plot of the cells that are finished."""
    panels: dict[Panel, dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
    settings, commits = {}, set()
    for cell in sorted(cells, key=lambda cell: METHODS.index(cell.policy["type"])):
        if content := read_result(cell):
            panel = Panel(cell.env["n_blocks"], cell.facts["preset"])
            panels[panel][cell.policy["type"]].append(content["result"])
            settings[panel] = cell
            commits.add(content["run"]["git_commit"])
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
    header = ("planner", "parameters", "seeds", "success", "each seed", "mean score", "training")
    for panel, planners in panels.items():
        cell, calls = settings[panel], next(iter(planners.values()))[0]["network_calls_per_plan"]
        lines += [
            "",
            f"## {panel.title[0].upper()}{panel.title[1:]}",
            "",
            f"{cell.steps} steps of {cell.batch_size} samples, {cell.demonstrations} demonstrations; {calls} network "
            f"calls for a plan (and level); {cell.starts} starts an evaluation, the last {cell.average_last} count.",
            "",
            markdown_table(header, rows(planners)).rstrip(),
        ]
    TABLE.write_text("\n".join(lines) + "\n")
    curves = {
        panel.title: {planner: [result["curve"] for result in seeds] for planner, seeds in planners.items()}
        for panel, planners in panels.items()
    }
    plot_curves(curves, PLOT)
    print(f"{TABLE}\n{PLOT}")
