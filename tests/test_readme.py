"""What the README shows of Python does what it says."""

import re
import subprocess
import sys

from .conftest import REPOSITORY


def test_the_examples_in_python_run():
    examples = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    code = "\n".join([*examples, "print(tuple(waypoints.shape))"])
    result = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "PICK 1.00  B 1.00" in result.stdout
    assert "(145, 4)" in result.stdout
    assert "True" in result.stdout.splitlines()
