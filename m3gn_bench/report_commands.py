"""The command that makes a web site of the records; part of the command line (see `cli`)."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import click

from m3gn_bench.console import DATA, JSON, WORKERS, Report

if TYPE_CHECKING:
    from m3gn_bench.leaderboard.record import ResultRecord
    from m3gn_bench.leaderboard.site.rollouts import Rollouts

STUDIES = Path("docs/studies")


@click.command("report")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder of the site; its start is index.html.",
)
@click.option(
    "--home",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=None,
    help="A leaderboard's folder.  [default: the project's own]",
)
@click.option(
    "--studies",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=None,
    help=f"Records of tradeoff and stability.  [default: {STUDIES}, where it exists]",
)
@click.option(
    "--tier", default="quick", show_default=True, help="Test trajectories that rollouts are chosen from."
)
@click.option(
    "--rollouts/--no-rollouts", "with_rollouts", default=True, help="Whether to let the models predict."
)
@WORKERS
@DATA
@JSON
def report_command(
    output: Path,
    home: Path | None,
    studies: Path | None,
    tier: str,
    with_rollouts: bool,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Make a web site of all records: tables, figures, findings, cards, and rollouts to look at in 3-D.

    It needs no server, and loads nothing from elsewhere: open index.html. Test trajectories are simulated first if they
    are not there yet. Needs the extra `report`.
    """
    require_extra()
    from m3gn_bench.datasets.schema import tier_sizes
    from m3gn_bench.leaderboard.record import HOME, read_records
    from m3gn_bench.leaderboard.site.build import build
    from m3gn_bench.study_page import read_records as read_studies

    tier_sizes(tier, {})  # says which tiers there are, before anything is done
    report = Report(as_json)
    home = home or HOME
    records = read_records(home)
    tradeoffs, stabilities = read_studies(studies or STUDIES)
    studied = len(tradeoffs) + len(stabilities)
    rollouts, left_out = (
        _rollouts(report, records, home, tier, data, workers) if with_rollouts else (None, [])
    )
    with report.progress("making pages") as on_progress:
        files = build(output, records, (tradeoffs, stabilities), rollouts, on_progress)
    size = sum(path.stat().st_size for path in files)
    shown = [] if rollouts is None else rollouts
    notes = [*left_out, *(note for one in shown for note in one.notes)]
    report.finish(
        {
            "start": str(output / "index.html"),
            "files": [str(path) for path in files],
            "bytes": size,
            "records": len(records),
            "studies": studied,
            "rollouts": {
                one.task.name: {
                    "models": list(one.models.values()),
                    "trajectories": [script.name for script in one.scripts],
                }
                for one in shown
            },
            "notes": notes,
        },
        *(f"note: {note}" for note in notes),
        f"{output / 'index.html'}: {len(files)} files, {size / 1e6:.1f} MB, of {len(records)} records and "
        f"{studied} studies; rollouts of {len(shown)} tasks",
    )


def require_extra() -> None:
    """Raise ConfigError, naming the extra to install, unless all libraries that pages are made with are there."""
    from m3gn_bench.errors import ConfigError

    try:
        for library in ("jinja2", "markdown_it", "matplotlib", "adjustText"):
            import_module(library)
    except ImportError as error:
        raise ConfigError(
            f"a report needs jinja2, markdown-it-py, matplotlib and adjustText ({error}); "
            "pip install 'm3gn-bench[report]'"
        ) from error


def _rollouts(
    report: Report, records: "list[ResultRecord]", home: Path, tier: str, data: Path, workers: int
) -> "tuple[list[Rollouts], list[str]]":
    """Rollouts of every task that has checkpoints which ship, and why others are left out."""
    from m3gn_bench.leaderboard.site.rollouts import roll_out, runnable
    from m3gn_bench.sources import find_or_generate, usable_tasks

    made: list[Rollouts] = []
    left_out: list[str] = []
    for task, scene in usable_tasks():
        models, reasons = runnable(records, task, scene.dataset_version, home)
        left_out += reasons
        if not models:
            continue
        with report.progress(f"simulating {task.scene}") as on_progress:
            path = find_or_generate(
                task, tier, data, splits=("test",), workers=workers, on_progress=on_progress
            )
        with report.progress(f"predicting {task.name}") as on_progress:
            made.append(roll_out(models, task, path, tier, on_progress))
    return made, left_out
