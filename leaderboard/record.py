"""Result records: one JSON file per track, task, model and seed, with every test trajectory's error."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from m3gn_bench.checkpoint import Checkpoint
from m3gn_bench.data import Materials
from m3gn_bench.datasets.errors import BenchError, first_problem
from m3gn_bench.datasets.schema import Record
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.metrics import TrajectoryErrors
from m3gn_bench.model import model_names

HOME = Path(__file__).parent
SHIPPED = "compact"  # preset of the reference checkpoints, of seed 0
RECORD_SCHEMA = 3
HASH_DIGITS = 16  # of a trajectory's content hash, enough to tell trajectories apart
# Names become parts of file names.
Name = Annotated[str, Field(pattern=r"^\w[\w.-]*$")]
Variant = Annotated[str, Field(pattern=r"^[\w .+=-]*$")]
Error = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class ContextResult(Record):
    """Errors at one context size; scaled units, frames after the anchor.

    Attributes:
        context: number of context frames.
        mse: full-rollout MSE over all nodes, mean over trajectories.
        mse_free_nodes: the same without fixed nodes.
        per_timestep_mse: mean over trajectories, for every frame after the anchor.
        trajectory_mse: `mse` of every trajectory.
        trajectory_mse_free_nodes: `mse_free_nodes` of every trajectory.
    """

    context: int
    mse: float
    mse_free_nodes: float
    per_timestep_mse: tuple[Error, ...]
    trajectory_mse: tuple[Error, ...]
    trajectory_mse_free_nodes: tuple[Error, ...]

    @model_validator(mode="after")
    def _summaries_follow_from_errors(self) -> Self:
        errors = np.array(self.trajectory_mse)
        derived: dict[str, tuple[Any, Any]] = {
            "mse": (self.mse, errors.mean()),
            "mse_free_nodes": (self.mse_free_nodes, np.mean(self.trajectory_mse_free_nodes)),
            "per_timestep_mse": (np.mean(self.per_timestep_mse), errors.mean()),
        }
        for name, (stated, expected) in derived.items():
            if not np.allclose(stated, expected, rtol=1e-6, atol=0):
                raise ValueError(
                    f"{name} {stated} does not follow from the trajectories' errors ({expected})"
                )
        return self

    @classmethod
    def from_errors(cls, context: int, errors: TrajectoryErrors) -> "ContextResult":
        """Summarise the errors of all trajectories. Raises BenchError if the predictions diverge."""
        diverged = np.count_nonzero(~np.isfinite(errors.mse))
        if diverged:
            raise BenchError(
                f"at context {context} the predictions of {diverged} of {len(errors.mse)} trajectories diverge: "
                "their errors are not finite"
            )
        return cls(
            context=context,
            mse=float(errors.mse.mean()),
            mse_free_nodes=float(errors.mse_free_nodes.mean()),
            per_timestep_mse=tuple(errors.per_timestep_mse.mean(0).tolist()),
            trajectory_mse=tuple(errors.mse.tolist()),
            trajectory_mse_free_nodes=tuple(errors.mse_free_nodes.tolist()),
        )


class ResultRecord(Record):
    """One row of the leaderboard and everything needed to re-derive it.

    Attributes:
        track: which board it belongs to.
        variant: what differs from the model's preset, in a word; empty where nothing does.
        materials: that trajectories were restricted to, in all splits; empty for all.
        dataset_version, dataset_hash: of the trajectories evaluated on.
        commit: of the code that scored it, if that ran from a checkout.
        machine: that scored it; empty if unknown.
        evaluation_threads, evaluation_seconds: of torch, and wall time of all predictions.
        ships: whether the checkpoint is kept beside the records, so that anybody can re-derive the errors.
    """

    record_schema: int = RECORD_SCHEMA
    track: Name
    task: Name
    model: Name
    preset: Name
    variant: Variant = ""
    materials: Materials = Field(default={})
    seed: int
    parameters: int = Field(ge=0)
    tier: str
    split: str
    dataset_version: str
    dataset_hash: str
    keys: tuple[str, ...]
    trajectory_hashes: tuple[str, ...]
    package_version: str
    commit: str | None
    machine: str
    evaluation_device: str
    evaluation_threads: int
    evaluation_seconds: float = Field(gt=0, allow_inf_nan=False)
    checkpoint: Checkpoint
    ships: bool
    results: tuple[ContextResult, ...]

    @model_validator(mode="after")
    def _one_error_per_trajectory(self) -> Self:
        lengths = {len(self.keys), len(self.trajectory_hashes)}
        for result in self.results:
            lengths |= {len(result.trajectory_mse), len(result.trajectory_mse_free_nodes)}
        if len(lengths) != 1:
            raise ValueError(f"keys, hashes and errors differ in number: {sorted(lengths)}")
        if len(set(self.keys)) != len(self.keys):
            raise ValueError("a trajectory is there twice")
        frames = {result.context + len(result.per_timestep_mse) for result in self.results}
        if len(frames) > 1:
            raise ValueError(f"trajectories have as many frames at every context size, not {sorted(frames)}")
        return self

    @property
    def name(self) -> str:
        """Identifies the record within a task."""
        return run_name(self.model, self.preset, self.variant, self.seed)

    def result(self, context: int) -> ContextResult | None:
        """The result at a context size, if recorded."""
        return next((r for r in self.results if r.context == context), None)

    def mse_over(self, context: int, keys: Sequence[str]) -> float | None:
        """Mean recorded error over some of the trajectories; None unless all of them were recorded."""
        result = self.result(context)
        if result is None or not keys or not set(keys) <= set(self.keys):
            return None
        errors = dict(zip(self.keys, result.trajectory_mse, strict=True))
        return float(np.mean([errors[key] for key in keys]))


def run_name(model: str, preset: str, variant: str, seed: int) -> str:
    """Name of a run within its track and task, as used for files."""
    return "-".join([model, preset, *([variant.replace(" ", "_")] if variant else []), f"s{seed}"])


def record_path(record: ResultRecord, home: Path = HOME) -> Path:
    """Where a record belongs."""
    return home / "records" / record.track / record.task / f"{record.name}.json"


def checkpoint_folder(task: str, model: str, preset: str, seed: int = 0, home: Path = HOME) -> Path:
    """Where the reference checkpoint that ships with the project lies."""
    return home / "checkpoints" / task / run_name(model, preset, "", seed)


def shipped_models(task: str, preset: str = SHIPPED) -> list[str]:
    """The models whose reference checkpoint on a task ships with the project."""
    return [name for name in model_names() if checkpoint_folder(task, name, preset).is_dir()]


def write_record(record: ResultRecord, home: Path = HOME) -> Path:
    """Write a record to its place, errors rounded to nine digits."""
    path = record_path(record, home)
    content = record.model_dump(mode="json")
    content["results"] = _rounded(content["results"])
    write_bytes_atomically(path, (json.dumps(content, indent=1) + "\n").encode())
    return path


def _rounded(value: object) -> object:
    if isinstance(value, float):
        return float(f"{value:.9g}")
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return value


def read_record(path: Path) -> ResultRecord:
    """One record. Raises BenchError if the file is none, or its numbers contradict each other."""
    content = path.read_bytes()
    try:
        return ResultRecord.model_validate_json(content)
    except ValidationError as error:
        problem = first_problem(error)
        stated = re.search(rb'"record_schema": *(\d+)', content)
        if stated is not None and int(stated[1]) != RECORD_SCHEMA:
            problem = (
                f"its record_schema is {int(stated[1])}, and this version reads {RECORD_SCHEMA}; {problem}"
            )
        raise BenchError(f"{path} is no valid result record: {problem}") from error


def read_records(home: Path = HOME) -> list[ResultRecord]:
    """All records, sorted by track, task and name. Raises BenchError naming a file that is none."""
    return [read_record(path) for path in sorted((home / "records").rglob("*.json"))]


def find_record(records: Sequence[ResultRecord], track: str, task: str, name: str) -> ResultRecord | None:
    """The record of a run (see `run_name`), if there is one."""
    return next((r for r in records if (r.track, r.task, r.name) == (track, task, name)), None)
