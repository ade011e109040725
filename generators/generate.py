"""Make a dataset: draw, simulate, check, shard, merge. Resumable, and the same for any number of workers."""

import platform
import shutil
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.file import open_file, read_metadata, read_splits, read_trajectory
from m3gn_bench.datasets.schema import (
    DATASET_SEED,
    LARGEST_SEED,
    SPLITS,
    Fidelity,
    Metadata,
    Rejection,
    Split,
    as_split,
    tier_sizes,
    trajectory_key,
)
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.datasets.validator import content_problems
from m3gn_bench.datasets.writer import merge_shards, reserved, write_shard
from m3gn_bench.generators.errors import GeneratorError, SolverError
from m3gn_bench.generators.executors import parse_executor
from m3gn_bench.generators.scene import Scene, SimulatesTogether
from m3gn_bench.generators.workers import run_jobs
from m3gn_bench.provenance import machine
from m3gn_bench.version import __version__

MAX_ATTEMPTS = 10


@dataclass(frozen=True)
class GenerationReport:
    """What `generate` made."""

    file: Path
    content_hash: str
    trajectories: int
    rejected: list[Rejection]
    cpu_seconds_per_trajectory: float
    generated: int  # now; the others were found from an earlier run


def draw(scene: Scene, split: Split, index: int, seed: int, attempt: int = 0) -> object:
    """Parameters of trajectory `index` of a split: the same whatever else is made, by whom, in what order."""
    entropy = [seed, zlib.crc32(scene.name.encode()), SPLITS.index(split), index]
    if attempt:
        entropy.append(attempt)
    return scene.sample(np.random.default_rng(np.random.SeedSequence(entropy)), index)


def simulate_one(
    scene: Scene, split: Split, index: int, *, seed: int = DATASET_SEED, fidelity: Fidelity = "default"
) -> tuple[Trajectory, list[Rejection]]:
    """Simulate one trajectory, redrawing its parameters where the solver or a check rejects them.

    Returns the trajectory (its CPU seconds among the diagnostics) and the rejected draws.

    Raises:
        GeneratorError: ten draws in a row were rejected.
    """
    (made,) = _simulate(scene, split, [index], seed, fidelity)
    return made


def _simulate(
    scene: Scene, split: Split, indices: Sequence[int], seed: int, fidelity: Fidelity
) -> list[tuple[Trajectory, list[Rejection]]]:
    """See `simulate_one`; at once, where the scene can do several."""
    made: dict[int, Trajectory] = {}
    rejected: dict[int, list[Rejection]] = {index: [] for index in indices}
    for attempt in range(MAX_ATTEMPTS):
        missing = [index for index in indices if index not in made]
        if not missing:
            break
        start = time.process_time()
        # One thread: the order of floating-point sums must not depend on the machine's core count.
        with threadpool_limits(1):
            draws = [draw(scene, split, index, seed, attempt) for index in missing]
            outcomes = _outcomes(scene, draws, fidelity)
        problems = [
            [str(outcome)] if isinstance(outcome, SolverError) else scene.check(outcome)
            for outcome in outcomes
        ]
        seconds = (time.process_time() - start) / len(missing)
        for index, outcome, found in zip(missing, outcomes, problems, strict=True):
            if isinstance(outcome, SolverError) or found:
                key = trajectory_key(split, index)
                rejected[index].append(Rejection(key=key, attempt=attempt, reason="; ".join(found)))
            else:
                diagnostics = {**outcome.diagnostics, "cpu_seconds": seconds}
                made[index] = replace(outcome, diagnostics=diagnostics)
    for index in indices:
        if index not in made:
            raise GeneratorError(
                f"{trajectory_key(split, index)}: all {MAX_ATTEMPTS} draws were rejected, the last because "
                f"{rejected[index][-1].reason}"
            )
    return [(made[index], rejected[index]) for index in indices]


def _outcomes(
    scene: Scene, draws: Sequence[object], fidelity: Fidelity
) -> Sequence[Trajectory | SolverError]:
    if isinstance(scene, SimulatesTogether):
        return scene.simulate_together(draws, scene.fidelities[fidelity])
    outcomes: list[Trajectory | SolverError] = []
    for parameters in draws:
        try:
            outcomes.append(scene.simulate(parameters, fidelity))
        except SolverError as error:
            outcomes.append(error)
    return outcomes


def dataset_name(scene: Scene, tier: str, splits: Sequence[str], fidelity: str, seed: int) -> str:
    """File name of a dataset: whatever is not the default is part of it."""
    parts = [scene.name, tier, *scene.variant.values()]
    if set(splits) != set(SPLITS):
        parts += [split for split in SPLITS if split in splits]
    if fidelity != "default":
        parts.append(fidelity)
    if seed != DATASET_SEED:
        parts.append(f"seed{seed}")
    return "-".join(parts) + ".h5"


def generate(
    scene: Scene,
    tier: str,
    out: Path,
    *,
    workers: int = 1,
    splits: Sequence[Split] = SPLITS,
    fidelity: Fidelity = "default",
    seed: int = DATASET_SEED,
    executor: str = "process",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> GenerationReport:
    """Generate a dataset file, or complete one that an earlier run left unfinished.

    Args:
        scene: which scene, with its options; it is sent to the workers as it is.
        tier: "smoke", "quick" or "paper"; smaller tiers are prefixes of larger ones.
        out: folder for the file and, until it is complete, for its shards.
        workers: processes; see `run_jobs`.
        splits: which splits to make.
        fidelity: "fast", "default" or "reference".
        seed: of the dataset; leaderboards use the default.
        executor: what runs the workers; see `run_jobs`. With a cluster, `out` must be a folder that all workers see.
        on_progress: called with (done, total) at first, and whenever some are done.

    Raises:
        GeneratorError: unknown names, a trajectory that cannot be made, or one that the validator would find fault
            with, or a cluster that cannot be used.
        DatasetError: no such split or tier; the folder cannot be written.
    """
    if fidelity not in scene.fidelities:
        raise GeneratorError(unknown_name("fidelity", fidelity, list(scene.fidelities)))
    if workers < 1:
        raise GeneratorError(f"workers must be at least 1, not {workers}")
    if not 0 <= seed <= LARGEST_SEED:
        raise GeneratorError(f"the seed must be between 0 and {LARGEST_SEED}, which {seed} is not")
    parse_executor(executor)
    if not splits:
        raise GeneratorError("there is no split to make")
    splits = [as_split(split) for split in splits]
    sizes = tier_sizes(tier, scene.paper_sizes)
    metadata = _metadata(scene, tier, fidelity, seed)
    path = out / dataset_name(scene, tier, splits, fidelity, seed)
    shard_folder = out / f".{'-'.join([scene.name, *scene.variant.values(), fidelity])}-seed{seed}.shards"
    wanted: dict[str, tuple[Split, int]] = {
        trajectory_key(split, i): (split, i)
        for split in SPLITS
        if split in splits
        for i in range(sizes[split])
    }
    shards = {key: _shard(shard_folder, key) for key in wanted}
    together = scene.together if isinstance(scene, SimulatesTogether) else 1
    with reserved(shard_folder, "generates this dataset", out):
        for left_by_killed_run in out.glob(f".{path.name}.*.tmp"):
            left_by_killed_run.unlink()
        todo: list[str] = []
        if not _is_dataset(path, list(wanted), metadata):
            todo = [key for key in wanted if not _is_complete(shards[key], [key], metadata)]
            done = len(wanted) - len(todo)
            on_progress(done, len(wanted))
            folder = shard_folder.absolute()  # workers of a cluster start in folders of their own
            missing: dict[Split, list[int]] = {split: [] for split in SPLITS}
            for split, index in (wanted[key] for key in todo):
                missing[split].append(index)
            jobs = (
                _Job(scene, folder, split, indices[first : first + together], metadata)
                for split, indices in missing.items()
                for first in range(0, len(indices), together)
            )
            with closing(  # so that an exception here ends the workers, too
                run_jobs(_make_shards, jobs, workers, executor=executor, shared=shard_folder)
            ) as finished:
                for made_now in finished:
                    done += made_now
                    on_progress(done, len(wanted))
            merge_shards(path, shards, metadata, scene.tasks_of)
        with open_file(path) as file:
            made = read_metadata(file)
            seconds = [float(file["trajectories"][key]["diagnostics"].attrs["cpu_seconds"]) for key in wanted]
        others = set(shard_folder.glob("*.h5")) - set(shards.values())
        if not others:  # else a larger tier was interrupted, and may go on
            shutil.rmtree(shard_folder, ignore_errors=True)  # somebody else may just look for the lock
    return GenerationReport(
        path, made.content_hash, len(wanted), list(made.rejections), float(np.mean(seconds)), len(todo)
    )


def _metadata(scene: Scene, tier: str, fidelity: Fidelity, seed: int) -> Metadata:
    return Metadata(
        scene=scene.name,
        dataset_version=scene.dataset_version,
        tier=tier,  # type: ignore[arg-type]
        paper_sizes=scene.paper_sizes,
        generator_version=__version__,
        simulator_versions=scene.simulator_versions(),
        fidelity=fidelity,
        variant=scene.variant,
        seed=seed,
        dt=scene.dt,
        time_unit=scene.time_unit,
        length_unit=scene.length_unit,
        material_units=scene.material_units,
        load_units=scene.load_units,
        frames=scene.frames,
        scale_centre=scene.scale_centre,
        scale_length=scene.scale_length,
        machine=machine(),
    )


def _is_dataset(path: Path, keys: Sequence[str], metadata: Metadata) -> bool:
    """Whether a whole dataset of an earlier run of this generator holds these, and lists them in its splits."""
    if not _is_complete(path, keys, metadata):
        return False
    try:
        with open_file(path) as file:
            tasks = read_splits(file)
    except DatasetError:
        return False
    return set(keys) == {key for splits in tasks.values() for listed in splits.values() for key in listed}


def _is_complete(path: Path, keys: Sequence[str], metadata: Metadata) -> bool:
    """Whether a file (a shard, or a whole dataset) of an earlier run of this generator holds these, whole."""
    if not path.is_file():
        return False
    try:
        with open_file(path) as file:
            found = read_metadata(file)
            for key in keys:
                read_trajectory(file, key)
    except DatasetError:
        return False
    own = {"tier", "content_hash", "rejections", "machine"}
    return found.model_dump(exclude=own) == metadata.model_dump(exclude=own)


@dataclass(frozen=True)
class _Job:
    """Trajectories of a split that one worker makes at once."""

    scene: Scene
    folder: Path
    split: Split
    indices: list[int]
    metadata: Metadata


def _make_shards(job: _Job) -> int:
    """Writes a file for each trajectory; returns how many there are."""
    metadata = job.metadata
    keys = {index: trajectory_key(job.split, index) for index in job.indices}
    # A worker that died later may have come so far.
    missing = [
        index for index, key in keys.items() if not _is_complete(_shard(job.folder, key), [key], metadata)
    ]
    versions = job.scene.simulator_versions()
    if versions != metadata.simulator_versions:
        raise GeneratorError(
            f"{platform.node()} would simulate with {versions}, not with {metadata.simulator_versions}; install the "
            "same on all machines"
        )
    made = _simulate(job.scene, job.split, missing, metadata.seed, metadata.fidelity)
    for index, (trajectory, rejected) in zip(missing, made, strict=True):
        for problem in content_problems(trajectory, metadata, keys[index]):
            raise GeneratorError(
                f"scene {job.scene.name} is not what it says: {problem.where}: {problem.message}"
            )
        own = metadata.model_copy(update={"rejections": tuple(rejected)})
        write_shard(_shard(job.folder, keys[index]), keys[index], trajectory, own)
    return len(keys)


def _shard(folder: Path, key: str) -> Path:
    return folder / f"{key}.h5"
