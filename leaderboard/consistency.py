"""What a record says of its task, its model and its run that is not so in this version of the project."""

from pydantic import ValidationError

from m3gn_bench.datasets.errors import BenchError, unknown_name
from m3gn_bench.datasets.schema import SPLITS, TIERS, as_split
from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.model import RunConfig, build_model, model_names
from m3gn_bench.sources import dataset_version, number_of_trajectories, trajectory_names
from m3gn_bench.tasks import TASKS

OVERTIME = 1.1  # a budget in minutes ends with the step that exceeds it


def contradictions(record: ResultRecord) -> list[str]:
    """One sentence each; none where all is well.

    A record's statistics need no look: they are derived from its errors whenever it is read. Parameters of a model
    that is not installed cannot be counted, nor is it known how many trajectories are of some materials only.
    """
    if record.task not in TASKS:
        return [unknown_name("task", record.task, list(TASKS))]
    if record.tier not in TIERS:
        return [unknown_name("tier", record.tier, list(TIERS))]
    if record.split not in SPLITS:
        return [unknown_name("split", record.split, list(SPLITS))]
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
    return found + (_of_the_configuration(record) if record.model in model_names() else [])


def _of_the_configuration(record: ResultRecord) -> list[str]:
    described = record.checkpoint
    try:
        config = RunConfig.from_json(described.config.model_dump())
        model = build_model(config, TASKS[record.task])
    except (BenchError, ValidationError) as error:
        return [f"configuration: none of {record.model}: {error}"]
    found = []
    if config.hash() != described.config_hash:
        found.append(f"config_hash: {described.config_hash}, not {config.hash()}")
    if model.parameter_count() != record.parameters:
        found.append(f"parameters: {record.parameters}, not {model.parameter_count()}")
    budget = config.training
    if model.is_learned and described.steps == 0:
        found.append(f"steps: 0, but {record.model} learns")
    elif model.is_learned and budget.steps is not None and described.steps != budget.steps:
        found.append(f"steps: {described.steps}, not the {budget.steps} of its settings")
    if budget.minutes is not None and described.minutes > OVERTIME * budget.minutes:
        found.append(f"minutes: {described.minutes:.3g}, not the {budget.minutes:.3g} of its settings")
    return found
