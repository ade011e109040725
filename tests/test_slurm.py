"""SLURM makes what one machine makes: by stand-ins for its commands, and by its daemons where they are installed."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import executor_jobs
import pytest

from m3gn_bench.datasets.file import content_hash, open_file
from m3gn_bench.generators import clusters
from m3gn_bench.generators.errors import GeneratorError
from m3gn_bench.generators.generate import generate
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.generators.workers import run_jobs

HERE = Path(__file__).parent

# Commands of SLURM, as far as submitit uses them: jobs run here at once, and their states are files.
SBATCH = """
number = sum(1 for _ in STATES.glob("*.sh")) + 1
script = STATES / f"{number}.sh"
script.write_text(Path(sys.argv[1]).read_text())
array = re.search(r"--array=0-([0-9]+)%([0-9]+)", script.read_text())
for task in range(int(array[1]) + 1) if array else [None]:
    name = str(number) if task is None else f"{number}_{task}"
    known = {"SLURM_JOB_ID": str(number), "STATE": str(STATES / f"{name}.state")}
    if task is not None:
        known |= {"SLURM_ARRAY_JOB_ID": str(number), "SLURM_ARRAY_TASK_ID": str(task)}
    Path(known["STATE"]).write_text("RUNNING")
    subprocess.Popen(["bash", script], env=os.environ | known, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
print(f"Submitted batch job {number}")
"""
SRUN = """
command = sys.argv[sys.argv.index(sys.executable) :]
code = subprocess.run(command, capture_output=True).returncode
Path(os.environ["STATE"]).write_text("FAILED" if code else "COMPLETED")
"""
SQUEUE = """
for path in STATES.glob("*.state"):
    if path.read_text() == "RUNNING":
        print(path.stem)
"""
SCANCEL = """
(STATES / f"{sys.argv[1]}.cancelled").touch()
"""


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the scripts, states and cancelled jobs of a made-up SLURM."""
    commands, states = tmp_path / "commands", tmp_path / "states"
    commands.mkdir()
    states.mkdir()
    head = "import os, re, subprocess, sys\nfrom pathlib import Path\n"
    for name, body in {"sbatch": SBATCH, "srun": SRUN, "squeue": SQUEUE, "scancel": SCANCEL}.items():
        script = commands / name
        script.write_text(f"#!{sys.executable}\n{head}STATES = Path({str(states)!r})\n{body}")
        script.chmod(0o755)
    monkeypatch.setenv("PATH", str(commands), prepend=":")
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    monkeypatch.setattr(clusters, "POLL_SECONDS", 0.1)
    monkeypatch.setattr(clusters, "QUEUE_SECONDS", 0.2)
    return states


def on_slurm(function: Callable[[Path], str], jobs: list[Path], shared: Path, workers: int = 1) -> set[str]:
    return set(run_jobs(function, jobs, workers, executor="slurm", shared=shared))


def test_jobs_of_slurm_make_the_same_data(slurm: Path, smoke_file: Path, tmp_path: Path) -> None:
    scene = get_scene("sheet_deformation")
    done = []
    made = generate(
        scene,
        "smoke",
        tmp_path / "out",
        splits=["test"],
        executor="slurm",
        on_progress=lambda count, total: done.append(count),
    )
    with open_file(smoke_file) as file:
        assert made.content_hash == content_hash(file, "smoke", ["test"])
    assert done == [0, 1, 2, 3, 4]
    assert [path.name for path in (tmp_path / "out").iterdir()] == [made.file.name]


def test_slurm_gets_one_array_of_jobs(slurm: Path, tmp_path: Path) -> None:
    jobs = [Path(str(number)) for number in range(10)]
    assert on_slurm(executor_jobs.name, jobs, tmp_path) == {job.name for job in jobs}
    (script,) = slurm.glob("*.sh")
    assert f"#SBATCH --array=0-{clusters.PARTS_PER_WORKER - 1}%1\n" in script.read_text()
    assert list(slurm.glob("*.cancelled")) == []
    assert not (tmp_path / "slurm").exists()


def test_a_lost_job_of_slurm_is_submitted_again(slurm: Path, tmp_path: Path) -> None:
    jobs = [tmp_path / name for name in ("lost", "also lost")]
    jobs[1].touch()  # not this time
    assert on_slurm(executor_jobs.die_once, jobs, tmp_path) == {"lost", "also lost"}
    assert len(list(slurm.glob("*.sh"))) == 2


@pytest.mark.parametrize(
    ("function", "message", "submitted"),
    [
        (executor_jobs.die, "was lost", clusters.LOSSES),
        (executor_jobs.fail, "a cannot be made", 1),
        (executor_jobs.break_down, r"failed; its log is .*out", 1),
    ],
)
def test_jobs_of_slurm_that_cannot_be_done(
    slurm: Path, tmp_path: Path, function: Callable[[Path], str], message: str, submitted: int
) -> None:
    with pytest.raises(GeneratorError, match=message):
        on_slurm(function, [tmp_path / "a"], tmp_path)
    assert len(list(slurm.glob("*.sh"))) == submitted


def test_an_interrupt_cancels_what_slurm_still_has(slurm: Path, tmp_path: Path) -> None:
    jobs = [tmp_path / str(number) for number in range(12)]
    with closing(run_jobs(executor_jobs.slow_name, jobs, 1, executor="slurm", shared=tmp_path)) as results:
        next(results)
    assert len(list(slurm.glob("*.cancelled"))) == clusters.PARTS_PER_WORKER - 1


def test_slurm_that_refuses(slurm: Path, tmp_path: Path) -> None:
    refusing = tmp_path / "commands" / "sbatch"
    refusing.write_text("#!/bin/sh\necho 'sbatch: error: invalid partition' >&2\nexit 1\n")
    with pytest.raises(GeneratorError, match=r"SLURM does not take the jobs: .*invalid partition"):
        on_slurm(executor_jobs.name, [tmp_path / "a"], tmp_path)


# --- the daemons ------------------------------------------------------------------------------------------

CONFIGURATION = """
ClusterName=one
SlurmctldHost=localhost
SlurmctldPort={port}
SlurmdPort={node_port}
AuthType=auth/munge
AuthInfo=socket={home}/munge.socket
CryptoType=crypto/munge
SlurmUser=root
SlurmdUser=root
StateSaveLocation={home}/controller
SlurmdSpoolDir={home}/node
SlurmctldPidFile={home}/slurmctld.pid
SlurmdPidFile={home}/slurmd.pid
ProctrackType=proctrack/pgid
TaskPlugin=task/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
NodeName=here NodeAddr=127.0.0.1 NodeHostname=localhost CPUs={cpus} State=UNKNOWN
PartitionName=main Nodes=here Default=YES State=UP
"""


@pytest.fixture(scope="module")
def real_slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The configuration of a cluster of this machine alone, without accounting, whose daemons run."""
    if not all(map(shutil.which, ("munged", "slurmctld", "slurmd"))) or os.geteuid() != 0:
        pytest.skip("needs SLURM and MUNGE (Debian: slurm-wlm, munge), and root to start their daemons")
    home = tmp_path_factory.mktemp("slurm")
    for name in ("controller", "node"):
        (home / name).mkdir()
    (home / "key").write_bytes(os.urandom(128))
    (home / "key").chmod(0o400)
    with socket.socket() as one, socket.socket() as other:
        one.bind(("", 0))
        other.bind(("", 0))
        ports = {"port": one.getsockname()[1], "node_port": other.getsockname()[1]}
    configuration = home / "slurm.conf"
    configuration.write_text(CONFIGURATION.format(home=home, cpus=os.cpu_count(), **ports))
    munge = ["munged", "--foreground", "--force"]
    munge += [f"--{name}-file={home / name}" for name in ("key", "seed", "pid", "log")]
    with ExitStack() as daemons, (home / "daemons.log").open("w") as log:
        for command in (
            [*munge, f"--socket={home}/munge.socket"],
            ["slurmctld", "-D", "-f", configuration],
            ["slurmd", "-D", "-f", configuration, "-N", "here"],
        ):
            daemon = daemons.enter_context(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT))
            daemons.callback(daemon.terminate)
        deadline = time.monotonic() + 60
        look = ["sinfo", "--noheader", "--format=%t"]
        environment = os.environ | {"SLURM_CONF": str(configuration)}
        while subprocess.run(look, env=environment, capture_output=True, text=True).stdout.strip() != "idle":
            assert time.monotonic() < deadline, (home / "daemons.log").read_text()
            time.sleep(0.5)
        yield configuration


def test_real_slurm_makes_the_same_data_and_does_lost_jobs_again(
    real_slurm: Path, smoke_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SLURM_CONF", str(real_slurm))
    monkeypatch.setenv("PYTHONPATH", str(HERE))
    monkeypatch.setattr(clusters, "QUEUE_SECONDS", 2)
    jobs = [tmp_path / name for name in ("lost", "also lost", "kept")]
    jobs[2].touch()  # not this time
    assert on_slurm(executor_jobs.die_once, jobs, tmp_path, workers=2) == {job.name for job in jobs}

    made = generate(
        get_scene("sheet_deformation"), "smoke", tmp_path / "out", splits=["test"], executor="slurm"
    )
    with open_file(smoke_file) as file:
        assert made.content_hash == content_hash(file, "smoke", ["test"])
    assert [path.name for path in (tmp_path / "out").iterdir()] == [made.file.name]
