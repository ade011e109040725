"""Predictions that need no learning; a model that does not beat them has learned nothing."""

import hashlib
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from m3gn_bench.data import Body, Case, Context
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.model import Model, ModelConfig, hold_fixed
from m3gn_bench.tasks import Task


class StandStill(Model):
    """Every node stays at the anchor."""

    def predict(self, context: Context) -> Tensor:
        """The anchor, repeated, shape [horizon, nodes, dim]."""
        return context.positions[-1].expand(context.horizon, -1, -1)


class ConstantVelocity(Model):
    """Every node goes on as it moved last."""

    def predict(self, context: Context) -> Tensor:
        """Linear extrapolation of the last two frames, shape [horizon, nodes, dim]."""
        steps = torch.arange(1, context.horizon + 1, device=context.positions.device)[:, None, None]
        return context.positions[-1] + steps * (context.positions[-1] - context.positions[-2])


class ScaledVelocity(Model):
    """Every node goes on along its last movement, as far as a function of time says that is the same for all.

    Attributes:
        factors: multiples of the last movement that fit the training data best, by anchor and by predicted frame,
            both counted from 0; shape [frames, frames], zero where there is nothing to predict.
    """

    factors: Tensor

    def __init__(self, task: Task, config: ModelConfig) -> None:
        super().__init__(task, config)
        self.register_buffer("factors", torch.zeros(task.frames, task.frames))

    def prepare(self, cases: Sequence[Case]) -> None:
        """Least squares for every anchor and frame, in which all trajectories count alike."""
        # All that least squares needs are scalar products of displacements since the first frame.
        products = np.zeros(self.factors.shape)
        for case in cases:
            moved = (case.positions - case.positions[0]).flatten(1).numpy().astype(np.float64)
            products += moved @ moved.T / moved.shape[1]
        with_velocity = np.diff(products, axis=0)  # row t: products with the movement from t to t + 1
        for anchor, with_all in enumerate(with_velocity, start=1):
            square = with_all[anchor] - with_all[anchor - 1]
            if square > 0:
                factors = (with_all[anchor + 1 :] - with_all[anchor]) / square
                self.factors[anchor, anchor + 1 :] = torch.from_numpy(factors)

    def predict(self, context: Context) -> Tensor:
        """The anchor plus multiples of the last movement, shape [horizon, nodes, dim]."""
        factors = self.factors[context.size - 1, context.size :, None, None]
        return context.positions[-1] + factors * (context.positions[-1] - context.positions[-2])


def mesh_fingerprints(body: Body) -> list[int]:
    """A number for the mesh of each body: the same edges between the same nodes give the same number."""
    counts = torch.bincount(body.body_of_node[body.edges[0]], minlength=len(body.node_counts)).tolist()
    fingerprints, start = [], 0
    for nodes, edges in zip(body.node_counts, body.edges.split(counts, dim=1), strict=True):
        content = np.append((edges - start).cpu().numpy(), nodes).astype("<i8").tobytes()
        digest = hashlib.sha256(content).digest()
        fingerprints.append(int.from_bytes(digest[:8], "little", signed=True))
        start += nodes
    return fingerprints


class MeshMemory(Model):
    """Base of models that keep trajectories of each mesh of the training data.

    Nodes of different trajectories correspond to each other only on the same mesh. All that is kept is in
    tensors, whose sizes depend on the data, so that a checkpoint holds it.

    Attributes:
        meshes: fingerprint of each mesh, shape [meshes], int64.
        node_counts: its number of nodes, shape [meshes].
        kept: number of trajectories kept of it, shape [meshes].
        paths: these trajectories side by side, shape [frames, sum of kept * node_counts, dim].
    """

    BUFFERS: ClassVar[tuple[str, ...]] = ("meshes", "node_counts", "kept", "paths")

    meshes: Tensor
    node_counts: Tensor
    kept: Tensor
    paths: Tensor

    def __init__(self, task: Task, config: ModelConfig) -> None:
        super().__init__(task, config)
        for name in ("meshes", "node_counts", "kept"):
            self.register_buffer(name, torch.zeros(0, dtype=torch.long))
        self.register_buffer("paths", torch.zeros(task.frames, 0, task.dimension))

    def remember(self, paths: dict[int, Tensor]) -> None:
        """Keep trajectories, given by their mesh's fingerprint, each of shape [frames, kept, nodes, dim]."""
        self.meshes = torch.tensor(list(paths))
        self.kept = torch.tensor([path.shape[1] for path in paths.values()])
        self.node_counts = torch.tensor([path.shape[2] for path in paths.values()])
        self.paths = torch.cat([path.flatten(1, 2) for path in paths.values()], dim=1)

    def recall(self, body: Body) -> list[Tensor]:
        """What is kept of each body's mesh, shape [frames, kept, nodes, dim] each.

        Raises:
            DatasetError: the training data had no such mesh.
        """
        known = self.meshes.tolist()
        parts = self.paths.split((self.kept * self.node_counts).tolist(), dim=1)
        found = []
        for index, fingerprint in enumerate(mesh_fingerprints(body)):
            if fingerprint not in known:
                raise DatasetError(
                    f"body {index + 1} of {len(body.node_counts)} has a mesh of {body.node_counts[index]} nodes "
                    f"whose edges are those of none of the {len(known)} meshes in the training data; "
                    f"{type(self).__name__} predicts only meshes that it was prepared with"
                )
            place = known.index(fingerprint)
            found.append(parts[place].unflatten(1, (int(self.kept[place]), -1)))
        return found

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: object) -> None:
        for name in self.BUFFERS:
            if prefix + name in state_dict:
                device = getattr(self, name).device
                setattr(self, name, torch.empty_like(state_dict[prefix + name], device=device))
        super()._load_from_state_dict(state_dict, prefix, *args)


class MeanTrajectory(MeshMemory):
    """Every node moves on from the anchor as it did on average over the training data on the same mesh."""

    def prepare(self, cases: Sequence[Case]) -> None:
        """Average the displacements since the first frame, in float64."""
        sums: dict[int, Tensor] = {}
        counts: dict[int, int] = {}
        for case in cases:
            moved = (case.positions - case.positions[0]).double().split(case.body.node_counts, dim=1)
            for mesh, displacement in zip(mesh_fingerprints(case.body), moved, strict=True):
                sums[mesh] = sums[mesh] + displacement if mesh in sums else displacement
                counts[mesh] = counts.get(mesh, 0) + 1
        self.remember({mesh: (total / counts[mesh]).float()[:, None] for mesh, total in sums.items()})

    def predict(self, context: Context) -> Tensor:
        """The anchor plus the mean's movement since the anchor, shape [horizon, nodes, dim].

        Raises:
            DatasetError: the training data had no such mesh.
        """
        mean = torch.cat([path[:, 0] for path in self.recall(context.body)], dim=1)
        now = context.size - 1
        return hold_fixed(context, context.positions[-1] + mean[now + 1 :] - mean[now])


class NeighbourConfig(ModelConfig):
    """How much the nearest neighbour is searched in."""

    # Training trajectories kept of each mesh, spread evenly over them; None keeps all. A checkpoint holds
    # every number of them.
    trajectories_per_mesh: int | None = Field(default=None, ge=1)


class NearestNeighbour(MeshMemory):
    """Every node moves on from the anchor as it did in the training trajectory that is closest so far.

    Among the kept training trajectories on the same mesh, the closest one has the smallest mean squared
    distance of node positions over the context's frames; nothing is aligned or removed.

    Of each mesh the preset "paper" keeps all training trajectories: 630 of Sheet Deformation, 350 of its OOD
    split, 675 of Deformable Block, 600 of Tissue Manipulation, 700 of Falling Teddy Bear, and 300 of each of
    the six Mixed Objects. The others keep as many as fit a checkpoint of a few MiB, see the preset file.
    """

    Config = NeighbourConfig
    preset_file = "nearest_neighbour.toml"
    config: NeighbourConfig

    def prepare(self, cases: Sequence[Case]) -> None:
        """Keep trajectories of every mesh."""
        candidates: dict[int, list[Tensor]] = {}
        for case in cases:
            paths = case.positions.split(case.body.node_counts, dim=1)
            for mesh, path in zip(mesh_fingerprints(case.body), paths, strict=True):
                candidates.setdefault(mesh, []).append(path)
        self.remember({mesh: torch.stack(self._chosen(paths), 1) for mesh, paths in candidates.items()})

    def predict(self, context: Context) -> Tensor:
        """The closest trajectory, shifted node by node onto the anchor, shape [horizon, nodes, dim].

        Raises:
            DatasetError: the training data had no such mesh.
        """
        seen = context.positions.split(context.body.node_counts, dim=1)
        continued = []
        for frames, kept in zip(seen, self.recall(context.body), strict=True):
            distances = (kept[: context.size] - frames[:, None]).square().mean((0, 2, 3))
            closest = kept[:, distances.argmin()]
            continued.append(closest[context.size :] + (frames[-1] - closest[context.size - 1]))
        return hold_fixed(context, torch.cat(continued, dim=1))

    def _chosen(self, paths: list[Tensor]) -> list[Tensor]:
        number = min(len(paths), self.config.trajectories_per_mesh or len(paths))
        return [paths[i * len(paths) // number] for i in range(number)]
