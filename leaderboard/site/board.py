"""The leaderboard's table: one row for every model, task, track and context size."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.leaderboard.render import tracks_of
from m3gn_bench.leaderboard.summary import (
    SOME,
    Entry,
    Estimate,
    by_materials,
    entries,
    probability_below,
    titles,
)

TINY = 1e-30  # an error of zero has no place on a logarithmic scale


@dataclass(frozen=True)
class Row:
    """One row of the table.

    Attributes:
        track, task, context: what was measured.
        entry: the model over its seeds.
        mse: full-rollout MSE over all nodes, scaled units.
        mse_free_nodes: mean over free nodes only.
        probability: that its mean error is lower than M3GN's; None where that cannot be said.
        places: of the interval's lower end, the mean and the upper end, on a logarithmic scale over all rows of the
            same track, task, part and context size [%].
    """

    track: str
    task: str
    context: int
    entry: Entry
    mse: Estimate
    mse_free_nodes: float
    probability: float | None
    places: tuple[float, float, float] = (50.0, 50.0, 50.0)

    @property
    def part(self) -> str:
        """What follows the task's name where trajectories are restricted to some materials."""
        return SOME if self.entry.records[0].materials else ""


@dataclass(frozen=True)
class Group:
    """What the rows of a track, task and part have in common."""

    track: str
    task: str
    part: str
    trajectories: tuple[int, ...]
    split: str
    tier: str
    versions: tuple[str, ...]


def digits(value: float) -> str:
    """A number with three digits, and never in powers of ten if it is large."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def board_rows(
    records: Sequence[ResultRecord], on_progress: Callable[[int, int], None] = lambda done, total: None
) -> list[Row]:
    """All rows: by track, task, part and context size, and the lowest error first.

    Args:
        records: what to show.
        on_progress: called with (done, total) after every track and task.
    """
    boards = [(track, task) for track in tracks_of(records) for task in titles(records)]
    result: list[Row] = []
    for done, (track, task) in enumerate(boards, 1):
        for part in by_materials(entries(records, track, task)):
            result += _ranked(track, task, part)
        on_progress(done, len(boards))
    return result


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """What trajectories the rows of every track, task and part are about."""
    found: dict[tuple[str, str, str], list[ResultRecord]] = {}
    for row in rows:
        found.setdefault((row.track, row.task, row.part), []).extend(row.entry.records)
    return [
        Group(
            track=track,
            task=task,
            part=part,
            trajectories=tuple(sorted({len(record.keys) for record in records})),
            split=records[0].split,
            tier=records[0].tier,
            versions=tuple(sorted({record.dataset_version for record in records})),
        )
        for (track, task, part), records in found.items()
    ]


def _ranked(track: str, task: str, part: Sequence[Entry]) -> list[Row]:
    """The rows of what can be compared."""
    m3gn = next((entry for entry in part if entry.label == "m3gn"), None)
    result: list[Row] = []
    for context in sorted({context for entry in part for context in entry.contexts}):
        rows = [_row(track, task, context, e, m3gn) for e in part if context in e.contexts]
        result += _placed(sorted(rows, key=lambda row: row.mse.mean))
    return result


def _row(track: str, task: str, context: int, entry: Entry, m3gn: Entry | None) -> Row:
    return Row(
        track=track,
        task=task,
        context=context,
        entry=entry,
        mse=entry.estimate(context),
        mse_free_nodes=float(entry.errors(context, free_nodes=True).mean()),
        probability=probability_below(entry, m3gn, context),
    )


def _placed(rows: Sequence[Row]) -> list[Row]:
    ends = [math.log(max(end, TINY)) for row in rows for end in (row.mse.low, row.mse.high)]
    lowest, extent = min(ends), max(ends) - min(ends)

    def place(value: float) -> float:
        return 50.0 if extent == 0 else 100 * (math.log(max(value, TINY)) - lowest) / extent

    return [
        Row(**{**vars(row), "places": (place(row.mse.low), place(row.mse.mean), place(row.mse.high))})
        for row in rows
    ]
