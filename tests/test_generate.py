"""A dataset is the same however it is made, and whatever happens on the way leaves no half-made file."""

import errno
import fcntl
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import patch

import h5py
import numpy as np
import pytest

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import content_hash, find_dataset, open_file, read_metadata, stored_hashes
from m3gn_bench.datasets.schema import DATASET_SEED, SPLITS
from m3gn_bench.datasets.trajectory import FREE, VTK_TETRA, Mesh, Trajectory
from m3gn_bench.datasets.validator import validate
from m3gn_bench.datasets.writer import reserved
from m3gn_bench.generators.errors import GeneratorError, SolverError
from m3gn_bench.generators.generate import MAX_ATTEMPTS, draw, generate, simulate_one
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.generators.sheet_deformation import SheetDeformation

SCRIPT = Path(sys.executable).parent / "m3gn-bench"


class FakeScene:
    """Costs no time; a tenth of its draws diverges, another tenth fails the check."""

    name: ClassVar[str] = "fake"
    dataset_version: ClassVar[str] = "1.0"
    tasks: ClassVar[tuple[str, ...]] = ("fake_task",)
    paper_sizes: ClassVar[dict[str, int]] = {"train": 100, "validation": 20, "test": 20}
    variant: ClassVar[dict[str, str]] = {}
    frames: ClassVar[int] = 3
    dt: ClassVar[float] = 1.0
    time_unit: ClassVar[str] = "s"
    length_unit: ClassVar[str] = "m"
    material_units: ClassVar[dict[str, str]] = {"draw": ""}
    load_units: ClassVar[dict[str, str]] = {}
    scale_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0)
    scale_length: ClassVar[float] = 1.0
    fidelities: ClassVar[dict[str, Any]] = {"default": None, "fast": None}
    limits: ClassVar[tuple[float, float]] = (0.1, 0.9)

    def sample(self, rng: np.random.Generator, index: int) -> float:
        return float(rng.uniform())

    def reason(self, parameter: float) -> str | None:
        """Why a draw is rejected, if it is."""
        below, above = self.limits
        if parameter < below:
            return f"diverges at {parameter}"
        return f"fails at {parameter}" if parameter > above else None

    def simulate(self, parameter: float, fidelity: str) -> Trajectory:
        reason = self.reason(parameter) or ""
        if reason.startswith("diverges"):
            raise SolverError(reason)
        rest = np.eye(4, 3, dtype=np.float32)[::-1].copy()
        mesh = Mesh(rest, np.array([[0, 3, 2, 1]], np.int32), VTK_TETRA, np.full(4, FREE, np.uint8))
        moved = np.arange(1, self.frames + 1, dtype=np.float32) * np.float32(parameter)
        return Trajectory(rest + moved[:, None, None], mesh, {"draw": parameter})

    def check(self, trajectory: Trajectory) -> list[str]:
        reason = self.reason(trajectory.material["draw"])
        return [reason] if reason else []

    def tasks_of(self, split: str, material: dict[str, float]) -> list[str]:
        return list(self.tasks)

    def simulator_versions(self) -> dict[str, str]:
        return {"fake": "1"}


class HopelessScene(FakeScene):
    """No draw is ever good."""

    name: ClassVar[str] = "hopeless"
    limits: ClassVar[tuple[float, float]] = (1.0, 1.0)


@pytest.fixture
def fake() -> FakeScene:
    return FakeScene()


def left_in(folder: Path) -> set[str]:
    """Names of everything in a folder, hidden or not."""
    return {path.name for path in folder.iterdir()}


# --- the same data, however made --------------------------------------------------------------------------


def test_smoke_tier_is_valid(smoke_file: Path) -> None:
    assert validate(smoke_file, strict=True).ok
    assert left_in(smoke_file.parent) == {"sheet_deformation-smoke.h5"}


@pytest.mark.parametrize(("split", "index"), [("train", 5), ("test", 3)])
def test_a_trajectory_alone_is_the_one_in_the_dataset(smoke_file: Path, split: str, index: int) -> None:
    """So it does not matter what else is made, in what order: tiers are prefixes of one another."""
    with open_file(smoke_file) as file:
        expected = stored_hashes(file)[f"{split}_{index:05d}"]
    trajectory, rejected = simulate_one(SheetDeformation(), split, index)  # type: ignore[arg-type]
    assert (trajectory.content_hash(), rejected) == (expected, [])


def test_smoke_is_a_prefix_of_quick(fake: FakeScene, tmp_path: Path) -> None:
    smoke, quick = (generate(fake, tier, tmp_path) for tier in ("smoke", "quick"))
    with open_file(smoke.file) as small, open_file(quick.file) as large:
        assert content_hash(large, "smoke") == content_hash(small) == smoke.content_hash
        assert content_hash(large, "smoke", ["test"]) == content_hash(small, "smoke", ["test"])
    assert smoke.content_hash != quick.content_hash
    assert left_in(tmp_path) == {"fake-smoke.h5", "fake-quick.h5"}


def test_a_complete_file_is_not_made_again(fake: FakeScene, tmp_path: Path) -> None:
    """Unless it is damaged: then everything in it is."""
    first = generate(fake, "smoke", tmp_path)
    again = generate(fake, "smoke", tmp_path)
    assert (first.generated, again.generated) == (16, 0)
    assert (again.content_hash, again.rejected) == (first.content_hash, first.rejected)
    with h5py.File(first.file, "a") as file:
        file["trajectories/test_00000/positions"][0, 0, 0] += 1
    repaired = generate(fake, "smoke", tmp_path)
    assert (repaired.generated, repaired.content_hash) == (16, first.content_hash)


def test_whatever_is_not_the_default_is_in_the_name(fake: FakeScene, tmp_path: Path) -> None:
    """Else a data set of another seed would be taken for the leaderboard's."""
    default = generate(fake, "smoke", tmp_path)
    seeded = generate(fake, "smoke", tmp_path, seed=7)
    fast = generate(fake, "smoke", tmp_path, fidelity="fast")
    part = generate(fake, "smoke", tmp_path, splits=["test", "train"])
    names = [report.file.name for report in (default, seeded, fast, part)]
    assert names == ["fake-smoke.h5", "fake-smoke-seed7.h5", "fake-smoke-fast.h5", "fake-smoke-train-test.h5"]
    assert seeded.content_hash != default.content_hash
    default.file.unlink()
    part.file.unlink()
    assert find_dataset(tmp_path, "fake", "smoke", SPLITS) is None


def test_all_draws_differ(fake: FakeScene) -> None:
    """A test trajectory that equals a training one would spoil the benchmark."""
    draws = [
        draw(scene, split, index, seed, attempt)  # type: ignore[arg-type]
        for scene in (fake, HopelessScene())
        for split in SPLITS
        for index in range(20)
        for seed in (DATASET_SEED, 1)
        for attempt in range(MAX_ATTEMPTS)
    ]
    assert len(set(draws)) == len(draws)


def test_what_the_validator_would_find_is_not_written(
    fake: FakeScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where a scene's own check is blind."""
    good = FakeScene.simulate

    def spoilt(self: FakeScene, parameter: float, fidelity: str) -> Trajectory:
        made = good(self, parameter, fidelity)
        made.positions[1, 2, 0] = np.nan
        return made

    monkeypatch.setattr(FakeScene, "simulate", spoilt)
    with pytest.raises(
        GeneratorError, match=r"scene fake .* train_\d+: positions holds 1 numbers that are not finite"
    ):
        generate(fake, "smoke", tmp_path)
    assert list(tmp_path.glob("*.h5")) == []


def test_unknown_splits_are_refused(fake: FakeScene, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="unknown split 'tets'; known: test, train, validation"):
        generate(fake, "smoke", tmp_path, splits=["tets"])  # type: ignore[list-item]
    with pytest.raises(GeneratorError, match="no split"):
        generate(fake, "smoke", tmp_path, splits=[])


def test_units_in_brackets_are_text(fake: FakeScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FakeScene, "time_unit", "[s]")
    with open_file(generate(fake, "smoke", tmp_path).file) as file:
        assert read_metadata(file).time_unit == "[s]"


# --- rejected draws ---------------------------------------------------------------------------------------


def test_rejected_draws_are_counted_and_redrawn(fake: FakeScene, tmp_path: Path) -> None:
    report = generate(fake, "smoke", tmp_path / "a")
    reasons = {(r.key, r.attempt): r.reason for r in report.rejected}
    assert any("diverges" in reason for reason in reasons.values())
    assert any("fails" in reason for reason in reasons.values())
    with open_file(report.file) as file:
        assert list(read_metadata(file).rejections) == report.rejected
        kept = {key: group["material"].attrs["draw"] for key, group in file["trajectories"].items()}
    for key, value in kept.items():
        split, _, index = key.rpartition("_")
        attempts = sum(rejected == key for rejected, _ in reasons)
        drawn = [draw(fake, split, int(index), DATASET_SEED, a) for a in range(attempts + 1)]  # type: ignore[arg-type]
        assert drawn[-1] == value
        assert [fake.reason(parameter) for parameter in drawn] == [  # type: ignore[arg-type]
            *(reasons[key, attempt] for attempt in range(attempts)),
            None,
        ]
    again = generate(fake, "smoke", tmp_path / "b")
    assert (again.content_hash, again.rejected) == (report.content_hash, report.rejected)


def test_hopeless_draws_end_the_run(tmp_path: Path) -> None:
    message = rf"train_00000: all {MAX_ATTEMPTS} draws were rejected, the last because diverges at 0\.\d+"
    with pytest.raises(GeneratorError, match=message):
        generate(HopelessScene(), "smoke", tmp_path)
    assert list(tmp_path.glob("*.h5")) == []


# --- interrupted, killed, at the same time ----------------------------------------------------------------


def stop_after(count: int) -> Callable[[int, int], None]:
    def on_progress(done: int, total: int) -> None:
        if done == count:
            raise KeyboardInterrupt

    return on_progress


def test_a_smaller_tier_leaves_an_interrupted_larger_one_alone(fake: FakeScene, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        generate(fake, "quick", tmp_path, on_progress=stop_after(20))
    assert generate(fake, "smoke", tmp_path).generated == 16 - 8  # the first 20 are of the training split
    assert generate(fake, "quick", tmp_path).generated == 96 - 20 - 8  # nothing is made twice
    assert left_in(tmp_path) == {"fake-smoke.h5", "fake-quick.h5"}


def test_shards_of_another_generator_are_made_again(
    fake: FakeScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        generate(fake, "smoke", tmp_path, on_progress=stop_after(5))
    monkeypatch.setattr(FakeScene, "dataset_version", "1.1")
    assert generate(fake, "smoke", tmp_path).generated == 16


def test_damaged_shards_are_made_again(fake: FakeScene, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        generate(fake, "smoke", tmp_path, on_progress=stop_after(5))
    shards = sorted(tmp_path.glob(".*.shards/*.h5"))
    shards[0].write_bytes(shards[0].read_bytes()[:-100])
    with h5py.File(shards[1], "r+") as file:
        file["trajectories/train_00001/positions"][0, 0, 0] = 9
    assert generate(fake, "smoke", tmp_path).generated == 16 - 3


def test_a_dataset_with_damaged_splits_is_made_again(fake: FakeScene, tmp_path: Path) -> None:
    path = generate(fake, "smoke", tmp_path).file
    whole = path.read_bytes()
    position = whole.index(b"test_00003")
    path.write_bytes(whole[:position] + b"T" + whole[position + 1 :])
    assert generate(fake, "smoke", tmp_path).generated == 16
    assert validate(path, strict=True).ok


def test_a_lock_of_a_deleted_folder_counts_for_nothing(tmp_path: Path) -> None:
    """Whoever opened the lock just before its holder finished, and deleted it, does not have it."""
    folder = tmp_path / "shards"
    taken = fcntl.flock

    def finish_first(lock: Any, how: int) -> None:
        shutil.rmtree(folder)
        taken(lock, how)

    with (
        patch("fcntl.flock", finish_first),
        pytest.raises(DatasetError, match="another process"),
        reserved(folder, "waits", tmp_path),
    ):
        pass
    with reserved(folder, "waits", tmp_path):
        pass


def test_a_file_system_without_locks_is_named(tmp_path: Path) -> None:
    def refuse(lock: Any, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    with (
        patch("fcntl.flock", refuse),
        pytest.raises(DatasetError, match=r"cannot be locked \(No locks available\)"),
        reserved(tmp_path / "shards", "waits", tmp_path),
    ):
        pass


def test_two_runs_do_not_mix(fake: FakeScene, tmp_path: Path) -> None:
    errors = []

    def second(done: int, total: int) -> None:
        if done == 5:
            with pytest.raises(DatasetError, match="another process") as error:
                generate(fake, "smoke", tmp_path)
            errors.append(error)

    assert generate(fake, "smoke", tmp_path, on_progress=second).generated == 16
    assert len(errors) == 1


def start(out: Path, split: str, *, workers: int = 2, **options: Any) -> subprocess.Popen[str]:
    """The real command, in a process group of its own as a shell would start it, and not deaf to Ctrl-C (as it
    would be if the tests themselves run in the background)."""
    options.setdefault("preexec_fn", lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    command = [SCRIPT, "generate", "sheet_deformation", "--tier", "smoke", "--split", split, "--out", out]
    return subprocess.Popen(
        [*map(str, command), "--workers", str(workers), "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,
    )


@pytest.fixture
def run() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """`start`, with nothing left running after the test."""
    started: list[subprocess.Popen[str]] = []

    def start_one(*arguments: Any, **options: Any) -> subprocess.Popen[str]:
        started.append(start(*arguments, **options))
        return started[-1]

    yield start_one
    for process in started:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its workers, too, should they outlive it
        process.communicate()


def wait_for(out: Path, pattern: str, count: int, process: subprocess.Popen[str]) -> None:
    """Wait until so many files are in the folder of shards."""
    for _ in range(3000):
        if len(list(out.glob(f".*.shards/{pattern}"))) >= count:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise AssertionError("the run made no progress in a minute")


def expected_hash(smoke_file: Path, split: str) -> str:
    """Of the file that one worker made, in the process of the tests."""
    with open_file(smoke_file) as file:
        return content_hash(file, "smoke", [split])


Run = Callable[..., subprocess.Popen[str]]


def test_killed_run_goes_on(run: Run, tmp_path: Path, smoke_file: Path) -> None:
    """Also: two workers make what one makes."""
    killed = run(tmp_path, "train")
    wait_for(tmp_path, "*.h5", 2, killed)
    killed.kill()
    # Workers hold the other end of these pipes: it closes when the last of them is gone.
    assert killed.communicate(timeout=30)[0] == ""
    assert list(tmp_path.glob("*.h5")) == []
    name = "sheet_deformation-smoke-train.h5"
    (tmp_path / f".{name}.4711.tmp").write_text("left by a run that was killed while it merged")

    second = run(tmp_path, "train")
    output, errors = second.communicate(timeout=120)
    assert (second.returncode, errors) == (0, "")
    made = json.loads(output)
    assert made["content_hash"] == expected_hash(smoke_file, "train")
    assert 0 < made["generated"] <= 6
    assert made["trajectories"] == 8
    assert left_in(tmp_path) == {name}


def test_interrupted_run_goes_on(run: Run, tmp_path: Path, smoke_file: Path) -> None:
    def interrupt(process: subprocess.Popen[str], how: Callable[[int], None]) -> None:
        how(process.pid)
        output, errors = process.communicate(timeout=30)
        assert process.returncode == 130
        assert output == ""
        assert errors.strip().splitlines() == ["interrupted; run the same command again"]
        assert list(tmp_path.glob("*.h5")) == []

    first = run(tmp_path, "validation")
    wait_for(tmp_path, "lock", 1, first)
    time.sleep(0.3)  # workers are importing
    interrupt(first, lambda pid: os.killpg(pid, signal.SIGINT))  # to the workers, too, as a terminal does
    second = run(tmp_path, "validation")
    wait_for(tmp_path, "*.h5", 1, second)
    interrupt(second, lambda pid: os.kill(pid, signal.SIGTERM))  # as a batch system does
    third = run(tmp_path, "validation")
    made = json.loads(third.communicate(timeout=120)[0])
    assert made["content_hash"] == expected_hash(smoke_file, "validation")
    assert 0 < made["generated"] < 4
    assert left_in(tmp_path) == {"sheet_deformation-smoke-validation.h5"}


def test_worker_that_dies_is_reported(tmp_path: Path) -> None:
    """As the kernel kills one when memory runs out."""

    def kill_a_worker(done: int, total: int) -> None:
        if done == 1:
            worker = multiprocessing.active_children()[0]
            assert worker.pid is not None
            os.kill(worker.pid, signal.SIGKILL)

    with pytest.raises(GeneratorError, match=r"a worker process died.*run the same again"):
        generate(get_scene("sheet_deformation"), "smoke", tmp_path, workers=2, on_progress=kill_a_worker)
    assert multiprocessing.active_children() == []
    assert list(tmp_path.glob("*.h5")) == []


# --- a disk that is full, a folder that cannot be written -------------------------------------------------


def test_full_disk(run: Run, tmp_path: Path, smoke_file: Path) -> None:
    """Writes beyond a size fail, as they would on a full disk: first those of shards, then the merge's."""

    def with_limit(size: int, workers: int = 1) -> tuple[int, str, str]:
        def limit() -> None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

        process = run(tmp_path, "test", workers=workers, preexec_fn=limit)
        output, errors = process.communicate(timeout=120)
        return process.returncode, output, errors

    shard = smoke_file.stat().st_size // 16
    for size, workers, kept in ((shard // 2, 2, 0), (2 * shard, 1, 4)):
        code, output, errors = with_limit(size, workers)
        assert (code, output) == (2, "")
        (line,) = errors.splitlines()
        assert line.startswith("error: cannot write ")
        assert line.endswith(": File too large")
        assert list(tmp_path.glob("*.h5")) == []
        assert list(tmp_path.rglob("*.tmp")) == []
        assert len(list(tmp_path.glob(".*.shards/*.h5"))) == kept
    code, output, _ = with_limit(2**30)
    made = json.loads(output)
    assert (code, made["generated"]) == (0, 0)
    assert made["content_hash"] == expected_hash(smoke_file, "test")


def test_merge_asks_for_space_first(fake: FakeScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        f_bavail, f_frsize = 3, 1

    monkeypatch.setattr("os.statvfs", lambda path: Full)
    with pytest.raises(DatasetError, match="less is free"):
        generate(fake, "smoke", tmp_path)
    assert list(tmp_path.glob("*.h5")) == []
    monkeypatch.undo()


def test_folder_that_cannot_be_made(fake: FakeScene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DatasetError, match=r"cannot write to .*file/data: Not a directory"):
        generate(fake, "smoke", tmp_path / "file" / "data")


@pytest.mark.parametrize("workers", [0, -1])
def test_number_of_workers_is_checked(fake: FakeScene, tmp_path: Path, workers: int) -> None:
    with pytest.raises(GeneratorError, match="at least 1"):
        generate(fake, "smoke", tmp_path, workers=workers)
    assert left_in(tmp_path) == set()
