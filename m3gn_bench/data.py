"""From stored trajectories to what models see: scaled tensors, and no more of the future than is allowed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.errors import ConfigError
from m3gn_bench.tasks import Task


@dataclass(frozen=True)
class Share:
    """What part of a batch some bodies are, where several processes have a part each (see `distributed`).

    Attributes:
        node_counts, collider_counts: number of mesh and of collider nodes of each body of the whole batch.
        first: the first body that is here; the others follow it.
    """

    node_counts: tuple[int, ...]
    collider_counts: tuple[int, ...]
    first: int


@dataclass(frozen=True, eq=False)
class Body:
    """What is known of one or several deformable bodies and their colliders and does not change with time.

    Several bodies form a disjoint union: their nodes are concatenated and their edges shifted, so every
    model handles a batch of trajectories without knowing it. Where there is no collider, it has no nodes.

    Attributes:
        rest_positions: the first frame, which models take for the body at rest; scaled, shape [nodes, dim].
        edges: sender and receiver of each directed mesh edge, sorted by receiver, shape [2, edges].
        static_features: shape [nodes, static].
        fixed: nodes that never move, shape [nodes], bool.
        material: scaled material parameters, one row per body, shape [bodies, materials].
        collider_edges: sender and receiver among collider nodes, shape [2, collider_edges].
        node_counts, collider_counts: number of mesh and of collider nodes of each body.
        share: what part of a batch this is; None: all of it.
    """

    rest_positions: Tensor
    edges: Tensor
    static_features: Tensor
    fixed: Tensor
    material: Tensor
    collider_edges: Tensor
    node_counts: tuple[int, ...]
    collider_counts: tuple[int, ...]
    share: Share | None = None

    @property
    def nodes(self) -> int:
        """Number of mesh nodes of all bodies."""
        return sum(self.node_counts)

    @property
    def collider_nodes(self) -> int:
        """Number of collider nodes of all bodies."""
        return sum(self.collider_counts)

    @cached_property
    def free_nodes(self) -> int:
        """Number of mesh nodes that may move."""
        return int((~self.fixed).sum())

    @cached_property
    def body_of_node(self) -> Tensor:
        """Index of the body that each mesh node belongs to, shape [nodes]."""
        return self._spread(self.node_counts)

    @cached_property
    def body_of_collider_node(self) -> Tensor:
        """Index of the body that each collider node belongs to, shape [collider_nodes]."""
        return self._spread(self.collider_counts)

    @cached_property
    def rest_vectors(self) -> Tensor:
        """Vector at rest from receiver to sender of each mesh edge, and its length, shape [edges, dim + 1]."""
        senders, receivers = self.edges
        return with_length(self.rest_positions[senders] - self.rest_positions[receivers])

    def drawn_per_body(self, draw: Callable[[int], np.ndarray]) -> np.ndarray:
        """Random numbers for bodies, along the last axis.

        Args:
            draw: gives so many. A share of a batch has them drawn for the whole batch and keeps its own, so that it
                does not matter how many processes share it.
        """
        whole = self.share or self
        return self._drawn(draw, (1,) * len(whole.node_counts), -1)

    def drawn_per_node(self, draw: Callable[[int], np.ndarray]) -> np.ndarray:
        """Random numbers for mesh nodes, along the last axis but one; see `drawn_per_body`."""
        whole = self.share or self
        return self._drawn(draw, whole.node_counts, -2)

    def drawn_per_collider_node(self, draw: Callable[[int], np.ndarray]) -> np.ndarray:
        """Random numbers for collider nodes, along the last axis but one; see `drawn_per_body`."""
        whole = self.share or self
        return self._drawn(draw, whole.collider_counts, -2)

    def _drawn(self, draw: Callable[[int], np.ndarray], counts: tuple[int, ...], axis: int) -> np.ndarray:
        """Those of own bodies, of whose counts along the axis `counts` tells for the whole batch."""
        values = draw(sum(counts))
        if self.share is None:
            return values
        stop = self.share.first + len(self.node_counts)
        own = np.arange(sum(counts[: self.share.first]), sum(counts[:stop]))
        return values.take(own, axis)

    def _spread(self, counts: tuple[int, ...]) -> Tensor:
        numbers = torch.tensor(counts, device=self.fixed.device)
        return torch.repeat_interleave(torch.arange(len(counts), device=numbers.device), numbers)


def with_length(vectors: Tensor) -> Tensor:
    """Vectors and their lengths, shape [..., dim + 1]."""
    return torch.cat([vectors, vectors.norm(dim=-1, keepdim=True)], dim=-1)


@dataclass(frozen=True, eq=False)
class Context:
    """What a model may know when it predicts: nothing of the mesh after the anchor.

    Attributes:
        body: the bodies.
        positions: frames 1..T^c, scaled, shape [context_frames, nodes, dim]; the last is the anchor.
        horizon: number of frames to predict.
        collider_path: the collider's positions in all frames, shape [frames, collider_nodes, dim].
        keys: the trajectories' names in the dataset, for seeds only: their numbers tell materials.
    """

    body: Body
    positions: Tensor
    horizon: int
    collider_path: Tensor
    keys: tuple[str, ...]

    @property
    def size(self) -> int:
        """Number of context frames T^c."""
        return len(self.positions)

    @property
    def frames(self) -> int:
        """Length of the whole trajectory in frames."""
        return self.size + self.horizon


def require_context(size: int, frames: int) -> None:
    """Raises ConfigError if so large a context of a trajectory of so many frames leaves nothing to predict."""
    if not 2 <= size < frames:
        raise ConfigError(
            f"context size {size} is out of range: a trajectory of {frames} frames allows 2 to {frames - 1}"
        )


@dataclass(frozen=True, eq=False)
class Case:
    """A whole trajectory (or several of the same length) in scaled units, from which contexts are cut.

    Attributes:
        body: the bodies.
        positions: shape [frames, nodes, dim].
        collider_path: shape [frames, collider_nodes, dim].
        keys: the trajectories' names in the dataset.
    """

    body: Body
    positions: Tensor
    collider_path: Tensor
    keys: tuple[str, ...]

    @property
    def frames(self) -> int:
        """Length in frames."""
        return len(self.positions)

    def context(self, size: int) -> Context:
        """The context of the first `size` frames. Raises ConfigError if it leaves nothing to predict."""
        require_context(size, self.frames)
        seen = self.positions[:size].clone()  # a view could be led back to the frames that follow
        return Context(self.body, seen, self.frames - size, self.collider_path, self.keys)

    def future(self, size: int) -> Tensor:
        """The frames after a context of that size, shape [frames - size, nodes, dim]."""
        return self.positions[size:]

    def to(self, where: torch.device | torch.dtype) -> "Case":
        """The same case on another device, or with its real numbers in another precision."""

        def move(value: Tensor) -> Tensor:
            real = value.is_floating_point()
            return value.to(where) if real or isinstance(where, torch.device) else value

        values = {field.name: getattr(self.body, field.name) for field in fields(Body)}
        moved: dict[str, Any] = {
            name: move(value) for name, value in values.items() if isinstance(value, Tensor)
        }
        return Case(replace(self.body, **moved), move(self.positions), move(self.collider_path), self.keys)


def join(cases: Sequence[Case]) -> Case:
    """Disjoint union of trajectories of equal length."""
    if len(cases) == 1:
        return cases[0]
    bodies = [case.body for case in cases]

    def shifted(edges: Sequence[Tensor], counts: Sequence[int]) -> Tensor:
        starts = np.cumsum([0, *counts[:-1]])
        return torch.cat([e + int(start) for e, start in zip(edges, starts, strict=True)], dim=1)

    body = Body(
        rest_positions=torch.cat([b.rest_positions for b in bodies]),
        edges=shifted([b.edges for b in bodies], [b.nodes for b in bodies]),
        static_features=torch.cat([b.static_features for b in bodies]),
        fixed=torch.cat([b.fixed for b in bodies]),
        material=torch.cat([b.material for b in bodies]),
        collider_edges=shifted([b.collider_edges for b in bodies], [b.collider_nodes for b in bodies]),
        node_counts=tuple(n for b in bodies for n in b.node_counts),
        collider_counts=tuple(n for b in bodies for n in b.collider_counts),
    )
    return Case(
        body=body,
        positions=torch.cat([case.positions for case in cases], dim=1),
        collider_path=torch.cat([case.collider_path for case in cases], dim=1),
        keys=tuple(key for case in cases for key in case.keys),
    )


def both_directions(pairs: np.ndarray) -> np.ndarray:
    """Directed edges, each once, from pairs of nodes [n, 2], sorted by receiver; shape [2, edges]."""
    unique = np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)  # rows (receiver, sender)
    return np.ascontiguousarray(unique[:, ::-1].T).astype(np.int64)


def mesh_edges(cells: np.ndarray) -> np.ndarray:
    """Both directions of every edge of a simplex mesh, sorted by receiver, shape [2, edges]."""
    corners = cells.shape[1]
    return both_directions(
        np.concatenate([cells[:, [i, j]] for i in range(corners) for j in range(i + 1, corners)])
    )


class Scaling(Protocol):
    """The map of a scene into [-1, 1]: a dataset's metadata has it, and so has a scene."""

    @property
    def scale_centre(self) -> tuple[float, ...]: ...

    @property
    def scale_length(self) -> float: ...


def case_from(task: Task, scaling: Scaling, trajectory: Trajectory, key: str) -> Case:
    """Scale a trajectory to [-1, 1] and add the task's features.

    Raises:
        DatasetError: the trajectory does not fit the task.
    """
    frames, _, dimension = trajectory.positions.shape
    if (frames, dimension) != (task.frames, task.dimension):
        raise DatasetError(
            f"trajectory {key} has {frames} frames in {dimension}-D, but task {task.name} has "
            f"{task.frames} in {task.dimension}-D"
        )
    centre = np.array(scaling.scale_centre)

    def scaled(positions: np.ndarray) -> Tensor:
        return torch.from_numpy(((positions - centre) / scaling.scale_length).astype(np.float32))

    path = trajectory.collider_positions
    if (path is not None) != task.has_collider:
        raise DatasetError(
            f"trajectory {key} has {'no' if path is None else 'a'} collider, but task {task.name} "
            f"has {'one' if task.has_collider else 'none'}"
        )
    collider_path = scaled(np.empty((frames, 0, dimension)) if path is None else path)
    collider_edges = trajectory.collider_edges
    material = [feature(trajectory.material[feature.name]) for feature in task.material]
    body = Body(
        # The first frame, not the stress-free shape: whoever watches a body that has a history (Deformable
        # Block) does not know it, and it would give the material away.
        rest_positions=scaled(trajectory.positions[0]),
        edges=torch.from_numpy(mesh_edges(trajectory.mesh.cells)),
        static_features=torch.from_numpy(task.static(trajectory)),
        fixed=torch.from_numpy(trajectory.mesh.node_type == FIXED),
        material=torch.tensor([material], dtype=torch.float32),
        collider_edges=torch.from_numpy(
            both_directions(np.empty((0, 2), np.int32) if collider_edges is None else collider_edges)
        ),
        node_counts=(len(trajectory.mesh.rest_positions),),
        collider_counts=(collider_path.shape[1],),
    )
    return Case(body, scaled(trajectory.positions), collider_path, (key,))


Materials = dict[str, tuple[float, ...]]  # values of material parameters, in their units


def load_cases(
    path: Path,
    task: Task,
    split: Split,
    tier: str | None = None,
    materials: Materials | None = None,
) -> list[Case]:
    """All trajectories of a split, in memory (every hash is verified on the way).

    Args:
        path: the dataset file.
        task, split, tier: what to read of it.
        materials: read only trajectories of these.

    Raises:
        DatasetError: the file is damaged, or holds no such trajectories.
        ConfigError: the scene has no such material parameter.
    """
    dataset = TrajectoryDataset(path, task.name, split, tier)
    unknown = set(materials or {}) - set(dataset.metadata.material_units)
    if unknown:
        raise ConfigError(
            unknown_name("material parameter", min(unknown), list(dataset.metadata.material_units))
        )
    cases = []
    for key, trajectory in zip(dataset.keys, map(dataset.__getitem__, range(len(dataset))), strict=True):
        if all(trajectory.material[name] in values for name, values in (materials or {}).items()):
            cases.append(case_from(task, dataset.metadata, trajectory, key))
    if not cases:
        of = f" of materials {materials}" if materials else ""
        raise DatasetError(f"{path} holds no {split} trajectories of task {task.name}{of}")
    return cases
