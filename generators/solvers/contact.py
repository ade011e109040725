"""Frictionless contact of a solid's boundary with rigid obstacles, by a penalty at Gauss points.

The energy is the integral of eps/2 <penetration>^2 over the boundary at rest, so the contact pressure is eps
times the penetration. Any obstacle is described by its depth function: how deep a point lies inside, and in
which direction it is pushed out.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from skfem import FacetBasis

from m3gn_bench.generators.solvers.finite_strain import Solid
from m3gn_bench.generators.solvers.sparse import Array


class Obstacle(Protocol):
    """A rigid body whose place depends on time alone."""

    def depth(self, points: Array, time: float) -> tuple[Array, Array, Array]:
        """Where points lie with respect to the obstacle.

        Args:
            points: shape [points, d].
            time: at which the obstacle is looked at.

        Returns:
            Depth below the surface (negative outside), shape [points]; outward normal n, shape [points, d];
            curvature c of the level sets, shape [points]: the normal changes by c (I - n n^T) per length.
        """
        ...


@dataclass(frozen=True)
class Disc:
    """A circle (in three dimensions: a ball) that moves at constant velocity.

    Attributes:
        radius: of the circle.
        start: its centre at time 0.
        velocity: of the centre.
    """

    radius: float
    start: tuple[float, ...]
    velocity: tuple[float, ...]

    def centre(self, time: float) -> Array:
        """Shape [d]."""
        return np.array(self.start) + time * np.array(self.velocity)

    def depth(self, points: Array, time: float) -> tuple[Array, Array, Array]:
        """See Obstacle."""
        offset = points - self.centre(time)
        distance = np.sqrt(np.einsum("pi,pi->p", offset, offset))
        inverse = 1 / np.maximum(distance, 1e-9 * self.radius)
        return self.radius - distance, offset * inverse[:, None], inverse


@dataclass(frozen=True)
class Floor:
    """The half-space below a height along the last axis."""

    height: float

    def depth(self, points: Array, time: float) -> tuple[Array, Array, Array]:
        """See Obstacle."""
        normal = np.zeros_like(points)
        normal[:, -1] = 1
        return self.height - points[:, -1], normal, np.zeros(len(points))


class ContactState(NamedTuple):
    """Contact under one displacement.

    Attributes:
        energy: of the penalty.
        force: its derivative with respect to the displacement, shape [dofs].
        resultants: force of the body on each obstacle, shape [obstacles, d].
        max_penetration: of each obstacle, 0 without contact, shape [obstacles].
        hessians: d^2 energy / dx^2 at the contact points, weighted, shape [facets, points, d, d].
    """

    energy: float
    force: Array
    resultants: Array
    max_penetration: Array
    hessians: Array


class PenaltyContact:
    """The penalty energy on a part of a solid's boundary.

    Args:
        solid: the body.
        facets: indices of boundary facets of its mesh that may touch an obstacle.
        integration_order: polynomial degree that the facets' Gauss rule integrates exactly (5: three points
            on an edge).
        penalty: eps [pressure per length].
        obstacles: rigid bodies.
    """

    def __init__(
        self,
        solid: Solid,
        facets: NDArray[np.integer],
        *,
        integration_order: int,
        penalty: float,
        obstacles: Sequence[Obstacle],
    ) -> None:
        self.penalty = penalty
        self.obstacles = tuple(obstacles)
        self._boundary = _Boundary.of(solid, facets, integration_order)

    @property
    def elements(self) -> NDArray[np.int64]:
        """The element behind every facet, shape [facets]."""
        return self._boundary.elements

    def positions(self, u: Array) -> Array:
        """Where the contact points are under the displacement u [dofs], shape [facets, points, d]."""
        return self._boundary.positions(u)

    def evaluate(self, u: Array, time: float) -> ContactState:
        """Energy, forces and Hessians under the displacement u, shape [dofs]."""
        boundary = self._boundary
        facets, points, _ = boundary.values.shape
        x = boundary.positions(u)
        d = x.shape[-1]
        x = x.reshape(-1, d)
        weights = self.penalty * boundary.weights.ravel()
        energy = 0.0
        traction = np.zeros_like(x)
        hessians = np.zeros((len(x), d, d))
        resultants = np.zeros((len(self.obstacles), d))
        max_penetration = np.zeros(len(self.obstacles))
        for k, obstacle in enumerate(self.obstacles):
            depth, normal, curvature = obstacle.depth(x, time)
            inside = np.flatnonzero(depth > 0)
            if not inside.size:
                continue
            depth, n, stiffness = depth[inside], normal[inside], weights[inside]
            pressure = stiffness * depth
            energy += 0.5 * float(pressure @ depth)
            push = pressure[:, None] * n
            traction[inside] -= push
            resultants[k] = -push.sum(0)
            max_penetration[k] = depth.max()
            bending = pressure * curvature[inside]
            hessians[inside] += ((stiffness + bending)[:, None] * n)[:, :, None] * n[:, None, :]
            for i in range(d):
                hessians[inside, i, i] -= bending
        if energy:
            nodal = boundary.values_transposed @ traction.reshape(facets, points, d)
            force: Array = np.bincount(boundary.dofs.ravel(), nodal.ravel(), len(u)).astype(
                np.float64, copy=False
            )
        else:
            force = np.zeros_like(u)
        return ContactState(
            energy, force, resultants, max_penetration, hessians.reshape(facets, points, d, d)
        )

    def add_stiffness(self, state: ContactState, matrices: Array) -> None:
        """Add the second derivative of the energy to the element matrices [elements, n, n] of the solid."""
        active = np.flatnonzero(state.hessians.any((1, 2, 3)))
        if not active.size:
            return
        boundary = self._boundary
        values = boundary.values[active]
        size = values.shape[-1] * state.hessians.shape[-1]
        facet = np.einsum("fqa,fqij,fqb->faibj", values, state.hessians[active], values, optimize=False)
        local = boundary.local_dofs[active]
        np.add.at(
            matrices,
            (boundary.elements[active, None, None], local[:, :, None], local[:, None, :]),
            facet.reshape(-1, size, size),
        )


@dataclass(frozen=True, eq=False)
class _Boundary:
    """Basis functions on facets; the functions that vanish there are left out."""

    elements: NDArray[np.int64]  # [facets]
    dofs: NDArray[np.int64]  # [facets, functions * d], of the solid
    local_dofs: NDArray[np.int64]  # [facets, functions * d], within the element
    nodes: NDArray[np.int64]  # [facets, functions]
    values: Array  # [facets, points, functions]
    values_transposed: Array
    weights: Array  # [facets, points]
    rest: Array  # [facets, points, d]

    @classmethod
    def of(cls, solid: Solid, facets: NDArray[np.integer], integration_order: int) -> "_Boundary":
        basis = FacetBasis(solid.mesh, solid.basis.elem, facets=facets, intorder=integration_order)
        values = np.array([np.broadcast_to(np.asarray(f[0]), basis.dx.shape) for f in basis.basis])
        values = values.transpose(1, 2, 0)  # facet, point, function
        there = np.abs(values).max(1) > 1e-12
        functions = int(there.sum(1).max())
        local = np.sort(np.argsort(~there, axis=1, kind="stable")[:, :functions], axis=1)
        rows = np.arange(len(local))[:, None]
        nodes = basis.element_dofs.T[rows, local].astype(np.int64)
        values = np.ascontiguousarray(np.take_along_axis(values, local[:, None, :], axis=2))
        d = solid.dimension
        component = np.arange(d)
        return cls(
            elements=solid.mesh.f2t[0, facets].astype(np.int64),
            dofs=(d * nodes[:, :, None] + component).reshape(len(nodes), -1),
            local_dofs=(d * local[:, :, None] + component).reshape(len(nodes), -1),
            nodes=nodes,
            values=values,
            values_transposed=np.ascontiguousarray(values.swapaxes(1, 2)),
            weights=np.ascontiguousarray(basis.dx),
            rest=values @ solid.nodes[nodes],
        )

    def positions(self, u: Array) -> Array:
        return self.rest + self.values @ u.reshape(-1, self.rest.shape[-1])[self.nodes]
