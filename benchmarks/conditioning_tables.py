"""Write what `benchmarks/results/` says of conditioning into docs/conditioning.md, below its heading `## Measured`.

python -m benchmarks.conditioning_tables
"""

import json
from collections.abc import Sequence
from typing import Any

from .machine import RESULTS
from .pages import DOCS, LABELS, markdown_table

PAGE = DOCS / "conditioning.md"
HEADING = "## Measured\n"


def percent(measured: dict[str, Any]) -> str:
    """A rate with its 95 % interval."""
    if measured["rate"] is None:
        return "none succeeded"
    low, high = (100 * bound for bound in measured["interval_95"])
    return f"{100 * measured['rate']:.1f} % ({low:.1f} to {high:.1f})"


def adherence_rows(result: dict[str, Any]) -> list[list[str]]:
    measured = [result[name] for name in ("with_prompt", "without_prompt")]
    adheres = [f"{percent(way['adherence'])} of {way['adherence']['of']}" for way in measured]
    counts = [f"{100 * way['adherence']['of'] / result['starts']:.1f} %" for way in measured]
    return [[LABELS[result["planner"]], *adheres, *counts, str(result["network_calls_per_plan"])]]


def valid_plan_rows(result: dict[str, Any]) -> list[list[str]]:
    given, free = (percent(result[name]["success"]) for name in ("valid_plan_given", "nothing_given"))
    return [[_name(result), given, free, str(result["starts"]), str(result["network_calls_per_plan"])]]


def candidates_rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    for best in result["best_of"]:
        rates = [percent(best[name]) for name in ("by_likelihood", "by_checker")]
        rows.append([_name(result), str(best["k"]), *rates, f"{best['seconds_per_plan']:.2f} s"])
    return rows


def _name(result: dict[str, Any]) -> str:
    blocks = result["parameters"].get("n_blocks")
    return f"{result['task'].removesuffix('-v0')}{f', {blocks} blocks' if blocks else ''}"


ADHERENCE = (
    "planner",
    "does what the prompt asks for, with the prompt",
    "without it",
    "plans that count, with the prompt",
    "without it",
    "network calls",
)
CANDIDATES = ("task", "k", "by likelihood", "by the task's checker, then likelihood", "time for a plan")
TABLES = (
    ("adherence_XArmToolUseRedOnTop", "P(red on top, given that all are stacked); the prompt: red last", ADHERENCE),
    ("adherence_BlockSorting2D", "P(the named block is moved first, given success); the prompt: that block", ADHERENCE),
    (
        "valid_plan_BlockSorting2D",
        "Success",
        ("task", "a valid plan given", "nothing given", "starts", "network calls"),
    ),
    ("candidates_BlockSorting2D", "Success of the best of k plans", CANDIDATES),
    ("candidates_XArmArrangeBlocks", "Success of the best of k plans", CANDIDATES),
)
ROWS = {"adherence": adherence_rows, "valid": valid_plan_rows, "candidates": candidates_rows}


def table(file: str, title: str, header: Sequence[str]) -> str:
    """One results file as a table, with the command that made it."""
    path = RESULTS / f"{file}.json"
    if not path.exists():
        return f"**{title}**: not yet run.\n"
    contents = json.loads(path.read_text())
    make_rows = ROWS[file.split("_")[0]]
    lines = markdown_table(header, [row for result in contents["results"] for row in make_rows(result)])
    run = contents["run"]
    where = run.get("gpu") or run["cpu"]
    return f"**{title}** ([json](../benchmarks/results/{path.name}))\n\n{lines}\n`{run['command']}`, on {where}.\n"


def write_page() -> None:
    before = PAGE.read_text().split(HEADING)[0]
    note = (
        "95 % intervals are Wilson's; the same starts in every column of a table, one training of each planner. The "
        "checkpoints are those of `python -m benchmarks.paper` with the preset that each command names: `small`, or "
        "`mini`, an earlier one in the middle of learning ([results](results.md)).\n"
    )
    PAGE.write_text("\n".join([before + HEADING, note, *(table(*arguments) for arguments in TABLES)]))


if __name__ == "__main__":
    write_page()
