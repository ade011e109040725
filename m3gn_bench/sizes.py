"""How many parameters each model has under each preset on each task."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

from m3gn_bench.model import PRESETS, ModelConfig, get_model_class, load_preset, usable_models
from m3gn_bench.tasks import Task


def parameter_counts(tasks: Iterable[Task]) -> dict[tuple[str, str, str], int]:
    """Number of trainable parameters by model, preset and task: of all models that can be used."""
    return {
        (name, preset, task.name): _count(name, load_preset(name, preset, task).model, _shape(task))
        for name in sorted(usable_models())
        for task in tasks
        for preset in PRESETS
    }


def _shape(task: Task) -> Task:
    """The task without what cannot matter to a model's size; some tasks then are the same."""
    return replace(task, name="", title="", scene="")


@cache  # building a model takes most of the time
def _count(name: str, config: ModelConfig, task: Task) -> int:
    return get_model_class(name)(task, config).parameter_count()
