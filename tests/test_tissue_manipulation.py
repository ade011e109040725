"""The tissue scene, quickly; `validation/` goes deeper."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.generate import draw, simulate_one
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.generators.tissue_manipulation import (
    FIXED_HEIGHT,
    HEIGHT,
    MATERIALS,
    PATCH_HEIGHT,
    PATCHES,
    THICKNESS,
    TRANSITIONS,
    TissueFidelity,
    TissueManipulation,
    TissueParameters,
    grasp_point,
    make_slab,
    surface,
    to_physical,
)

SCENE = TissueManipulation()


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """As datasets are made; matrices this small only suffer from more."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """Nearly incompressible tissue pulled to the upper left."""
    return SCENE.simulate(TissueParameters(*MATERIALS[2], patch=5, angle=130.0), "fast")


# --- the recorded surface ---------------------------------------------------------------------------------


def edges_of(cells: np.ndarray) -> np.ndarray:
    """Directed edges of the triangles, shape [3 * triangles, 2]."""
    return np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]])


def test_surface_has_the_counts_of_the_original() -> None:
    mesh = surface().mesh
    edges = {frozenset(edge) for edge in edges_of(mesh.cells).tolist()}
    assert (len(mesh.rest_positions), len(mesh.cells), len(edges)) == (361, 718, 1077)
    assert np.array_equal(np.unique(mesh.cells), np.arange(361))


def test_surface_is_closed_and_outward() -> None:
    """Every directed edge once, and its opposite once; no pinched vertex; Euler's number of a sphere."""
    mesh = surface().mesh
    edges = edges_of(mesh.cells)
    directed = Counter(map(tuple, edges.tolist()))
    assert set(directed.values()) == {1}
    assert all((b, a) in directed for a, b in directed)
    assert len(mesh.rest_positions) - len(edges) // 2 + len(mesh.cells) == 2
    for vertex in range(361):  # the triangles around it are a single fan
        turned = np.concatenate([np.roll(mesh.cells, k, axis=1) for k in range(3)])
        following = {a: b for v, a, b in turned.tolist() if v == vertex}
        start = at = next(iter(following))
        fan: list[int] = []
        while at != start or not fan:
            fan.append(at)
            at = following[at]
        assert len(fan) == len(following)
    corners = surface().rest_positions[mesh.cells]
    volume = np.einsum("ci,ci->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    z = np.linspace(0, HEIGHT, 2001)
    width = to_physical(np.column_stack([np.ones_like(z), 0 * z, z]))[:, 0]
    width -= to_physical(np.column_stack([0 * z, 0 * z, z]))[:, 0]
    assert volume == pytest.approx(THICKNESS * np.trapezoid(width, z), rel=2e-3)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.min() > 3  # [mm^2]


def test_foot_is_fixed_and_faces_mirror_each_other() -> None:
    recorded = surface()
    fixed = recorded.mesh.node_type == FIXED
    assert np.array_equal(fixed, recorded.rest_positions[:, 2] <= FIXED_HEIGHT)
    assert 0 < fixed.sum() < 361
    opposite = recorded.rest_positions[recorded.mirrored]
    assert np.allclose(opposite, recorded.rest_positions * (1, -1, 1), atol=1e-12)


# --- the slab ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("patch", range(PATCHES))
def test_slab_is_that_of_the_surface(patch: int) -> None:
    """Recorded rest positions are interpolated from the solid's nodes, and the patch is whole cells."""
    slab = make_slab(patch, (6, 1, 8))
    interpolated = slab.interpolation @ slab.body.solid.nodes
    above = surface().rest_positions[:, 2] > FIXED_HEIGHT
    assert (
        np.abs(interpolated - surface().rest_positions)[above].max() < 0.2
    )  # of 80 mm: the outline is cubic
    assert not interpolated[~above].any()
    nodes = np.unique(slab.body.constrained[slab.gripped] // 3)
    assert len(nodes) == 20  # of one hexahedron
    low, high = slab.body.solid.nodes[nodes].min(0), slab.body.solid.nodes[nodes].max(0)
    assert (low[2], high[2]) == (HEIGHT - PATCH_HEIGHT, HEIGHT)
    point = grasp_point(patch)
    assert (low <= point).all()
    assert (point <= high).all()
    assert surface().grasped(patch).sum() == 6


# --- sampling ---------------------------------------------------------------------------------------------


def test_sampling() -> None:
    drawn = [draw(SCENE, "train", index, DATASET_SEED) for index in range(600)]
    draws = [parameters for parameters in drawn if isinstance(parameters, TissueParameters)]
    assert len(draws) == 600
    assert Counter(d.poisson_ratio for d in draws[:96]) == dict.fromkeys((-0.9, 0.0, 0.49), 32)
    assert {(d.poisson_ratio, d.youngs_modulus) for d in draws} == set(MATERIALS)
    assert {d.patch for d in draws} == set(range(PATCHES))
    angles = np.array([d.angle for d in draws])
    assert angles.min() >= 0
    assert angles.max() <= 180
    assert np.histogram(angles, 6, (0, 180))[0].min() > 75
    assert all(d.direction[2] >= 0 and d.direction[1] == 0 for d in draws)


def test_registered() -> None:
    assert get_scene("tissue_manipulation") == SCENE
    assert SCENE.task_size("tissue_manipulation", "test", 120) == 120


# --- a simulation -----------------------------------------------------------------------------------------


def test_simulation(trajectory: Trajectory) -> None:
    assert SCENE.check(trajectory) == []
    assert trajectory.positions.shape == (SCENE.frames, 361, 3)
    assert trajectory.positions.dtype == np.float32
    assert set(trajectory.material) == set(SCENE.material_units)
    assert set(trajectory.loads) == set(SCENE.load_units)
    scaled = (trajectory.positions - np.array(SCENE.scale_centre)) / SCENE.scale_length
    assert np.abs(scaled).max() <= 1
    assert np.array_equal(trajectory.positions[0], trajectory.mesh.rest_positions)
    assert trajectory.diagnostics["min_jacobian"] > 0.5
    assert trajectory.diagnostics["bisections"] == 0


def test_gripper_is_followed(trajectory: Trajectory) -> None:
    """0.25 mm per frame in a straight line, with the grasped vertices."""
    path = trajectory.collider_positions
    assert path is not None
    steps = np.diff(path[:, 0].astype(np.float64), axis=0)
    assert np.allclose(steps, 0.25 * trajectory.loads["direction"], atol=1e-5)
    grasped = surface().grasped(int(trajectory.loads["patch"][0]))
    moved = trajectory.positions - trajectory.mesh.rest_positions
    assert np.allclose(moved[:, grasped], (path - path[0]), atol=2e-5)
    assert (trajectory.mesh.node_type[grasped] != FIXED).all()
    assert np.linalg.norm(moved[-1, grasped], axis=-1) == pytest.approx(25.0, abs=1e-4)


def test_force_grows_with_stiffness() -> None:
    """It is proportional to the stiffness."""
    pulls = [
        SCENE.simulate(TissueParameters(nu, E, patch=9, angle=90.0), "fast").diagnostics
        for nu, E in ((0.0, 20e3), (0.0, 80e3))
    ]
    ratio = pulls[1]["max_gripper_force_newton"] / pulls[0]["max_gripper_force_newton"]
    assert ratio == pytest.approx(4, rel=1e-4)


def test_same_draw_gives_the_same_content() -> None:
    first, _ = simulate_one(SCENE, "test", 1, fidelity="fast")
    make_slab.cache_clear()
    second, _ = simulate_one(SCENE, "test", 1, fidelity="fast")
    assert first.content_hash() == second.content_hash()
    other, _ = simulate_one(SCENE, "test", 2, fidelity="fast")
    assert other.content_hash() != first.content_hash()


def test_a_hopeless_pull_is_an_error_that_says_where() -> None:
    """A gripper as fast as a rifle bullet, down into the foot."""
    push = TissueParameters(*MATERIALS[1], patch=9, angle=-90.0, speed=1e6)
    with pytest.raises(SolverError, match=rf"frame 1 of {TRANSITIONS}: .*bisections.*smallest J"):
        SCENE.simulate_with(push, TissueFidelity((6, 1, 8), 1, 1e-3))


# --- faults that the checks must find ---------------------------------------------------------------------


def planted(trajectory: Trajectory, fault: str) -> Trajectory:
    positions = trajectory.positions.copy()
    recorded = surface()
    rest = recorded.rest_positions
    middle = int(np.argmin(np.abs(rest - (0, -5, 65)).sum(1)))
    diagnostics = dict(trajectory.diagnostics)
    if fault == "not finite":
        positions[50, middle] = np.nan
    elif fault == "a fixed node moves":
        positions[7:, recorded.mesh.node_type == FIXED] += np.float32(1e-3)
    elif fault == "strays from the gripper":
        positions[30:, recorded.grasped(int(trajectory.loads["patch"][0]))] += np.float32(0.01)
    elif fault == "turns over":
        across = positions[40, recorded.mesh.cells[(recorded.mesh.cells == middle).any(1)]].reshape(-1, 3)
        positions[40:, middle] += 2.2 * (across.max(0) - positions[40, middle]) * (1, 0, 1)
    elif fault == "is crushed":
        cell = recorded.mesh.cells[(recorded.mesh.cells == middle).any(1)][0]
        corners = positions[60, cell]
        positions[60:, cell[0]] = 0.97 * corners[1:].mean(0) + 0.03 * corners[0]
    elif fault == "jumps":
        positions[80:, rest[:, 2] > 60] += np.array([0, 0, 1.5], np.float32)
    elif fault == "buckles":
        bend = np.clip(rest[:, 2] - FIXED_HEIGHT, 0, None) * np.clip(95 - rest[:, 2], 0, None)
        growth = np.linspace(0, 1, len(positions)) ** 4
        positions[..., 1] += (1e-5 * growth[:, None] * bend).astype(np.float32)
    elif fault == "unstable":
        diagnostics["unstable_frames"] = 1
    elif fault == "of its volume":
        diagnostics["min_jacobian"] = 0.05
    return replace(trajectory, positions=positions, diagnostics=diagnostics)


@pytest.mark.parametrize(
    "fault",
    [
        "not finite",
        "a fixed node moves",
        "strays from the gripper",
        "turns over",
        "is crushed",
        "jumps",
        "buckles",
        "unstable",
        "of its volume",
    ],
)
def test_planted_faults_are_found(trajectory: Trajectory, fault: str) -> None:
    problems = SCENE.check(planted(trajectory, fault))
    assert any(fault in problem for problem in problems), problems


def test_a_push_that_would_buckle_is_refused() -> None:
    """The solver finds the wall that stays straight; the check knows that this equilibrium is unstable."""
    push = SCENE.simulate(TissueParameters(*MATERIALS[1], patch=9, angle=-90.0, speed=6.0), "fast")
    assert any("unstable" in problem for problem in SCENE.check(push))
