"""The benchmark's tasks: which data, what a model is told about them, how it is scored.

Every ambiguity of the paper that touches features or scoring is decided here:

- Node features are the node type (one-hot), then static features. In Sheet Deformation these are the nodal
  force at full load and a flag for clamped nodes (the paper gives two numbers, which it does not name).
- A context of T^c frames are the frames 1..T^c; the last of them is the anchor. Scored are the frames after
  the anchor. Frames count states, so Sheet Deformation has 51 frames and 50 transitions.
- Nodes whose position is prescribed (clamped) are known to every model and are kept where they are. Errors
  are given over all nodes, and over free nodes only, which the former dilutes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from m3gn_bench.datasets.errors import unknown_name
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


@dataclass(frozen=True)
class Task:
    """A task.

    Attributes:
        name: as used on the command line.
        title: as used in tables.
        scene: the generator whose dataset file holds the task's split.
        dimension: of space.
        frames: states per trajectory.
        node_types: length of the node type's one-hot code.
        static_features: names of the static node features.
        static: computes them from a trajectory, shape [nodes, len(static_features)].
        edge_types: length of the edge type's one-hot code.
        has_collider: whether a rigid body with a known path takes part.
        material: what a model with material information is told.
        context_sizes: numbers of context frames at which the task is scored.
        training_context: smallest and largest number of context frames in training.
        m3gn_history: past velocities among the simulator's inputs in M3GN (paper's parameter counts).
    """

    name: str
    title: str
    scene: str
    dimension: int
    frames: int
    node_types: int
    static_features: tuple[str, ...]
    static: Callable[[Trajectory], np.ndarray]
    edge_types: int
    has_collider: bool
    material: tuple[MaterialFeature, ...]
    context_sizes: tuple[int, ...]
    training_context: tuple[int, int]
    m3gn_history: int

    @property
    def node_features(self) -> int:
        """Length of the node features that all models share: type, collider displacement, static."""
        return self.node_types + self.dimension * self.has_collider + len(self.static_features)

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
        node_types=1,
        static_features=("force", "clamped"),
        static=_sheet_features,
        edge_types=1,
        has_collider=False,
        material=(MaterialFeature("youngs_modulus", 10.0, 1000.0, logarithmic=True),),
        context_sizes=(2, 5, 10),
        training_context=(2, 15),
        m3gn_history=0,
    )


TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        _sheet("sheet_deformation", "Sheet Deformation"),
        _sheet("sheet_deformation_ood", "Sheet Deformation (OOD)"),
    )
}


def get_task(name: str) -> Task:
    """The task of that name. Raises ConfigError listing all tasks if there is none."""
    if name not in TASKS:
        raise ConfigError(unknown_name("task", name, list(TASKS)))
    return TASKS[name]
