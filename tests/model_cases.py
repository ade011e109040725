"""Small made-up cases of every kind of task, and what each registered model is known to read.

No simulator is involved: bodies have 16 to 30 nodes and move smoothly at random. Run this file to write the
stored outputs in `model_outputs.json` anew, after a change that is meant to alter what models compute.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.transform import Rotation

from m3gn_bench.data import Body, Case, both_directions, mesh_edges
from m3gn_bench.datasets.plugins import plugins
from m3gn_bench.model import Model, build_model, load_preset
from m3gn_bench.tasks import Task, get_task

KINDS = ("sheet_deformation", "deformable_block", "tissue_manipulation", "falling_teddy")
OURS = sorted(name for name, entry in plugins("model").items() if entry.value.startswith("m3gn_bench."))
OUTPUTS = Path(__file__).with_name("model_outputs.json")


def node_features(task: Task, rng: np.random.Generator, fixed: np.ndarray) -> np.ndarray:
    """Random forces and the flag of fixed nodes, for as many as the task has."""
    features = np.stack([rng.normal(0, 0.3, len(fixed)), fixed], -1)
    return features[:, : len(task.static_features)]


def assemble(
    task: Task,
    seed: int,
    rest: np.ndarray,
    edges: np.ndarray,
    fixed: np.ndarray,
    path: np.ndarray,
    collider_edges: np.ndarray,
    drift: np.ndarray,
) -> Case:
    """A case from its geometry; free nodes follow the drift [frames, 1, dim] and motions of their own."""
    rng = np.random.default_rng([seed, 1])
    time = np.linspace(0, 1, task.frames)[:, None, None]
    shapes = time ** rng.uniform(0.3, 0.8), np.sin(2 * time * rng.uniform(0.5, 1.5))
    own = sum(shape * rng.normal(0, 0.07, rest.shape) for shape in shapes)
    features = node_features(task, rng, fixed)
    body = Body(
        rest_positions=torch.tensor(rest, dtype=torch.float32),
        edges=torch.from_numpy(edges),
        static_features=torch.tensor(features, dtype=torch.float32),
        fixed=torch.tensor(fixed),
        material=torch.tensor(rng.uniform(-1, 1, (1, len(task.material))), dtype=torch.float32),
        collider_edges=torch.from_numpy(collider_edges),
        node_counts=(len(rest),),
        collider_counts=(path.shape[1],),
    )
    positions = rest + (drift + own) * ~fixed[:, None]
    return Case(
        body,
        torch.tensor(positions, dtype=torch.float32),
        torch.tensor(path, dtype=torch.float32),
        (f"test_{seed:05d}",),
    )


def lattice(side: int) -> np.ndarray:
    """Points of a square lattice over [-1, 1]^2, row by row from below."""
    ticks = np.linspace(-1, 1, side)
    return np.array([(x, y) for y in ticks for x in ticks])


def ellipsoid(nodes: int, semi_axes: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface: points on an ellipsoid, and the directed edges between them; the same at every call."""
    points = np.random.default_rng(nodes).normal(size=(nodes, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points * semi_axes, mesh_edges(ConvexHull(points).simplices)


NO_EDGES = np.zeros((2, 0), np.int64)


def sheet_case(seed: int, size: int = 4) -> Case:
    """A square sheet of size x size nodes, its border clamped."""
    task = get_task("sheet_deformation")
    flat = lattice(size)
    rest = np.pad(flat, ((0, 0), (0, 1)))
    border = np.abs(flat).max(1) > 0.99
    path = np.zeros((task.frames, 0, 3))
    return assemble(
        task,
        seed,
        rest,
        mesh_edges(Delaunay(flat).simplices),
        border,
        path,
        NO_EDGES,
        np.zeros((task.frames, 1, 3)),
    )


def block_case(seed: int, size: int = 4) -> Case:
    """A trapezoid of size x size nodes, its base clamped; a ring of 3 size nodes comes down on it.

    The ring starts out of reach of the block and ends in its uppermost row.
    """
    task = get_task("deformable_block")
    rng = np.random.default_rng([seed, 0])
    flat = lattice(size)
    rest = flat * np.stack([1 - 0.2 * rng.uniform() * (flat[:, 1] + 1) / 2, np.ones(len(flat))], -1)
    angles = np.arange(3 * size) * 2 * np.pi / (3 * size)
    radius = rng.uniform(0.2, 0.5)
    start = np.array([rng.uniform(-0.7, 0.7), 1.5 + radius])
    ring = start + radius * np.stack([np.sin(angles), -np.cos(angles)], -1)
    time = np.linspace(0, 1, task.frames)[:, None, None]
    collider_edges = both_directions(np.stack([np.arange(3 * size), np.roll(np.arange(3 * size), -1)], -1))
    drift = time * np.array([0.0, -0.1])
    base = flat[:, 1] < -0.99
    path = ring + time * np.array([0.0, -0.57])
    return assemble(task, seed, rest, mesh_edges(Delaunay(flat).simplices), base, path, collider_edges, drift)


def tissue_case(seed: int, size: int = 4) -> Case:
    """A closed surface of 5 size nodes, its lower part clamped; one collider node pulls at its top."""
    task = get_task("tissue_manipulation")
    rng = np.random.default_rng([seed, 0])
    rest, edges = ellipsoid(5 * size, (0.5, 0.25, 1.0))
    fixed = rest[:, 2] < np.sort(rest[:, 2])[size]
    time = np.linspace(0, 1, task.frames)[:, None, None]
    angle = rng.uniform(0, np.pi)
    pull = 0.5 * time * np.array([np.cos(angle), 0.0, np.sin(angle)])
    path = rest[[rest[:, 2].argmax()]] + pull
    return assemble(task, seed, rest, edges, fixed, path, NO_EDGES, 0.5 * pull)


def falling_case(seed: int, size: int = 4) -> Case:
    """A closed surface of 5 size nodes, turned at random, that falls towards z = 0 and slows down."""
    task = get_task("falling_teddy")
    shape, edges = ellipsoid(5 * size, (0.3, 0.4, 0.5))
    rest = Rotation.random(rng=seed).apply(shape) + np.array([0.0, 0.0, 1.0])
    time = np.linspace(0, 1, task.frames)[:, None, None]
    drift = -0.6 * np.tanh(3 * time**2) * np.array([0.0, 0.0, 1.0])
    path = np.zeros((task.frames, 0, 3))
    return assemble(task, seed, rest, edges, np.zeros(len(rest), bool), path, NO_EDGES, drift)


MAKERS: dict[str, Callable[[int, int], Case]] = dict(
    zip(KINDS, (sheet_case, block_case, tissue_case, falling_case), strict=True)
)


@cache
def make_case(kind: str, seed: int, size: int = 4) -> Case:
    """The made-up case of that number; `size` sets the number of nodes."""
    return MAKERS[kind](seed, size)


def training_cases(kind: str) -> list[Case]:
    """What models take their statistics from: three trajectories of the usual mesh, one of a larger."""
    return [*(make_case(kind, seed) for seed in range(3)), make_case(kind, 3, size=5)]


def build(name: str, kind: str, training: Sequence[Case]) -> Model:
    """A model of the smoke preset with random weights, prepared on some cases."""
    task = get_task(kind)
    model = build_model(load_preset(name, "smoke", task), task, seed=1)
    model.prepare(training)
    return model.eval()


@cache
def make_model(name: str, kind: str) -> Model:
    """The model that tests share; they must not change it."""
    return build(name, kind, training_cases(kind))


def usual_size(kind: str) -> int:
    """Context frames of most tests: many, so that few remain for a step-wise model to roll out."""
    return get_task(kind).frames - 8


def predict(model: Model, case: Case, size: int) -> torch.Tensor:
    """The model's prediction from the first `size` frames."""
    with torch.inference_mode():
        return model.predict(case.context(size))


@cache
def reference(name: str, kind: str, seed: int = 3) -> torch.Tensor:
    """The shared model's prediction on an unchanged case."""
    return predict(make_model(name, kind), make_case(kind, seed), usual_size(kind))


def permute(case: Case, order: torch.Tensor, collider_order: torch.Tensor) -> Case:
    """The same case with mesh nodes and collider nodes in another order."""
    place, collider_place = torch.argsort(order), torch.argsort(collider_order)
    body = replace(
        case.body,
        rest_positions=case.body.rest_positions[order],
        edges=place[case.body.edges],
        static_features=case.body.static_features[order],
        fixed=case.body.fixed[order],
        collider_edges=collider_place[case.body.collider_edges],
    )
    return Case(body, case.positions[:, order], case.collider_path[:, collider_order], case.keys)


def transform(case: Case, matrix: torch.Tensor, shift: torch.Tensor) -> Case:
    """The whole scene, collider included, after x -> matrix x + shift."""
    body = replace(case.body, rest_positions=case.body.rest_positions @ matrix.T + shift)
    return Case(body, case.positions @ matrix.T + shift, case.collider_path @ matrix.T + shift, case.keys)


def stored_numbers(name: str, kind: str) -> list[float]:
    """Root mean square of the predicted movement, and its projection on four random directions."""
    case, size = make_case(kind, 3), usual_size(kind)
    moved = (reference(name, kind) - case.positions[size - 1]).double().numpy()
    directions = np.random.default_rng(0).normal(size=(4, *moved.shape))
    scale = moved.size**0.5
    return [float(np.linalg.norm(moved) / scale), *((directions * moved).sum((1, 2, 3)) / scale).tolist()]


def main() -> None:
    """Write the stored outputs of all models that belong to this package."""
    torch.set_num_threads(1)
    outputs = {kind: {name: stored_numbers(name, kind) for name in OURS} for kind in KINDS}
    OUTPUTS.write_text(json.dumps(outputs, indent=1) + "\n")


if __name__ == "__main__":
    main()
