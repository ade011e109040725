"""Jobs that the workers of tests/test_executors.py do; a module of its own, for workers must be able to import it."""

import os
import signal
import time
from pathlib import Path

from m3gn_bench.generators.errors import GeneratorError


def name(path: Path) -> str:
    """An ordinary job."""
    return path.name


def slow_name(path: Path) -> str:
    """One that is still under way when something happens."""
    time.sleep(0.5)
    return path.name


def die_once(marker: Path) -> str:
    """Killed as by a machine that fails, unless it was before."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def die(path: Path) -> str:
    """Killed whenever it is tried."""
    os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def fail(path: Path) -> str:
    """What a user can act on."""
    raise GeneratorError(f"{path.name} cannot be made")


def break_down(path: Path) -> str:
    """A mistake in the program."""
    return f"{1 / 0} {path.name}"
