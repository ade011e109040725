"""Matrices that solvers keep in other forms, written out."""

import numpy as np

from m3gn_bench.generators.solvers.explicit import ExplicitSolid
from m3gn_bench.generators.solvers.sparse import BandedAssembler


def dense(assembler: BandedAssembler, banded: np.ndarray) -> np.ndarray:
    """A banded matrix in the order of the unknowns, shape [unknowns, unknowns], from its definition as a map."""
    lower = np.zeros((assembler.unknowns,) * 2)
    for offset, diagonal in enumerate(banded):
        lower += np.diag(diagonal[: assembler.unknowns - offset], -offset)
    matrix = np.empty_like(lower)
    order = assembler._order
    matrix[np.ix_(order, order)] = lower + lower.T - np.diag(banded[0])
    return matrix


def stiffness_at_rest(body: ExplicitSolid) -> np.ndarray:
    """Derivative of all forces by all coordinates, shape [3 nodes, 3 nodes], from differences of the force [N/m]."""
    masses, step = np.repeat(body.masses, 3), 1e-7
    columns = []
    for change in step * np.eye(3 * body.nodes):
        there, back = (
            body.accelerations(
                body.vertices + sign * change.reshape(-1, 3), np.zeros((body.nodes, 3))
            ).ravel()
            for sign in (1, -1)
        )
        columns.append(masses * (back - there) / (2 * step))
    return np.array(columns).T
