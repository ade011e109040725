"""CalculiX, run on an input file of ours: an independent finite element program."""

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from m3gn_bench.generators.solvers.sparse import Array

needs_calculix = pytest.mark.skipif(
    shutil.which("ccx") is None, reason="CalculiX (ccx) isn't installed: install Debian's calculix-ccx"
)


def run_calculix(folder: Path, deck: str) -> str:
    """Run CalculiX on one thread; the printed results, or a failure with the end of its log."""
    (folder / "deck.inp").write_text(deck)
    run = subprocess.run(
        ["ccx", "deck"],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    log = run.stdout + run.stderr
    ended_well = run.returncode == 0 and "Job finished" in log and "*ERROR" not in log
    assert ended_well, f"CalculiX failed with exit status {run.returncode}:\n{log[-2000:]}"
    return (folder / "deck.dat").read_text()


def final_displacements(results: str, nodes: int) -> Array:
    """The last table "displacements (vx,vy,vz) for set ALL and time T", shape [nodes, 3]."""
    title, _, table = results[results.rindex("displacements") :].partition("\n")
    time = float(title.split()[-1])
    assert time == 1.0, f"CalculiX stopped at load fraction {time}"
    rows = [line.split() for line in table.splitlines() if line.strip()][:nodes]
    values = np.array(rows, dtype=float)
    assert np.array_equal(values[:, 0], np.arange(1, nodes + 1)), "CalculiX left nodes out"
    return values[:, 1:]
