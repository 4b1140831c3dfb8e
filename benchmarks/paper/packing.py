"""Carry cells to a machine that has neither a checkout nor a package registry, and their results back.

    python -m benchmarks.paper --preset default --methods hdp --seeds 0 --pack outputs/packed
    cd outputs/packed; PYTHONPATH=. python -m benchmarks.paper --packed --budget_minutes 9
    python -m benchmarks.paper --unpack outputs/packed

The first and the last command are for here, the second one for there. The folder holds the code, the demonstrations
(compressed; they are unpacked where cells first run) and the last checkpoints of cells that were stopped. LeRobot and
its dependencies must be installed there, this package need not be.
"""

import json
import shutil
import subprocess
import tarfile
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import distribution
from pathlib import Path

from huggingface_hub import save_torch_state_dict
from safetensors.torch import load_file, save_file

from ..cells import DATASETS, WORK, Cell, complete_checkpoints, record_dataset
from ..evaluation import load_policy
from ..machine import REPOSITORY, RESULTS, git_commit, write_json

CODE = ("benchmarks/*.py", "benchmarks/paper", "dataset_tools", "gym_hdp_tasks", "lerobot_hdp", "lerobot_policy_hdp.py")
METADATA = ("METADATA", "entry_points.txt")
MAX_MIB = 40
CELLS = "cells.json"
WEIGHTS = "model.safetensors"
ARCHIVE = "{}.tar.xz"


def pack(cells: Sequence[Cell], folder: Path) -> None:
    """Put all that some cells need into a folder; record their demonstrations first, if they are not there.

    Raises:
        FileExistsError: the folder is there already.
        ValueError: the folder is larger than `MAX_MIB`, or a cell begins with weights that are to be downloaded.
    """
    if downloads := [cell.name for cell in cells if cell.policy.get("pretrained_backbone_weights")]:
        raise ValueError(f"these cells begin with weights from the network, which cannot be packed: {downloads}")
    folder.mkdir(parents=True)
    tracked = ["git", "ls-files", "--cached", "--others", "--exclude-standard", *CODE]
    files = subprocess.run(tracked, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.split()
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / file, folder / file)
    (folder / "COMMIT").write_text(git_commit() + "\n")
    write_json(folder / CELLS, [asdict(cell) for cell in cells])
    _pack_metadata(folder)
    for cell in {cell.dataset_root: cell for cell in cells}.values():
        record_dataset(cell, num_workers=2)
        _compress(cell.dataset_root, folder)
    for cell in cells:
        if cell.last_checkpoint is not None:
            _compress(cell.folder, folder)
    mib = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 2**20
    if mib > MAX_MIB:
        shutil.rmtree(folder)
        raise ValueError(f"{folder} has {mib:.0f} MiB, more than {MAX_MIB}: pack fewer tasks, or no stopped cells")
    print(f"{folder}: {len(cells)} cells, {mib:.1f} MiB")


def packed_cells() -> list[Cell]:
    """The cells of the packed folder that is the working folder, ready to run.

    Raises:
        FileNotFoundError: the working folder was not packed.
    """
    cells = [Cell(**fields) for fields in json.loads(Path(CELLS).read_text())]
    for root in (DATASETS, WORK):
        for archive in root.rglob(ARCHIVE.format("*")):
            with tarfile.open(archive) as file:
                file.extractall(archive.parent, filter="data")
            archive.unlink()
    return cells


def _pack_metadata(folder: Path) -> None:
    """What tells LeRobot, by the distribution's name, that there is a policy plugin on the path."""
    installed = distribution("lerobot_policy_hdp")
    target = folder / f"lerobot_policy_hdp-{installed.version}.dist-info"
    target.mkdir()
    for name in METADATA:
        (target / name).write_text(installed.read_text(name) or "")


def _compress(source: Path, folder: Path) -> None:
    """Add a folder of `outputs/`, as an archive in its place."""
    archive = folder / ARCHIVE.format(source)
    archive.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(archive, "w:xz") as file:
        file.add(source.resolve(), source.name)


def unpack(folder: Path) -> None:
    """Take over the results of a folder, and the cells that went further there than here."""

    def how_far(cell_folder: Path) -> tuple[int, int]:
        complete, progress = complete_checkpoints(cell_folder), cell_folder / "progress.json"
        evaluations = len(json.loads(progress.read_text())["curve"]) if progress.exists() else 0
        return int(complete[-1].name) if complete else 0, evaluations

    for progress in (folder / WORK).rglob("progress.json"):
        there = progress.parent
        here = WORK / there.relative_to(folder / WORK)
        if how_far(there) > how_far(here):
            new = here.with_name(f"{here.name}.new")
            shutil.rmtree(new, ignore_errors=True)
            shutil.copytree(there, new, symlinks=True)
            shutil.rmtree(here, ignore_errors=True)
            new.rename(here)
            print(here)
    results = folder / "benchmarks" / "results"
    for file in results.rglob("*.json"):
        own = RESULTS / file.relative_to(results)
        if not own.exists():
            own.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(file, own)
            print(own)


def export(checkpoint: Path, target: Path, max_file_size: str = "5GB") -> None:
    """Write a checkpoint to plan with: the averaged weights, as bfloat16. What trains it on begins a new average.

    Args:
        checkpoint: a `pretrained_model` folder.
        target: a new folder of the same form, if one file is enough.
        max_file_size: e.g. `15MB`. What needs more is written as several files, for `join_files`.

    Raises:
        FileExistsError: there is such a folder already.
    """
    if target.exists():
        raise FileExistsError(f"{target} exists already: delete it first")
    policy, *_ = load_policy(checkpoint)
    policy.planner.load_state_dict(policy._planning_network.state_dict())
    policy.ema = None
    policy.config.pretrained_path = None
    unfinished = target.with_name(f"{target.name}.new")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    for path in checkpoint.iterdir():
        if path.name != WEIGHTS:
            shutil.copy(path, unfinished)
    policy.config.save_pretrained(unfinished)
    weights = {
        name: value.bfloat16() if value.is_floating_point() else value for name, value in policy.state_dict().items()
    }
    save_torch_state_dict(weights, unfinished, max_shard_size=max_file_size)
    unfinished.rename(target)


def join_files(folder: Path) -> None:
    """Make one file of the weights that `export` wrote as several."""
    parts = sorted(folder.glob("model-*.safetensors"))
    if parts:
        save_file({name: value for part in parts for name, value in load_file(part).items()}, folder / WEIGHTS)
        for path in [*parts, folder / f"{WEIGHTS}.index.json"]:
            path.unlink()
