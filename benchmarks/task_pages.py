"""Write what `benchmarks/results/` says into the pages of `docs/tasks/`, below their heading `## Measured`.

Below each table stands where its figures come from: each command, with the commit at which it was run.

python -m benchmarks.task_pages
"""

import json

from .machine import RESULTS
from .pages import DOCS

FOLDER = DOCS / "tasks"
PAGES = {
    "xarm_sorting.md": ["XArmSorting"],
    "xarm_arrange_blocks.md": ["XArmArrangeBlocks"],
    "xarm_tool_use.md": ["XArmToolUse", "XArmToolUseRedOnTop"],
}
HEADING = "## Measured\n"


def load(name: str) -> dict:
    """A results file; empty when it is not there."""
    path = RESULTS / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else {}


def expert_table(task: str) -> str:
    """One expert's figures, as a table."""
    own, menagerie = load(f"expert_{task}"), load(f"expert_{task}_menagerie")
    replay = load("replay").get(f"{task}-v0")
    counts = own["plans"].values()
    rows = {
        "successes": f'{successes(own)}; with `robot="menagerie"` {successes(menagerie)}',
        "clipped actions": own["clipped_actions"],
        "plans": f"{len(counts)} different ones, each chosen {min(counts)} to {max(counts)} times "
        f"([counts](../../benchmarks/results/expert_{task}.json))",
        "episodes per second, one process": f"{own['episodes_per_second']:.1f}",
        "time inside `mj_step`": f"{own['physics_fraction']:.0%}",
    }
    if replay:
        rows["recorded episodes that replay to the recorded score"] = (
            f"{replay['same_score']} of {replay['num_episodes']}"
        )
    lines = [f"| {task} | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())]
    return "\n".join([*lines, "", sources(own, menagerie, *([replay] if replay else []))])


def successes(result: dict) -> str:
    total = result["num_episodes"]
    return f"{total - len(result['failures'])} of {total} seeded starts"


def sources(*results: dict) -> str:
    """Where results come from, as a list, each command once."""
    runs = [result["run"] for result in results]
    lines = [f"- `{run['command']}`, commit {run['git_commit']}, {run['cores']} cores ({run['cpu']})" for run in runs]
    return "\n".join(dict.fromkeys(lines)) + "\n"


def open_loop_table() -> str:
    """Plans per second by each way of executing them, as a table."""
    results = load("open_loop")
    any_result = next(iter(results.values()))
    num_plans, num_cores = any_result["num_plans"], any_result["num_cores"]
    ways = list(any_result["plans_per_second"])
    headings = [*ways, "bare physics, one thread", f"`execute_plans` / {num_cores} threads of bare physics"]
    lines = [f"| plans per second | {' | '.join(headings)} |", "|---" * (len(headings) + 1) + "|"]
    for task, result in results.items():
        bare = result["bare_physics_plans_per_second_per_thread"]
        speeds = " | ".join(f"{speed:.1f}" for speed in [*result["plans_per_second"].values(), bare])
        lines.append(f"| {task} | {speeds} | {result['plans_per_second']['execute_plans'] / bare / num_cores:.2f} |")
    agree = all(result["scores_agree"] for result in results.values())
    lines += ["", f"{num_plans} plans on {num_cores} cores; all scores agree: {agree}."]
    return "\n".join([*lines, "", sources(*results.values())])


def recording_table() -> str:
    """How long `hdp-record` takes, as a table; empty before it was measured."""
    results = load("recording")
    if not results:
        return ""
    lines = [
        "| hdp-record | episodes | seconds | episodes per second | inside `mj_step` | rendering |",
        "|---|---|---|---|---|---|",
    ]
    for obs_type in ("state", "pixels_state"):
        result = results[obs_type]
        lines.append(
            f"| {result['task']}, `{obs_type}` | {result['num_episodes']} | {result['seconds']:.0f} "
            f"| {result['episodes_per_second']:.1f} | {result['physics_fraction']:.0%} "
            f"| {result['rendering_fraction']:.0%} |"
        )
    workers = results["state"]["num_workers"]
    lines += ["", f"{workers} workers, start-up included; the shares are those of one worker."]
    return "\n".join(["", *lines, "", sources(results)])


def replace_measured(page: str, text: str) -> None:
    before = (FOLDER / page).read_text().split(HEADING)[0]
    (FOLDER / page).write_text(f"{before}{HEADING}\n{text}")


def main() -> None:
    for page, tasks in PAGES.items():
        replace_measured(page, "\n".join(expert_table(task) for task in tasks))
    replace_measured("xarm.md", open_loop_table() + recording_table())


if __name__ == "__main__":
    main()
