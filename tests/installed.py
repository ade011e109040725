"""Examples as packages of their own, and what the commands say where one is installed."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any


def install(example: Path, folder: Path) -> dict[str, str]:
    """An environment in which an example is installed, outside the one that runs the tests, without network."""
    source, target = folder / "source", folder / "target"
    shutil.copytree(example, source)  # building leaves files beside what is built
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--no-build-isolation",
    ]
    done = subprocess.run(
        [*pip, "--target", str(target), str(source)], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr
    return os.environ | {"PYTHONPATH": str(target)}


def command(environment: dict[str, str], *arguments: object) -> dict[str, Any]:
    """What a command says in JSON."""
    script = Path(sys.executable).with_name("m3gn-bench")
    done = subprocess.run(
        [str(script), *map(str, arguments), "--json"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))
