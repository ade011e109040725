"""Every scene's generation is killed without warning, goes on, and ends with the same dataset; in bounded memory."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from m3gn_bench.datasets.file import content_hash, open_file
from m3gn_bench.generators.generate import generate
from m3gn_bench.generators.scene import get_scene, scene_names

COMMAND = Path(sys.executable).parent / "m3gn-bench"


def start(scene: str, folder: Path) -> subprocess.Popen[str]:
    """Two workers on the test split of the smoke tier, in a process group of their own."""
    arguments = ["generate", scene, "--tier", "smoke", "--split", "test", "--fidelity", "fast"]
    return subprocess.Popen(
        [str(COMMAND), *arguments, "--workers", "2", "--out", str(folder), "--json"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.parametrize("scene", scene_names())
def test_killed_generation_goes_on(scene: str, tmp_path: Path) -> None:
    """kill -9 of the command and of its workers after the first trajectory."""
    killed = start(scene, tmp_path)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob(".*.shards/*.h5")):
        assert killed.poll() is None, "ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    assert list(tmp_path.glob("*.h5")) == []

    second = start(scene, tmp_path)
    made = json.loads(second.communicate(timeout=300)[0])
    assert 0 < made["generated"] < 4
    undisturbed = generate(get_scene(scene), "smoke", tmp_path / "whole", splits=["test"], fidelity="fast")
    assert made["content_hash"] == undisturbed.content_hash
    with open_file(undisturbed.file) as file:
        assert content_hash(file, "smoke", ["test"]) == made["content_hash"]


def test_workers_stay_below_a_gibibyte() -> None:
    """Of all the processes that the tests above started."""
    largest = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    print(f"{largest / 2**20:.0f} MiB")
    assert 0 < largest < 2**30
