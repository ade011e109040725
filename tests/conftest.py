"""Fixtures that several test files share. The one real dataset is generated once."""

import os

# Tests run side by side, one in each process; this counts if it is said before numpy is loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
from filelock import FileLock
from skfem import MeshTet

from m3gn_bench.datasets.schema import DATASET_SEED, SMALL_TIERS, SPLITS, Metadata, Tier, trajectory_key
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TETRA, Mesh, Trajectory
from m3gn_bench.datasets.writer import merge_shards, write_shard
from m3gn_bench.generators.generate import generate
from m3gn_bench.generators.scene import get_scene

TETRA_METADATA = Metadata(
    scene="tetra",
    dataset_version="1.0",
    tier="smoke",
    paper_sizes={"train": 100, "validation": 20, "test": 20},
    generator_version="0",
    simulator_versions={"none": "1.0"},
    fidelity="default",
    seed=DATASET_SEED,
    dt=0.1,
    time_unit="s",
    length_unit="µm",  # not ASCII
    material_units={"stiffness": "Pa", "density": "kg"},
    load_units={"push": "N"},
    frames=4,
    scale_centre=(0.0, 0.0, 0.5),
    scale_length=2.0,
)
Change = Callable[[str, Trajectory], Trajectory]


def box_of_tetrahedra(
    size: tuple[float, float, float], cells: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and tetrahedra of positive volume, six to each cell of a box; its lower corner is the origin."""
    ticks = (np.linspace(0, s, n + 1) for s, n in zip(size, cells, strict=True))
    mesh = MeshTet.init_tensor(*ticks).oriented()
    return mesh.p.T.copy(), np.ascontiguousarray(mesh.t.T, np.int32)


class TetraWriter(Protocol):
    """Writes a dataset file of tiny made-up trajectories; see `write_tetra`."""

    def __call__(
        self, path: Path, *, change: Change = ..., metadata: Metadata = ..., only: set[str] | None = ...
    ) -> Path: ...


def tetra_trajectory(key: str) -> Trajectory:
    """Two tetrahedra, one fixed node, random positions: every part that a trajectory can have."""
    rng = np.random.default_rng(zlib.crc32(key.encode()))
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32)
    positions = np.repeat(rest[None], TETRA_METADATA.frames, axis=0)
    positions[:, 1:] += rng.normal(scale=0.1, size=positions[:, 1:].shape).astype(np.float32)
    return Trajectory(
        positions=positions,
        mesh=Mesh(
            rest_positions=rest,
            cells=np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32),
            cell_type=VTK_TETRA,
            node_type=np.array([FIXED, FREE, FREE, FREE, FREE], np.uint8),
        ),
        material={"stiffness": float(rng.uniform(1, 2)), "density": 1.5},
        loads={"push": rng.normal(size=(5, 3)).astype(np.float32)},
        collider_positions=rng.normal(size=(TETRA_METADATA.frames, 2, 3)).astype(np.float32),
        collider_edges=np.array([[0, 1]], np.int32),
        tags={"object": "wedge"},
        diagnostics={"cpu_seconds": 0.1, "iterations": 7.0},
    )


def tetra_dataset(
    path: Path,
    *,
    change: Change = lambda key, trajectory: trajectory,
    metadata: Metadata = TETRA_METADATA,
    only: set[str] | None = None,
) -> Path:
    """Write the whole tier that the metadata names (or `only` these keys), each trajectory changed first."""
    tier: Tier = metadata.tier
    keys = [trajectory_key(split, i) for split in SPLITS for i in range(SMALL_TIERS[tier][split])]
    shards = {
        key: path.parent / f"shards-of-{path.stem}" / key for key in keys if only is None or key in only
    }
    for key, shard in shards.items():
        write_shard(shard, key, change(key, tetra_trajectory(key)), metadata)
    merge_shards(path, shards, metadata, lambda split, material: ["tetra_task"])
    return path


@pytest.fixture(scope="session")
def write_tetra() -> TetraWriter:
    """Writes dataset files in milliseconds, on tetrahedra, with a collider."""
    return tetra_dataset


@pytest.fixture(scope="session")
def tetra() -> Trajectory:
    """One made-up trajectory."""
    return tetra_trajectory("train_00000")


@pytest.fixture(scope="session")
def tetra_metadata() -> Metadata:
    """The metadata of made-up datasets."""
    return TETRA_METADATA


@pytest.fixture(scope="session")
def tetra_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid dataset file of made-up trajectories. Copy it before damaging it."""
    return tetra_dataset(tmp_path_factory.mktemp("tetra") / "tetra-smoke.h5")


@pytest.fixture(scope="session")
def smoke_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The smoke tier of Sheet Deformation, which all processes of a test run share. Copy it before damaging it."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with FileLock(folder / "smoke.lock"):
        return generate(get_scene("sheet_deformation"), "smoke", folder / "smoke").file
