"""The table and the learning curves of `benchmarks.planner_comparison`, from its results files."""

import json
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from statistics import mean
from typing import Any, NamedTuple

from .paper.presets import METHODS

DOCS = Path(__file__).parents[1] / "docs"
TABLE, PLOT = DOCS / "planner_comparison.md", DOCS / "images" / "planner_comparison.svg"
PROTOCOL = ("demonstrations", "steps", "batch_size", "starts", "average_last", "network_calls_per_plan")
"""What cells must share to be compared, ..."""
NETWORK = ("num_layers", "width", "dtype")
"""... and options of their planners, too."""
LABELS = {
    "hdp": "HDP",
    "diffuser": "Diffuser",
    "joint_diffuser": "Joint Diffuser",
    "separate_diffuser": "Separate Diffuser",
    "hd": "HD",
    "chd": "CHD",
}


class Panel(NamedTuple):
    """The cells that are compared with each other."""

    n_blocks: int
    prediction_type: str

    @property
    def title(self) -> str:
        return f"{self.n_blocks} blocks, {self.prediction_type} prediction"


Results = dict[Panel, dict[str, list[dict[str, Any]]]]
"""Of each panel, of each planner, the results of its seeds."""


def read_results(files: Iterable[Path]) -> tuple[Results, set[str]]:
    """The results, and the commits that they come from.

    Raises:
        ValueError: cells that are compared differ in training or evaluation.
    """
    results: Results = defaultdict(lambda: defaultdict(list))
    commits = set()
    for file in files:
        content = json.loads(file.read_text())
        result = content["result"]
        blocks = int(result["task_name"].split("_")[-2])
        prediction_type = result["policy"].get("prediction_type", "sample")
        results[Panel(blocks, prediction_type)][result["planner"]].append(result)
        commits.add(content["run"]["git_commit"])
    for panel, planners in results.items():
        cells = [cell for seeds in planners.values() for cell in seeds]
        protocols = {(*(cell[key] for key in PROTOCOL), *(cell["policy"][key] for key in NETWORK)) for cell in cells}
        if len(protocols) > 1:
            raise ValueError(f"{panel.title}: cells of different ({', '.join(PROTOCOL + NETWORK)}): {protocols}")
    return dict(sorted(results.items())), commits


def at_the_end(result: dict[str, Any], figure: str) -> float:
    """A figure's mean over the last evaluations of one cell."""
    return mean(point[figure] for point in result["curve"][-result["average_last"] :])


def table(planners: dict[str, list[dict[str, Any]]]) -> Iterable[str]:
    """The rows of a panel's table."""
    yield "| planner | parameters | seeds | success | each seed | mean score | training |"
    yield "|---|---|---|---|---|---|---|"
    for planner in sorted(planners, key=METHODS.index):
        cells = sorted(planners[planner], key=lambda cell: cell["seed"])
        success = [at_the_end(cell, "success_rate") for cell in cells]
        score = mean(at_the_end(cell, "mean_score") for cell in cells)
        minutes = mean(cell["train_s"] for cell in cells) / 60
        each = ", ".join(f"{100 * rate:.1f} %" for rate in success)
        yield (
            f"| {LABELS[planner]} | {cells[0]['parameters']:,} | {len(cells)} | {100 * mean(success):.1f} % | {each} "
            f"| {score:.2f} | {minutes:.1f} min |"
        )


def write_table(results: Results, commits: set[str]) -> None:
    """Write the page with all tables."""
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
    for panel, planners in results.items():
        cell = next(iter(planners.values()))[0]
        lines += [
            "",
            f"## {panel.title}",
            "",
            f"{cell['steps']} steps of {cell['batch_size']} samples, {cell['demonstrations']} demonstrations, "
            f"{cell['network_calls_per_plan']} network calls for a plan (and level); {cell['starts']} starts an "
            f"evaluation, the last {cell['average_last']} count.",
            "",
            *table(planners),
        ]
    TABLE.write_text("\n".join(lines) + "\n")


def use_svg() -> Any:
    """`matplotlib.pyplot`, drawing to SVG files; the same results make the same file.

    Raises:
        ImportError: Matplotlib is not installed: it comes with the extra `benchmarks`.
    """
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "planners"
    from matplotlib import pyplot

    return pyplot


def write_plot(results: Results) -> None:
    """Draw success over optimiser steps: a line for each planner, a band between its seeds."""
    plt = use_svg()
    columns = min(2, len(results))
    rows = -(-len(results) // columns)
    size = (4.5 * columns, 3 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, sharey=True, squeeze=False, layout="constrained")
    for axis, (panel, planners) in zip(axes.flat, results.items(), strict=False):
        for planner in sorted(planners, key=METHODS.index):
            colour = f"C{METHODS.index(planner)}"
            steps = [point["step"] for point in planners[planner][0]["curve"]]
            rates = list(zip(*([p["success_rate"] for p in cell["curve"]] for cell in planners[planner]), strict=True))
            axis.plot(steps, [mean(seeds) for seeds in rates], color=colour, label=LABELS[planner])
            axis.fill_between(steps, list(map(min, rates)), list(map(max, rates)), color=colour, alpha=0.15, lw=0)
        axis.set(title=panel.title, xlabel="optimiser steps", ylabel="success rate", ylim=(0, 1))
        axis.label_outer()
        axis.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper")
    figure.savefig(PLOT, metadata={"Date": None})


def write_report(files: Iterable[Path]) -> None:
    """Write the page and the plot."""
    results, commits = read_results(files)
    if not results:
        raise SystemExit("no cell of the comparison is finished yet")
    write_table(results, commits)
    write_plot(results)
    print(f"{TABLE}\n{PLOT}")
