"""Freed memory stays in the process, where the C library can be told so."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource, sys, torch
from m3gn_bench.cpu import use_cpu
use_cpu(1) if sys.argv[1] == "kept" else torch.set_num_threads(1)
faults = []
for _ in range(8):
    blocks = [torch.ones(1_000_000) for _ in range(20)]  # 80 MB, or 20 000 pages
    del blocks
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
assert torch.get_num_threads() == 1
print(faults[-1] - faults[2])  # by then, what is kept fits
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc's allocator")
def test_freed_memory_is_kept() -> None:
    faults = {
        name: int(
            subprocess.run([sys.executable, "-c", PROGRAM, name], capture_output=True, check=True).stdout
        )
        for name in ("kept", "given back")
    }
    assert faults["kept"] < 100
    assert faults["given back"] > 5_000
