"""Save and load trained models: safetensors for numbers, JSON for everything else, no pickles.

A checkpoint is a folder of two files: `weights.safetensors` and `checkpoint.json`, which says what the
weights belong to and carries their SHA-256.
"""

import hashlib
from pathlib import Path
from typing import Any

import safetensors
from pydantic import Field, ValidationError
from safetensors.torch import load, save
from torch import Tensor

from m3gn_bench.data import Materials
from m3gn_bench.datasets.errors import first_problem
from m3gn_bench.datasets.schema import Record
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import CheckpointError
from m3gn_bench.model import Model, RunConfig, build_model, load_preset
from m3gn_bench.tasks import Task, get_task

WEIGHTS, DESCRIPTION = "weights.safetensors", "checkpoint.json"


class ConfigRecord(Record):
    """A `RunConfig` as JSON; what the two tables may hold is the model's and the training loop's affair."""

    model_name: str
    preset: str
    model: dict[str, Any]
    training: dict[str, Any]


class Checkpoint(Record):
    """What `checkpoint.json` says.

    Attributes:
        minutes: training time (on a CPU: CPU time of training steps).
        validation_error: mean full-rollout MSE over context sizes of the kept weights; None if not trained.
        dataset_hash: content hash of the data trained on (training and validation split).
        materials: only the trajectories of these materials were trained on.
        processes: how many trained it together, each with a device and threads of its own.
        commit: of the code that finished its training, if that ran from a checkout.
    """

    task: str
    seed: int
    config: ConfigRecord
    config_hash: str
    steps: int
    best_step: int
    minutes: float
    validation_error: float | None
    dataset_hash: str
    materials: Materials = Field(default={})
    device: str
    threads: int
    processes: int = 1
    package_version: str
    commit: str | None = None
    weights_sha256: str = ""


def save_checkpoint(folder: Path, weights: dict[str, Tensor], description: Checkpoint) -> None:
    """Write a checkpoint; the description comes last, so a folder that has one is complete."""
    content = save({name: value.contiguous() for name, value in weights.items()})
    complete = description.model_copy(update={"weights_sha256": hashlib.sha256(content).hexdigest()})
    write_bytes_atomically(folder / WEIGHTS, content)
    write_bytes_atomically(folder / DESCRIPTION, (complete.model_dump_json(indent=2) + "\n").encode())


def copy_checkpoint(source: Path, target: Path) -> None:
    """Copy a checkpoint, and nothing else that its run left; the description comes last, as in `save_checkpoint`."""
    for name in (WEIGHTS, DESCRIPTION):
        write_bytes_atomically(target / name, (source / name).read_bytes())


def read_description(folder: Path) -> Checkpoint:
    """The description of a checkpoint. Raises CheckpointError if there is none or it is damaged."""
    path = folder / DESCRIPTION
    if not path.is_file():
        raise CheckpointError(
            f"no checkpoint in {folder} ({DESCRIPTION} is missing); make one with 'm3gn-bench train'"
        )
    try:
        return Checkpoint.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise CheckpointError(f"{path} is damaged: {first_problem(error)}") from error


def is_of_preset(description: Checkpoint) -> bool:
    """Whether its settings, but for the budget, are its preset's. Raises ConfigError if there is no such preset."""
    config = description.config
    usual = load_preset(config.model_name, config.preset, get_task(description.task))
    return description.config_hash == usual.hash()


def load_checkpoint(folder: Path, task: Task | None = None) -> tuple[Model, Checkpoint]:
    """The model of a checkpoint, ready to predict.

    Args:
        folder: of the checkpoint.
        task: its task as the data to predict have it (see `task_of_data`), if not as the benchmark's own have it.

    Raises:
        CheckpointError: missing, damaged, or made for another version of the model.
        ConfigError: no such model.
        PluginError: the package of its model or task cannot be imported.
    """
    description = read_description(folder)
    path = folder / WEIGHTS
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"cannot read {path}: {error.strerror}") from error
    if hashlib.sha256(content).hexdigest() != description.weights_sha256:
        raise CheckpointError(
            f"{path} does not match the SHA-256 in {DESCRIPTION}: it is damaged or was replaced"
        )
    try:
        config = RunConfig.from_json(description.config.model_dump())
        model = build_model(config, task or get_task(description.task))
        model.load_state_dict(load(content))
    except (ValidationError, KeyError, RuntimeError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{folder} does not fit this version of its model: {error}") from error
    return model.eval(), description
