"""A split of a dataset file as a torch dataset: lazy, picklable, one open file per process."""

import os
from pathlib import Path
from typing import Any

import h5py
from torch.utils.data import Dataset

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.file import open_file, read_metadata, read_splits, read_trajectory
from m3gn_bench.datasets.schema import Split, in_tier, tier_sizes
from m3gn_bench.datasets.trajectory import Trajectory


class TrajectoryDataset(Dataset[Trajectory]):
    """A split of a dataset file as a map-style torch dataset of `Trajectory`.

    The file is opened at the first access in each process, so the object can be pickled and handed to
    `DataLoader` workers.

    Args:
        path: the dataset file.
        task: whose split to read, e.g. "sheet_deformation" or "sheet_deformation_ood".
        split: "train", "validation" or "test".
        tier: read only this tier's trajectories; default: all that the file holds.

    Raises:
        DatasetError: the file is unusable, or has no such task or split.
    """

    def __init__(self, path: Path | str, task: str, split: Split, tier: str | None = None) -> None:
        self.path = Path(path)
        self.task = task
        self.split = split
        self._handle: tuple[int, h5py.File] | None = None
        with open_file(self.path) as file:
            self.metadata = read_metadata(file)
            tasks = read_splits(file)
        if task not in tasks:
            raise DatasetError(f"{self.path}: {unknown_name('task', task, list(tasks))}")
        if split not in tasks[task]:
            raise DatasetError(f"{self.path}: {unknown_name('split', split, list(tasks[task]))}")
        keys = tasks[task][split]
        if tier is not None:
            sizes = tier_sizes(tier, self.metadata.paper_sizes)
            keys = [key for key in keys if in_tier(key, sizes)]
        self.keys = keys

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, index: int) -> Trajectory:
        return read_trajectory(self._file(), self.keys[index])

    def _file(self) -> h5py.File:
        if self._handle is None or self._handle[0] != os.getpid():
            self._handle = (os.getpid(), open_file(self.path))
        return self._handle[1]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_handle": None}
