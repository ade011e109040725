"""The commands of the leaderboard; part of the command line (see `cli`)."""

import os
import sys
from datetime import date
from pathlib import Path

import click

from m3gn_bench.console import JSON, Report, table


@click.group()
def leaderboard() -> None:
    """Show the leaderboard, make its tables, re-derive its numbers."""


@leaderboard.command()
@click.option("--task", "task_name", default=None, help="Only this task.")
@JSON
def show(task_name: str | None, as_json: bool) -> None:
    """All result records."""
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.tasks import get_task

    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records() if task_name in (None, r.task)]
    rows: list[list[object]] = [
        [
            r.task,
            r.model,
            r.preset,
            r.seed,
            result.context,
            f"{result.mse * 1e6:.4g}",
            f"{result.mse_free_nodes * 1e6:.4g}",
        ]
        for r in records
        for result in r.results
    ]
    Report(as_json).finish(
        {"records": [record.model_dump(mode="json") for record in records]},
        table(
            "Full-rollout MSE x 1e6",
            ["task", "model", "preset", "seed", "context", "mse", "free nodes"],
            rows,
        ),
    )


@leaderboard.command()
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="[default: the project's own]",
)
@click.option("--check", is_flag=True, help="Write nothing; exit code 1 if the page is out of date.")
@JSON
def render(output: Path | None, check: bool, as_json: bool) -> None:
    """Make the Markdown tables from the records."""
    from m3gn_bench.datasets.writer import write_bytes_atomically
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.leaderboard.render import TABLE
    from m3gn_bench.leaderboard.render import render as render_page

    path = output or TABLE
    records = read_records()
    content = render_page(records).encode()
    current = path.is_file() and path.read_bytes() == content
    if not check:
        write_bytes_atomically(path, content)
    verdict = ("up to date" if current else "OUT OF DATE") if check else "written"
    Report(as_json).finish(
        {"file": str(path), "records": len(records), "up_to_date": current or not check},
        f"{path}: {verdict}, {len(records)} records",
    )
    sys.exit(1 if check and not current else 0)


@leaderboard.command("check")
@click.option("--task", "task_name", default=None, help="Only this task.")
@click.option("--trajectories", type=click.IntRange(min=1), default=3, show_default=True, help="Per record.")
@click.option("--offset", type=int, default=None, help="Which of them.  [default: changes from day to day]")
@JSON
def check_command(task_name: str | None, trajectories: int, offset: int | None, as_json: bool) -> None:
    """Re-derive numbers from nothing and compare with the records; exit code 1 where they differ."""
    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.leaderboard.check import RELATIVE_TOLERANCE, check_records
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.tasks import get_task

    use_cpu(os.cpu_count() or 1)
    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records() if task_name in (None, r.task)]
    report = Report(as_json)
    with report.progress("re-deriving") as on_progress:
        outcome = check_records(
            records,
            trajectories=trajectories,
            offset=date.today().toordinal() if offset is None else offset,
            on_progress=on_progress,
        )
    largest = max((c.relative_difference for c in outcome.compared), default=0.0)
    identical = sum(c.same_trajectory for c in outcome.compared)
    lines = [*outcome.problems]
    lines += [
        f"{c.task}/{c.model}-{c.preset}-s{c.seed}, context {c.context}, {c.trajectory}: "
        f"recorded {c.recorded:.6g}, re-derived {c.rederived:.6g}"
        for c in outcome.compared
        if not c.ok
    ]
    lines += [
        f"{len(outcome.compared)} errors of {len(records)} records compared; largest relative difference "
        f"{largest:.1e} (allowed {RELATIVE_TOLERANCE:g}); {identical} on bit-identical trajectories",
        "every sampled number was re-derived" if outcome.ok else "the leaderboard does NOT hold",
    ]
    report.finish(outcome.model_dump(mode="json"), "\n".join(lines))
    sys.exit(0 if outcome.ok else 1)
