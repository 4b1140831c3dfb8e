"""The benchmarks can be started, and say how."""

import importlib
import pkgutil

import pytest

import benchmarks

MODULES = sorted(module.name for module in pkgutil.iter_modules(benchmarks.__path__))


@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_can_be_imported_and_states_its_command(name):
    module = importlib.import_module(f"benchmarks.{name}")
    if hasattr(module, "main"):
        assert f"python -m benchmarks.{name}" in module.__doc__
