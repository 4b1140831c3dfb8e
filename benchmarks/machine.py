"""What a result has to say about where it comes from."""

import json
import os
import platform
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

REPOSITORY = Path(__file__).parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
PACKAGES = ("lerobot", "torch", "gymnasium", "mujoco", "numpy")


def describe_run() -> dict[str, object]:
    """The command, the code, the machine and the versions of the packages that matter, for a results file."""
    return {
        "command": "python -m " + shlex.join([_module_name(), *sys.argv[1:]]),
        "git_commit": git_commit(),
        "cpu": _cpu_name(),
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),  # with AVX2 alone, training computes in float32
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "python": platform.python_version(),
        "packages": {name: import_module(name).__version__ for name in PACKAGES},
    }


def write_json(path: Path, content: Any) -> None:
    """Write a file, all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".new")
    unfinished.write_text(json.dumps(content, indent=2) + "\n")
    unfinished.rename(path)


def git_commit() -> str:
    """The commit of this code, `+changes` if it was changed since; in a packed folder, what its file `COMMIT` says."""
    if (packed := REPOSITORY / "COMMIT").exists():
        return packed.read_text().strip()
    changes = _git("status", "--porcelain", "--", "*.py", "*.json", "*.toml", "*.xml", ":!benchmarks/results")
    return _git("rev-parse", "--short", "HEAD") + ("+changes" if changes else "")


def _module_name() -> str:
    specification = sys.modules["__main__"].__spec__
    return specification.name.removesuffix(".__main__") if specification else sys.argv[0]


def _git(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.strip()


def _cpu_name() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
