"""Where jobs run: which executors there are, and how results are taken from one as they come."""

from collections.abc import Callable, Generator, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from itertools import islice
from typing import Literal, TypeVar
from urllib.parse import urlsplit

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.generators.errors import GeneratorError, require_installed

Job = TypeVar("Job")
Made = TypeVar("Made")

KNOWN = ["process", "dask://HOST:PORT", "slurm"]


@dataclass(frozen=True)
class Executor:
    """What runs jobs.

    Attributes:
        kind: processes of this machine, workers of a dask scheduler, or jobs of SLURM.
        address: of dask's scheduler.
    """

    kind: Literal["process", "dask", "slurm"]
    address: str = ""


def parse_executor(text: str) -> Executor:
    """What a user calls an executor.

    Raises:
        GeneratorError: there is no such executor, or its library is not installed.
    """
    if text == "process":
        return Executor("process")
    if text == "slurm":
        require_installed("submitit", "executor slurm", "slurm")
        return Executor("slurm")
    if _is_dask_address(text):
        require_installed("distributed", "executor dask", "dask")
        return Executor("dask", text.removeprefix("dask://"))
    raise GeneratorError(unknown_name("executor", text, KNOWN))


def _is_dask_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme == "dask" and bool(parts.hostname) and parts.port is not None
    except ValueError:  # the port is no number
        return False


def as_finished(
    submit: Callable[[Job], Future[Made]],
    jobs: Iterable[Job],
    window: Callable[[], int],
    patience: float | None = None,
) -> Generator[Made]:
    """Submit jobs, never too many ahead, and give their results as they come.

    Args:
        submit: hands a job to an executor.
        jobs: what to do; read as far as jobs are submitted.
        window: how many jobs may be under way, at least 1.
        patience: ask `window` again after so many seconds [s] without a result, too.

    Raises:
        Exception: whatever a job raised, or its executor.
    """
    remaining = iter(jobs)
    pending: set[Future[Made]] = set()
    while True:
        pending.update(map(submit, islice(remaining, max(0, window() - len(pending)))))
        if not pending:
            return
        finished, pending = wait(pending, patience, FIRST_COMPLETED)
        for future in finished:
            yield future.result()
