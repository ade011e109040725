"""Run independent jobs on a cluster: by the workers of a dask scheduler, or as jobs of SLURM.

Workers read and write files, so all folders must be on a file system that they share with this process. A job
whose worker dies is run again, a few times; whatever it had finished it finds.
"""

import logging
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic

from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.generators.errors import GeneratorError
from m3gn_bench.generators.executors import Job, Made, as_finished
from m3gn_bench.version import __version__

if TYPE_CHECKING:
    from distributed import Client
    from submitit import Job as SubmititJob

CONNECT_SECONDS = 4  # to a scheduler
LOOK_SECONDS = 10.0  # between looks at workers that give no results
GONE = "the dask scheduler at {} went away; run the same command again to go on"

PARTS_PER_WORKER = 4  # of all jobs: more even out, fewer start Python less often
LARGEST_ARRAY = 1000  # jobs at once that SLURM takes where nobody changed MaxArraySize
SLURM_MINUTES = (
    240  # before SLURM stops a job and it is queued again; SBATCH_TIMELIMIT in the environment wins
)
LOSSES = 3  # of the same part, before it is given up; dask has the same limit
POLL_SECONDS = 1.0  # between looks for results
QUEUE_SECONDS = 30.0  # between looks at SLURM's queue, which serves many


@dataclass(frozen=True)
class _OnWorker(Generic[Job, Made]):
    """The function, on a worker that is fit for it."""

    function: Callable[[Job], Made]
    shared: Path
    version: str = __version__

    def __call__(self, job: Job) -> Made:
        if self.version != __version__:
            raise GeneratorError(
                f"worker {platform.node()} has m3gn-bench {__version__}, not {self.version}; install the same there"
            )
        if not self.shared.is_dir():
            raise GeneratorError(
                f"worker {platform.node()} does not see {self.shared}; with this executor all folders must be on a "
                "file system that all workers share"
            )
        return self.function(job)


# -- dask ----------------------------------------------------------------------------------------------


def run_with_dask(
    function: Callable[[Job], Made], jobs: Iterable[Job], address: str, shared: Path
) -> Generator[Made]:
    """Results from the workers of a dask scheduler, which runs lost jobs again by itself.

    Args:
        function, jobs: see `run_jobs`.
        address: HOST:PORT of the scheduler.
        shared: see `run_jobs`.

    Raises:
        GeneratorError: no scheduler there, or it went away; unfit workers, or too many died of the same job.
    """
    from distributed import Client, KilledWorker

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what goes wrong is reported here
    try:
        client = Client(f"tcp://{address}", timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:  # ValueError: whatever answers there is no scheduler
        raise GeneratorError(
            f"no dask scheduler answers at {address}; start one with 'dask scheduler', or correct the address"
        ) from error
    pool = client.get_executor(pure=False)  # the same job again is to be done again
    submit = partial(pool.submit, partial(_in_own_process, _OnWorker(function, shared.absolute())))
    try:
        yield from as_finished(submit, jobs, _Workers(client, address).window, LOOK_SECONDS)
    except KilledWorker as error:
        raise GeneratorError(
            f"{error.allowed_failures + 1} workers died of the same job, the last one at {error.last_worker.address} "
            "(out of memory?); run the same command again to go on"
        ) from error
    except CancelledError as error:
        raise GeneratorError(GONE.format(address)) from error
    except ModuleNotFoundError as error:
        raise GeneratorError(
            f"a worker has no module {error.name}; install the same there as here"
        ) from error
    finally:
        pool.shutdown(wait=False)
        client.close()


def _in_own_process(function: Callable[[Job], Made], job: Job) -> Made:
    """The function, unless other jobs could share its process: random generators and CPU time are the process's."""
    from distributed import get_worker

    worker = get_worker()
    if worker.state.nthreads != 1:
        raise GeneratorError(
            f"worker {worker.address} does {worker.state.nthreads} jobs at a time in one process; start workers with "
            "'dask worker HOST:PORT --nworkers N --nthreads 1'"
        )
    return function(job)


@dataclass
class _Workers:
    """Those of a scheduler, which may come and go."""

    client: "Client"
    address: str
    present: bool = True

    def window(self) -> int:
        """Twice as many jobs as there are workers, so that none waits; says so once where there are none."""
        try:
            count = len(self.client.nthreads())
        except OSError as error:
            raise GeneratorError(GONE.format(self.address)) from error
        if self.present and not count:
            logging.getLogger(__name__).warning("the dask scheduler has no workers; waiting for some")
        self.present = count > 0
        return max(1, 2 * count)


# -- SLURM ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part(Generic[Job, Made]):
    """Several jobs, one after the other, as one job of SLURM; errors that a user can act on are results."""

    function: Callable[[Job], Made]

    def __call__(self, jobs: Sequence[Job]) -> list[Made] | BenchError:
        try:
            return [self.function(job) for job in jobs]
        except BenchError as error:
            return error

    def checkpoint(self, jobs: Sequence[Job]) -> Any:
        """What submitit queues when SLURM is about to end this for its time: all again, as finished jobs are quick."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, jobs)


def run_with_slurm(
    function: Callable[[Job], Made], jobs: Iterable[Job], workers: int, shared: Path
) -> Generator[Made]:
    """Results from an array of SLURM jobs, each of which does several of ours; lost ones are submitted again.

    Args:
        function, jobs: see `run_jobs`.
        workers: SLURM jobs at a time.
        shared: see `run_jobs`; submitit's files and the logs go to a folder in it, which goes when all is done.

    Raises:
        GeneratorError: no SLURM here, or it refuses; a job failed, or was lost several times.
    """
    from submitit import AutoExecutor
    from submitit.core.utils import FailedJobError, FailedSubmissionError

    todo = list(jobs)
    if not todo:
        return
    folder = shared.absolute() / "slurm"
    try:
        executor = AutoExecutor(folder, cluster="slurm")
    except RuntimeError as error:
        raise GeneratorError("executor slurm: there is no SLURM on this machine (srun is missing)") from error
    executor.update_parameters(
        name="m3gn-bench",
        timeout_min=SLURM_MINUTES,
        cpus_per_task=1,
        slurm_array_parallelism=workers,
        slurm_stderr_to_stdout=True,
    )
    part = _Part(_OnWorker(function, shared.absolute()))
    count = min(len(todo), PARTS_PER_WORKER * workers, LARGEST_ARRAY)
    parts = [todo[start::count] for start in range(count)]

    def accepted(submit: Callable[[], Any]) -> Any:
        try:
            return submit()
        except (FailedJobError, FailedSubmissionError) as error:
            raise GeneratorError(f"SLURM does not take the jobs: {error}") from error

    submitted = accepted(lambda: executor.map_array(part, parts))
    pending = [_Submitted(job, jobs_of) for job, jobs_of in zip(submitted, parts, strict=True)]
    queue = _Queue()
    try:
        while pending:
            results = set(folder.iterdir())  # unlike a look for one file, never out of a cache of NFS
            done = [entry for entry in pending if entry.job.paths.result_pickle in results]
            for entry in done:
                pending.remove(entry)
                yield from entry.made()
            if done:
                continue
            gone = queue.gone({entry.job.job_id for entry in pending})
            for lost in [entry for entry in pending if entry.job.job_id in gone]:
                lost.check_losses()
                pending.remove(lost)
                again = accepted(partial(executor.submit, part, lost.todo))
                pending.append(_Submitted(again, lost.todo, lost.losses + 1))
            time.sleep(POLL_SECONDS)
    finally:
        for entry in pending:
            entry.job.cancel(check=False)
    shutil.rmtree(folder)


@dataclass(frozen=True)
class _Submitted(Generic[Job]):
    """A job of SLURM, what it does, and how often that was lost before."""

    job: "SubmititJob[Any]"
    todo: Sequence[Job]
    losses: int = 0

    def made(self) -> list[Any]:
        """Its results, which are there; errors that a user can act on are raised."""
        from submitit.core.utils import FailedJobError

        try:
            made = self.job.result()
        except FailedJobError as error:
            raise GeneratorError(
                f"SLURM job {self.job.job_id} failed; its log is {self.job.paths.stdout}"
            ) from error
        if isinstance(made, BenchError):
            raise made
        return made

    def check_losses(self) -> None:
        """Raise an error if this loss is one too many."""
        if self.losses + 1 == LOSSES:
            raise GeneratorError(
                f"SLURM job {self.job.job_id} was lost (out of memory?), as it was {self.losses} times before; its log "
                f"is {self.job.paths.stdout}; run the same command again to go on"
            )


@dataclass
class _Queue:
    """What SLURM still has, by squeue: sacct, which submitit asks, tells nothing where there is no accounting."""

    looked: float = field(default_factory=time.monotonic)
    missing: set[str] = field(default_factory=set)

    def gone(self, waiting: set[str]) -> set[str]:
        """Those of these jobs that two looks in a row miss; a result has that long to become visible here."""
        if time.monotonic() - self.looked < QUEUE_SECONDS:
            return set()
        self.looked = time.monotonic()
        command = ["squeue", "--me", "--array", "--noheader", "--format=%i"]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        if answer.returncode:  # its controller is busy, or away for a moment
            return set()
        missing = waiting - set(answer.stdout.split())
        gone = missing & self.missing
        self.missing = missing
        return gone
