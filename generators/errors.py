"""Errors of the generators."""

import importlib.util

from m3gn_bench.datasets.errors import BenchError


class GeneratorError(BenchError):
    """A dataset cannot be generated as asked."""


class ParameterError(GeneratorError, ValueError):
    """A parameter of a simulation is outside its physical range."""


class SolverError(BenchError):
    """A solver did not reach equilibrium. The draw is rejected and counted, never kept."""


def problem(frame: int, what: str, remedy: str) -> str:
    """What is wrong with a trajectory, from which frame on, and what to do about it, in one line."""
    return f"frame {frame}: {what}; {remedy}"


def require_installed(library: str, purpose: str, extra: str) -> None:
    """Raises GeneratorError, naming the extra to install, where an optional library is missing."""
    if importlib.util.find_spec(library) is None:
        raise GeneratorError(
            f"{purpose} needs {library}, which is not installed: pip install 'm3gn-bench[{extra}]'"
        )
