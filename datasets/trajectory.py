"""One simulated trajectory and the hash of its content."""

import hashlib
import json
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

VTK_TRIANGLE = 5
VTK_TETRA = 10
CELL_CORNERS = {VTK_TRIANGLE: 3, VTK_TETRA: 4}

FREE, FIXED = 0, 1  # node types: FIXED nodes never move (Dirichlet condition)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A mesh at rest.

    Attributes:
        rest_positions: stress-free node positions, physical units, shape [nodes, dim], float32.
        cells: node indices of each cell, shape [cells, corners], int32.
        cell_type: VTK cell type of all cells (5 triangle, 10 tetrahedron).
        node_type: FREE or FIXED, shape [nodes], uint8.
    """

    rest_positions: NDArray[np.float32]
    cells: NDArray[np.int32]
    cell_type: int
    node_type: NDArray[np.uint8]

    def arrays(self) -> dict[str, np.ndarray]:
        """The mesh as named arrays, as stored and as hashed."""
        return {
            "rest_positions": np.asarray(self.rest_positions, "<f4"),
            "cells": np.asarray(self.cells, "<i4"),
            "cell_type": np.asarray(self.cell_type, "<i4"),
            "node_type": np.asarray(self.node_type, "u1"),
        }


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Everything that is known of one simulation.

    Attributes:
        positions: node positions, physical units, shape [frames, nodes, dim], float32.
        mesh: the mesh at rest.
        material: parameters by name, in the unit that the dataset's metadata states.
        loads: named arrays that describe the load, e.g. nodal forces [N] of shape [nodes, dim].
        collider_positions: shape [frames, collider_nodes, dim], or None where there is no collider.
        collider_edges: node indices of the collider's own edges, shape [edges, 2], int32, or None where it
            has none (a grasping point, for example).
        tags: what else is known in words, e.g. {"object": "teddy"}.
        diagnostics: what the solver reports (iterations, seconds); not part of the content hash, because
            it describes the making, not the trajectory.
    """

    positions: NDArray[np.float32]
    mesh: Mesh
    material: dict[str, float]
    loads: dict[str, np.ndarray] = field(default_factory=dict)
    collider_positions: NDArray[np.float32] | None = None
    collider_edges: NDArray[np.int32] | None = None
    tags: dict[str, str] = field(default_factory=dict)
    diagnostics: dict[str, float] = field(default_factory=dict)

    def arrays(self) -> dict[str, np.ndarray]:
        """All content as named arrays; the names are the paths inside a trajectory's HDF5 group."""
        arrays = {f"mesh/{name}": value for name, value in self.mesh.arrays().items()}
        arrays["positions"] = np.asarray(self.positions, "<f4")
        arrays |= {f"loads/{name}": np.asarray(value, "<f4") for name, value in self.loads.items()}
        if self.collider_positions is not None:
            arrays["collider_positions"] = np.asarray(self.collider_positions, "<f4")
        if self.collider_edges is not None:
            arrays["collider_edges"] = np.asarray(self.collider_edges, "<i4")
        return arrays

    def content_hash(self) -> str:
        """SHA-256 over names, shapes, types and bytes of all arrays, over the material, and over the tags."""
        digest = hash_arrays(self.arrays())
        material = json.dumps({name: float(value) for name, value in self.material.items()}, sort_keys=True)
        digest.update(material.encode())
        if self.tags:
            digest.update(json.dumps(self.tags, sort_keys=True).encode())
        return digest.hexdigest()


def hash_arrays(arrays: dict[str, np.ndarray]) -> "hashlib._Hash":
    """A SHA-256 that has consumed the arrays in the order of their names (little endian, C order)."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest


def combine_hashes(hashes: dict[str, str]) -> str:
    """The content hash of a set of trajectories from their keys and hashes; the order does not matter."""
    lines = "".join(f"{key} {hashes[key]}\n" for key in sorted(hashes))
    return hashlib.sha256(lines.encode()).hexdigest()
