"""Makes the meshes of the falling objects: python generators/meshes/make_meshes.py OUT [--object NAME]

Distance field -> marching cubes -> even clusters -> fTetWild, many times over; what is kept is the mesh with the
largest stable time step, because the explicit solver's cost goes with its inverse. fTetWild is not
deterministic: run again, this gives other meshes of the same quality, whose trajectories differ in detail. The
meshes that belong to the benchmark are therefore the committed ones, and are never overwritten unless asked
(--overwrite). Needs the extra "mesh" and takes about one minute per object.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from m3gn_bench.generators.meshes.geometry import (
    Floats,
    Indices,
    boundary_triangles,
    cell_volumes,
    component_count,
    enclosed_volume,
    euler_characteristic,
    is_closed,
    smallest_dihedral_angle,
)
from m3gn_bench.generators.meshes.remeshing import Candidate, candidates, recipes
from m3gn_bench.generators.meshes.shapes import SHAPES, Field
from m3gn_bench.generators.objects import HASHES, MAX_SURFACE_NODES, SoftBody, write_object

GRID_STEP = 0.0125
GRID_CORNERS = np.array([-0.75, -0.75, -0.25]), np.array([0.75, 0.75, 1.25])
EXACT_SURFACE_NODES = {"teddy": 304}  # the paper's count
TARGETS = (296, 300, 304, 308, 312)
EDGE_FACTORS = (1.05, 1.15, 1.25, 1.4)
ENVELOPES = (0.003, 0.006)  # a wider one gives larger steps and takes the ears off
ROUNDS = 2  # through all combinations
CELLS = (900, 2200)  # fewer lock, more cost


def level_set(shape: Field) -> tuple[Floats, Indices]:
    """The zero level of a distance field by marching cubes, facing outwards.

    Raises:
        ValueError: the shape is open, in parts, or has handles.
    """
    from skimage.measure import marching_cubes

    low, high = GRID_CORNERS
    axes = [np.arange(start, stop, GRID_STEP) for start, stop in zip(low, high, strict=True)]
    field = shape(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    vertices, triangles, _, _ = marching_cubes(
        field, 0.0, spacing=(GRID_STEP,) * 3, gradient_direction="ascent"
    )
    vertices, triangles = vertices.astype(np.float64) + low, triangles.astype(np.int32)
    if not is_closed(triangles) or component_count(triangles) > 1 or euler_characteristic(triangles) != 2:
        raise ValueError("a shape must be one closed surface without handles")
    if enclosed_volume(vertices, triangles) < 0:
        triangles = triangles[:, ::-1].copy()
    return vertices, triangles


def choose(name: str) -> Candidate:
    """The candidate with the largest stable step among those of the right size."""
    vertices, triangles = level_set(SHAPES[name])
    exact = EXACT_SURFACE_NODES.get(name)
    targets = [exact] * len(TARGETS) if exact else TARGETS  # the same recipe gives another mesh each time
    sweep = ROUNDS * recipes(targets, EDGE_FACTORS, ENVELOPES)
    right = [
        candidate
        for candidate in candidates(vertices, triangles, sweep)
        if CELLS[0] <= len(candidate.tetrahedra) <= CELLS[1]
        and candidate.surface_nodes <= MAX_SURFACE_NODES
        and exact in (None, candidate.surface_nodes)
    ]
    if not right:
        raise RuntimeError(f"none of the meshes of {name} has the right size; widen the sweep")
    steps = sorted(candidate.stable_step for candidate in right)
    print(
        f"{name}: {len(right)} candidates of {len(sweep)}, stable step [s] from {steps[0]:.2e} over "
        f"{steps[len(steps) // 2]:.2e} to {steps[-1]:.2e}"
    )
    return max(right, key=lambda candidate: candidate.stable_step)


def statistics(chosen: Candidate) -> dict[str, float | int]:
    """What hashes.json says of a mesh of largest extent 1."""
    volumes = cell_volumes(chosen.vertices, chosen.tetrahedra)
    return {
        "nodes": len(chosen.vertices),
        "surface_nodes": chosen.surface_nodes,
        "surface_triangles": len(boundary_triangles(chosen.tetrahedra)),
        "tetrahedra": len(chosen.tetrahedra),
        "volume": float(f"{volumes.sum():.6g}"),
        "smallest_dihedral_angle_degrees": float(
            f"{smallest_dihedral_angle(chosen.vertices, chosen.tetrahedra):.4g}"
        ),
        "stable_step_seconds": float(f"{chosen.stable_step:.4g}"),
    }


def main(arguments: list[str]) -> None:
    """See the module's description."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path, help="folder for NAME.npz and hashes.json")
    parser.add_argument("--object", choices=list(SHAPES), help="make only this one")
    parser.add_argument("--overwrite", action="store_true", help="replace meshes that are already there")
    options = parser.parse_args(arguments)
    names = [options.object] if options.object else list(SHAPES)
    present = [name for name in names if (options.out / f"{name}.npz").exists()]
    if present and not options.overwrite:
        parser.error(f"{options.out} already holds {', '.join(present)}; give another folder or --overwrite")
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / HASHES
    entries = json.loads(table.read_text()) if table.exists() else {}
    for name in names:
        chosen = choose(name)
        body = SoftBody(name, chosen.vertices, chosen.tetrahedra, chosen.surface_nodes)
        write_object(body, options.out / f"{name}.npz")
        entries[name] = {"sha256": body.content_hash()} | statistics(chosen)
        table.write_text(json.dumps(entries, indent=2, sort_keys=True) + "\n")
        print(f"  {entries[name]}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
