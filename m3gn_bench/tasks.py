"""The benchmark's tasks: which data, what a model is told about them, how it is scored.

What every model is told, and what is scored, is decided here; `docs/models.md` lists all decisions where the
paper leaves a choice.

- Node features are the node type (one-hot, where there is a collider: mesh or collider), then static features,
  then the height where the ground is not part of the graph. In Sheet Deformation the static features are the
  nodal force at full load and a flag for clamped nodes (the paper gives two numbers, which it does not name).
- A context of T^c frames are the frames 1..T^c; the last of them is the anchor. Scored are the frames after
  the anchor. Frames count states, so Sheet Deformation has 51 frames and 50 transitions.
- Nodes whose position is prescribed (clamped) are known to every model and are kept where they are. Errors
  are given over all nodes, and over free nodes only, which the former dilutes. Collider nodes are not scored.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.plugins import blamed_on_package, load, plugins, usable
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.errors import ConfigError


@dataclass(frozen=True)
class MaterialFeature:
    """A material parameter as a number in [-1, 1] over its range, on a linear or logarithmic scale."""

    name: str
    lower: float
    upper: float
    logarithmic: bool = False

    def __call__(self, value: float) -> float:
        """The scaled parameter."""
        scale: Callable[[float], float] = np.log if self.logarithmic else float
        lower, upper = scale(self.lower), scale(self.upper)
        return float(2 * (scale(value) - lower) / (upper - lower) - 1)


def _no_static_features(trajectory: Trajectory) -> np.ndarray:
    return np.zeros((len(trajectory.mesh.rest_positions), 0), np.float32)


@dataclass(frozen=True)
class Task:
    """A task. Without more being said, nodes have no static features, and nothing but themselves to meet.

    Attributes:
        name: as used on the command line.
        title: as used in tables.
        scene: the generator whose dataset file holds the task's split.
        dimension: of space.
        frames: states per trajectory.
        material: what a model with material information is told.
        context_sizes: numbers of context frames at which the task is scored.
        training_context: smallest and largest number of context frames in training.
        static_features: names of the static node features.
        static: computes them from a trajectory, shape [nodes, len(static_features)].
        has_collider: whether a rigid body with a known path takes part.
        collider_has_edges: whether it has edges of its own (a single grasping point has none).
        height_feature: whether nodes know their last coordinate, which stands for the ground.
        m3gn_history: the last movement among the simulator's inputs in M3GN (paper's parameter counts).
    """

    name: str
    title: str
    scene: str
    dimension: int
    frames: int
    material: tuple[MaterialFeature, ...]
    context_sizes: tuple[int, ...]
    training_context: tuple[int, int]
    static_features: tuple[str, ...] = ()
    static: Callable[[Trajectory], np.ndarray] = _no_static_features
    has_collider: bool = False
    collider_has_edges: bool = False
    height_feature: bool = False
    m3gn_history: bool = False

    @property
    def node_types(self) -> int:
        """Length of the node type's one-hot code: mesh, collider."""
        return 1 + self.has_collider

    @property
    def edge_types(self) -> int:
        """Length of the edge type's one-hot code: mesh, collider's own, collider to mesh, mesh to collider."""
        return 1 + self.collider_has_edges + 2 * self.has_collider

    @property
    def node_features(self) -> int:
        """Length of the node features that all models share: type, static features, height."""
        return self.node_types + len(self.static_features) + self.height_feature

    @property
    def collider_features(self) -> int:
        """Length of the feature that says where the collider will end, for models that look ahead."""
        return self.dimension * self.has_collider

    @property
    def middle_context(self) -> int:
        """The context size at which models are compared where one is enough."""
        return self.context_sizes[len(self.context_sizes) // 2]

    @property
    def edge_features(self) -> int:
        """Length of the edge features: type, rest vector and length, current vector and length."""
        return self.edge_types + 2 * (self.dimension + 1)


SHEET_FORCE_SCALE = 200.0  # [N], the magnitude of each force


def _sheet_features(trajectory: Trajectory) -> np.ndarray:
    force = trajectory.loads["nodal_forces"][:, 2] / SHEET_FORCE_SCALE
    return np.stack([force, trajectory.mesh.node_type == FIXED], axis=-1).astype(np.float32)


def _sheet(name: str, title: str) -> Task:
    return Task(
        name=name,
        title=title,
        scene="sheet_deformation",
        dimension=3,
        frames=51,
        static_features=("force", "clamped"),
        static=_sheet_features,
        has_collider=False,
        collider_has_edges=False,
        height_feature=False,
        material=(MaterialFeature("youngs_modulus", 10.0, 1000.0, logarithmic=True),),
        context_sizes=(2, 5, 10),
        training_context=(2, 15),
    )


def _falling(name: str, title: str) -> Task:
    return Task(
        name=name,
        title=title,
        scene=name,
        dimension=3,
        frames=201,
        static_features=(),
        static=_no_static_features,
        has_collider=False,
        collider_has_edges=False,
        height_feature=True,
        material=(MaterialFeature("youngs_modulus", 1e5, 1e6), MaterialFeature("poisson_ratio", 0.0, 0.499)),
        context_sizes=(10, 20, 30),
        training_context=(10, 50),
    )


OWN_TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        _sheet("sheet_deformation", "Sheet Deformation"),
        _sheet("sheet_deformation_ood", "Sheet Deformation (OOD)"),
        Task(
            name="deformable_block",
            title="Deformable Block",
            scene="deformable_block",
            dimension=2,
            frames=39,
            static_features=(),
            static=_no_static_features,
            has_collider=True,
            collider_has_edges=True,
            height_feature=False,
            material=(MaterialFeature("poisson_ratio", -0.9, 0.49),),
            context_sizes=(2, 5, 10),
            training_context=(2, 15),
            m3gn_history=True,
        ),
        Task(
            name="tissue_manipulation",
            title="Tissue Manipulation",
            scene="tissue_manipulation",
            dimension=3,
            frames=101,
            static_features=(),
            static=_no_static_features,
            has_collider=True,
            collider_has_edges=False,
            height_feature=False,
            material=(MaterialFeature("poisson_ratio", -0.9, 0.49),),  # determines Young's modulus
            context_sizes=(3, 10, 20),
            training_context=(2, 40),
            m3gn_history=True,
        ),
        _falling("falling_teddy", "Falling Teddy Bear"),
        _falling("mixed_objects", "Mixed Objects Falling"),
    )
}


class _Tasks(Mapping[str, Task]):
    """Our own tasks, then those of other packages: loaded only where it is they, or all, that are asked for.

    Iteration goes on without a package that cannot be used; looking up its task raises PluginError.
    """

    def __getitem__(self, name: str) -> Task:
        if name in OWN_TASKS:
            return OWN_TASKS[name]
        if name not in plugins("task"):
            raise KeyError(name)
        return task_of_package(name)

    def __iter__(self) -> Iterator[str]:
        yield from OWN_TASKS
        for name, _ in usable("task", task_of_package, OWN_TASKS):
            yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)


@cache
def task_of_package(name: str) -> Task:
    """What an entry point gives: a task, or a callable that returns one."""
    found = load("task", name)
    with blamed_on_package("task", name):
        task = found() if callable(found) else found
        if not isinstance(task, Task):
            raise TypeError(f"it is no Task but of type {type(task).__name__}")
        if task.name != name:
            raise ValueError(f"the task calls itself {task.name!r}")
    return task


TASKS: Mapping[str, Task] = _Tasks()


def get_task(name: str) -> Task:
    """The task of that name.

    Raises:
        ConfigError: there is none (lists all).
        PluginError: it belongs to another package, which cannot be used (names the package).
    """
    if name not in TASKS:
        raise ConfigError(unknown_name("task", name, list(TASKS)))
    return TASKS[name]


def task_of_data(name: str, metadata: Metadata) -> Task:
    """The task as a dataset has it: data of others have a length of their own, and may not tell the material.

    Raises:
        ConfigError: no such task.
        DatasetError: too few frames for the contexts that models are trained on and scored at.
    """
    task = get_task(name)
    if not metadata.is_imported:
        return task
    longest = max(*task.context_sizes, *task.training_context)
    if metadata.frames <= longest:
        raise DatasetError(
            f"{metadata.frames} frames are too few for task {name}, whose models see up to {longest} of them and "
            "predict the rest"
        )
    told = tuple(feature for feature in task.material if feature.name in metadata.material_units)
    return replace(task, frames=metadata.frames, material=told)
