"""Write trajectories: one shard file each, later merged into one dataset file by a single writer.

Every file appears under its final name only when it is complete: it is written under a temporary name,
flushed to disk and renamed. A killed run leaves whole shards (the next run goes on from them), never half
a file under a name that anybody reads.
"""

import fcntl
import io
import os
import re
import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile

import h5py
import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.schema import Metadata, Rejection, Split, as_text, fixed_length, parse_key
from m3gn_bench.datasets.trajectory import Trajectory, combine_hashes, hash_arrays

LIBVER = "v110"  # HDF5 1.10 and later read it; the first format with checksums on everything but the arrays
COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that becomes `path` on success and vanishes on failure.

    Raises:
        DatasetError: the operating system refuses (no space, no permission), in one line.
    """
    # Processes of several machines may write the same file.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        read = error.filename and Path(error.filename) not in {path, temporary, path.parent}
        what = f"{error.strerror} ({error.filename})" if read else error.strerror or error
        raise DatasetError(f"cannot write {path}: {what}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Write a whole file or nothing. Raises DatasetError as `atomic_path` does."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def require_writable(folder: Path) -> None:
    """For work whose result goes there in the end. Raises DatasetError if nothing can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise DatasetError(f"cannot write to {folder}: {error.strerror or error}") from error


@contextmanager
def reserved(folder: Path, doing: str, place: Path) -> Iterator[None]:
    """The folder, made if need be, for this process alone (the lock ends with the process); it goes if it stays empty.

    Args:
        folder: what to reserve.
        doing: what another process that holds it does, for the message.
        place: what a user knows it by, for the message.

    Raises:
        DatasetError: another process has it, or it cannot be written or locked.
    """
    busy = DatasetError(f"another process {doing} in {place}; wait until it has finished")
    path = folder / "lock"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = path.open("w")
    except OSError as error:
        raise DatasetError(f"cannot write to {place}: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Whoever had it may have deleted it in the end: then this is the lock of nothing.
            if not os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                raise busy
        except (BlockingIOError, FileNotFoundError):
            raise busy from None
        except OSError as error:
            raise DatasetError(
                f"{place} cannot be locked ({error.strerror or error}); choose a folder on a file system with locks"
            ) from error
        try:
            yield
        finally:
            with suppress(OSError):
                path.unlink()
                folder.rmdir()


def write_shard(path: Path, key: str, trajectory: Trajectory, metadata: Metadata) -> str:
    """Write one trajectory as a dataset file of its own and return its content hash."""
    buffer = io.BytesIO()  # in memory first: a full disk then is an ordinary OSError, not an HDF5 one
    with h5py.File(buffer, "w", libver=LIBVER) as file:
        digest = _write_trajectory(file, key, trajectory)
        file.attrs.update(metadata.model_copy(update={"content_hash": digest}).to_attributes())
    write_bytes_atomically(path, buffer.getvalue())
    return digest


def _write_trajectory(file: h5py.File, key: str, trajectory: Trajectory) -> str:
    mesh_arrays = trajectory.mesh.arrays()
    mesh_name = f"meshes/{hash_arrays(mesh_arrays).hexdigest()[:16]}"
    if mesh_name not in file:
        for name, array in mesh_arrays.items():
            _write_array(file, f"{mesh_name}/{name}", array)
    group = file.create_group(f"trajectories/{key}")
    group["mesh"] = file[mesh_name]
    for name, array in trajectory.arrays().items():
        if not name.startswith("mesh/"):
            _write_array(group, name, array)
    group.create_group("material").attrs.update(trajectory.material)
    if trajectory.tags:
        group.create_group("tags").attrs.update({k: fixed_length(v) for k, v in trajectory.tags.items()})
    group.create_group("diagnostics").attrs.update(trajectory.diagnostics)
    digest = trajectory.content_hash()
    group.attrs["content_hash"] = fixed_length(digest)
    return digest


def _write_array(group: h5py.Group, name: str, array: np.ndarray) -> None:
    options = {"chunks": array.shape, **COMPRESSION} if array.ndim and array.size else {}
    group.create_dataset(name, data=array, **options)


def merge_shards(
    path: Path,
    shards: dict[str, Path],
    metadata: Metadata,
    tasks_of: Callable[[Split, dict[str, float]], list[str]],
) -> str:
    """Merge shards into one dataset file and return its content hash.

    Args:
        path: the dataset file to make.
        shards: file of every trajectory key, in the order of the splits.
        metadata: root attributes; content hash and rejections are filled in here.
        tasks_of: the tasks in whose split of the same name a trajectory with this material takes part.
    """
    hashes: dict[str, str] = {}
    members: dict[str, list[str]] = {}
    rejections: list[Rejection] = []
    # HDF5 reports a full disk late and in its own words, so ask the file system first.
    needed = sum(shard.stat().st_size for shard in shards.values())
    path.parent.mkdir(parents=True, exist_ok=True)
    stats = os.statvfs(path.parent)
    if stats.f_bavail * stats.f_frsize < needed:
        raise DatasetError(
            f"cannot write {path}: {needed / 1e6:.1f} MB needed, less is free in {path.parent}"
        )

    with atomic_path(path) as temporary, _hdf5_errors(), h5py.File(temporary, "w", libver=LIBVER) as file:
        file.create_group("meshes")
        file.create_group("trajectories")
        for key, shard in shards.items():
            with h5py.File(shard) as source:
                (mesh_name,) = source["meshes"]
                if mesh_name not in file["meshes"]:
                    source.copy(f"meshes/{mesh_name}", file["meshes"])
                origin = source[f"trajectories/{key}"]
                group = file.create_group(f"trajectories/{key}")
                group.attrs["content_hash"] = origin.attrs["content_hash"]
                for name in origin:
                    if name != "mesh":
                        source.copy(origin[name], group, name)
                group["mesh"] = file[f"meshes/{mesh_name}"]
                hashes[key] = as_text(origin.attrs["content_hash"])
                split, _ = parse_key(key)
                for task in tasks_of(split, dict(origin["material"].attrs)):
                    members.setdefault(f"splits/{task}/{split}", []).append(key)
                rejections += Metadata.from_attributes(dict(source.attrs)).rejections
        return _complete(file, members, hashes, metadata.model_copy(update={"rejections": tuple(rejections)}))


def write_dataset(
    path: Path, trajectories: Iterable[tuple[str, Trajectory]], task: str, describe: Callable[[], Metadata]
) -> str:
    """Write trajectories that come one by one into one dataset file, and return its content hash.

    Args:
        path: the dataset file to make.
        trajectories: key and content of each, in the order of the splits.
        task: in whose splits they are.
        describe: the root attributes, asked for when the last trajectory has come.
    """
    hashes: dict[str, str] = {}
    members: dict[str, list[str]] = {}
    with atomic_path(path) as temporary, _new_hdf5(temporary) as file:
        for key, trajectory in trajectories:
            with _hdf5_errors():
                hashes[key] = _write_trajectory(file, key, trajectory)
            members.setdefault(f"splits/{task}/{parse_key(key)[0]}", []).append(key)
        metadata = describe()
        with _hdf5_errors():
            return _complete(file, members, hashes, metadata)


@contextmanager
def _new_hdf5(path: Path) -> Iterator[h5py.File]:
    """A new file: what HDF5 reports of it, which it may do as late as at the end, but nothing that the body raises."""
    with _hdf5_errors():
        file = h5py.File(path, "w", libver=LIBVER)
    try:
        yield file
    finally:
        with _hdf5_errors():
            file.close()


def _complete(
    file: h5py.File, members: dict[str, list[str]], hashes: dict[str, str], metadata: Metadata
) -> str:
    """Splits and root attributes, which come last; returns the content hash."""
    for name, keys in members.items():
        file.create_dataset(name, data=np.array(keys, "S"), chunks=(len(keys),), fletcher32=True)
    content_hash = combine_hashes(hashes)
    file.attrs.update(metadata.model_copy(update={"content_hash": content_hash}).to_attributes())
    return content_hash


@contextmanager
def _hdf5_errors() -> Iterator[None]:
    """HDF5 reports what the operating system refused in a long text: make it the OSError that it is."""
    try:
        yield
    except (RuntimeError, OSError) as error:
        code = re.search(r"errno = (\d+)", str(error))
        if code is None:
            raise OSError(f"HDF5 failed ({error})") from error
        raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
