"""What several benchmarks ask for on their command line, and the trajectories that they get for it."""

import argparse
from pathlib import Path

import numpy as np

from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.schema import Split
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import Task


def add_dataset_options(parser: argparse.ArgumentParser) -> None:
    """Which data, and that results are wanted as JSON."""
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--tier", default="paper")
    parser.add_argument("--json", action="store_true")


def spread_cases(task: Task, split: Split, options: argparse.Namespace) -> list[Case]:
    """`options.trajectories` of a split, evenly spread over it."""
    path = find_or_generate(task, options.tier, options.data, splits=(split,))
    dataset = TrajectoryDataset(path, task.name, split, options.tier)
    chosen = np.linspace(0, len(dataset) - 1, options.trajectories).astype(int)
    return [case_from(task, dataset.metadata, dataset[int(i)], dataset.keys[int(i)]) for i in chosen]
