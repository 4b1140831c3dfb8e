"""What the README shows of Python does what it says, and the pages' links lead somewhere."""

import json
import re
import subprocess
import sys
from pathlib import Path
from statistics import mean

import pytest

from benchmarks.cells import points_that_count

from .conftest import REPOSITORY

PAGES = [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("checkpoints/*.md"), *REPOSITORY.glob("docs/**/*.md")]


def test_the_examples_in_python_run():
    section = (REPOSITORY / "README.md").read_text().partition("## From Python")[2]
    examples = re.findall(r"```python\n(.*?)```", section, re.DOTALL)
    code = "\n".join([*examples, "print(tuple(waypoints.shape))"])
    result = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "PICK 1.00  B 1.00" in result.stdout
    assert "(145, 4)" in result.stdout
    assert "True" in result.stdout.splitlines()


def test_figures_that_link_to_a_results_file_are_what_it_says():
    figures = [
        (page.parent / path, int(figure))
        for page in PAGES
        for figure, path in re.findall(r"\[(\d+) %\]\((\S*benchmarks/results/\S+\.json)\)", page.read_text())
    ]
    assert len(figures) > 30
    for path, figure in figures:
        points = points_that_count(json.loads(path.read_text())["result"])
        assert figure == round(100 * mean(point["success_rate"] for point in points)), path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_links_lead_somewhere(page: Path):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)|src=\"([^\"]+)\"", text)
    links = [link or source for link, source in targets]
    missing = [link for link in links if "://" not in link and not (page.parent / link).exists()]
    assert not missing
