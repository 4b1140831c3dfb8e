"""Write all pages of `docs/` that are made from results files, and measure nothing: `python -m benchmarks`."""

from importlib import import_module

from . import task_pages
from .paper import report

PAGES = (
    "ablations",
    "conditioning_tables",
    "few_step_planning",
    "growth",
    "plan_variety",
    "planner_latency",
    "planner_report",
    "training_speed",
)
"""Modules of this package that write one page."""


def main() -> None:
    for name in PAGES:
        import_module(f"benchmarks.{name}").write_page()
    task_pages.main()
    report.write_report()


if __name__ == "__main__":
    main()
