"""Running JavaScript: Node with a script and data, or a skipped test where there is no Node."""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

import pytest


def run_node(script: str, data: Any, *arguments: str) -> Any:
    """What a script prints, as JSON.

    :param script: in which ``data`` is the data and ``require`` works; it returns the result
    :param data: that JSON can hold
    """
    node = shutil.which("node")
    if node is None:
        pytest.skip("node, which runs JavaScript, is not installed")
    wrapped = (
        'const data = JSON.parse(require("fs").readFileSync(0, "utf8"));'
        f"const result = (() => {{ {script} }})(); process.stdout.write(JSON.stringify(result));"
    )
    done = subprocess.run(
        [node, *arguments, "-e", wrapped], input=json.dumps(data), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
