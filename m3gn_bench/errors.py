"""Errors of models, training and evaluation."""

from m3gn_bench.datasets.errors import BenchError


class ConfigError(BenchError):
    """An unknown name or a value out of range in what the user asked for."""


class CheckpointError(BenchError):
    """A checkpoint is missing, damaged or does not fit."""


class TrainingError(BenchError):
    """Training cannot go on."""
