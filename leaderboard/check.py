"""Re-derive recorded numbers from nothing: simulate, run the shipped checkpoint or train again, compare."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.datasets.schema import Record
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.leaderboard.campaign import Outcome
from m3gn_bench.leaderboard.consistency import contradictions
from m3gn_bench.leaderboard.record import HASH_DIGITS, HOME, ResultRecord, checkpoint_folder, find_record
from m3gn_bench.sources import regenerate
from m3gn_bench.tasks import get_task

Kind = Literal["shipped checkpoint", "trained again"]
# Other processors round differently: predictions by 1e-6, and training, which magnifies that, by up to 1e-3 (measured
# with and without the processor's vector instructions, 30 steps). A wrong model or generator is far off.
TOLERANCES: dict[Kind, float] = {"shipped checkpoint": 1e-3, "trained again": 5e-3}


class Comparison(Record):
    """One trajectory of one record at one context size."""

    kind: Kind
    track: str
    task: str
    run: str
    context: int
    trajectory: str
    recorded: float
    rederived: float
    relative_difference: float  # the larger one of all nodes and of free nodes
    same_trajectory: bool  # bit for bit
    ok: bool


class CheckReport(Record):
    """All comparisons and what could not be compared."""

    ok: bool
    compared: tuple[Comparison, ...]
    problems: tuple[str, ...]

    @classmethod
    def of(cls, compared: Sequence[Comparison], problems: Sequence[str]) -> "CheckReport":
        """Nothing is wrong if there is something to compare, no problem, and no difference."""
        ok = bool(compared) and not problems and all(comparison.ok for comparison in compared)
        return cls(ok=ok, compared=tuple(compared), problems=tuple(problems))


def sample(records: Sequence[ResultRecord], count: int, offset: int) -> tuple[list[ResultRecord], int]:
    """So many records from all over the board, others for every offset; and how often all had their turn before.

    With that number for an offset of `check_records`, repeated checks cover all trajectories of all records.
    """
    turns = max(1, -(-len(records) // count))
    return list(records[offset % turns :: turns]), offset // turns


def chosen(number: int, count: int, offset: int) -> list[int]:
    """So many of a number of trajectories, others for every offset, until all had their turn."""
    count = min(count, number)
    return sorted({(offset * count + place) % number for place in range(count)})


def check_records(
    records: Sequence[ResultRecord],
    *,
    trajectories: int,
    offset: int,
    home: Path = HOME,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> CheckReport:
    """Re-derive the errors of some trajectories of records whose checkpoints ship with the leaderboard.

    Args:
        records: what to check.
        trajectories: how many per record.
        offset: which ones, see `chosen`.
        home: the leaderboard's folder, with the checkpoints.
        on_progress: called with (done, total) after every record.
    """
    compared: list[Comparison] = []
    problems: list[str] = []
    for done, record in enumerate(records, 1):
        where = f"{record.task}/{record.name}"
        folder = checkpoint_folder(record.task, record.model, record.preset, record.seed, home)
        if not folder.is_dir():
            problems.append(f"{where}: its checkpoint does not ship: there is no {folder}")
            continue
        try:
            model, description = load_checkpoint(folder)
        except BenchError as error:
            problems.append(f"{where}: {error}")
            continue
        if description != record.checkpoint:
            problems.append(f"{where}: the shipped checkpoint is not the one that was recorded")
            continue
        places = chosen(len(record.keys), trajectories, offset)
        cases, hashes = regenerate(get_task(record.task), [record.keys[place] for place in places])
        errors = evaluate_model(model, cases, [result.context for result in record.results])
        for result in record.results:
            found = errors[result.context]
            compared += [
                _comparison(
                    "shipped checkpoint",
                    record,
                    result.context,
                    index,
                    (float(found.mse[row]), float(found.mse_free_nodes[row])),
                    hashes[row][:HASH_DIGITS],
                )
                for row, index in enumerate(places)
            ]
        on_progress(done, len(records))
    return CheckReport.of(compared, problems)


def check_statements(records: Sequence[ResultRecord]) -> list[str]:
    """What records say of themselves that is not so, whether or not their numbers can be re-derived."""
    return [
        f"{record.track}: {record.task}/{record.name}: {problem}"
        for record in records
        for problem in contradictions(record)
    ]


def compare_with_retrained(records: Sequence[ResultRecord], again: Sequence[Outcome]) -> CheckReport:
    """Compare the records of some runs with what came of the same runs just now."""
    compared: list[Comparison] = []
    problems: list[str] = []
    for outcome in again:
        run, new = outcome.run, outcome.record
        where = f"{run.task}/{run.name}"
        record = find_record(records, run.track, run.task, run.name)
        if record is None:
            problems.append(f"{where}: it is planned, but there is no record of it")
            continue
        if new is None:
            problems.append(f"{where}: training again failed: {outcome.error}")
            continue
        stated = {result.context: result for result in record.results}
        if (new.keys, new.parameters) != (record.keys, record.parameters) or stated.keys() != {
            result.context for result in new.results
        }:
            problems.append(f"{where}: its trajectories, contexts or parameters are not those on record")
            continue
        for result in new.results:
            errors = zip(result.trajectory_mse, result.trajectory_mse_free_nodes, strict=True)
            compared += [
                _comparison(
                    "trained again", record, result.context, index, both, new.trajectory_hashes[index]
                )
                for index, both in enumerate(errors)
            ]
            before, now = stated[result.context].per_timestep_mse, result.per_timestep_mse
            same_length = len(before) == len(now)
            if not same_length or not np.allclose(before, now, rtol=TOLERANCES["trained again"], atol=0):
                problems.append(f"{where}, context {result.context}: the error over time is another one")
    return CheckReport.of(compared, problems)


def _comparison(
    kind: Kind, record: ResultRecord, context: int, index: int, rederived: tuple[float, float], content: str
) -> Comparison:
    result = record.result(context)
    assert result is not None
    recorded = (result.trajectory_mse[index], result.trajectory_mse_free_nodes[index])
    difference = max(
        0.0 if new == old else abs(new - old) / max(new, old)
        for new, old in zip(rederived, recorded, strict=True)
    )
    return Comparison(
        kind=kind,
        track=record.track,
        task=record.task,
        run=record.name,
        context=context,
        trajectory=record.keys[index],
        recorded=recorded[0],
        rederived=rederived[0],
        relative_difference=difference,
        same_trajectory=content == record.trajectory_hashes[index],
        ok=difference <= TOLERANCES[kind],
    )
