"""What is written is read back bit for bit, hashes see every change, splits and tiers are what they promise."""

import os
import pickle
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from conftest import TetraWriter
from torch.utils.data import DataLoader

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import (
    content_hash,
    find_dataset,
    open_file,
    read_metadata,
    read_splits,
    read_trajectory,
    stored_hashes,
)
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.schema import SPLITS, Metadata, Rejection
from m3gn_bench.datasets.trajectory import Mesh, Trajectory
from m3gn_bench.datasets.writer import merge_shards, write_shard
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.sheet_deformation import YOUNGS_MODULI, SheetDeformation
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import get_task

TASK = "tetra_task"


# --- content hash -----------------------------------------------------------------------------------------


def from_arrays(arrays: dict[str, np.ndarray], original: Trajectory) -> Trajectory:
    """The inverse of `Trajectory.arrays`."""
    mesh = {name.removeprefix("mesh/"): array for name, array in arrays.items() if name.startswith("mesh/")}
    return replace(
        original,
        positions=arrays["positions"],
        mesh=Mesh(**{**mesh, "cell_type": int(mesh["cell_type"])}),  # type: ignore[arg-type]
        loads={"push": arrays["loads/push"]},
        collider_positions=arrays["collider_positions"],
        collider_edges=arrays["collider_edges"],
    )


def single_bit_changes(trajectory: Trajectory) -> Iterator[Trajectory]:
    """The trajectory with every single bit of its content flipped in turn."""
    arrays = trajectory.arrays()
    for name, array in arrays.items():
        for bit in range(8 * array.nbytes):
            content = bytearray(array.tobytes())
            content[bit // 8] ^= 1 << bit % 8
            changed = np.frombuffer(content, array.dtype).reshape(array.shape)
            yield from_arrays({**arrays, name: changed}, trajectory)
    for name, value in trajectory.material.items():
        for bit in range(64):
            number = (np.float64(value).view(np.uint64) ^ np.uint64(1 << bit)).view(np.float64)
            yield replace(trajectory, material={**trajectory.material, name: float(number)})


def test_content_hash_sees_every_bit(tetra: Trajectory) -> None:
    changed = [trajectory.content_hash() for trajectory in single_bit_changes(tetra)]
    assert len(changed) > 4000
    assert len({*changed, tetra.content_hash()}) == len(changed) + 1


def test_content_hash_sees_names_shapes_and_absence(tetra: Trajectory) -> None:
    push = tetra.loads["push"]
    variants = [
        tetra,
        replace(tetra, loads={"pull": push}),
        replace(tetra, loads={"push": push.reshape(3, 5)}),
        replace(tetra, loads={}),
        replace(tetra, collider_positions=None),
        replace(tetra, collider_edges=None),
        replace(tetra, tags={}),
        replace(tetra, tags={"object": "edge"}),
        replace(tetra, tags={"thing": "wedge"}),
        replace(
            tetra, material={"stiffness": tetra.material["density"], "density": tetra.material["stiffness"]}
        ),
        replace(tetra, material={"density": tetra.material["density"]}),
    ]
    assert len({trajectory.content_hash() for trajectory in variants}) == len(variants)


def test_content_hash_ignores_diagnostics_and_order(tetra: Trajectory) -> None:
    same = replace(tetra, diagnostics={"seconds": 3.0}, material=dict(reversed(tetra.material.items())))
    assert same.content_hash() == tetra.content_hash()


# --- writing and reading ----------------------------------------------------------------------------------


def assert_identical(read: Trajectory, written: Trajectory) -> None:
    found, expected = read.arrays(), written.arrays()
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape), name
        assert found[name].tobytes() == array.tobytes(), name
    assert (read.material, read.tags) == (written.material, written.tags)
    assert read.diagnostics == written.diagnostics


def test_round_trip_is_bit_exact(tmp_path: Path, tetra: Trajectory, tetra_metadata: Metadata) -> None:
    special = np.array([np.inf, -0.0, 1e-45, np.finfo(np.float32).max], np.float32)  # no float64 in between
    written = {
        "train_00000": tetra,
        "train_00001": replace(tetra, loads={"push": special}, collider_positions=None),
        "test_00000": replace(tetra, loads={}, material={"stiffness": 0.1 + 0.2}, diagnostics={}),
    }
    shards = {key: tmp_path / key for key in written}
    digests = {k: write_shard(shards[k], k, trajectory, tetra_metadata) for k, trajectory in written.items()}
    path = tmp_path / "all.h5"
    total = merge_shards(path, shards, tetra_metadata, lambda split, material: [TASK])
    with open_file(path) as file:
        assert read_metadata(file) == tetra_metadata.model_copy(update={"content_hash": total})
        assert stored_hashes(file) == digests
        assert read_splits(file) == {TASK: {"train": ["train_00000", "train_00001"], "test": ["test_00000"]}}
        for key, trajectory in written.items():
            assert_identical(read_trajectory(file, key), trajectory)


def test_meshes_are_stored_once(tmp_path: Path, tetra: Trajectory, tetra_metadata: Metadata) -> None:
    larger = replace(tetra.mesh, rest_positions=2 * tetra.mesh.rest_positions)
    written = {"train_00000": tetra, "train_00001": tetra, "train_00002": replace(tetra, mesh=larger)}
    shards = {key: tmp_path / key for key in written}
    for key, trajectory in written.items():
        write_shard(shards[key], key, trajectory, tetra_metadata)
    merge_shards(tmp_path / "all.h5", shards, tetra_metadata, lambda split, material: [TASK])
    with open_file(tmp_path / "all.h5") as file:
        assert len(file["meshes"]) == 2
        first, second, third = (file[f"trajectories/{key}/mesh"] for key in written)
        assert first == second  # the same object in the file: a hard link
        assert first != third
        assert {first, third} == set(file["meshes"].values())


def test_hash_of_file_is_independent_of_merge_order(
    tmp_path: Path, tetra_file: Path, tetra_metadata: Metadata
) -> None:
    with open_file(tetra_file) as file:
        keys = list(file["trajectories"])
        shards = {key: tmp_path / key for key in keys}
        for key in keys:
            write_shard(shards[key], key, read_trajectory(file, key), tetra_metadata)
        expected = read_metadata(file).content_hash
        assert content_hash(file) == expected
    backwards = dict(reversed(shards.items()))
    assert merge_shards(tmp_path / "b.h5", backwards, tetra_metadata, lambda *_: [TASK]) == expected
    del backwards[keys[3]]
    assert merge_shards(tmp_path / "c.h5", backwards, tetra_metadata, lambda *_: [TASK]) != expected


def test_any_number_of_rejections_fits(tmp_path: Path, tetra: Trajectory, tetra_metadata: Metadata) -> None:
    """The classic HDF5 format allows 64 KiB per attribute; a hard scene's rejections are more."""
    shards, rejections = {}, []
    for i in range(40):
        key = f"train_{i:05d}"
        own = tuple(Rejection(key=key, attempt=a, reason="no equilibrium: " + "x" * 400) for a in range(9))
        shards[key] = tmp_path / key
        write_shard(shards[key], key, tetra, tetra_metadata.model_copy(update={"rejections": own}))
        rejections += own
    merge_shards(tmp_path / "all.h5", shards, tetra_metadata, lambda *_: [TASK])
    with open_file(tmp_path / "all.h5") as file:
        assert list(read_metadata(file).rejections) == rejections


# --- the torch dataset ------------------------------------------------------------------------------------


def test_dataset_is_lazy_and_picklable(tetra_file: Path) -> None:
    dataset = TrajectoryDataset(tetra_file, TASK, "train")
    assert isinstance(dataset, torch.utils.data.Dataset)
    assert len(dataset) == 8
    assert len(pickle.dumps(dataset)) < 4000  # no trajectory inside
    first = dataset[0]  # opens the file
    again = pickle.loads(pickle.dumps(dataset))
    assert again.keys == dataset.keys
    assert_identical(again[0], first)


def describe_in_worker(batch: list[Trajectory]) -> tuple[str, bool]:
    """The hash of a batch of one, and whether the worker that read it did so through a file of its own."""
    worker = torch.utils.data.get_worker_info()
    assert worker is not None
    return batch[0].content_hash(), worker.dataset._handle[0] == os.getpid()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_dataset_works_in_worker_processes(tetra_file: Path) -> None:
    dataset = TrajectoryDataset(tetra_file, TASK, "train")
    hashes = [dataset[i].content_hash() for i in range(len(dataset))]  # the file stays open: forks inherit it
    loader = DataLoader(dataset, num_workers=2, collate_fn=describe_in_worker, multiprocessing_context="fork")
    assert list(loader) == [(digest, True) for digest in hashes]


def test_dataset_verifies_what_it_returns(tmp_path: Path, tetra_file: Path) -> None:
    path = Path(shutil.copy(tetra_file, tmp_path))
    with h5py.File(path, "r+") as file:
        positions = file["trajectories/train_00002/positions"]
        positions[1, 2, 0] = np.nextafter(positions[1, 2, 0], np.float32(9))
    dataset = TrajectoryDataset(path, TASK, "train")
    assert dataset[1].positions.shape == (4, 5, 3)
    with pytest.raises(DatasetError, match="train_00002 does not match its content hash"):
        dataset[2]


@pytest.mark.parametrize(
    ("task", "split", "tier", "known"),
    [
        ("bending", "train", None, TASK),
        (TASK, "holdout", None, "test, train, validation"),
        (TASK, "train", "huge", "paper, quick, smoke"),
    ],
)
def test_unknown_names_list_what_exists(
    tetra_file: Path, task: str, split: str, tier: str | None, known: str
) -> None:
    with pytest.raises(DatasetError, match=f"known: {known}"):
        TrajectoryDataset(tetra_file, task, split, tier)  # type: ignore[arg-type]


# --- tiers, and finding files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(
    tmp_path_factory: pytest.TempPathFactory, write_tetra: TetraWriter, tetra_metadata: Metadata
) -> Path:
    """A data folder with all that one may contain: two tiers, one split alone, and files to be left alone."""
    folder = tmp_path_factory.mktemp("folder")

    def metadata(**changes: object) -> Metadata:
        return tetra_metadata.model_copy(update=changes)

    smoke = write_tetra(folder / "tetra-smoke.h5")
    write_tetra(folder / "tetra-quick.h5", metadata=metadata(tier="quick"))
    test_keys = {f"test_{i:05d}" for i in range(4)}
    write_tetra(folder / "tetra-smoke-test.h5", only=test_keys)
    # Smaller than any of these, so that size alone would choose them:
    write_tetra(folder / "tetra-smoke-test-fast.h5", only=test_keys, metadata=metadata(fidelity="fast"))
    write_tetra(folder / "tetra-smoke-test-seed7.h5", only=test_keys, metadata=metadata(seed=7))
    write_tetra(folder / "tetra-other.h5", only=test_keys, metadata=metadata(scene="other"))
    write_tetra(folder / "tetra-old.h5", only=test_keys, metadata=metadata(dataset_version="0.9"))
    (folder / "tetra-truncated.h5").write_bytes(smoke.read_bytes()[:5000])
    (folder / "tetra-text.h5").write_text("no dataset")
    (folder / "tetra-folder.h5").mkdir()
    return folder


def test_tiers_are_prefixes(folder: Path) -> None:
    smoke, quick = folder / "tetra-smoke.h5", folder / "tetra-quick.h5"
    for split in SPLITS:
        keys = TrajectoryDataset(quick, TASK, split).keys
        prefix = TrajectoryDataset(quick, TASK, split, "smoke").keys
        assert prefix == TrajectoryDataset(smoke, TASK, split).keys == keys[: len(prefix)]
        assert 0 < len(prefix) < len(keys)
    with open_file(smoke) as small, open_file(quick) as large:
        assert content_hash(small) == content_hash(small, "smoke") == content_hash(large, "smoke")
        assert content_hash(large, "smoke", ["test"]) == content_hash(small, "smoke", ["test"])
        assert content_hash(large, "smoke") != content_hash(large, "quick")
        with pytest.raises(DatasetError, match="whole quick tier"):
            content_hash(small, "quick")


@pytest.mark.parametrize(
    ("tier", "splits", "expected"),
    [
        ("smoke", SPLITS, "tetra-smoke.h5"),
        ("smoke", ("test",), "tetra-smoke-test.h5"),
        ("smoke", ("train", "validation"), "tetra-smoke.h5"),
        ("quick", ("test",), "tetra-quick.h5"),
        ("paper", ("test",), None),
    ],
)
def test_smallest_suitable_file_is_found(
    folder: Path, tier: str, splits: tuple[str, ...], expected: str | None
) -> None:
    found = find_dataset(folder, "tetra", tier, splits, "1.0")
    assert (found and found.name) == expected


def test_data_of_an_older_version_are_found_by_whom_asks_for_them(folder: Path) -> None:
    for version in ("0.9", None):
        found = find_dataset(folder, "tetra", "smoke", ["test"], version)
        assert found == folder / "tetra-old.h5"
    assert find_dataset(folder, "tetra", "smoke", ["test"], "0.8") is None


def test_data_of_an_older_version_are_simulated_again(smoke_file: Path, tmp_path: Path) -> None:
    """What commands read without being told which file is of the present version, or is made."""
    task = get_task("sheet_deformation")
    path = tmp_path / smoke_file.name
    shutil.copy(smoke_file, path)
    assert find_or_generate(task, "smoke", tmp_path, splits=["test"]) == path
    with h5py.File(path, "r+") as file:
        file.attrs["dataset_version"] = np.bytes_("0.9")
    again = find_or_generate(task, "smoke", tmp_path, splits=["test"])
    assert again == tmp_path / "sheet_deformation-smoke-test.h5"
    with open_file(again) as file, open_file(smoke_file) as original:
        assert content_hash(file, "smoke", ["test"]) == content_hash(original, "smoke", ["test"])


def test_nothing_is_found_in_no_folder(tmp_path: Path) -> None:
    assert find_dataset(tmp_path / "absent", "tetra", "smoke", SPLITS) is None


# --- sheet deformation's splits ---------------------------------------------------------------------------


def test_ood_split_of_the_file(smoke_file: Path) -> None:
    with open_file(smoke_file) as file:
        splits = read_splits(file)
        moduli = {
            key: group["material"].attrs["youngs_modulus"] for key, group in file["trajectories"].items()
        }
    assert set(splits) == {"sheet_deformation", "sheet_deformation_ood"}
    for split in SPLITS:
        chosen = splits["sheet_deformation_ood"][split]
        everything = splits["sheet_deformation"][split]
        assert chosen == [key for key in everything if (60 <= moduli[key] <= 500) == (split != "test")]
        assert {key.rpartition("_")[0] for key in everything} == {split}
        assert 0 < len(chosen) < len(everything)


@pytest.mark.parametrize("split", SPLITS)
def test_splits_of_the_full_size(split: str) -> None:
    """At the paper's size nothing is simulated here: parameters are drawn and sorted into tasks."""
    scene = SheetDeformation()
    drawn = [draw(scene, split, i, seed=2025).youngs_modulus for i in range(scene.paper_sizes[split])]  # type: ignore[arg-type, attr-defined]
    for size in range(1, len(drawn) + 1):  # every prefix is balanced, so every tier is
        counts = Counter(drawn[:size])
        assert max(counts.values()) - min(counts[modulus] for modulus in YOUNGS_MODULI) <= 1
    in_ood = {e for e in drawn if "sheet_deformation_ood" in scene.tasks_of(split, {"youngs_modulus": e})}  # type: ignore[arg-type]
    assert in_ood == ({10, 30, 750, 1000} if split == "test" else {60, 100, 180, 320, 500})
    assert all("sheet_deformation" in scene.tasks_of(split, {"youngs_modulus": e}) for e in drawn)  # type: ignore[arg-type]
