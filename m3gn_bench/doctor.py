"""What this installation is, what it can use, and whether it computes what it should."""

import os
import platform
import shutil
import time
from collections.abc import Callable, Collection, Iterator
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.datasets.plugins import DISTRIBUTION, Kind, package_of, plugins
from m3gn_bench.datasets.recorded import TOLERANCE, differences, read_record
from m3gn_bench.datasets.schema import Record
from m3gn_bench.version import __version__

if TYPE_CHECKING:
    from packaging.requirements import Requirement

PAPER_TIERS_GB = 2.5  # of all scenes together
State = Literal["fine", "missing", "wrong"]


class Finding(Record):
    """One thing that was looked at.

    Attributes:
        part: what kind of thing it is.
        name: which one.
        state: "missing" is optional and no fault.
        detail: what was found, or what to do.
    """

    part: str
    name: str
    state: State
    detail: str


def examine(data: Path, self_test: bool, on_progress: Callable[[int, int], None]) -> list[Finding]:
    """Look at everything.

    Args:
        data: the folder where datasets would go.
        self_test: also simulate a trajectory of every scene and run a shipped model, which takes half a minute.
        on_progress: called with (done, total) after every part.
    """
    parts: dict[str, Callable[[], Iterator[Finding]]] = {
        "machine": machine,
        "libraries": libraries,
        "packages": packages,
        "devices": devices,
        "disk": lambda: disk(data),
        "meshes": meshes,
        "leaderboard": board,
    }
    if self_test:
        parts |= {"simulations": simulations, "predictions": predictions}
    found: list[Finding] = []
    for done, (name, part) in enumerate(parts.items(), 1):
        try:
            for finding in part():
                found.append(finding)
        except Exception as error:  # a library that is broken or not there, which is what is looked for here
            detail = f"cannot be looked at: {type(error).__name__}: {error}"
            found.append(Finding(part="doctor", name=name, state="wrong", detail=detail))
        on_progress(done, len(parts))
    return found


def machine() -> Iterator[Finding]:
    """The processor and the programs that everything runs on."""
    from m3gn_bench.provenance import machine as processor

    yield Finding(part="machine", name="m3gn-bench", state="fine", detail=__version__)
    yield Finding(part="machine", name="Python", state="fine", detail=platform.python_version())
    yield Finding(part="machine", name="system", state="fine", detail=platform.platform())
    yield Finding(part="machine", name="processor", state="fine", detail=processor())
    threads = {
        name: os.environ[name] for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS") if name in os.environ
    }
    limits = ", ".join(f"{name}={value}" for name, value in threads.items()) or "no limit set"
    yield Finding(part="machine", name="threads", state="fine", detail=limits)


def libraries() -> Iterator[Finding]:
    """Every library that the package asks for, and the extras that would bring those that are missing."""
    from packaging.requirements import Requirement

    missing: dict[str, list[str]] = {}
    for requirement in map(Requirement, requires(DISTRIBUTION) or []):
        name, extra = requirement.name, _extra_of(requirement)
        if name == DISTRIBUTION or extra in ("test", "dev"):
            continue
        package = DISTRIBUTION if extra is None else f"{DISTRIBUTION}[{extra}]"
        try:
            found = version(name)
        except PackageNotFoundError:
            if extra is None:
                detail = f"required; pip install {package}"
                yield Finding(part="library", name=name, state="wrong", detail=detail)
            else:
                missing.setdefault(extra, []).append(name)
            continue
        if requirement.specifier.contains(found, prereleases=True):
            yield Finding(part="library", name=name, state="fine", detail=found)
        else:
            detail = f"{found} is installed, {requirement.specifier} is needed; pip install '{package}'"
            yield Finding(part="library", name=name, state="wrong", detail=detail)
    for extra_name, names in missing.items():
        advice = f"without {', '.join(names)}; pip install 'm3gn-bench[{extra_name}]'"
        yield Finding(part="extra", name=extra_name, state="missing", detail=advice)


def _extra_of(requirement: "Requirement") -> str | None:
    """The extra that a requirement belongs to; None if it is always required."""
    marker = requirement.marker
    if marker is None or marker.evaluate({"extra": ""}):
        return None
    extras = metadata(DISTRIBUTION).get_all("Provides-Extra") or []
    return next((extra for extra in extras if marker.evaluate({"extra": extra})), None)


def packages() -> Iterator[Finding]:
    """What other packages add, and whether it can be used."""
    from m3gn_bench.generators.scene import OWN_SCENES, get_scene
    from m3gn_bench.model import get_model_class
    from m3gn_bench.tasks import OWN_TASKS, get_task

    # A package may not take a name of ours, and it is ours that would be found.
    kinds: dict[Kind, tuple[Callable[[str], object], Collection[str]]] = {
        "scene": (get_scene, OWN_SCENES),
        "task": (get_task, OWN_TASKS),
        "model": (get_model_class, ()),
    }
    for kind, (get, own) in kinds.items():
        for name in plugins(kind):
            package = package_of(kind, name)
            if package == DISTRIBUTION:
                continue
            try:
                get(name)
            except BenchError as error:
                yield Finding(part=kind, name=name, state="wrong", detail=str(error))
                continue
            taken = name in own
            detail = f"the name is taken; {package} needs another" if taken else f"of the package {package}"
            yield Finding(part=kind, name=name, state="wrong" if taken else "fine", detail=detail)


def devices() -> Iterator[Finding]:
    """What torch and Warp can compute on."""
    import torch

    vector = torch.backends.cpu.get_cpu_capability()
    detail = f"{torch.get_num_threads()} threads, {vector}"
    yield Finding(part="device", name="torch cpu", state="fine", detail=detail)
    for number in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(number)
        detail = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB"
        yield Finding(part="device", name=f"torch cuda:{number}", state="fine", detail=detail)
    if torch.backends.mps.is_available():
        yield Finding(part="device", name="torch mps", state="fine", detail="Apple")
    from m3gn_bench.generators.solvers.quiet_warp import wp

    for device in wp.get_devices():
        yield Finding(part="device", name=f"warp {device.alias}", state="fine", detail=device.name)


def disk(data: Path) -> Iterator[Finding]:
    """Room for datasets."""
    place = next(folder for folder in (data.absolute(), *data.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free / 1e9
    enough = free > PAPER_TIERS_GB
    detail = f"{free:.1f} GB free; all paper tiers together take {PAPER_TIERS_GB} GB"
    yield Finding(part="disk", name=str(place), state="fine" if enough else "missing", detail=detail)


def meshes() -> Iterator[Finding]:
    """Whether the objects that fall are those that were published."""
    from m3gn_bench.generators.falling import MixedObjects
    from m3gn_bench.generators.objects import load_object

    for name in MixedObjects.objects:
        try:
            body = load_object(name)
        except BenchError as error:
            yield Finding(part="mesh", name=name, state="wrong", detail=str(error))
        else:
            detail = f"{len(body.tetrahedra)} tetrahedra, hash holds"
            yield Finding(part="mesh", name=name, state="fine", detail=detail)


def board() -> Iterator[Finding]:
    """Whether records can be read and checkpoints that ship are there."""
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.leaderboard.record import checkpoint_folder, read_records

    try:
        records = read_records()
        shipped = [record for record in records if record.ships]
        for record in shipped:
            read_description(checkpoint_folder(record.task, record.model, record.preset, record.seed))
    except BenchError as error:
        yield Finding(part="leaderboard", name="records", state="wrong", detail=str(error))
    else:
        detail = f"{len(records)} records, {len(shipped)} with checkpoints"
        yield Finding(part="leaderboard", name="records", state="fine", detail=detail)


def simulations() -> Iterator[Finding]:
    """One trajectory of each of our scenes, simulated anew and compared with what is on record."""
    from m3gn_bench.generators.generate import simulate_one
    from m3gn_bench.generators.scene import OWN_SCENES, get_scene

    for name in OWN_SCENES:
        scene, start = get_scene(name), time.perf_counter()
        try:
            expected = read_record(name).sketches["test_00000"]
            trajectory, _ = simulate_one(scene, "test", 0)
        except BenchError as error:
            yield Finding(part="self-test", name=name, state="wrong", detail=str(error))
            continue
        difference = float(np.max([*differences(trajectory, expected, scene.scale_length).values()]))
        right = difference <= TOLERANCE
        detail = f"simulated in {time.perf_counter() - start:.1f} s; {difference:.1e} from the record (scaled units)"
        yield Finding(part="self-test", name=name, state="fine" if right else "wrong", detail=detail)


def predictions() -> Iterator[Finding]:
    """One trajectory of every M3GN that ships, predicted and compared with the record."""
    from m3gn_bench.leaderboard.check import CheckReport, check_records, check_statements
    from m3gn_bench.leaderboard.record import read_records

    for record in read_records():
        if record.model != "m3gn" or not record.ships:
            continue
        name = f"m3gn on {record.task}"
        try:
            found = check_records([record], trajectories=1, offset=0)
        except BenchError as error:
            yield Finding(part="self-test", name=name, state="wrong", detail=str(error))
            continue
        outcome = CheckReport.of(found.compared, [*check_statements([record]), *found.problems])
        largest = max((c.relative_difference for c in outcome.compared), default=float("nan"))
        detail = "; ".join(outcome.problems) or f"error within {largest:.1e} of the record"
        yield Finding(part="self-test", name=name, state="fine" if outcome.ok else "wrong", detail=detail)
