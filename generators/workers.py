"""Run independent jobs in several processes that end with this one, however it ends."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from m3gn_bench.generators.errors import GeneratorError

Job = TypeVar("Job")
Made = TypeVar("Made")


def run_jobs(function: Callable[[Job], Made], jobs: Iterable[Job], workers: int) -> Generator[Made]:
    """Results of the function for all jobs, as they finish; a failure or an interrupt stops the rest at once.

    Close the generator where it may not be exhausted, so that the workers end, too.

    Args:
        function, jobs: of a module, and what pickle can send, unless there is one worker: that is this process.
        workers: number of processes.

    Raises:
        GeneratorError: a process died.
    """
    if workers == 1:
        for job in jobs:
            yield function(job)
        return
    context = get_context("spawn")
    end, parent_lives = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, context, initializer=_end_with, initargs=(end,))
    try:
        pending: set[Future[Made]] = set()
        for job in jobs:
            with _interrupts_held():
                pending.add(pool.submit(function, job))
            if len(pending) >= 2 * workers:
                finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield future.result()
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                yield future.result()
        pool.shutdown()  # all done: let workers end by themselves, before the pipe tells them to
    except BrokenProcessPool as error:
        raise GeneratorError(
            "a worker process died (out of memory, or killed); run the same command again to go on"
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
