"""docs/results.md: the paper's tables and figures, ours beside theirs, from the files in `benchmarks/results/`."""

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from .. import doing_nothing, planner_latency
from ..cells import all_runs, points_that_count, read_result
from ..conditioning_tables import percent
from ..evaluation import MISTAKES
from ..machine import RESULTS
from ..pages import COLOURS, DOCS, LABELS, markdown_table, plot_curves, save_figure, use_svg
from . import published
from .presets import METHODS, PRESETS, TASKS, exists, make_cells

SEEDS = [0, 1, 2]
XARM_TASKS = {
    "xarm_sorting": "X-Arm Sorting",
    "xarm_arrange_blocks": "Arrange Blocks",
    "xarm_tool_use": "Tool Use",
}
FROM_IMAGES = {"xarm_sorting_images": "X-Arm Sorting, from an image alone"}
TASKS_2D = {f"block_sorting_2d_{n}_blocks": f"{n} blocks" for n in (2, 3, 4)}
TITLES = {
    "paper": "The paper's hyperparameters",
    "default": "Our settings at the paper's network size",
    "small": "Our settings with a network of a seventh of the size, on a CPU core",
    "small_adamw": "The same network, trained by AdamW, for longer, with condition tokens by an MLP",
    "mini": "Earlier settings, without rotary positions and Muon, on a CPU core",
    "mini_epsilon": "The same, predicting the noise, as the paper does",
}
MISSING = "missing"
OF_SMALL = "Planners of the preset `small`, 200 starts. [More](conditioning.md#measured)"
FEWEST_FOR_AN_INTERVAL = 3
"""Trainings. Of two, Student's t makes an interval of width 0, if they happen to agree, or one that says nothing."""
T_95 = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262)
"""Two-sided 95 % quantiles of Student's t with 1, 2, ... degrees of freedom."""

Results = dict[tuple[str, str, str], list[dict[str, Any]]]
"""Of each (preset, task, method), the contents of its finished cells' files: `run` and `result`."""


def write_report(page: Path = DOCS / "results.md") -> list[Path]:
    """Write the page, and its plots into `images/` beside it; return their paths."""
    cells = make_cells(list(PRESETS), list(TASKS), list(METHODS), SEEDS)
    results: Results = defaultdict(list)
    for cell in cells:
        if content := read_result(cell):
            results[cell.facts["preset"], cell.facts["task_name"], cell.policy["type"]].append(content)
    curves, blocks = page.parent / "images" / "training_curves.svg", page.parent / "images" / "number_of_blocks.svg"
    plot_training(results, curves)
    plot_blocks(results, blocks)
    finished = {preset: sum(len(found) for key, found in results.items() if key[0] == preset) for preset in PRESETS}
    planned = {preset: sum(cell.facts["preset"] == preset for cell in cells) for preset in PRESETS}
    counts = ", ".join(f"{finished[preset]} of {planned[preset]} with `--preset {preset}`" for preset in PRESETS)
    parts = [
        "# Results, beside the paper's\n",
        "Written by `python -m benchmarks.paper --report` from the files in `benchmarks/results/`; `python -m "
        "benchmarks.paper --list` says what can be run next. A preset, here, is a series of trainings "
        "([`presets.py`](../benchmarks/paper/presets.py)); `--policy.preset` is a planner's settings. Figures of the "
        "paper are as printed there. Finished "
        f"cells (a method, a task and one of the seeds {', '.join(map(str, SEEDS))}): {counts}.\n",
        "## The simulation table\n",
        "Each cell gives the mean score and, in parentheses, its standard deviation over seeds and over the last "
        "checkpoints, as in the paper. With two seeds, the mean of each follows; from three on, the 95 % interval of "
        "the mean (Student's t): of further trainings, because all seeds share their demonstrations. Last comes "
        "success: how often the whole task was solved. The tasks are built after the "
        "paper's description, in our own simulation: its figures stand beside ours for orientation. "
        f"{floor(XARM_TASKS)}\n",
        "All settings were chosen by HDP's success, and then used for all planners, but for what only masked symbols "
        "or HDP have: `symbol_lead`, `confidence_threshold` and, in arranging, `lead_share`. [How fair that "
        "is](fairness.md).\n",
        *(simulation(preset, XARM_TASKS, results) for preset in ("default", "small", "small_adamw", "mini", "paper")),
        "## From an image\n",
        'The paper\'s figure "Image conditioning": the planner sees the scene at the start, by one camera, and nothing '
        "else: no pose, nor where the arm is. A ResNet-18 (11.2 million parameters more) reads the image, in the paper "
        "a pretrained one, with `small` a new one. The hierarchical planners plan observations, and take no images.\n",
        *(simulation(preset, FROM_IMAGES, results) for preset in ("small", "paper")),
        "## The number of blocks\n",
        "2D sorting, with one waypoint a pose (19, 37 and 55 actions; the paper has 73, 109 and 145). The paper shows "
        "this as a bar plot without figures: Diffuser and its variants fall with the number of blocks, HDP falls less. "
        f"{floor(TASKS_2D)}\n",
        f"![Mean score over the number of blocks]({blocks.relative_to(page.parent)})\n",
        *(simulation(preset, TASKS_2D, results) for preset in ("default", "small", "mini", "mini_epsilon")),
        "### With a valid plan given\n",
        valid_plan(),
        "## HDP and Diffuser over training\n",
        "A line is the mean of the seeds, its band their range. The paper's figure is of the same two.\n",
        f"![Success over training]({curves.relative_to(page.parent)})\n",
        "## The best of each training\n",
        "How long a training lasts was chosen for HDP; some planners are better before its end. Success in % in the "
        "last three evaluations, which are those that count, and in the best three in a row. (The starts differ from "
        "one evaluation to the next, and the best of several is too good by chance.)\n",
        *(best_in_a_row(preset, results) for preset in ("default", "small")),
        "## Adherence to a prompt\n",
        adherence(),
        "## Latency\n",
        latency(),
        "## Training time\n",
        f"The paper: {published.TRAINING}. Ours, in minutes and samples a second: wall time of `hdp-train`, its start "
        "and its checkpoints included. Other work may have used the machine at the same time, as on the H200, which "
        "eight trainings shared.\n",
        training_time(results),
        "## What HDP's failures are\n",
        "In the evaluations that count.\n",
        failures(results),
    ]
    page.write_text("\n".join(parts))
    return [page, curves, blocks]


def simulation(preset: str, titles: dict[str, str], results: Results) -> str:
    """Scores of all methods on some tasks; beside the paper's, where it has figures."""
    header = ["method"]
    for task, title in titles.items():
        header += [f"{title}: paper", "ours"] if task in published.SCORES else [title]
    rows = []
    for method in METHODS:
        if not all(exists(method, preset, task) for task in titles):
            continue
        row = [LABELS[method]]
        for task in titles:
            if task in published.SCORES:
                theirs = published.SCORES[task].get(method)
                row.append("{} % ({} %)".format(*theirs) if theirs else "")
            row.append(score(results.get((preset, task, method))))
        rows.append(row)
    settings = PRESETS[preset]
    words = []
    for task, title in titles.items():
        how = settings.tasks[task]
        words.append(
            f"{title}: {how.demonstrations:,} demonstrations, {how.steps:,} steps of {how.batch_size}"
            f"{differences(how.policy)}{differences(settings.hdp_policy | how.hdp_policy, 'HDP with ')}"
        )
    return (
        f"### {TITLES[preset]} (`--preset {preset}`)\n\n{markdown_table(header, rows)}\n{'; '.join(words)}. "
        f"{settings.starts} starts an evaluation, the last {settings.average_last} of {settings.evaluations} count.\n"
    )


def differences(policy: dict[str, Any], whose: str = "") -> str:
    """Options that differ from a preset's, in words; nothing, if none do."""
    values = {name: f"{value:.3g}" if isinstance(value, float) else value for name, value in policy.items()}
    return f", {whose}`{', '.join(f'{name}={value}' for name, value in values.items())}`" if policy else ""


def floor(titles: dict[str, str]) -> str:
    """The mean scores of doing nothing."""
    measured = json.loads(doing_nothing.FILE.read_text())
    scores = ", ".join(f"{title}: {100 * measured[task]['mean_score']:.0f} %" for task, title in titles.items())
    return f"A robot that stays where it is has a mean score, too ({scores}; `python -m benchmarks.doing_nothing`)."


def last_points(contents: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The evaluations that count, of all seeds."""
    return [point for content in contents for point in points_that_count(content["result"])]


def score(contents: Sequence[dict[str, Any]] | None) -> str:
    """Mean score in %, its standard deviation, of several seeds their means or the interval of the mean; success."""
    if not contents:
        return MISSING
    points = last_points(contents)
    scores = [100 * point["mean_score"] for point in points]
    of_seeds = [mean(100 * point["mean_score"] for point in last_points([content])) for content in contents]
    seeds = f"seeds: {', '.join(f'{seed:.0f}' for seed in of_seeds)}"
    if len(of_seeds) == 1:
        seeds = "one seed"
    elif len(of_seeds) >= FEWEST_FOR_AN_INTERVAL:
        half = T_95[len(of_seeds) - 2] * stdev(of_seeds) / math.sqrt(len(of_seeds))
        low, high = max(0, mean(of_seeds) - half), min(100, mean(of_seeds) + half)
        seeds = f"{len(of_seeds)} seeds: {low:.0f} to {high:.0f}"
    success = 100 * mean(point["success_rate"] for point in points)
    return f"{mean(scores):.0f} % ({stdev(scores):.0f} %), {seeds}; success {success:.0f} %"


def best_in_a_row(preset: str, results: Results) -> str:
    """Success in the evaluations that count, and in the best ones that follow each other, of all methods."""
    titles = {
        task: title for task, title in (XARM_TASKS | FROM_IMAGES | TASKS_2D).items() if task in PRESETS[preset].tasks
    }
    count = PRESETS[preset].average_last

    def cell(contents: Sequence[dict[str, Any]]) -> str:
        last = mean(point["success_rate"] for point in last_points(contents))
        return f"{100 * last:.0f}, {100 * mean(map(best, contents)):.0f}"

    def best(content: dict[str, Any]) -> float:
        rates = [point["success_rate"] for point in content["result"]["curve"]]
        return max(mean(rates[start : start + count]) for start in range(len(rates) - count + 1))

    rows = []
    for method in METHODS:
        measured = {task: results.get((preset, task, method)) for task in titles if exists(method, preset, task)}
        rows.append([LABELS[method], *(cell(found) if (found := measured.get(task)) else "" for task in titles)])
    return f"{TITLES[preset]} (`--preset {preset}`)\n\n{markdown_table(['method', *titles.values()], rows)}"


def plot_training(results: Results, path: Path) -> None:
    """The paper's figure "Performance over time", for each task that has both planners."""
    panels = {}
    for preset, task in dict.fromkeys((preset, task) for preset, task, _ in results):
        pair = {method: results.get((preset, task, method)) for method in ("hdp", "diffuser")}
        if all(pair.values()):
            panels[f"{task}, {preset}"] = {
                method: [content["result"]["curve"] for content in contents or []] for method, contents in pair.items()
            }
    if panels:
        plot_curves(panels, path)


def plot_blocks(results: Results, path: Path) -> None:
    """The paper's bar plot over the number of blocks: the mean of all seeds and checkpoints that count."""
    plt = use_svg()
    presets = ("default", "small", "mini")
    figure, axes = plt.subplots(1, len(presets), figsize=(11, 3), sharey=True, layout="constrained")
    for preset, axis in zip(presets, axes, strict=True):
        methods = [method for method in METHODS if any((preset, task, method) in results for task in TASKS_2D)]
        for number, method in enumerate(methods):
            for position, task in enumerate(TASKS_2D):
                if contents := results.get((preset, task, method)):
                    height = mean(point["mean_score"] for point in last_points(contents))
                    drawn = axis.get_legend_handles_labels()[1]
                    label = None if LABELS[method] in drawn else LABELS[method]
                    place = position + 0.13 * (number - (len(methods) - 1) / 2)
                    axis.bar(place, height, 0.12, color=COLOURS[method], label=label)
        axis.set_xticks(range(len(TASKS_2D)), TASKS_2D.values())
        axis.set(ylabel="mean score", ylim=(0, 1.02), title=f"2D sorting, preset {preset}")
        if axis.patches:
            axis.legend(fontsize=7, loc="lower left")
    save_figure(figure, path)


def _conditioning(file: str) -> list[dict[str, Any]]:
    """What `benchmarks.conditioning` wrote; nothing, if it was not run."""
    path = RESULTS / f"{file}.json"
    return json.loads(path.read_text())["results"] if path.exists() else []


def valid_plan() -> str:
    """Success with the expert's symbolic plan given, and with none, over the number of blocks."""
    measured = {result["parameters"]["n_blocks"]: result for result in _conditioning("valid_plan_BlockSorting2D")}
    rows = []
    for blocks in (2, 3, 4):
        result = measured.get(blocks)
        names = ("valid_plan_given", "nothing_given")
        cells = [percent(result[name]["success"]) for name in names] if result else [MISSING, MISSING]
        rows.append([f"{blocks} blocks", *cells, f"{result['train_steps']:,}" if result else ""])
    header = ["HDP, success", "a valid plan given", "nothing given", "steps of training"]
    return f"{markdown_table(header, rows)}\n{OF_SMALL}\n"


def adherence() -> str:
    """The paper's "conditional plan coherence", ours beside it, and the same measure on 2D sorting."""
    measured: dict[str, dict[str, str]] = {}
    for column, file in (("red", "adherence_XArmToolUseRedOnTop"), ("first", "adherence_BlockSorting2D")):
        for result in _conditioning(file):
            own = measured.setdefault(result["planner"], {})
            for name in ("with_prompt", "without_prompt"):
                own[f"{column}, {name}"] = percent(result[name]["adherence"])
    rows = []
    for method, (middle, spread) in published.ADHERENCE.items():
        names = [f"{column}, {name}" for column in ("red", "first") for name in ("with_prompt", "without_prompt")]
        ours = [measured.get(method, {}).get(name, MISSING) for name in names]
        rows.append([LABELS[method], f"{middle} % ({spread} %)", *ours])
    header = [
        "planner",
        "P(red on top, given that all are stacked), with the prompt: paper",
        "ours",
        "without it",
        "2D, 3 blocks: P(the named block is moved first, given success), with the prompt",
        "without it",
    ]
    note = "In the paper, without the prompt, it is 30 to 35 % for all."
    return f"{markdown_table(header, rows)}\n{note} {OF_SMALL}\n"


def latency() -> str:
    """Time of a plan over Diffuser's, on each device."""
    if not (contents := planner_latency.read_results()):
        return f"{MISSING}: `python -m benchmarks.planner_latency`\n"
    theirs = published.LATENCY_OVER_DIFFUSER
    columns = {"paper": {method: f"+{theirs[method]} %" for method in METHODS if method in theirs}}
    for content in contents:
        device = planner_latency.device_name(content)
        for size, measured in content["result"]["batch_size"].items():
            ratios = {method: measured[method]["ratio"][1] for method in METHODS if method in measured}
            columns[f"{device}, batch {size}"] = {name: f"{100 * (ratio - 1):+.0f} %" for name, ratio in ratios.items()}
    rows = [[LABELS[method], *(column.get(method, "") for column in columns.values())] for method in METHODS]
    return (
        f"{markdown_table(['over Diffuser, at as many network calls', *columns], rows)}\n"
        "Medians ([milliseconds, spread and commands](planner_latency.md)). The paper gives one figure for "
        '"Hierarchical Diffusion", which stands beside both. On a CPU, time goes with the number of '
        "tokens: in the paper's setting HDP has 108 more, most of them PAD; without padding (`--preset default`) 36.\n"
    )


def training_time(results: Results) -> str:
    """Minutes and samples a second of all methods, for each preset and task."""
    rows = []
    for preset, settings in PRESETS.items():
        for task in settings.tasks:
            row, machines = [f"{task}, {preset}"], set()
            for method in METHODS:
                contents = results.get((preset, task, method), [])
                for run in (run for content in contents for run in all_runs(content)):
                    machines.add(run["gpu"] or _cpu(run))
                minutes = [content["result"]["train_s"] / 60 for content in contents]
                speeds = [content["result"]["samples_per_second"] for content in contents]
                missing = MISSING if exists(method, preset, task) else ""
                row.append(f"{mean(minutes):.1f} min, {mean(speeds):.0f}/s" if contents else missing)
            rows.append([*row, "; ".join(sorted(machines))])
    return markdown_table(["task, preset", *LABELS.values(), "machine"], rows)


def _cpu(run: dict[str, Any]) -> str:
    instructions = f" with {run['cpu_capability']}" if "cpu_capability" in run else ""
    threads = f", {run['threads']} threads" if run.get("threads", 1) > 1 else ""
    return f"{run['cpu']}{instructions}, {run['cores']} cores{threads}"


def failures(results: Results) -> str:
    """Of HDP's failures, which had a valid symbolic plan, and what went wrong first in the motion of these."""
    rows = []
    for preset, settings in PRESETS.items():
        for task in settings.tasks:
            if not (contents := results.get((preset, task, "hdp"))):
                rows.append([f"{task}, {preset}", MISSING, *[""] * (3 + len(MISTAKES))])
                continue
            points = last_points(contents)
            failed, with_valid = (sum(p[name] for p in points) for name in ("failures", "failures_with_valid_plan"))
            starts = contents[0]["result"]["starts"] * len(points)
            row = [f"{task}, {preset}", *map(str, (starts, failed, failed - with_valid, with_valid))]
            if all("first_mistakes" in point for point in points):
                row += [str(sum(point["first_mistakes"][mistake] for point in points)) for mistake in MISTAKES]
            else:
                row += ["not counted"] * len(MISTAKES)
            rows.append(row)
    header = ["task, preset", "starts", "failures", "the symbolic plan was invalid", "it was valid, the motion failed"]
    mistakes = ["of these: closed on nothing", "lost what it held", "took or set down in a wrong place"]
    return markdown_table(header + mistakes, rows)
