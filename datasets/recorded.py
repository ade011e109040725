"""What a dataset was when it was recorded, so that anybody can tell whether they made the same.

The same code on the same kind of processor gives the same bits. Another processor may round differently in the
last digit (other vector instructions, fused multiply-add), which changes the content hash but nothing that
matters; for that case a few coordinates of every quick-tier trajectory are kept and compared with a tolerance.
"""

from pathlib import Path

import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import (
    content_hash,
    open_file,
    read_metadata,
    read_trajectory,
    stored_hashes,
    tier_hashes,
)
from m3gn_bench.datasets.schema import SMALL_TIERS, Record, in_tier
from m3gn_bench.datasets.trajectory import FREE, Trajectory
from m3gn_bench.datasets.writer import write_bytes_atomically

FOLDER = Path(__file__).parent / "recorded"
PROBED_FRAMES = 3
PROBED_NODES = 4
# In scaled units, as are all errors on the leaderboard. Rounding alone stays far below: 1e-12 m added to the start
# of a falling body, the most sensitive of the scenes, moves it by less than 1e-6 (`validation/test_falling.py`).
TOLERANCE = 1e-4


class RecordedDataset(Record):
    """Hashes of a scene's tiers, and probes of the quick tier: coordinates by trajectory."""

    scene: str
    dataset_version: str
    generator_version: str
    simulator_versions: dict[str, str]
    machine: str
    hashes: dict[str, str]
    probes: dict[str, tuple[float, ...]]

    def require(self, version: str, tier: str) -> None:
        """Raises DatasetError if this tier of this version of the dataset is not recorded."""
        if version != self.dataset_version or tier not in self.hashes:
            raise DatasetError(
                f"version {version}, tier {tier} of {self.scene} cannot be compared; recorded of {self.scene} are "
                f"version {self.dataset_version}, tiers {', '.join(self.hashes)}"
            )


class Reproduction(Record):
    """How a dataset file compares with the record: bit by bit, or else by probes of the quick tier's trajectories."""

    scene: str
    tier: str
    file: str
    identical: bool
    trajectories: int
    largest_difference: float  # scaled units; 0 if identical
    tolerance: float = TOLERANCE

    @property
    def ok(self) -> bool:
        """Whether this is the recorded dataset, up to rounding."""
        return self.identical or (self.trajectories > 0 and self.largest_difference <= self.tolerance)


def probe(trajectory: Trajectory) -> tuple[float, ...]:
    """Coordinates of a few free nodes in a few frames, the last one among them, in physical units."""
    frames = len(trajectory.positions)
    free = np.flatnonzero(trajectory.mesh.node_type == FREE)
    chosen_frames = np.linspace(0, frames - 1, PROBED_FRAMES + 1, dtype=int)[1:]
    chosen_nodes = free[np.linspace(0, len(free) - 1, PROBED_NODES + 2, dtype=int)[1:-1]]
    return tuple(trajectory.positions[np.ix_(chosen_frames, chosen_nodes)].ravel().tolist())


def record(path: Path, folder: Path | None = None) -> Path:
    """Record a dataset file; returns the record's path.

    Raises:
        DatasetError: the file is not the benchmark's own (see `require_own`), or holds less than what is recorded of
            its version; it cannot be read, or the record not written.
    """
    require_own(path)
    with open_file(path) as file:
        metadata, hashes = read_metadata(file), tier_hashes(file)
        destination = (folder or FOLDER) / f"{metadata.scene}.json"
        if destination.is_file():
            before = read_record(metadata.scene, folder)
            lost = before.hashes.keys() - hashes.keys()
            if lost and before.dataset_version == metadata.dataset_version:
                raise DatasetError(
                    f"{path} has no tier {', '.join(sorted(lost))}, which is recorded of {metadata.scene}; "
                    "record a file that has"
                )
        quick = sorted(key for key in stored_hashes(file) if in_tier(key, SMALL_TIERS["quick"]))
        recorded = RecordedDataset(
            scene=metadata.scene,
            dataset_version=metadata.dataset_version,
            generator_version=metadata.generator_version,
            simulator_versions=metadata.simulator_versions,
            machine=metadata.machine,
            hashes=hashes,
            probes={key: probe(read_trajectory(file, key)) for key in quick},
        )
    write_bytes_atomically(destination, (recorded.model_dump_json(indent=1) + "\n").encode())
    return destination


def require_own(path: Path) -> None:
    """Only what everybody is meant to reproduce may be recorded.

    Raises:
        DatasetError: the file has another solver, object, fidelity or seed than the benchmark, or holds less than
            the quick tier.
    """
    with open_file(path) as file:
        metadata = read_metadata(file)
        if not metadata.is_benchmark:
            raise DatasetError(
                f"{path} is not the benchmark's own dataset: fidelity {metadata.fidelity}, seed {metadata.seed}, "
                f"options {metadata.variant or 'none'}; only that one is recorded"
            )
        content_hash(file, "quick")


def read_record(scene: str, folder: Path | None = None) -> RecordedDataset:
    """What is recorded of a scene. Raises DatasetError if nothing is."""
    path = (folder or FOLDER) / f"{scene}.json"
    if not path.is_file():
        raise DatasetError(f"nothing is recorded of {scene}; `m3gn-bench card FILE` records a dataset file")
    return RecordedDataset.model_validate_json(path.read_bytes())


def compare(path: Path, folder: Path | None = None) -> Reproduction:
    """Compare a dataset file with what is recorded of its scene.

    Raises:
        DatasetError: nothing is recorded of this scene, version or tier.
    """
    with open_file(path) as file:
        metadata = read_metadata(file)
        recorded = read_record(metadata.scene, folder)
        recorded.require(metadata.dataset_version, metadata.tier)
        identical = content_hash(file, metadata.tier) == recorded.hashes[metadata.tier]
        keys = [key for key in stored_hashes(file) if key in recorded.probes]
        largest = 0.0
        if not identical:
            for key in keys:
                difference = np.subtract(probe(read_trajectory(file, key)), recorded.probes[key])
                largest = float(np.max([largest, np.abs(difference).max() / metadata.scale_length]))
    return Reproduction(
        scene=metadata.scene,
        tier=metadata.tier,
        file=str(path),
        identical=identical,
        trajectories=len(keys),
        largest_difference=largest,
    )
