"""Figures of the leaderboard, from the records alone: errors over the context and over time."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.leaderboard.summary import Entry, entries, middle, titles

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A model has the same colour and mark in every figure.
STYLES = {
    "m3gn": ("C0", "o"),
    "m3gn_replan": ("C9", "D"),
    "mgn": ("C3", "s"),
    "mgn_material": ("C1", "P"),
    "mango": ("C2", "^"),
    "egno": ("C4", "v"),
    "mgn_mp": ("C5", "X"),
    "stand_still": ("0.6", "."),
    "nearest_neighbour": ("0.3", "."),
    "scaled_velocity": ("k", "."),
}


def draw_board(records: Sequence[ResultRecord], track: str, task: str) -> "Figure | None":
    """Error over the number of context frames, and over time at the middle one; None if there is nothing to show.

    Bars are 95 % intervals over seeds and trajectories; models without a style of their own are left out.
    """
    from matplotlib.figure import Figure

    rows = [row for row in entries(records, track, task) if row.label in STYLES]
    if not rows:
        return None
    figure = Figure(figsize=(11, 4), layout="constrained")
    over_context, over_time = figure.subplots(1, 2)
    at = middle(rows[0].contexts)
    for row in rows:
        colour, mark = STYLES[row.label]
        _error_over_context(over_context, row, colour, mark)
        error = row.per_timestep(at)
        over_time.plot(np.arange(at, at + len(error)), error, color=colour, label=row.label)
    over_context.set(
        yscale="log",
        xlabel="context frames",
        ylabel="full-rollout MSE",
        xticks=rows[0].contexts,
        title=titles(records)[task],
    )
    over_time.set(yscale="log", xlabel="frame", ylabel="MSE of the frame", title=f"after {at} context frames")
    figure.legend(*over_context.get_legend_handles_labels(), fontsize=8, loc="outside right center")
    for axes in (over_context, over_time):
        axes.grid(alpha=0.3)
    return figure


def _error_over_context(axes: object, row: Entry, colour: str, mark: str) -> None:
    found = [row.estimate(context) for context in row.contexts]
    means = np.array([e.mean for e in found])
    bars = np.array([[e.mean - e.low for e in found], [e.high - e.mean for e in found]])
    axes.errorbar(  # type: ignore[attr-defined]
        row.contexts, means, bars, color=colour, marker=mark, markersize=5, capsize=3, label=row.label
    )
