"""Clusters make what one machine makes, whatever dies on the way; whatever is wrong with them is one clear line."""

import importlib.util
import json
import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import executor_jobs
import pytest

from m3gn_bench.cli import run
from m3gn_bench.datasets.file import content_hash, open_file
from m3gn_bench.generators import clusters
from m3gn_bench.generators.errors import GeneratorError
from m3gn_bench.generators.executors import Executor, parse_executor
from m3gn_bench.generators.generate import generate
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.generators.workers import run_jobs

DASK = Path(sys.executable).parent / "dask"
HERE = Path(__file__).parent
LOSSES = 1  # of a job, after which the scheduler of these tests gives it up


# --- names ------------------------------------------------------------------------------------------------


def test_known_executors() -> None:
    assert parse_executor("process") == Executor("process")
    assert parse_executor("slurm") == Executor("slurm")
    assert parse_executor("dask://head-node:8786") == Executor("dask", "head-node:8786")
    assert parse_executor("dask://[::1]:8786") == Executor("dask", "[::1]:8786")


@pytest.mark.parametrize("text", ["", "ray", "dask", "dask://head", "dask://head:x", "dask://:8786", "Slurm"])
def test_unknown_executors_list_what_exists(text: str) -> None:
    with pytest.raises(GeneratorError, match=r"unknown executor .*; known: dask://HOST:PORT, process, slurm"):
        parse_executor(text)


@pytest.mark.parametrize(("text", "extra"), [("dask://head:1", "dask"), ("slurm", "slurm")])
def test_a_missing_library_names_the_extra(text: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda library: None)
    with pytest.raises(GeneratorError, match=rf"pip install 'm3gn-bench\[{extra}\]'"):
        parse_executor(text)


@pytest.mark.parametrize(
    ("executor", "message"),
    [
        ("ray", "unknown executor 'ray'"),
        ("dask://127.0.0.1:1", "no dask scheduler answers at 127.0.0.1:1"),
        ("slurm", "there is no SLURM on this machine"),
    ],
)
def test_the_command_says_what_is_wrong(
    executor: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    start = time.monotonic()
    with pytest.raises(SystemExit) as stop:
        run(
            [
                "generate",
                "sheet_deformation",
                "--tier",
                "smoke",
                "--out",
                str(tmp_path),
                "--executor",
                executor,
            ]
        )
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {'' if executor != 'slurm' else 'executor slurm: '}{message}")
    assert time.monotonic() - start < 15  # a few seconds, on a machine that has nothing else to do


# --- dask -------------------------------------------------------------------------------------------------


class Cluster:
    """A dask scheduler and its workers, in processes of their own, which start in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
        self.workers: list[subprocess.Popen[bytes]] = []

    def wait(self) -> None:
        """Until the scheduler has written where it is: it makes the file first."""
        deadline = time.monotonic() + 60
        while not (self.file.exists() and self.file.stat().st_size):
            assert time.monotonic() < deadline
            assert self.scheduler.poll() is None
            time.sleep(0.05)
        self.executor = json.loads(self.file.read_text())["address"].replace("tcp://", "dask://")

    def add_worker(self, threads: int = 1) -> None:
        self.workers.append(self._start("worker", "--nthreads", str(threads), "--no-nanny", "--no-dashboard"))

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{kind}.log").open("ab") as log:
            return subprocess.Popen(
                [str(DASK), kind, "--scheduler-file", str(self.file), *options],
                cwd=self.folder,
                stdout=log,
                stderr=log,
            )


@pytest.fixture
def cluster(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    """A scheduler without workers."""
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", str(LOSSES))
    started = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        started.wait()
        yield started
    finally:
        started.stop()


def test_a_killed_worker_of_dask_loses_nothing(
    cluster: Cluster, smoke_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What one worker had in hand the other makes; the same data as in one process. The folder is a relative one."""
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        cluster.add_worker()

    def kill_a_worker(done: int, total: int) -> None:
        if done == 1:
            cluster.workers[0].kill()

    scene, split = get_scene("sheet_deformation"), "test"
    made = generate(
        scene, "smoke", Path("data"), splits=[split], executor=cluster.executor, on_progress=kill_a_worker
    )
    with open_file(smoke_file) as file:
        assert made.content_hash == content_hash(file, "smoke", [split])
    assert made.generated == 4
    assert [worker.poll() is None for worker in cluster.workers] == [False, True]
    assert {path.name for path in (tmp_path / "data").iterdir()} == {made.file.name}


def test_a_campaign_on_dask(
    cluster: Cluster, smoke_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.add_worker()
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'track = "trial"\ntier = "smoke"\n[[runs]]\ntasks = ["sheet_deformation"]\nmodels = ["mgn"]\n'
        'preset = "smoke"\nsteps = 3\nseeds = [0, 1]\n'
    )
    places = [f"--{name}={tmp_path / name}" for name in ("home", "runs")]
    command = ["campaign", str(plan), *places, f"--data={smoke_file.parent}"]
    with pytest.raises(SystemExit) as stop:
        run([*command, "--executor", cluster.executor, "--json"])
    assert (stop.value.code or 0) == 0
    assert json.loads(capsys.readouterr().out)["counts"] == {"done": 2, "outdated": 0, "to do": 0}


def test_workers_of_dask_that_do_not_fit(cluster: Cluster, tmp_path: Path) -> None:
    """Jobs in threads of one process would share random generators; a folder that is not shared holds no results."""
    jobs = [tmp_path / "a"]
    cluster.add_worker(threads=2)
    with pytest.raises(GeneratorError, match=r"2 jobs at a time in one process.*--nthreads 1"):
        list(run_jobs(executor_jobs.name, jobs, 1, executor=cluster.executor, shared=tmp_path))
    cluster.workers[0].kill()
    cluster.add_worker()
    with pytest.raises(GeneratorError, match=r"does not see .*elsewhere; .*file system"):
        list(run_jobs(executor_jobs.name, jobs, 1, executor=cluster.executor, shared=tmp_path / "elsewhere"))
    with pytest.raises(GeneratorError, match="a cannot be made"):
        list(run_jobs(executor_jobs.fail, jobs, 1, executor=cluster.executor, shared=tmp_path))


def test_a_job_that_kills_its_workers_ends(cluster: Cluster, tmp_path: Path) -> None:
    for _ in range(LOSSES + 1):
        cluster.add_worker()
    with pytest.raises(GeneratorError, match=r"2 workers died of the same job, .*out of memory"):
        list(run_jobs(executor_jobs.die, [tmp_path], 1, executor=cluster.executor, shared=tmp_path))


def test_a_scheduler_without_workers_and_then_gone(
    cluster: Cluster, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Jobs wait for workers, and say so; when the scheduler goes, they end."""
    jobs = [tmp_path / str(number) for number in range(20)]
    results = run_jobs(executor_jobs.slow_name, jobs, 1, executor=cluster.executor, shared=tmp_path)
    with closing(results):
        cluster.add_worker()  # it takes longer to start than the first look at workers comes
        with caplog.at_level(logging.WARNING, logger=clusters.__name__):
            next(results)
        assert "the dask scheduler has no workers" in caplog.text
        cluster.scheduler.kill()
        with pytest.raises(GeneratorError, match=r"scheduler .* went away; run the same"):
            list(results)
