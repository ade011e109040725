"""Every scene's generation is killed without warning, goes on, and ends with the same dataset; in bounded memory."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
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


MEASURE = """
import json, resource, sys, time
from threadpoolctl import threadpool_limits
from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.scene import get_scene

scene, fidelity, draws = get_scene(sys.argv[1]), sys.argv[2], int(sys.argv[3])
seconds = []
with threadpool_limits(1):
    for index in range(draws):
        start = time.process_time()
        trajectory = scene.simulate(draw(scene, "test", index, DATASET_SEED), fidelity)
        seconds.append(time.process_time() - start)
        assert scene.check(trajectory) == []
print(json.dumps([seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024]))
"""


def measured(scene: str, fidelity: str, draws: int) -> tuple[list[float], int]:
    """CPU seconds of each simulation, and the largest memory [bytes], of a process of its own."""
    arguments = [sys.executable, "-c", MEASURE, scene, fidelity, str(draws)]
    done = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, check=True)
    seconds, memory = json.loads(done.stdout)
    print(f"{scene}, {fidelity}: {np.mean(seconds[1:] or seconds):.2f} s, {memory / 2**20:.0f} MiB")
    return seconds, memory


# The project's limits hold where the cards' times were taken (0.63, 0.11, 0.64, 0.77, 0.85 s). Shared machines were
# seen at little more than half of that speed, with nothing changed, so twice the limits are allowed.
SLOW_MACHINE = 2.0


@pytest.mark.parametrize(
    ("scene", "allowed"),
    [
        ("sheet_deformation", 1.2),
        ("deformable_block", 0.3),
        ("tissue_manipulation", 1.0),
        ("falling_teddy", 1.0),
        ("mixed_objects", 2.0),
    ],
)
def test_time_and_memory_of_a_trajectory(scene: str, allowed: float) -> None:
    """Mean CPU seconds on one core, without the first (which loads and compiles); below a gibibyte."""
    seconds, memory = measured(scene, "default", 13)
    assert np.mean(seconds[1:]) < SLOW_MACHINE * allowed
    assert memory < 2**30


def test_memory_of_a_refined_body() -> None:
    """Eight times as many tetrahedra."""
    _, memory = measured("falling_teddy", "reference", 1)
    assert memory < 2**30
