"""What a record says of its task, its model and its run that is not so in this version of the project."""

import math

from pydantic import ConfigDict, ValidationError

from m3gn_bench.checkpoint import Checkpoint
from m3gn_bench.datasets.errors import BenchError, unknown_name
from m3gn_bench.datasets.schema import SPLITS, TIERS, as_split
from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.model import PRESETS, ModelConfig, RunConfig, TrainingConfig, build_model, model_names
from m3gn_bench.sources import dataset_version, number_of_trajectories, trajectory_names
from m3gn_bench.tasks import TASKS

OVERTIME = 1.1  # a budget in minutes ends with the step that exceeds it


class _AsStated(ModelConfig):
    """Hyper-parameters of a model that is not installed: whatever its author has."""

    model_config = ConfigDict(extra="allow")


def contradictions(record: ResultRecord) -> list[str]:
    """One sentence each; none where all is well.

    A record's statistics need no look: they are derived from its errors whenever it is read. Hyper-parameters of a
    model that is not installed have no meaning here and its parameters cannot be counted, nor is it known how many
    trajectories are of some materials only.
    """
    if record.task not in TASKS:
        return [unknown_name("task", record.task, list(TASKS))]
    if record.tier not in TIERS:
        return [unknown_name("tier", record.tier, list(TIERS))]
    if record.split not in SPLITS:
        return [unknown_name("split", record.split, list(SPLITS))]
    if record.preset not in PRESETS:
        return [unknown_name("preset", record.preset, list(PRESETS))]
    task, described, split = TASKS[record.task], record.checkpoint, as_split(record.split)
    frames = {result.context + len(result.per_timestep_mse) for result in record.results}
    expected: dict[str, tuple[object, object]] = {
        "checkpoint's task, model, preset and seed": (
            (described.task, described.config.model_name, described.config.preset, described.seed),
            (record.task, record.model, record.preset, record.seed),
        ),
        "materials": (record.materials, described.materials),
        "dataset version": (record.dataset_version, dataset_version(task)),
        "context sizes": (tuple(result.context for result in record.results), task.context_sizes),
        "frames that errors are of": (sorted(frames), [task.frames]),
    }
    if not record.materials:
        number = number_of_trajectories(task, record.tier, split)
        expected["number of trajectories"] = (len(record.keys), number)
    found = [f"{name}: {stated}, not {true}" for name, (stated, true) in expected.items() if stated != true]
    names = trajectory_names(task, record.tier, split)
    strange = sorted(set(record.keys) - set(names))
    if strange:
        found.append(f"trajectories: {strange[0]} is none of the {split} split of tier {record.tier}")
    return found + _of_the_training(record) + _of_the_configuration(record)


def _of_the_training(record: ResultRecord) -> list[str]:
    """What is true of no model."""
    described = record.checkpoint
    found = []
    if not 0 <= described.minutes < math.inf:
        found.append(f"minutes: {described.minutes}, not a time that training takes")
    if not 0 <= described.best_step <= described.steps:
        found.append(f"best_step: {described.best_step}, not one of {described.steps} steps")
    if record.parameters and not described.steps:
        found.append(f"steps: 0, but {record.model} learns")
    if described.steps and not record.parameters:
        found.append(f"steps: {described.steps}, but {record.model} has no parameters that could learn")
    return found


def _of_the_configuration(record: ResultRecord) -> list[str]:
    described = record.checkpoint
    is_installed = described.config.model_name in model_names()
    try:
        config = RunConfig.from_json(described.config.model_dump()) if is_installed else _as_stated(described)
        parameters = build_model(config, TASKS[record.task]).parameter_count() if is_installed else None
    except (BenchError, ValidationError) as error:
        return [f"configuration: none of {record.model}: {error}"]
    found = []
    if config.hash() != described.config_hash:
        found.append(f"config_hash: {described.config_hash}, not {config.hash()}")
    if parameters not in (None, record.parameters):
        found.append(f"parameters: {record.parameters}, not {parameters}")
    return found + (_of_the_budget(described, config.training) if described.steps else [])


def _as_stated(described: Checkpoint) -> RunConfig:
    """The configuration of a model that is not installed. Raises ValidationError where nothing is trained like that."""
    stated = described.config
    return RunConfig(
        model_name=stated.model_name,
        preset=stated.preset,
        model=_AsStated.model_validate(stated.model),
        training=TrainingConfig.model_validate(stated.training),
    )


def _of_the_budget(described: Checkpoint, training: TrainingConfig) -> list[str]:
    steps, minutes = training.steps, training.minutes
    if (steps is None) == (minutes is None):
        return [
            f"budget of its settings: steps {steps} and minutes {minutes}, but there is always one of them"
        ]
    if steps is not None and described.steps != steps:
        return [f"steps: {described.steps}, not the {steps} of its settings"]
    if minutes is not None and described.minutes > OVERTIME * minutes:
        return [f"minutes: {described.minutes:.3g}, not the {minutes:.3g} of its settings"]
    return []
