"""Open dataset files and read what is in them; nothing is returned that does not match its hash."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.schema import FORMAT, SCHEMA_VERSION, SPLITS, Metadata, in_tier, tier_sizes
from m3gn_bench.datasets.trajectory import Mesh, Trajectory, combine_hashes
from pydantic import ValidationError


def open_file(path: Path) -> h5py.File:
    """Open a dataset file for reading.

    Raises:
        DatasetError: missing, truncated, not HDF5, not ours, or of another schema version.
    """
    if not path.is_file():
        raise DatasetError(f"no dataset file at {path}; make one with 'm3gn-bench generate'")
    try:
        file = h5py.File(path)
    except OSError as error:
        raise DatasetError(
            f"{path} cannot be opened as HDF5, it may be truncated or damaged ({error})"
        ) from error
    try:
        found, version = file.attrs.get("format"), file.attrs.get("schema_version")
        if found != FORMAT:
            raise DatasetError(f"{path} is HDF5 but no m3gn-bench dataset (attribute 'format' is {found!r})")
        if version != SCHEMA_VERSION:
            raise DatasetError(
                f"{path} has schema version {version}, this m3gn-bench reads {SCHEMA_VERSION}; generate it again"
            )
    except DatasetError:
        file.close()
        raise
    return file


def read_metadata(file: h5py.File) -> Metadata:
    """The root attributes. Raises DatasetError if they do not fit the schema."""
    try:
        return Metadata.from_attributes(dict(file.attrs))
    except (ValidationError, ValueError) as error:
        first = str(error).splitlines()
        raise DatasetError(
            f"{file.filename} has damaged root attributes: {' '.join(first[1:3]) or error}"
        ) from error


def read_trajectory(file: h5py.File, key: str) -> Trajectory:
    """Read one trajectory and verify its content hash.

    Raises:
        DatasetError: missing, damaged, or its content does not match its hash.
    """
    with damage_as_dataset_error(f"{file.filename}: trajectory {key}"):
        group = file["trajectories"][key]
        mesh = group["mesh"]
        trajectory = Trajectory(
            positions=group["positions"][()],
            mesh=Mesh(
                rest_positions=mesh["rest_positions"][()],
                cells=mesh["cells"][()],
                cell_type=int(mesh["cell_type"][()]),
                node_type=mesh["node_type"][()],
            ),
            material={name: float(value) for name, value in group["material"].attrs.items()},
            loads={name: array[()] for name, array in group["loads"].items()} if "loads" in group else {},
            collider_positions=group["collider_positions"][()] if "collider_positions" in group else None,
            diagnostics={name: float(value) for name, value in group["diagnostics"].attrs.items()},
        )
        stored = group.attrs["content_hash"]
    if trajectory.content_hash() != stored:
        raise DatasetError(
            f"{file.filename}: trajectory {key} does not match its content hash; generate it again"
        )
    return trajectory


@contextmanager
def damage_as_dataset_error(where: str) -> Iterator[None]:
    """Whatever h5py raises on a damaged file becomes one line that names the place."""
    try:
        yield
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise DatasetError(f"{where} is damaged or missing ({error})") from error


def stored_hashes(file: h5py.File) -> dict[str, str]:
    """The recorded content hash of every trajectory, by key."""
    with damage_as_dataset_error(f"{file.filename}: the list of trajectories"):
        return {key: str(group.attrs["content_hash"]) for key, group in file["trajectories"].items()}


def content_hash(file: h5py.File, tier: str | None = None, splits: Sequence[str] = SPLITS) -> str:
    """Content hash of the trajectories of a tier (default: all in the file) and of the given splits.

    Raises:
        DatasetError: the file does not hold the whole tier.
    """
    hashes = stored_hashes(file)
    metadata = read_metadata(file)
    sizes = tier_sizes(tier or metadata.tier, metadata.paper_sizes)
    chosen = {k: h for k, h in hashes.items() if in_tier(k, sizes) and k.rpartition("_")[0] in splits}
    if tier is not None and len(chosen) != sum(sizes[s] for s in SPLITS if s in splits):
        raise DatasetError(f"{file.filename} does not hold the whole {tier} tier")
    return combine_hashes(chosen)


def find_dataset(folder: Path, scene: str, tier: str, splits: Sequence[str]) -> Path | None:
    """The smallest default-fidelity dataset file in a folder that holds the scene's tier and splits, or None."""
    suitable = []
    for path in folder.glob(f"{scene}-*.h5"):
        try:
            with open_file(path) as file:
                if read_metadata(file).fidelity == "default":
                    content_hash(file, tier, splits)
                    suitable.append((path.stat().st_size, path))
        except DatasetError:
            continue
    return min(suitable)[1] if suitable else None
