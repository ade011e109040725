"""Records of the same run with several seeds, put together: what tables, figures and claims are made from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.metrics import bootstrap_means
from m3gn_bench.tasks import TASKS

SOME = ", some materials"  # after the name of a task
SEEDS = 3  # fewer say too little of what another seed would give


@dataclass(frozen=True)
class Estimate:
    """A mean error with its 95 % interval over seeds and trajectories."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Entry:
    """One row of a board: a model (and what is special about it) on a task, over all its seeds.

    Attributes:
        records: one per seed, all on the same trajectories.
        keys: the trajectories that count; all if None.
    """

    records: tuple[ResultRecord, ...]
    keys: tuple[str, ...] | None = None

    def restricted_to(self, keys: tuple[str, ...]) -> "Entry":
        """The same with only these trajectories."""
        return Entry(self.records, keys)

    @property
    def label(self) -> str:
        """The model, and the variant if there is one."""
        first = self.records[0]
        return f"{first.model} ({first.variant})" if first.variant else first.model

    @property
    def seeds(self) -> int:
        """Number of seeds."""
        return len(self.records)

    @property
    def has_enough_seeds(self) -> bool:
        """Whether it can be compared with other rows; what does not learn is the same for every seed."""
        return self.seeds >= SEEDS or self.training_steps == 0

    @property
    def parameters(self) -> int:
        """Number of trainable parameters."""
        return self.records[0].parameters

    @property
    def training_steps(self) -> float:
        """Mean number over seeds."""
        return float(np.mean([record.checkpoint.steps for record in self.records]))

    @property
    def training_device(self) -> str:
        """What `training_minutes` are of: the CPU if any seed was trained there."""
        devices = {record.checkpoint.device for record in self.records}
        return "cpu" if "cpu" in devices else min(devices)

    @property
    def training_minutes(self) -> float:
        """Mean number over the seeds that were trained on `training_device`."""
        trained = [record.checkpoint for record in self.records]
        return float(np.mean([one.minutes for one in trained if one.device == self.training_device]))

    @property
    def seconds_per_prediction(self) -> dict[str, float]:
        """Wall time of one prediction in batches by machine, mean over contexts, of one thread of a CPU.

        The least of a machine's seeds: other work only adds.
        """
        found: dict[str, float] = {}
        for record in self.records:
            if (record.evaluation_device, record.evaluation_threads) == ("cpu", 1):
                seconds = record.evaluation_seconds / (len(record.keys) * len(self.contexts))
                found[record.machine] = min(seconds, found.get(record.machine, seconds))
        return found

    @cached_property
    def contexts(self) -> tuple[int, ...]:
        """Context sizes, ascending."""
        return tuple(sorted(result.context for result in self.records[0].results))

    def errors(self, context: int, free_nodes: bool = False) -> np.ndarray:
        """Errors of every seed and trajectory, shape [seeds, trajectories]."""
        found = [record.result(context) for record in self.records]
        errors = np.array(
            [r.trajectory_mse_free_nodes if free_nodes else r.trajectory_mse for r in found if r is not None]
        )
        if self.keys is None:
            return errors
        place = {key: number for number, key in enumerate(self.records[0].keys)}
        return errors[:, [place[key] for key in self.keys]]

    def estimate(self, context: int) -> Estimate:
        """Mean error at a context size and its interval."""
        errors = self.errors(context)
        low, high = np.percentile(bootstrap_means([errors]), [2.5, 97.5])
        return Estimate(float(errors.mean()), float(low), float(high))

    def per_timestep(self, context: int) -> np.ndarray:
        """Mean error of every frame after the anchor, shape [horizon]."""
        found = [record.result(context) for record in self.records]
        return np.mean([r.per_timestep_mse for r in found if r is not None], axis=0)


def probability_of_less(
    first: Entry, second: Entry, context: int, second_context: int | None = None, margin: float = 0.0
) -> float:
    """Probability that the first has the lower mean error, over resampled seeds and common trajectories.

    Args:
        first, second: two rows.
        context: number of context frames.
        second_context: of the second row, if another.
        margin: by which share of the second's error the first may exceed it.

    Raises:
        ValueError: they were not scored on the same trajectories.
    """
    if (first.keys or first.records[0].keys) != (second.keys or second.records[0].keys):
        raise ValueError(f"{first.label} and {second.label} were scored on different trajectories")
    ours, theirs = bootstrap_means(
        [first.errors(context), (1 + margin) * second.errors(second_context or context)],
        same_runs=first.records == second.records,
    )
    return float(np.mean(ours < theirs) + 0.5 * np.mean(ours == theirs))


def probability_below(row: Entry, yardstick: Entry | None, context: int) -> float | None:
    """`probability_of_less` against the row that others are measured by; None where that cannot be said."""
    if yardstick is None or yardstick is row or context not in yardstick.contexts:
        return None
    if yardstick.records[0].keys != row.records[0].keys:
        return None
    if not (yardstick.has_enough_seeds and row.has_enough_seeds):
        return None
    return probability_of_less(row, yardstick, context)


def entries(records: Sequence[ResultRecord], track: str, task: str) -> list[Entry]:
    """The rows of a board, best error at the middle context size first.

    Like is compared with like: of records on several versions of the data only those on the latest count.

    Raises:
        BenchError: records are of different tiers, splits or presets, or those of a row do not belong together.
    """
    board = [record for record in records if (record.track, record.task) == (track, task)]
    latest = max((_number(record) for record in board), default=())
    groups: dict[tuple[str, str], list[ResultRecord]] = {}
    for record in board:
        if (record.tier, record.split) != (board[0].tier, board[0].split):
            raise BenchError(
                f"{track}/{task}: {record.name} was scored on {record.split} trajectories of tier {record.tier}, but "
                f"{board[0].name} on {board[0].split} trajectories of tier {board[0].tier}; use another track"
            )
        if record.preset != board[0].preset:
            raise BenchError(
                f"{track}/{task}: {record.name} is of preset {record.preset}, but {board[0].name} of preset "
                f"{board[0].preset}; use another track"
            )
        if _number(record) == latest:
            row = groups.setdefault((record.model, record.variant), [])
            if row and _belongs(record) != _belongs(row[0]):
                raise BenchError(
                    f"{track}/{task}: {record.name} has other trajectories or settings than {row[0].name}; make the "
                    "older one again, or name what differs by a variant"
                )
            row.append(record)
    found = [Entry(tuple(sorted(group, key=lambda r: r.seed))) for group in groups.values()]
    return sorted(found, key=lambda entry: float(entry.errors(middle(entry.contexts)).mean()))


def by_materials(rows: Sequence[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Rows of all trajectories, and of some materials only, whose errors cannot be compared with the others."""
    some = [row for row in rows if row.records[0].materials]
    return [row for row in rows if row not in some], some


def _belongs(record: ResultRecord) -> tuple[object, ...]:
    """What is the same for all seeds of a row."""
    return record.keys, record.materials, record.checkpoint.config


def _number(record: ResultRecord) -> tuple[tuple[int, str], ...]:
    """The dataset's version as something that has an order; words come before numbers, as pre-releases do."""
    parts = record.dataset_version.split(".")
    return tuple((int(part), "") if part.isdecimal() else (-1, part) for part in parts)


def titles(records: Sequence[ResultRecord]) -> dict[str, str]:
    """Titles of all tasks by name; one that only records know (its package is not here) has its name for a title."""
    known = {name: task.title for name, task in TASKS.items()}
    return known | {record.task: record.task for record in records if record.task not in known}


def middle(contexts: Sequence[int]) -> int:
    """The middle one of some context sizes."""
    return sorted(contexts)[len(contexts) // 2]
