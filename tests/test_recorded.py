"""A record tells the same dataset from another one, bit by bit or up to rounding."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree

from m3gn_bench.cli import cli
from m3gn_bench.datasets import card, recorded
from m3gn_bench.datasets.card import CARDS, Moments
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory, stored_hashes, tier_hashes
from m3gn_bench.datasets.recorded import (
    PROJECTIONS,
    TOLERANCE,
    compare,
    differences,
    read_record,
    record,
    sketch,
)
from m3gn_bench.datasets.schema import SMALL_TIERS, trajectory_key
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.datasets.writer import merge_shards, write_shard
from m3gn_bench.generators.scene import get_scene, scene_names
from m3gn_bench.generators.sheet_deformation import SheetDeformation


@pytest.fixture(scope="module")
def quick_file(smoke_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As many trajectories as the quick tier has; beyond the smoke tier they repeat themselves."""
    folder = tmp_path_factory.mktemp("quick")
    with open_file(smoke_file) as file:
        metadata = read_metadata(file).model_copy(update={"tier": "quick"})
        shards = {}
        for split, size in SMALL_TIERS["quick"].items():
            for index in range(size):
                key = trajectory_key(split, index)
                trajectory = read_trajectory(file, trajectory_key(split, index % SMALL_TIERS["smoke"][split]))
                shards[key] = folder / f"{key}.shard"
                write_shard(shards[key], key, trajectory, metadata)
    merge_shards(folder / "quick.h5", shards, metadata, lambda split, material: ["sheet_deformation"])
    return folder / "quick.h5"


def altered(source: Path, folder: Path, change: float, **metadata: Any) -> Path:
    """A copy of a dataset whose coordinates differ by `change` of the scene's half-width."""
    with open_file(source) as file:
        described = read_metadata(file).model_copy(update=metadata)
        shards = {}
        for key in stored_hashes(file):
            old = read_trajectory(file, key)
            moved = old.positions + np.float32(change * described.scale_length)
            shards[key] = folder / f"{key}.shard"
            write_shard(shards[key], key, replace(old, positions=moved), described)
    path = folder / "altered.h5"
    merge_shards(path, shards, described, lambda split, material: ["sheet_deformation"])
    return path


def test_the_same_file_is_identical(quick_file: Path, smoke_file: Path, tmp_path: Path) -> None:
    """Also a smaller tier, since tiers are prefixes of one another."""
    record(quick_file, tmp_path)
    for file, trajectories in ((quick_file, 96), (smoke_file, 16)):
        outcome = compare(file, tmp_path)
        assert (outcome.ok, outcome.identical, outcome.largest_difference) == (True, True, 0.0)
        assert outcome.trajectories == trajectories


@pytest.mark.parametrize(("change", "ok"), [(2e-6, True), (1e-3, False), (np.nan, False)])
def test_another_file_is_measured(
    quick_file: Path, smoke_file: Path, tmp_path: Path, change: float, ok: bool
) -> None:
    record(quick_file, tmp_path)
    outcome = compare(altered(smoke_file, tmp_path, change), tmp_path)
    assert not outcome.identical
    assert outcome.where.endswith(", positions")
    assert outcome.ok == ok
    if np.isfinite(change):  # three projections estimate it
        assert change / 3 < outcome.largest_difference < 3 * change


@pytest.mark.parametrize("change", [{"fidelity": "fast"}, {"variant": {"solver": "other"}}, {"seed": 1}])
def test_only_the_benchmarks_own_data_are_recorded(
    smoke_file: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    with pytest.raises(DatasetError, match="not the benchmark's own dataset"):
        record(altered(smoke_file, tmp_path, 0.0, **change), tmp_path / "records")
    assert not (tmp_path / "records").exists()


def test_less_than_the_quick_tier_is_not_recorded(smoke_file: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="whole quick tier"):
        record(smoke_file, tmp_path)


def test_less_than_what_is_recorded_does_not_replace_it(quick_file: Path, tmp_path: Path) -> None:
    path = record(quick_file, tmp_path)
    larger = json.loads(path.read_text())
    larger["hashes"]["paper"] = "0" * 64
    path.write_text(json.dumps(larger))
    with pytest.raises(DatasetError, match="has no tier paper, which is recorded of sheet_deformation"):
        record(quick_file, tmp_path)
    assert json.loads(path.read_text()) == larger
    path.write_text(json.dumps(larger | {"dataset_version": "0.9"}))
    record(quick_file, tmp_path)  # of a newer version less is something


def with_changed(array: np.ndarray, place: Any, change: float) -> np.ndarray:
    changed = array.copy()
    changed[place] += change
    return changed


def tampered(trajectory: Trajectory, part: str) -> Trajectory:
    """The trajectory with one part of it wrong."""
    mesh, scale = trajectory.mesh, np.ptp(trajectory.positions)
    match part:
        case "positions":  # one node in one frame
            return replace(trajectory, positions=with_changed(trajectory.positions, (30, 100), 0.1 * scale))
        case "mesh/rest_positions":
            moved = with_changed(mesh.rest_positions, 100, 0.01 * scale)
            return replace(trajectory, mesh=replace(mesh, rest_positions=moved))
        case "loads/nodal_forces":
            wrong = trajectory.loads["nodal_forces"][::-1]
            return replace(trajectory, loads=trajectory.loads | {"nodal_forces": wrong})
        case "material/youngs_modulus":
            return replace(
                trajectory, material={"youngs_modulus": trajectory.material["youngs_modulus"] * 1.001}
            )
        case "cells":
            return replace(trajectory, mesh=replace(mesh, cells=mesh.cells[::-1]))
        case "node_type":
            return replace(trajectory, mesh=replace(mesh, node_type=1 - mesh.node_type))
        case "tags":
            return replace(trajectory, tags={"object": "teddy"})
        case _:
            return replace(trajectory, collider_positions=trajectory.positions[:, :1])


@pytest.mark.parametrize(
    "part", ["positions", "mesh/rest_positions", "loads/nodal_forces", "material/youngs_modulus"]
)
def test_a_sketch_has_all_that_is_rounded(smoke_file: Path, part: str) -> None:
    """What differs is named; nothing else does."""
    with open_file(smoke_file) as file:
        trajectory, scale_length = read_trajectory(file, "test_00000"), read_metadata(file).scale_length
    found = differences(tampered(trajectory, part), sketch(trajectory), scale_length)
    assert found[part] > TOLERANCE
    assert all(difference < 1e-6 for name, difference in found.items() if name != part)


@pytest.mark.parametrize("part", ["cells", "node_type", "tags", "collider"])
def test_a_sketch_has_all_that_is_not_rounded(smoke_file: Path, part: str) -> None:
    with open_file(smoke_file) as file:
        trajectory = read_trajectory(file, "test_00000")
    assert differences(tampered(trajectory, part), sketch(trajectory), 1.0) == {"what is not rounded": np.inf}


def test_a_difference_is_estimated_without_bias(smoke_file: Path) -> None:
    """Over many random errors the mean square of the sketch's differences is that of the numbers."""
    with open_file(smoke_file) as file:
        trajectory = read_trajectory(file, "test_00000")
    known, rng, size = sketch(trajectory), np.random.default_rng(0), 1.0
    estimates = []
    for _ in range(200):
        error = size * rng.normal(size=trajectory.positions.shape).astype(np.float32)
        noisy = replace(trajectory, positions=trajectory.positions + error)
        estimates.append(differences(noisy, known, scale_length=1.0)["positions"])
    # The square is chi-squared with three degrees of freedom over three: its mean of 200 has a deviation of 6 %.
    assert np.mean(np.square(estimates)) == pytest.approx(size**2, rel=0.2)


@pytest.mark.parametrize("change", [{"dataset_version": "9.9"}, {"scene": "unheard_of"}])
def test_what_is_not_recorded_cannot_be_compared(
    quick_file: Path, smoke_file: Path, tmp_path: Path, change: dict[str, str]
) -> None:
    record(quick_file, tmp_path)
    with pytest.raises(DatasetError, match=r"recorded of"):
        compare(altered(smoke_file, tmp_path, 0.0, **change), tmp_path)


def test_moments_are_those_of_all_vectors() -> None:
    rng = np.random.default_rng(0)
    batches = [1e3 + rng.normal(size=(n, 5, 3)) for n in (1, 4, 2)]
    moments = Moments()
    for batch in batches:
        moments.add(batch)
    together = np.concatenate(batches).reshape(-1, 3)
    assert moments.mean == pytest.approx(together.mean(0))
    assert moments.variance == pytest.approx(together.var(0), rel=1e-9)


@pytest.mark.parametrize("scene", scene_names())
def test_every_scene_is_recorded_with_its_paper_tier(scene: str) -> None:
    found = read_record(scene)
    assert found.dataset_version == get_scene(scene).dataset_version
    assert set(found.hashes) == {"smoke", "quick", "paper"}
    assert len(found.sketches) == sum(get_scene(scene).paper_sizes.values())
    shown = (CARDS / f"{scene}.md").read_text()
    assert all(digest in shown for digest in found.hashes.values())


@pytest.mark.parametrize("scene", scene_names())
def test_recorded_sketches_tell_trajectories_apart(scene: str) -> None:
    """By the positions alone, which come last before the material. Chance makes a few nearly the same: five pairs of
    Tissue Manipulation have one patch, one material, and directions that differ by less than 0.07 degrees.
    """
    material = len(get_scene(scene).material_units)
    sketches = read_record(scene).sketches.values()
    positions = np.array([known.numbers[-material - PROJECTIONS : -material] for known in sketches])
    nearest = cKDTree(positions).query(positions, k=2)[0][:, 1] / np.sqrt(PROJECTIONS)
    assert (nearest < TOLERANCE * get_scene(scene).scale_length).mean() < 0.02


def test_reproduce_command(quick_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From nothing, against a record of other data: exit code 1. (CI runs it against the good ones.)"""
    record(altered(quick_file, tmp_path, 1e-2), tmp_path)
    monkeypatch.setattr(recorded, "FOLDER", tmp_path)
    arguments = ["reproduce", "sheet_deformation", "--tier", "smoke", "--workers", "1", "--json"]
    outcome = CliRunner().invoke(cli, arguments)
    assert outcome.exit_code == 1
    found = json.loads(outcome.stdout)
    assert (found["ok"], found["identical"]) == (False, False)
    assert 1e-2 / 3 < found["largest_difference"] < 3e-2
    assert found["where"].endswith(", positions")


def test_card_command(quick_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the block between the markers changes; the hashes are those of the file."""
    shipped = (CARDS / "sheet_deformation.md").read_text()
    (tmp_path / "sheet_deformation.md").write_text(shipped)
    monkeypatch.setattr(card, "CARDS", tmp_path)
    monkeypatch.setattr(recorded, "FOLDER", tmp_path)
    outcome = CliRunner().invoke(cli, ["card", str(quick_file), "--json"])
    assert outcome.exit_code == 0, outcome.output
    paths = json.loads(outcome.stdout)
    assert (Path(paths["card"]).parent, Path(paths["record"]).parent) == (tmp_path, tmp_path)
    written = Path(paths["card"]).read_text()
    before, middle, after = parts(written)
    assert (before, after) == (parts(shipped)[0], parts(shipped)[2])
    rows = middle.splitlines()
    assert f"| trajectories | 96, tier `quick`, dataset version {SheetDeformation.dataset_version} |" in rows
    # What there is to infer does not depend on the tier.
    (effect,) = (row for row in rows if row.startswith("| softest against stiffest"))
    assert effect in parts(shipped)[1].splitlines()
    hashes = read_record("sheet_deformation", tmp_path).hashes
    assert all(f"| content hash, {tier} | `{digest}` |" in rows for tier, digest in hashes.items())
    with open_file(quick_file) as file:
        assert hashes == tier_hashes(file)


def test_a_card_is_not_written_of_a_file_that_is_not_recorded(
    quick_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(quick_file, tmp_path)
    known = read_record("sheet_deformation", tmp_path)
    larger = known.model_copy(update={"hashes": {**known.hashes, "paper": "0" * 64}})
    (tmp_path / "sheet_deformation.json").write_text(larger.model_dump_json())
    monkeypatch.setattr(recorded, "FOLDER", tmp_path)
    monkeypatch.setattr(card, "CARDS", tmp_path)
    shutil.copy(CARDS / "sheet_deformation.md", tmp_path)
    outcome = CliRunner().invoke(cli, ["card", str(quick_file)])
    assert "has no tier paper, which is recorded" in str(outcome.exception)
    assert (tmp_path / "sheet_deformation.md").read_text() == (CARDS / "sheet_deformation.md").read_text()


def parts(text: str) -> tuple[str, str, str]:
    """Before, in and after the generated block."""
    before, _, rest = text.partition(card.BEGIN)
    block, _, after = rest.partition(card.END)
    return before, block, after


def test_reproduce_complains_before_the_work(
    quick_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record(quick_file, tmp_path)
    monkeypatch.setattr(recorded, "FOLDER", tmp_path)
    outcome = CliRunner().invoke(cli, ["reproduce", "sheet_deformation", "--tier", "paper"])
    assert isinstance(outcome.exception, DatasetError)
    assert "tiers smoke, quick" in str(outcome.exception)
