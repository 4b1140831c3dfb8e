"""The checkpoints that come with the repository do their task."""

from pathlib import Path

import pytest

from benchmarks.evaluation import evaluate

from .conftest import REPOSITORY

CHECKPOINTS = sorted(path.parent for path in (REPOSITORY / "checkpoints").glob("*/config.json"))

assert CHECKPOINTS, "the folder of checkpoints is empty"


@pytest.mark.parametrize("checkpoint", CHECKPOINTS, ids=lambda path: path.name)
def test_a_checkpoint_succeeds_on_fresh_starts_with_valid_plans(checkpoint: Path):
    result = evaluate(checkpoint, starts=10, first_seed=5_000)
    assert result["success_rate"] >= 0.8
    assert result["failures"] == round(10 * (1 - result["success_rate"]))
    assert result["valid_plans"] >= 8
