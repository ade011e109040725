"""Whole records of models that ship, made again: every test trajectory, every context size, every frame.

`m3gn-bench leaderboard check` compares errors of some trajectories; the means over all of them, frame by frame, which
the board's curves are drawn from, take all of the test split.
"""

from pathlib import Path

import numpy as np
import pytest

from m3gn_bench.leaderboard.check import TOLERANCES
from m3gn_bench.leaderboard.record import checkpoint_folder, find_record, read_records
from m3gn_bench.leaderboard.scoring import score
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import get_task

MODELS = {
    "deformable_block": ("m3gn", "mgn", "mgn_mp", "mango", "egno"),
    "sheet_deformation": ("m3gn", "scaled_velocity"),
    "sheet_deformation_ood": ("m3gn", "scaled_velocity"),
    "tissue_manipulation": ("m3gn",),
    "falling_teddy": ("m3gn",),
}


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where this process keeps its test trajectories."""
    return tmp_path_factory.mktemp("data")


@pytest.mark.parametrize(("name", "model"), [(task, model) for task in MODELS for model in MODELS[task]])
def test_every_number_of_a_record(folder: Path, name: str, model: str) -> None:
    """Errors of trajectories within what other processors may round to, and so their means over time."""
    checkpoint = checkpoint_folder(name, model, "compact")
    dataset = find_or_generate(get_task(name), "paper", folder, splits=("test",))
    made = score(checkpoint, dataset, track="compact", tier="paper")
    recorded = find_record(read_records(), "compact", name, made.name)
    assert recorded is not None
    assert made.keys == recorded.keys
    largest = 0.0
    for here, there in zip(made.results, recorded.results, strict=True):
        assert here.context == there.context
        for what in ("trajectory_mse", "trajectory_mse_free_nodes", "per_timestep_mse"):
            ours, theirs = (np.array(getattr(result, what)) for result in (here, there))
            largest = max(largest, float(np.abs(ours / theirs - 1).max()))
    print(f"{name}/{model}: largest relative difference {largest:.1e}")
    assert largest < TOLERANCES["shipped checkpoint"]
