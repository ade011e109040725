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
    """A rigid body whose place depends on time alone. Points have the shape [points, d]."""

    def depth(self, points: Array, time: float) -> Array:
        """How deep points lie below the surface at that time, negative outside, shape [points]."""
        ...

    def normal(self, points: Array, time: float) -> tuple[Array, Array]:
        """Outward normal n, shape [points, d], and curvature c of the level sets of the depth, shape [points].

        The normal changes by c (I - n n^T) per length.
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

    def depth(self, points: Array, time: float) -> Array:
        """See Obstacle."""
        offset = points - self.centre(time)
        return self.radius - np.sqrt((offset * offset).sum(-1))

    def normal(self, points: Array, time: float) -> tuple[Array, Array]:
        """See Obstacle."""
        offset = points - self.centre(time)
        distance = np.maximum(np.sqrt((offset * offset).sum(-1)), 1e-9 * self.radius)
        return offset / distance[:, None], 1 / distance


class _Touch(NamedTuple):
    """The contact points inside one obstacle: their indices, and everything weighted for integration."""

    points: NDArray[np.intp]
    normal: Array  # [touching, d]
    stiffness: Array  # eps, weighted
    bending: Array  # pressure times curvature, weighted


class ContactState(NamedTuple):
    """Contact under one displacement.

    Attributes:
        energy: of the penalty.
        force: its derivative with respect to the displacement, shape [dofs]; None without contact.
        resultants: force of the body on each obstacle, shape [obstacles, d].
    """

    energy: float
    force: Array | None
    resultants: Array
    touches: tuple[_Touch, ...]


class BoundaryPoints:
    """Gauss points on a part of a solid's boundary, and the basis functions that do not vanish there.

    Never changed, so many simulations may share it.

    Args:
        solid: the body.
        facets: indices of boundary facets of its mesh.
        integration_order: polynomial degree that the facets' Gauss rule integrates exactly (5: three points
            on an edge).

    Attributes:
        elements: behind each facet, shape [facets].
        dofs, local_dofs: of the functions, in the solid and in the element, shape [facets, d * functions].
        values: of the functions, shape [facets, points, functions].
        weights: of integration over the boundary at rest, shape [facets, points].
    """

    def __init__(self, solid: Solid, facets: NDArray[np.integer], integration_order: int) -> None:
        basis = FacetBasis(solid.mesh, solid.basis.elem, facets=facets, intorder=integration_order)
        values = np.array([np.broadcast_to(np.asarray(f[0]), basis.dx.shape) for f in basis.basis])
        values = values.transpose(1, 2, 0)  # facet, point, function
        there = np.abs(values).max(1) > 1e-12
        functions = int(there.sum(1).max())
        local = np.sort(np.argsort(~there, axis=1, kind="stable")[:, :functions], axis=1)
        d = solid.dimension
        component = np.arange(d)
        self._nodes = np.take_along_axis(basis.element_dofs.T.astype(np.int64), local, axis=1)
        self.elements: NDArray[np.int64] = solid.mesh.f2t[0, facets].astype(np.int64)
        self.dofs = (d * self._nodes[:, :, None] + component).reshape(len(local), -1)
        self.local_dofs = (d * local[:, :, None] + component).reshape(len(local), -1)
        self.values = np.ascontiguousarray(np.take_along_axis(values, local[:, None, :], axis=2))
        self.values_transposed = np.ascontiguousarray(self.values.swapaxes(1, 2))
        self.weights: Array = np.ascontiguousarray(basis.dx)
        self.rest: Array = self.values @ solid.nodes[self._nodes]

    def positions(self, u: Array) -> Array:
        """Where the points are under displacements u [..., dofs], shape [..., facets, points, d]."""
        d = self.rest.shape[-1]
        return self.rest + self.values @ u.reshape(*u.shape[:-1], -1, d)[..., self._nodes, :]


class PenaltyContact:
    """The penalty energy on a part of a solid's boundary.

    Args:
        boundary: the points that may touch an obstacle.
        penalty: eps [pressure per length].
        obstacles: rigid bodies.
    """

    def __init__(self, boundary: BoundaryPoints, *, penalty: float, obstacles: Sequence[Obstacle]) -> None:
        self.boundary = boundary
        self.penalty = penalty
        self.obstacles = tuple(obstacles)

    def evaluate(self, u: Array, time: float) -> ContactState:
        """Energy and forces under the displacement u, shape [dofs]."""
        boundary = self.boundary
        positions = boundary.positions(u)
        facets, points, d = positions.shape
        x = positions.reshape(-1, d)
        energy = 0.0
        resultants = np.zeros((len(self.obstacles), d))
        touches = []
        traction: Array | None = None
        for k, obstacle in enumerate(self.obstacles):
            depth = obstacle.depth(x, time)
            inside = (depth > 0).nonzero()[0]
            if not inside.size:
                continue
            depth = depth[inside]
            normal, curvature = obstacle.normal(x[inside], time)
            stiffness = self.penalty * boundary.weights.ravel()[inside]
            pressure = stiffness * depth
            energy += 0.5 * float(pressure @ depth)
            if traction is None:
                traction = np.zeros_like(x)
            push = pressure[:, None] * normal
            traction[inside] -= push
            resultants[k] = -push.sum(0)
            touches.append(_Touch(inside, normal, stiffness, pressure * curvature))
        force: Array | None = None
        if traction is not None:
            nodal = boundary.values_transposed @ traction.reshape(facets, points, d)
            force = np.bincount(boundary.dofs.ravel(), nodal.ravel(), len(u)).astype(np.float64, copy=False)
        return ContactState(energy, force, resultants, tuple(touches))

    def add_stiffness(self, state: ContactState, matrices: Array) -> None:
        """Add the second derivative of the energy to the element matrices [elements, n, n] of the solid."""
        boundary = self.boundary
        points, functions = boundary.values.shape[1:]
        d = boundary.rest.shape[-1]
        for touch in state.touches:
            n = touch.normal
            hessians = ((touch.stiffness + touch.bending)[:, None] * n)[:, :, None] * n[:, None, :]
            for i in range(d):
                hessians[:, i, i] -= touch.bending
            facet, point = np.divmod(touch.points, points)
            values = boundary.values[facet, point]
            blocks = (
                values[:, :, None, None, None]
                * hessians[:, None, :, None, :]
                * values[:, None, None, :, None]
            )
            local = boundary.local_dofs[facet]
            where = (boundary.elements[facet, None, None], local[:, :, None], local[:, None, :])
            np.add.at(matrices, where, blocks.reshape(len(n), functions * d, functions * d))
