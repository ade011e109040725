"""Run independent jobs in several processes: here, where they end with this one however it ends, or on a cluster."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

from m3gn_bench.generators.errors import GeneratorError
from m3gn_bench.generators.executors import Job, Made, as_finished, parse_executor


def run_jobs(
    function: Callable[[Job], Made],
    jobs: Iterable[Job],
    workers: int,
    *,
    executor: str = "process",
    shared: Path | None = None,
) -> Generator[Made]:
    """Results of the function for all jobs, as they finish; a failure or an interrupt stops the rest at once.

    Close the generator where it may not be exhausted, so that the workers end, too.

    Args:
        function, jobs: of a module, and what pickle can send, unless one process does it all: that is this one. On a
            cluster a job is run again if its worker dies, so it must not mind what it did before.
        workers: number of processes; with "slurm", of jobs at a time; with dask the cluster decides.
        executor: "process", "dask://HOST:PORT" or "slurm".
        shared: a folder that all workers of a cluster must see, as everything that jobs read or write.

    Raises:
        GeneratorError: unknown executor, no cluster there, a worker that does not fit, or died (on a cluster: again
            and again).
    """
    where = parse_executor(executor)
    if where.kind == "process":
        return _run_here(function, jobs, workers)
    from m3gn_bench.generators import clusters

    if shared is None:
        raise GeneratorError(f"executor {where.kind} needs a folder that all workers see")
    if where.kind == "dask":
        return clusters.run_with_dask(function, jobs, where.address, shared)
    return clusters.run_with_slurm(function, jobs, workers, shared)


def _run_here(function: Callable[[Job], Made], jobs: Iterable[Job], workers: int) -> Generator[Made]:
    """In processes of this machine; one worker is this process."""
    if workers == 1:
        for job in jobs:
            yield function(job)
        return
    context = get_context("spawn")
    end, parent_lives = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, context, initializer=_end_with, initargs=(end,))

    def submit(job: Job) -> Future[Made]:
        with _interrupts_held():
            return pool.submit(function, job)

    try:
        yield from as_finished(submit, jobs, lambda: 2 * workers)
        pool.shutdown()  # all done: let workers end by themselves, before the pipe tells them to
    except BrokenProcessPool as error:
        raise GeneratorError(
            "a worker process died: out of memory, or killed (run the same again to go on), or the script that called "
            "this does not guard its start by `if __name__ == '__main__':`, and every worker started it again"
        ) from error
    finally:
        parent_lives.close()
        pool.shutdown(cancel_futures=True)
        end.close()


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C is for this process alone, a moment later: processes started in here inherit deafness to it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with(end: Connection) -> None:
    """End this worker, whatever it does, once the parent closes its side of the pipe or is killed."""

    def watch() -> None:
        end.poll(None)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
