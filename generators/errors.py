"""Errors of the generators."""

from m3gn_bench.datasets.errors import BenchError


class GeneratorError(BenchError):
    """A dataset cannot be generated as asked."""


class SolverError(BenchError):
    """A solver did not reach equilibrium. The draw is rejected and counted, never kept."""
