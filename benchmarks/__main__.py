"""Write all pages of `docs/` that are made from results files, and measure nothing: `python -m benchmarks`."""

from types import ModuleType

from . import (
    ablations,
    conditioning_tables,
    few_step_planning,
    growth,
    plan_variety,
    planner_latency,
    planner_report,
    task_pages,
    training_speed,
)
from .paper import report

PAGES: tuple[ModuleType, ...] = (
    ablations,
    conditioning_tables,
    few_step_planning,
    growth,
    plan_variety,
    planner_latency,
    planner_report,
    training_speed,
)
"""Modules that write one page."""


def main() -> None:
    for module in PAGES:
        module.write_page()
    task_pages.main()
    report.write_report()


if __name__ == "__main__":
    main()
