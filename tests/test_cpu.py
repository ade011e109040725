"""Freed memory stays in the process, where the C library can be told so."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys, torch
from m3gn_bench.cpu import use_cpu
use_cpu(1) if sys.argv[1] == "kept" else torch.set_num_threads(1)

def faults_of_a_step():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    activations = [torch.ones(1_000_000)]  # 80 MB in all, or 20 000 pages
    while len(activations) < 20:
        activations.append(activations[-1] + 1)
    while activations:  # as in a backward pass
        activations.pop()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


faults = [faults_of_a_step() for _ in range(8)]
assert torch.get_num_threads() == 1
print(sum(faults[3:]))  # by then, what is kept fits
"""


# Without these, when glibc gives a block back depends on what has happened before.
THRESHOLDS = {"MALLOC_TRIM_THRESHOLD_": "131072", "MALLOC_MMAP_THRESHOLD_": "131072"}


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_freed_memory_is_kept() -> None:
    environment = os.environ | THRESHOLDS
    faults = {}
    for name in ("kept", "given back"):
        command = [sys.executable, "-c", PROGRAM, name]
        outcome = subprocess.run(command, capture_output=True, check=True, env=environment)
        faults[name] = int(outcome.stdout)
    assert faults["given back"] > 50_000
    assert faults["kept"] < 0.1 * faults["given back"]
