"""What a user gets from `pip install` instead of a clone."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import REPOSITORY

CHECK = """
import gymnasium, lerobot_policy_hdp, gym_hdp_tasks
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
register_third_party_plugins()
planners = {"hdp", "diffuser", "joint_diffuser", "separate_diffuser", "hd", "chd"}
assert planners <= set(PreTrainedConfig.get_known_choices())
import dataset_tools.record, lerobot_hdp.page, lerobot_hdp.scripts.hdp_train
assert lerobot_hdp.page.TEMPLATE.exists()
assert "hdp" in EnvConfig.get_known_choices()
gymnasium.make("hdp/XArmSorting-v0").reset(seed=0)
print(lerobot_policy_hdp.__file__)
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The wheel, installed without its dependencies, which the test environment has."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", folder, REPOSITORY], check=True)
    [wheel] = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", folder / "site", wheel], check=True)
    return folder / "site"


def test_lerobot_finds_the_plugin_from_any_folder(installed, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    result = subprocess.run(
        [sys.executable, "-c", CHECK], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == str(installed / "lerobot_policy_hdp.py")


def test_train_configs_are_installed(installed):
    shipped = {path.name for path in (installed / "share/lerobot_policy_hdp/configs").glob("*.json")}
    assert shipped == {path.name for path in (REPOSITORY / "configs").glob("*.json")}


ONE_AT_A_TIME = """
import importlib, sys
for package, modules in MODULES.items():
    for name in [name for name in sys.modules if name.split(".")[0] in PACKAGES]:
        del sys.modules[name]
    sys.modules.update(dict.fromkeys(PACKAGES - {package}))  # an import of these is an error
    for name in modules:
        importlib.import_module(name)
"""
PACKAGES = {"lerobot_hdp", "gym_hdp_tasks", "dataset_tools"}


def test_a_package_works_without_those_that_build_on_it(installed):
    """Its modules are imported where the others cannot be."""
    modules = {
        package: [
            ".".join(path.relative_to(installed).with_suffix("").parts).removesuffix(".__init__")
            for path in sorted((installed / package).rglob("*.py"))
        ]
        for package in ("gym_hdp_tasks", "lerobot_hdp")
    }
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    code = f"PACKAGES, MODULES = {PACKAGES}, {modules}{ONE_AT_A_TIME}"
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
