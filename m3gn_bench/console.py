"""How the command line talks: options of many commands, tables and progress for people, one JSON object for programs.

Results go to standard output, progress and errors to standard error. Progress is off where standard error is
no terminal, and with --json.
"""

import json
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from m3gn_bench.provenance import usable_cores

JSON = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
DATA = click.option(
    "--data",
    type=click.Path(path_type=Path, file_okay=False),
    default=lambda: Path(os.environ.get("M3GN_BENCH_DATA", "data")),
    help="Folder of dataset files.  [default: $M3GN_BENCH_DATA, or ./data]",
)
WORKERS = click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=usable_cores(),
    help="Processes that simulate.  [default: all cores]",
)
EXECUTOR = click.option(
    "--executor",
    default="process",
    show_default=True,
    metavar="process|dask://HOST:PORT|slurm",
    help="What runs them: this machine, the workers of a dask scheduler (extra `dask`), or SLURM (extra `slurm`), "
    "where --workers counts jobs at a time. On a cluster all folders must be on a file system that all workers see.",
)
SEED = click.IntRange(0, 2**63 - 1)  # as datasets.schema.LARGEST_SEED, which takes long to import
DEVICE = click.option("--device", default="cpu", show_default=True, help="A torch device.")
OnProgress = Callable[[int, int], None]
WIDE = 10_000  # columns


class Report:
    """Where a command puts its result.

    Args:
        as_json: print one JSON object instead of text.
        silent: print nothing; another process does.
    """

    def __init__(self, as_json: bool, silent: bool = False) -> None:
        self.as_json = as_json
        self.silent = silent
        self.errors = Console(stderr=True)

    def finish(self, record: dict[str, object], *texts: str | Table) -> None:
        """Print the record as JSON, or else the texts and tables."""
        if self.silent:
            return
        if self.as_json:
            click.echo(json.dumps(_finite(record), indent=2, allow_nan=False))
            return
        plain: dict[str, Any] = {
            "markup": False,
            "emoji": False,
            "highlight": False,
        }  # units in brackets are no markup
        # Tables are as wide as they need to be, whatever the terminal is: rich would make room by leaving out digits.
        whole = Console(width=WIDE, soft_wrap=True, **plain)
        sentences = Console(**plain) if sys.stdout.isatty() else whole
        for text in texts:
            (whole if isinstance(text, Table) else sentences).print(text)

    @contextmanager
    def progress(self, description: str) -> Iterator[OnProgress]:
        """A progress bar, as a function of (done, total)."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        shown = self.errors.is_terminal and not self.as_json and not self.silent
        with Progress(*columns, console=self.errors, disable=not shown, transient=True) as bar:
            task = bar.add_task(description, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)


def _finite(value: object) -> object:
    """The same with null for NaN and infinity, which JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return value


def table(title: str, columns: list[str], rows: list[list[object]]) -> Table:
    """A rich table; all columns but the first are right-aligned numbers."""
    result = Table(title=title, title_justify="left")
    for number, column in enumerate(columns):
        result.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        result.add_row(*("" if value is None else str(value) for value in row))
    return result
