"""What the pages in `docs/` share that are written from results files: names, tables, plots."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from .machine import REPOSITORY

DOCS = REPOSITORY / "docs"
LABELS = {
    "hdp": "HDP",
    "diffuser": "Diffuser",
    "joint_diffuser": "Joint Diffuser",
    "separate_diffuser": "Separate Diffuser",
    "hd": "HD",
    "chd": "CHD",
}
"""Policy type to the name of the planner."""
COLOURS = {method: f"C{number}" for number, method in enumerate(LABELS)}

Curve = list[dict[str, Any]]
"""The evaluations of a training: `step`, `success_rate`, ..."""


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [" | ".join(header), " | ".join(["---"] * len(header)), *(" | ".join(row) for row in rows)]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def use_svg() -> Any:
    """`matplotlib.pyplot`, drawing to SVG files; the same results make the same file.

    Raises:
        ImportError: Matplotlib is not installed: it comes with the extra `benchmarks`.
    """
    import matplotlib

    matplotlib.use("svg")
    matplotlib.rcParams["svg.hashsalt"] = "hdp"
    from matplotlib import pyplot

    return pyplot


def plot_curves(panels: dict[str, dict[str, list[Curve]]], path: Path) -> None:
    """Draw success over optimiser steps: a line for the mean of the seeds, a band between them.

    Args:
        panels: for each title, for each policy type, the learning curves of its seeds.
        path: of the SVG file.
    """
    plt = use_svg()
    columns = math.ceil(math.sqrt(len(panels)))
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.6 * columns, 2.7 * rows), squeeze=False, layout="constrained")
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    handles = {}
    for axis, (title, curves_of) in zip(axes.flat, panels.items(), strict=False):
        for method, curves in curves_of.items():
            rates = list(zip(*([point["success_rate"] for point in curve] for curve in curves), strict=True))
            steps = [point["step"] for point in curves[0]]
            [handles[LABELS[method]]] = axis.plot(steps, list(map(mean, rates)), color=COLOURS[method])
            axis.fill_between(steps, [*map(min, rates)], [*map(max, rates)], color=COLOURS[method], alpha=0.15, lw=0)
        axis.set_title(title, fontsize=9)
        axis.set(xlabel="optimiser steps", ylabel="success rate", ylim=(0, 1.02))
        axis.grid(alpha=0.3)
    figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8)
    save_figure(figure, path)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure as SVG, without the date of the day."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
    use_svg().close(figure)
