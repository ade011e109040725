"""What a dataset was when it was recorded, so that anybody can tell whether they made the same.

The same code on the same kind of processor gives the same bits. Another processor may round differently in the
last digit (other vector instructions, fused multiply-add), which changes the content hash but nothing that
matters; for that case a sketch of every trajectory is kept: a few numbers to which all of its numbers contribute.
"""

import json
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
from m3gn_bench.datasets.schema import Record
from m3gn_bench.datasets.trajectory import Trajectory, hash_arrays
from m3gn_bench.datasets.writer import write_bytes_atomically

FOLDER = Path(__file__).parent / "recorded"
PROJECTIONS = 3  # of an array; with one alone, a difference may cancel
DIGITS = 7
# In scaled units, as are all errors on the leaderboard. Rounding alone stays far below: 1e-12 m added to the start
# of a falling body, the most sensitive of the scenes, moves it by less than 1e-6 (`validation/test_falling.py`).
TOLERANCE = 1e-4


class Sketch(Record):
    """What a trajectory is known by where its bits may differ.

    Attributes:
        discrete: a hash of what is not rounded: names and shapes of all arrays, cells, node types, edges, tags.
        numbers: of every other array, in the order of the names, the material's parameters last: its random
            projections, or itself if it is not larger than they are. Physical units.
    """

    discrete: str
    numbers: tuple[float, ...]


class RecordedDataset(Record):
    """Hashes of a scene's tiers, and a sketch of every trajectory."""

    scene: str
    dataset_version: str
    generator_version: str
    simulator_versions: dict[str, str]
    machine: str
    hashes: dict[str, str]
    sketches: dict[str, Sketch]

    def require(self, version: str, tier: str) -> None:
        """Raises DatasetError if this tier of this version of the dataset is not recorded."""
        if version != self.dataset_version or tier not in self.hashes:
            raise DatasetError(
                f"version {version}, tier {tier} of {self.scene} cannot be compared; recorded of {self.scene} are "
                f"version {self.dataset_version}, tiers {', '.join(self.hashes)}"
            )


class Reproduction(Record):
    """How a dataset file compares with the record: bit by bit, or else by the sketches of its trajectories."""

    scene: str
    tier: str
    file: str
    identical: bool
    trajectories: int
    largest_difference: float  # as of `differences`; 0 if identical, infinite if what is not rounded differs
    where: str  # the trajectory, and what of it, that differs most; empty if identical
    tolerance: float = TOLERANCE

    @property
    def ok(self) -> bool:
        """Whether this is the recorded dataset, up to rounding."""
        return self.identical or (self.trajectories > 0 and self.largest_difference <= self.tolerance)


def sketch(trajectory: Trajectory) -> Sketch:
    """A trajectory's sketch."""
    numbers = [number for array in _rounded_arrays(trajectory).values() for number in _project(array)]
    return Sketch(
        discrete=_discrete(trajectory), numbers=tuple(float(f"{number:.{DIGITS}g}") for number in numbers)
    )


def differences(trajectory: Trajectory, recorded: Sketch, scale_length: float) -> dict[str, float]:
    """How far each array of a trajectory is from the recorded one, by name.

    The root mean square of the differences of the projections, which estimates that of the differences of the numbers
    themselves (Alon, Matias and Szegedy 1996): lengths over `scale_length`, anything else over its own root mean
    square. Infinite if what is not rounded differs.
    """
    if _discrete(trajectory) != recorded.discrete:
        return {"what is not rounded": np.inf}
    found, position = {}, 0
    for name, array in _rounded_arrays(trajectory).items():
        numbers = _project(array)
        expected = recorded.numbers[position : position + len(numbers)]
        position += len(numbers)
        is_length = name.endswith("positions")
        unit = scale_length if is_length else float(np.sqrt(np.mean(np.square(array)))) or 1.0
        found[name] = float(np.sqrt(np.mean(np.square(np.subtract(numbers, expected))))) / unit
    return found


def _discrete(trajectory: Trajectory) -> str:
    """A hash of what is not rounded."""
    rounded = _rounded_arrays(trajectory)
    digest = hash_arrays({k: v for k, v in trajectory.arrays().items() if k not in rounded})
    shapes = {name: list(array.shape) for name, array in rounded.items()}
    digest.update(json.dumps([shapes, trajectory.tags], sort_keys=True).encode())
    return digest.hexdigest()[:16]


def _rounded_arrays(trajectory: Trajectory) -> dict[str, np.ndarray]:
    """Everything that a processor may round in its own way, in double precision."""
    arrays = {name: a for name, a in sorted(trajectory.arrays().items()) if a.dtype.kind == "f"}
    material = {f"material/{name}": np.array(value) for name, value in sorted(trajectory.material.items())}
    return {name: array.astype(np.float64) for name, array in (arrays | material).items()}


def _project(array: np.ndarray) -> np.ndarray:
    """The array against random signs, divided by the root of its size: of the order of its root mean square."""
    if array.size <= PROJECTIONS:
        return array.ravel()
    bits = np.random.PCG64(0).random_raw(PROJECTIONS * array.size // 64 + 1).astype("<u8")
    signs = 2.0 * np.unpackbits(bits.view(np.uint8), count=PROJECTIONS * array.size) - 1
    return signs.reshape(PROJECTIONS, -1) @ array.ravel() / np.sqrt(array.size)


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
        recorded = RecordedDataset(
            scene=metadata.scene,
            dataset_version=metadata.dataset_version,
            generator_version=metadata.generator_version,
            simulator_versions=metadata.simulator_versions,
            machine=metadata.machine,
            hashes=hashes,
            sketches={key: sketch(read_trajectory(file, key)) for key in sorted(stored_hashes(file))},
        )
    # A line for every trajectory.
    text = recorded.model_dump_json().replace(']},"', ']},\n"') + "\n"
    write_bytes_atomically(destination, text.encode())
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
        keys = [key for key in stored_hashes(file) if key in recorded.sketches]
        found = {
            f"{key}, {name}": difference
            for key in ([] if identical else keys)
            for name, difference in differences(
                read_trajectory(file, key), recorded.sketches[key], metadata.scale_length
            ).items()
        }
    # NaN is the worst that there can be.
    where = max(found, key=lambda name: np.nan_to_num(found[name], nan=np.inf), default="")
    return Reproduction(
        scene=metadata.scene,
        tier=metadata.tier,
        file=str(path),
        identical=identical,
        trajectories=len(keys),
        largest_difference=found.get(where, 0.0),
        where=where,
    )
