"""What several benchmarks ask for on their command line, and the trajectories that they get for it."""

import argparse
from pathlib import Path

import numpy as np

from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import Task, get_task


def add_dataset_options(parser: argparse.ArgumentParser) -> None:
    """Which data, and that results are wanted as JSON."""
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--tier", default="paper")
    parser.add_argument("--json", action="store_true")


def parse_for_validation(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, Task, list[Case]]:
    """What was asked of one thread: options, the `--task`, and trajectories spread evenly over its validation split."""
    parser.add_argument("--trajectories", type=int, default=20, help="spread over the validation split")
    add_dataset_options(parser)
    options = parser.parse_args()
    use_cpu(1)
    task = get_task(options.task)
    path = find_or_generate(task, options.tier, options.data, splits=("validation",))
    dataset = TrajectoryDataset(path, task.name, "validation", options.tier)
    chosen = np.linspace(0, len(dataset) - 1, options.trajectories).astype(int)
    cases = [case_from(task, dataset.metadata, dataset[int(i)], dataset.keys[int(i)]) for i in chosen]
    return options, task, cases
