"""Write what `benchmarks/results/` says of conditioning into docs/conditioning.md, below its heading `## Measured`.

python -m benchmarks.conditioning_tables
"""

import json
from pathlib import Path
from typing import Any

from .train_and_evaluate import RESULTS

PAGE = Path(__file__).parents[1] / "docs" / "conditioning.md"
HEADING = "## Measured\n"


def percent(measured: dict[str, Any]) -> str:
    """A rate with its 95 % interval."""
    if measured["rate"] is None:
        return "none succeeded"
    low, high = (100 * bound for bound in measured["interval_95"])
    return f"{100 * measured['rate']:.1f} % ({low:.1f} to {high:.1f})"


def adherence_rows(result: dict[str, Any]) -> list[str]:
    cells = [result["planner"], *(percent(result[name]["adherence"]) for name in ("with_prompt", "without_prompt"))]
    return [" | ".join([*cells, str(result["with_prompt"]["adherence"]["of"]), str(result["network_calls_per_plan"])])]


def valid_plan_rows(result: dict[str, Any]) -> list[str]:
    given, free = (percent(result[name]["success"]) for name in ("valid_plan_given", "nothing_given"))
    return [f"{_name(result)} | {given} | {free} | {result['starts']} | {result['network_calls_per_plan']}"]


def candidates_rows(result: dict[str, Any]) -> list[str]:
    return [
        f"{_name(result)} | {best['k']} | {percent(best['by_likelihood'])} | {percent(best['by_checker'])} | "
        f"{best['seconds_per_plan']:.2f} s"
        for best in result["best_of"]
    ]


def _name(result: dict[str, Any]) -> str:
    blocks = result["parameters"].get("n_blocks")
    return f"{result['task'].removesuffix('-v0')}{f', {blocks} blocks' if blocks else ''}"


ADHERENCE = "planner | asked for, with the prompt | without | plans that count | network calls"
TABLES = (
    ("adherence_XArmToolUseRedOnTop", "P(red on top, given that all are stacked); the prompt: red last", ADHERENCE),
    ("adherence_BlockSorting2D", "P(the named block is moved first, given success); the prompt: that block", ADHERENCE),
    ("valid_plan_BlockSorting2D", "Success", "task | a valid plan given | nothing given | starts | network calls"),
    (
        "candidates_BlockSorting2D",
        "Success of the best of k plans",
        "task | k | by likelihood | by the task's checker, then likelihood | time for a plan",
    ),
)
ROWS = {"adherence": adherence_rows, "valid": valid_plan_rows, "candidates": candidates_rows}


def table(file: str, title: str, header: str) -> str:
    """One results file as a table, with the command that made it."""
    path = RESULTS / f"{file}.json"
    if not path.exists():
        return f"**{title}**: not yet run.\n"
    contents = json.loads(path.read_text())
    make_rows = ROWS[file.split("_")[0]]
    rows = [header, " | ".join(["---"] * len(header.split("|")))]
    rows += [row for result in contents["results"] for row in make_rows(result)]
    lines = "\n".join(f"| {row} |" for row in rows)
    run = contents["run"]
    where = run.get("gpu") or run["cpu"]
    return f"**{title}** ([json](../benchmarks/results/{path.name}))\n\n{lines}\n\n`{run['command']}`, on {where}.\n"


def main() -> None:
    before = PAGE.read_text().split(HEADING)[0]
    note = "95 % intervals are Wilson's; the same starts in every column of a table.\n"
    PAGE.write_text("\n".join([before + HEADING, note, *(table(*arguments) for arguments in TABLES)]))


if __name__ == "__main__":
    main()
