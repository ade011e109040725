"""Score a trained model on a split: predict, measure, and put everything on record."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from m3gn_bench.checkpoint import load_checkpoint, read_description
from m3gn_bench.data import load_cases
from m3gn_bench.datasets.file import content_hash, open_file, read_metadata, stored_hashes
from m3gn_bench.datasets.schema import Split
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.leaderboard.record import HASH_DIGITS, ContextResult, ResultRecord
from m3gn_bench.provenance import commit, machine
from m3gn_bench.tasks import task_of_data
from m3gn_bench.training import usable_device
from m3gn_bench.version import __version__


def score(
    checkpoint: Path,
    dataset: Path,
    *,
    track: str,
    tier: str,
    split: Split = "test",
    contexts: Sequence[int] | None = None,
    variant: str = "",
    ships: bool = False,
    device: str = "cpu",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResultRecord:
    """The record of a checkpoint's errors on a split of the data, and there on the materials that it was trained on.

    Args:
        checkpoint: folder of a finished training run.
        dataset: file that holds the tier and split of the checkpoint's task.
        track: which board the record is for.
        tier, split: which trajectories.
        contexts: numbers of context frames; the task's own if None.
        variant: what differs from the model's preset, in a word.
        ships: whether the checkpoint is kept beside the records.
        device: of torch, that predicts.
        on_progress: called with (done, total) after every batch.

    Raises:
        CheckpointError, DatasetError: files that are damaged or do not fit.
        ConfigError: the device cannot be used.
        BenchError: predictions that are not finite.
    """
    made_by = commit()  # asked now: the checkout may change while this predicts
    with open_file(dataset) as file:
        metadata = read_metadata(file)
        dataset_hash = content_hash(file, tier, (split,))
        hashes = stored_hashes(file)
    task = task_of_data(read_description(checkpoint).task, metadata)
    model, described = load_checkpoint(checkpoint, task)
    where = usable_device(device)
    model.to(where)
    cases = [case.to(where) for case in load_cases(dataset, task, split, tier, described.materials)]
    start = time.perf_counter()
    errors = evaluate_model(model, cases, contexts or task.context_sizes, on_progress)
    seconds = time.perf_counter() - start
    keys = tuple(case.keys[0] for case in cases)
    return ResultRecord(
        track=track,
        task=task.name,
        model=described.config.model_name,
        preset=described.config.preset,
        variant=variant,
        materials=described.materials,
        seed=described.seed,
        parameters=model.parameter_count(),
        tier=tier,
        split=split,
        dataset_version=metadata.dataset_version,
        dataset_hash=dataset_hash,
        keys=keys,
        trajectory_hashes=tuple(hashes[key][:HASH_DIGITS] for key in keys),
        package_version=__version__,
        commit=made_by,
        machine=machine(),
        evaluation_device=device,
        evaluation_threads=torch.get_num_threads(),
        evaluation_seconds=seconds,
        checkpoint=described,
        ships=ships,
        results=tuple(ContextResult.from_errors(context, e) for context, e in errors.items()),
    )
