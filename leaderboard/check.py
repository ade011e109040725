"""Re-derive recorded numbers from nothing: simulate test trajectories, run the shipped checkpoint, compare."""

from collections.abc import Callable, Sequence

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.datasets.schema import Record
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.leaderboard.record import HASH_DIGITS, ResultRecord, checkpoint_folder
from m3gn_bench.sources import regenerate
from m3gn_bench.tasks import get_task

RELATIVE_TOLERANCE = 1e-3  # other processors round differently; a wrong model or generator is far off


class Comparison(Record):
    """One trajectory of one record at one context size."""

    task: str
    model: str
    preset: str
    seed: int
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


def check_records(
    records: Sequence[ResultRecord],
    *,
    trajectories: int,
    offset: int,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> CheckReport:
    """Re-derive the errors of some trajectories of every record that has a checkpoint.

    Args:
        records: what to check.
        trajectories: how many per record.
        offset: shifts which ones, so that repeated checks cover all.
        on_progress: called with (done, total) after every record.
    """
    compared: list[Comparison] = []
    problems: list[str] = [] if records else ["there are no records"]
    for done, record in enumerate(records, 1):
        where = f"{record.task}/{record.name}"
        folder = checkpoint_folder(record.task, record.model, record.preset, record.seed)
        if not folder.is_dir():
            problems.append(f"{where}: its checkpoint does not ship with the project")
            continue
        model, description = load_checkpoint(folder)
        if model.parameter_count() != record.parameters:
            problems.append(
                f"{where}: the model has {model.parameter_count()} parameters, not {record.parameters}"
            )
        if description != record.checkpoint:
            problems.append(f"{where}: the shipped checkpoint is not the one that was recorded")
            continue
        count = min(trajectories, len(record.keys))
        chosen = sorted({(offset * count + i) % len(record.keys) for i in range(count)})
        cases, hashes = regenerate(get_task(record.task), [record.keys[i] for i in chosen])
        contexts = [result.context for result in record.results]
        errors = evaluate_model(model, cases, contexts)
        for result in record.results:
            for place, index in enumerate(chosen):
                recorded = result.trajectory_mse[index]
                rederived = float(errors[result.context].mse[place])
                recorded_free = result.trajectory_mse_free_nodes[index]
                rederived_free = float(errors[result.context].mse_free_nodes[place])
                difference = max(
                    abs(rederived - recorded) / recorded, abs(rederived_free - recorded_free) / recorded_free
                )
                compared.append(
                    Comparison(
                        task=record.task,
                        model=record.model,
                        preset=record.preset,
                        seed=record.seed,
                        context=result.context,
                        trajectory=record.keys[index],
                        recorded=recorded,
                        rederived=rederived,
                        relative_difference=difference,
                        same_trajectory=hashes[place][:HASH_DIGITS] == record.trajectory_hashes[index],
                        ok=difference <= RELATIVE_TOLERANCE,
                    )
                )
        on_progress(done, len(records))
    ok = not problems and all(comparison.ok for comparison in compared)
    return CheckReport(ok=ok, compared=tuple(compared), problems=tuple(problems))
