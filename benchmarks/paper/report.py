"""docs/results.md: the paper's tables and figures, ours beside theirs, from the files in `benchmarks/results/`."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from ..cells import RESULTS, Cell
from ..conditioning_tables import TABLES, table
from ..evaluation import wilson_interval
from ..planner_report import LABELS, use_svg
from . import published
from .presets import METHODS, PRESETS, TASKS, make_cells

DOCS = Path(__file__).parents[2] / "docs"
PAGE, CURVES = DOCS / "results.md", DOCS / "images" / "training_curves.svg"
SEEDS = [0, 1, 2]
XARM_TASKS = {
    "xarm_sorting": "X-Arm Sorting",
    "xarm_arrange_blocks": "Arrange Blocks",
    "xarm_tool_use": "Tool Use",
}
TASKS_2D = {f"block_sorting_2d_{n}_blocks": f"{n} blocks" for n in (2, 3, 4)}
TITLES = {
    "paper": "The paper's hyperparameters",
    "default": "Ours at the paper's network size",
    "mini": "Ours on two CPU cores: a network of a tenth of the size, a small part of the training",
    "mini_epsilon": "The same with the paper's noise prediction",
}
MISSING = "missing"

Results = dict[tuple[str, str, str], list[dict[str, Any]]]
"""Of each (preset, task, planner), the contents of its cells' files: `run` and `result`."""


def write_report() -> list[Path]:
    """Write the page and its plots; return their paths."""
    cells = make_cells(list(PRESETS), list(TASKS), list(METHODS), SEEDS)
    results = read_results(cells)
    parts = [
        "# Results, beside the paper's\n",
        "Written by `python -m benchmarks.paper --report` from the files in `benchmarks/results/`. "
        "`python -m benchmarks.paper --list` says what can be run next. Figures of the paper are as printed there.\n",
        *simulation(results),
        *number_of_blocks(results),
        *training_curves(results),
        "## Adherence\n",
        *adherence(),
        "## Latency\n",
        *latency(),
        *training_time(results),
        *failures(results),
        *missing_cells(cells),
    ]
    PAGE.write_text("\n".join(parts))
    return [PAGE, *([CURVES] if results else [])]


def read_results(cells: Iterable[Cell]) -> Results:
    """The contents of the cells that are finished."""
    results: Results = defaultdict(list)
    for cell in cells:
        if cell.result_file.exists():
            key = cell.facts["preset"], cell.facts["task_name"], cell.policy["type"]
            results[key].append(json.loads(cell.result_file.read_text()))
    return dict(results)


def last_points(contents: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The evaluations that count, of all seeds."""
    return [point for content in contents for point in content["result"]["curve"][-content["result"]["average_last"] :]]


def score(contents: Sequence[dict[str, Any]]) -> str:
    """Mean score and its standard deviation over seeds and checkpoints, as the paper gives them."""
    scores = [100 * point["mean_score"] for point in last_points(contents)]
    spread = f" ({stdev(scores):.0f} %)" if len(scores) > 1 else ""
    return f"{mean(scores):.0f} %{spread}"


def success(contents: Sequence[dict[str, Any]]) -> str:
    """Success rate and its 95 % interval over all starts of the evaluations that count."""
    points, starts = last_points(contents), contents[0]["result"]["starts"]
    rate = mean(point["success_rate"] for point in points)
    low, high = wilson_interval(round(rate * starts * len(points)), starts * len(points))
    return f"{100 * rate:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def rows(header: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """A table in Markdown, with an empty line after it."""
    table_lines = [" | ".join(header), " | ".join(["---"] * len(header)), *(" | ".join(line) for line in lines)]
    return [*(f"| {line} |" for line in table_lines), ""]


def simulation(results: Results) -> list[str]:
    """The paper's table "Robotic simulation benchmark performance", once for each preset."""
    text = [
        "## The simulation table\n",
        "Mean score and, in parentheses, its standard deviation over seeds and over the checkpoints at the end of "
        "training. Beside ours: full success, with a 95 % interval (Wilson) over all their starts, which says nothing "
        "of the spread between trainings, and the number of seeds.\n",
    ]
    for preset in ("paper", "default", "mini"):
        text += [f"### {TITLES[preset]} (`--preset {preset}`)\n"]
        header = ["method"]
        for title in XARM_TASKS.values():
            header += [f"{title}: paper", "ours"]
        lines = []
        for method in METHODS:
            line = [LABELS[method]]
            for task in XARM_TASKS:
                middle, spread = published.SCORES[method][task]
                line += [f"{middle} % ({spread} %)", ours(results.get((preset, task, method)))]
            lines.append(line)
        text += rows(header, lines)
        text += [_training_in_words(preset, XARM_TASKS), ""]
    return text


def ours(contents: Sequence[dict[str, Any]] | None) -> str:
    """Score, success and seeds of a planner, if it was run."""
    if not contents:
        return MISSING
    return f"{score(contents)}; success {success(contents)}; {len(contents)}"


def number_of_blocks(results: Results) -> list[str]:
    """The paper's bar plot over the number of blocks, with and without a valid plan given."""
    text = [
        "## The number of blocks\n",
        "2D sorting. The paper shows this as a bar plot without figures: Diffuser and its variants fall with the "
        "number of blocks, HDP hardly does. Ours, as above.\n",
    ]
    for preset in ("mini", "mini_epsilon"):
        lines = []
        for method in METHODS:
            cells = [results.get((preset, task, method)) for task in TASKS_2D]
            lines.append([LABELS[method], *map(ours, cells)])
        text += [f"### {TITLES[preset]} (`--preset {preset}`)\n", *rows(["method", *TASKS_2D.values()], lines)]
        text += [_training_in_words(preset, TASKS_2D), ""]
    return [*text, _conditioning("valid_plan_BlockSorting2D")]


def _training_in_words(preset: str, titles: dict[str, str]) -> str:
    """Demonstrations and steps of each task."""
    settings = PRESETS[preset]
    parts = []
    for task, title in titles.items():
        training = settings.tasks[task]
        parts.append(
            f"{title}: {training.demonstrations:,} demonstrations, {training.steps:,} steps of {training.batch_size}"
        )
    evaluations = (
        f"{settings.starts} starts an evaluation, the last {settings.average_last} of {settings.evaluations} count."
    )
    return f"{'; '.join(parts)}. {evaluations}"


def _conditioning(file: str) -> str:
    """A table of docs/conditioning.md."""
    return table(*next(arguments for arguments in TABLES if arguments[0] == file))


def training_curves(results: Results) -> list[str]:
    """The paper's figure "Performance over time": HDP against Diffuser."""
    panels = [
        (preset, task)
        for preset, task in dict.fromkeys((preset, task) for preset, task, _ in results)
        if all((preset, task, method) in results for method in ("hdp", "diffuser"))
    ]
    text = ["## HDP and Diffuser over training\n"]
    if not panels:
        return [*text, f"{MISSING}: no task has both.\n"]
    plt = use_svg()
    columns = min(3, len(panels))
    lines = -(-len(panels) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3.4 * columns, 2.6 * lines), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    for axis, (preset, task) in zip(axes.flat, panels, strict=False):
        for colour, method in zip(("C0", "C1"), ("hdp", "diffuser"), strict=True):
            curves = [content["result"]["curve"] for content in results[preset, task, method]]
            rates = list(zip(*([point["success_rate"] for point in curve] for curve in curves), strict=True))
            steps = [point["step"] for point in curves[0]]
            axis.plot(steps, list(map(mean, rates)), color=colour, label=LABELS[method])
            axis.fill_between(steps, list(map(min, rates)), list(map(max, rates)), color=colour, alpha=0.15, lw=0)
        axis.set(title=f"{task}, {preset}", xlabel="optimiser steps", ylabel="success rate", ylim=(0, 1.02))
        axis.title.set_fontsize(8)
        axis.grid(alpha=0.3)
    axes[0, 0].legend()
    CURVES.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(CURVES, metadata={"Date": None})
    plt.close(figure)
    return [
        *text,
        f"![Success over training]({CURVES.relative_to(DOCS)})\n",
        "A line is the mean of the seeds, its band their range.\n",
    ]


def adherence() -> list[str]:
    """The paper's "conditional plan coherence", and ours."""
    figures = published.ADHERENCE.items()
    lines = [[LABELS[method], f"{middle} % ({spread} %)"] for method, (middle, spread) in figures]
    return [
        "The paper, P(red on top | all stacked) with the prompt that red comes last; without it, 30 to 35 % for all:\n",
        *rows(["method", "paper"], lines),
        _conditioning("adherence_XArmToolUseRedOnTop"),
        _conditioning("adherence_BlockSorting2D"),
    ]


def latency() -> list[str]:
    """Time of a plan over Diffuser's."""
    path = RESULTS / "planner_latency.json"
    if not path.exists():
        return [f"{MISSING}: `python -m benchmarks.planner_latency`\n"]
    content = json.loads(path.read_text())
    result, sizes = content["result"], content["result"]["batch_size"]
    lines = []
    for method in METHODS:
        theirs = published.LATENCY_OVER_DIFFUSER.get(method)
        ours = [f"{100 * (measured[method]['ratio'][1] - 1):+.0f} %" for measured in sizes.values()]
        lines.append([LABELS[method], "" if theirs is None else f"+{theirs} %", *ours])
    header = ["method", "paper", *(f"ours, batch {size}" for size in sizes)]
    return [
        f"Over Diffuser at as many network calls, {result['num_layers']} layers of width {result['width']}, on "
        f"{content['run']['gpu'] or content['run']['cpu']}; medians ([spread](planner_latency.md)). "
        f"`{content['run']['command']}`\n",
        *rows(header, lines),
    ]


def training_time(results: Results) -> list[str]:
    """How long the cells trained, and where."""
    lines = []
    for (preset, task, method), contents in results.items():
        first = contents[0]
        minutes = [content["result"]["train_s"] / 60 for content in contents]
        speeds = [content["result"]["samples_per_second"] for content in contents]
        run = first["run"]
        lines.append(
            [
                preset,
                task,
                LABELS[method],
                f"{first['result']['parameters']:,}",
                f"{min(minutes):.1f} to {max(minutes):.1f}" if len(minutes) > 1 else f"{minutes[0]:.1f}",
                f"{mean(speeds):.0f}",
                run["gpu"] or f"{run['cpu']}, {run['cores']} cores",
                run["git_commit"],
            ]
        )
    header = ["preset", "task", "method", "parameters", "minutes", "samples/s", "machine", "commit"]
    return [
        "## Training time\n",
        f"The paper: {published.TRAINING}. Ours: wall time of `hdp-train`, its start and its checkpoints included; on "
        "a CPU, other cells may have used some of the cores.\n",
        *rows(header, lines),
    ]


def failures(results: Results) -> list[str]:
    """Of HDP's failures in the evaluations that count, which had a valid symbolic plan."""
    lines = []
    for (preset, task, method), contents in results.items():
        if method != "hdp":
            continue
        counts: Counter[str] = Counter()
        for point in last_points(contents):
            counts.update({key: point[key] for key in ("failures", "failures_with_valid_plan", "valid_plans")})
        starts = contents[0]["result"]["starts"] * len(last_points(contents))
        invalid = counts["failures"] - counts["failures_with_valid_plan"]
        lines.append(
            [preset, task, str(starts), str(counts["failures"]), str(invalid), str(counts["failures_with_valid_plan"])]
        )
    header = [
        "preset",
        "task",
        "starts",
        "failures",
        "the symbolic plan was invalid",
        "it was valid, the motion failed",
    ]
    return ["## What HDP's failures are\n", *rows(header, lines)]


def missing_cells(cells: Sequence[Cell]) -> list[str]:
    """How many cells are not finished, by preset."""
    lines = []
    for preset in PRESETS:
        own = [cell for cell in cells if cell.facts["preset"] == preset]
        finished = sum(cell.result_file.exists() for cell in own)
        lines.append([f"`--preset {preset}`", str(finished), str(len(own) - finished)])
    return [f"## Cells of the seeds {', '.join(map(str, SEEDS))}\n", *rows(["preset", "finished", MISSING], lines)]
