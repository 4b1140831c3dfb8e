"""Write what `benchmarks/results/` says into the pages of `docs/tasks/`, below their heading `## Measured`.

python -m benchmarks.task_pages
"""

import json
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "tasks"
RESULTS = Path(__file__).parent / "results"
PAGES = {
    "xarm_sorting.md": ["XArmSorting"],
    "xarm_arrange_blocks.md": ["XArmArrangeBlocks"],
    "xarm_tool_use.md": ["XArmToolUse", "XArmToolUseRedOnTop"],
}
HEADING = "## Measured\n"


def expert_table(task: str) -> str:
    """One expert's figures, as a table."""
    own = json.loads((RESULTS / f"expert_{task}.json").read_text())
    menagerie = json.loads((RESULTS / f"expert_{task}_menagerie.json").read_text())
    counts = own["plans"].values()
    return f"""| {task} | |
|---|---|
| successes | {successes(own)}; with `robot="menagerie"` {successes(menagerie)} |
| clipped actions | {own["clipped_actions"]} |
| plans | {len(counts)} different ones, each chosen {min(counts)} to {max(counts)} times |
| episodes per second, one process | {own["episodes_per_second"]:.1f} |
| time inside `mj_step` | {own["physics_fraction"]:.0%} |

`python -m benchmarks.experts --tasks {own["task"]} --num_episodes {own["num_episodes"]}`
"""


def successes(result: dict) -> str:
    total = result["num_episodes"]
    return f"{total - len(result['failures'])} of {total} seeded starts"


def open_loop_table() -> str:
    """Plans per second by each way of executing them, as a table."""
    results = json.loads((RESULTS / "open_loop.json").read_text())
    any_result = next(iter(results.values()))
    ways = list(any_result["plans_per_second"])
    lines = [f"| plans per second | {' | '.join(ways)} | bare physics, one thread |", "|---" * (len(ways) + 2) + "|"]
    for task, result in results.items():
        speeds = [*result["plans_per_second"].values(), result["bare_physics_plans_per_second_per_thread"]]
        lines.append(f"| {task} | {' | '.join(f'{speed:.1f}' for speed in speeds)} |")
    agree = all(result["scores_agree"] for result in results.values())
    lines += ["", f"{any_result['num_plans']} plans on {any_result['num_cores']} cores; all scores agree: {agree}."]
    lines += ["", f"`python -m benchmarks.open_loop --num_plans {any_result['num_plans']}`", ""]
    return "\n".join(lines)


def replace_measured(page: str, text: str) -> None:
    before = (FOLDER / page).read_text().split(HEADING)[0]
    note = "The figures are from two cores that a training run shared.\n"
    (FOLDER / page).write_text(f"{before}{HEADING}\n{note}\n{text}")


def main() -> None:
    for page, tasks in PAGES.items():
        replace_measured(page, "\n".join(expert_table(task) for task in tasks))
    replace_measured("xarm.md", open_loop_table())


if __name__ == "__main__":
    main()
