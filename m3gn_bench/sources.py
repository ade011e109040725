"""Where trajectories come from: a dataset file that is there already, or the generator.

The only module besides the command line that reaches into the generators, and only when called: models and
evaluation work without a simulator installed.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.datasets.file import find_dataset, open_file, read_metadata
from m3gn_bench.datasets.plugins import leave_out
from m3gn_bench.datasets.schema import SPLITS, Split, parse_key, tier_sizes, trajectory_key
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.tasks import TASKS, Task, task_of_data

if TYPE_CHECKING:
    from m3gn_bench.generators.scene import Scene


def find_or_generate(
    task: Task,
    tier: str,
    folder: Path,
    *,
    splits: Sequence[Split] = SPLITS,
    workers: int = 1,
    executor: str = "process",
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """A dataset file in `folder` that holds the task's tier and splits; generated if there is none.

    Args:
        task, tier, splits: what it must hold.
        folder: where to look, and to put it.
        workers, executor, on_progress: see `generate`.

    Raises:
        GeneratorError, DatasetError: see `generate`.
    """
    from m3gn_bench.generators.generate import generate
    from m3gn_bench.generators.scene import get_scene

    scene = get_scene(task.scene)
    found = find_dataset(folder, task.scene, tier, splits, scene.dataset_version)
    if found is not None:
        return found

    return generate(
        scene,
        tier,
        folder,
        splits=splits,
        workers=workers,
        executor=executor,
        on_progress=on_progress,
    ).file


def usable_tasks() -> "list[tuple[Task, Scene]]":
    """All tasks with their scenes, without those of packages that cannot be used."""
    from m3gn_bench.generators.scene import scene_names, usable_scenes

    scenes = usable_scenes()
    found = []
    for task in TASKS.values():
        if task.scene in scenes:
            found.append((task, scenes[task.scene]))
        elif task.scene not in scene_names():  # a scene that is there, but unusable, was named already
            leave_out(f"task {task.name!r}: {unknown_name('scene', task.scene, scene_names())}")
    return found


def given(path: Path, name: str) -> tuple[Task, str]:
    """A task as a given dataset file has it, and the tier that is all of the file."""
    with open_file(path) as file:
        metadata = read_metadata(file)
    return task_of_data(name, metadata), metadata.tier


def number_of_trajectories(task: Task, tier: str, split: Split) -> int:
    """How many trajectories of a split take part in a task in a tier."""
    from m3gn_bench.generators.scene import get_scene

    scene = get_scene(task.scene)
    return scene.task_size(task.name, split, tier_sizes(tier, scene.paper_sizes)[split])


def trajectory_names(task: Task, tier: str, split: Split) -> list[str]:
    """All that a tier's split has in the dataset, also those that take no part in the task."""
    from m3gn_bench.generators.scene import get_scene

    scene = get_scene(task.scene)
    return [trajectory_key(split, index) for index in range(tier_sizes(tier, scene.paper_sizes)[split])]


def dataset_version(task: Task) -> str:
    """The version of the dataset that the task's scene makes."""
    from m3gn_bench.generators.scene import get_scene

    return get_scene(task.scene).dataset_version


def regenerate(task: Task, keys: Sequence[str]) -> tuple[list[Case], list[str]]:
    """Simulate single trajectories anew, by their names in the dataset; returns cases and content hashes."""
    from m3gn_bench.generators.scene import get_scene

    trajectories = [_simulate(task.scene, key) for key in keys]
    cases = [
        case_from(task, get_scene(task.scene), trajectory, key)
        for key, trajectory in zip(keys, trajectories, strict=True)
    ]
    return cases, [trajectory.content_hash() for trajectory in trajectories]


@lru_cache(maxsize=256)  # several records are checked on the same trajectories
def _simulate(scene_name: str, key: str) -> Trajectory:
    from m3gn_bench.generators.generate import simulate_one
    from m3gn_bench.generators.scene import get_scene

    trajectory, _ = simulate_one(get_scene(scene_name), *parse_key(key))
    return trajectory
