"""What other installed packages add to the benchmark by entry points, each loaded when it is asked for.

A package that cannot be used is named in one line, and is no obstacle to whoever does not need it.
"""

import logging
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, TypeVar

from m3gn_bench.datasets.errors import BenchError

Kind = Literal["scene", "task", "model"]
T = TypeVar("T")
DISTRIBUTION = "m3gn-bench"  # this package, among those that have entry points


class PluginError(BenchError):
    """What an installed package adds to the benchmark cannot be used."""


@cache  # looking through all installed packages takes milliseconds
def plugins(kind: Kind) -> dict[str, EntryPoint]:
    """Entry points of the group `m3gn_bench.<kind>s` by name; our own models are among those of models.

    The first package that takes a name has it, and we come first; says which others are left out.
    """
    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=f"m3gn_bench.{kind}s"), key=lambda e: _package(e) != DISTRIBUTION):
        if entry.name in found:
            _leave_out_taken(kind, entry)
        else:
            found[entry.name] = entry
    return found


def package_of(kind: Kind, name: str) -> str:
    """The package that adds what bears that name, or where its code is if that is all one knows."""
    return _package(plugins(kind)[name])


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist else entry.value


@contextmanager
def blamed_on_package(kind: Kind, name: str) -> Iterator[None]:
    """Turns whatever the code of another package raises into one line that names the package.

    Raises:
        PluginError: something was raised.
    """
    try:
        yield
    except Exception as error:
        reason = str(error) if isinstance(error, BenchError) else f"{type(error).__name__}: {error}"
        raise PluginError(
            f"{kind} {name!r} of the package {package_of(kind, name)} cannot be used: {reason}"
        ) from error


def load(kind: Kind, name: str) -> Any:
    """What an entry point names. Raises PluginError, naming its package, if that cannot be imported."""
    with blamed_on_package(kind, name):
        return plugins(kind)[name].load()


@cache  # says everything once
def leave_out(reason: str) -> None:
    """Say on the log (without a configuration: on standard error) what an iteration goes on without."""
    logging.getLogger(__name__).warning("warning: left out: %s", reason)


def _leave_out_taken(kind: Kind, entry: EntryPoint) -> None:
    leave_out(f"{kind} {entry.name!r} of the package {_package(entry)}: the name is taken")


def usable(kind: Kind, get: Callable[[str], T], own: Container[str] = ()) -> Iterator[tuple[str, T]]:
    """Name and object of every entry point that can be used; says which are left out.

    Args:
        kind: what to go through.
        get: gives what bears a name, or raises PluginError.
        own: names that are ours, which no package may take.
    """
    for name, entry in plugins(kind).items():
        if name in own:
            _leave_out_taken(kind, entry)
            continue
        try:
            found = get(name)
        except PluginError as error:
            leave_out(str(error))
        else:
            yield name, found
