"""Symmetric sparse matrices whose pattern never changes: assemble by one `bincount`, factorise banded.

A finite-element model is assembled thousands of times on the same mesh, so the map from element entries
to matrix slots is computed once. Below a few thousand unknowns a banded Cholesky factorisation beats general
sparse LU, and it reports an indefinite matrix, which LU does not.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

Array = NDArray[np.float64]


class BandedAssembler:
    """Gathers element vectors and matrices into the free unknowns, in lower banded storage.

    Args:
        element_dofs: global degrees of freedom of every element, shape [elements, local_dofs].
        free: the unconstrained degrees of freedom, shape [unknowns].
        dofs: number of all degrees of freedom.
        orders: permutations of the unknowns that might make the band narrow; the given numbering and reverse
            Cuthill-McKee are tried in any case.
    """

    def __init__(
        self,
        element_dofs: NDArray[np.int64],
        free: NDArray[np.int64],
        dofs: int,
        orders: Sequence[NDArray[np.integer]] = (),
    ) -> None:
        self.free = free
        self.dofs = dofs
        self.unknowns = len(free)
        self._element_dofs = element_dofs.ravel()

        unknown_of = np.full(dofs, -1, dtype=np.int64)
        unknown_of[free] = np.arange(self.unknowns)
        local = unknown_of[element_dofs]
        rows = np.repeat(local, local.shape[1], axis=1).ravel()
        columns = np.tile(local, (1, local.shape[1])).ravel()
        inside = (rows >= 0) & (columns >= 0)

        pattern = csr_matrix(
            (np.ones(inside.sum(), dtype=np.int8), (rows[inside], columns[inside])),
            shape=(self.unknowns,) * 2,
        )
        # On a rectangular mesh numbered row by row the given order beats Cuthill-McKee, which goes diagonally.
        candidates = (
            np.arange(self.unknowns),
            reverse_cuthill_mckee(pattern, symmetric_mode=True),
            *orders,
        )
        self._order = min(candidates, key=lambda order: _bandwidth(rows[inside], columns[inside], order))
        rank = np.argsort(self._order)
        banded_row, banded_column = rank[rows], rank[columns]
        lower = inside & (banded_row >= banded_column)
        self._entries = np.flatnonzero(lower)
        offset = (banded_row - banded_column)[lower].astype(np.int64)
        self.bandwidth = int(offset.max())
        self._slots = offset * self.unknowns + banded_column[lower]

    def vector(self, element_vectors: Array) -> Array:
        """Sum element vectors [elements, local_dofs] into the free unknowns [unknowns]."""
        return self.full_vector(element_vectors)[self.free]

    def full_vector(self, element_vectors: Array) -> Array:
        """Sum element vectors [elements, local_dofs] into all degrees of freedom [dofs]."""
        return _gather(self._element_dofs, element_vectors.ravel(), self.dofs)

    def matrix(self, element_matrices: Array) -> Array:
        """Sum element matrices [elements, local_dofs, local_dofs] into [bandwidth + 1, unknowns]."""
        size = (self.bandwidth + 1) * self.unknowns
        return _gather(self._slots, element_matrices.reshape(-1)[self._entries], size).reshape(
            self.bandwidth + 1, self.unknowns
        )

    def factorise(self, matrix: Array) -> "BandedCholesky":
        """Cholesky factorisation of an assembled matrix.

        Raises:
            LinAlgError: the matrix is not positive definite.
        """
        return BandedCholesky(matrix, self._order)

    def factorise_shifted(self, matrix: Array) -> "tuple[BandedCholesky, int]":
        """Factorise A + sigma diag|A| with the smallest sigma of a geometric series that is definite.

        Returns the factor and how often sigma was raised (0: the matrix was definite as it is).

        Raises:
            LinAlgError: not even a shift by a thousand times the diagonal helps (NaN, in practice).
        """
        diagonal = np.abs(matrix[0])
        diagonal = np.maximum(diagonal, 0.01 * diagonal.mean())  # an entry may just be changing its sign
        shifted = matrix
        for attempt in range(10):
            try:
                return self.factorise(shifted), attempt
            except LinAlgError:
                shifted = matrix.copy()
                shifted[0] += 1e-5 * 10**attempt * diagonal
        raise LinAlgError("the stiffness matrix stays indefinite under a diagonal shift")


def _gather(slots: NDArray[np.int64], values: Array, size: int) -> Array:
    """Sum values into slots."""
    return np.asarray(np.bincount(slots, values, size), dtype=np.float64)


def _bandwidth(rows: NDArray[np.int64], columns: NDArray[np.int64], order: NDArray[np.integer]) -> int:
    rank = np.argsort(order)
    return int(np.abs(rank[rows] - rank[columns]).max())


class BandedCholesky:
    """A = L L^T in lower banded storage, with the permutation that made the band narrow."""

    def __init__(self, matrix: Array, order: NDArray[np.integer]) -> None:
        self._order = order
        self._factor = cholesky_banded(matrix, lower=True, check_finite=False)

    def solve(self, right_hand_side: Array) -> Array:
        """Solve A x = b, b of shape [unknowns]."""
        x = np.empty_like(right_hand_side)
        x[self._order] = cho_solve_banded(
            (self._factor, True), right_hand_side[self._order], check_finite=False
        )
        return x
