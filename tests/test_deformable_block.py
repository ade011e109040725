"""The Deformable Block scene, quickly; `validation/` goes deeper."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.generators.deformable_block import (
    BASE,
    COLLIDER_NODES,
    FRAME,
    HEIGHT,
    HIDDEN_FRAMES,
    POISSON_RATIOS,
    RADIUS,
    RECORDED_FRAMES,
    SPEED,
    START_RANGE,
    TRAPEZOIDS,
    BlockParameters,
    DeformableBlock,
    make_block,
    max_force_drop,
)
from m3gn_bench.generators.errors import GeneratorError, SolverError
from m3gn_bench.generators.scene import get_scene

PARAMETERS = BlockParameters(widths=(220.0, 180.0), poisson_ratios=(0.0, 0.49), radius=35.0, start=25.0)


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    return DeformableBlock().simulate(PARAMETERS)


# --- draws ------------------------------------------------------------------------------------------------


def test_draws_cover_all_pairs_of_trapezoid_and_ratio_evenly() -> None:
    scene = DeformableBlock()
    draws = [scene.sample(np.random.default_rng(i), i) for i in range(135)]
    pairs = Counter((d.widths, d.poisson_ratios[1]) for d in draws)
    assert set(pairs) == {(widths, ratio) for widths in TRAPEZOIDS for ratio in POISSON_RATIOS}
    assert set(pairs.values()) == {5}
    assert all(d.poisson_ratios[0] != d.poisson_ratios[1] for d in draws)
    assert len({d.poisson_ratios for d in draws}) == 6  # every ordered pair of different ratios
    radii = np.array([d.radius for d in draws])
    assert radii.min() > RADIUS[0]
    assert radii.max() < RADIUS[2]
    assert radii.mean() == pytest.approx(sum(RADIUS) / 3, rel=0.1)
    reach = np.array([abs(d.start) / (d.widths[1] / 2) for d in draws])
    assert START_RANGE * 0.9 < reach.max() < START_RANGE
    assert {d.poisson_ratios[1] for d in draws[:4]} == set(POISSON_RATIOS)  # so small tiers have them, too


# --- what is recorded -------------------------------------------------------------------------------------


def test_shapes_and_types(trajectory: Trajectory) -> None:
    assert trajectory.positions.shape == (RECORDED_FRAMES, 81, 2)
    assert trajectory.positions.dtype == np.float32
    assert trajectory.mesh.cells.shape == (128, 3)
    assert trajectory.collider_positions is not None
    assert trajectory.collider_positions.shape == (RECORDED_FRAMES, COLLIDER_NODES, 2)
    assert trajectory.collider_edges is not None
    assert trajectory.collider_edges.shape == (COLLIDER_NODES, 2)
    assert trajectory.material == {"poisson_ratio": 0.49}
    assert {name: value.shape for name, value in trajectory.loads.items()} == {
        "first_poisson_ratio": (1,),
        "radius": (1,),
        "start": (2,),
    }
    scene = DeformableBlock()
    assert set(scene.material_units) == set(trajectory.material)
    assert set(scene.load_units) == set(trajectory.loads)
    assert scene.check(trajectory) == []


def test_lattice_is_row_by_row_and_the_base_is_fixed(trajectory: Trajectory) -> None:
    rest = trajectory.mesh.rest_positions.reshape(9, 9, 2)
    assert np.allclose(rest[..., 1], np.linspace(BASE, BASE + HEIGHT, 9)[:, None])
    assert np.allclose(rest[0, [0, -1], 0], [-110, 110])
    assert np.allclose(rest[-1, [0, -1], 0], [-90, 90])
    fixed = trajectory.mesh.node_type == FIXED
    assert fixed[:9].all()
    assert not fixed[9:].any()
    assert (trajectory.positions[:, fixed] == trajectory.mesh.rest_positions[fixed]).all()
    edges = {
        tuple(sorted(pair)) for a, b, c in trajectory.mesh.cells.tolist() for pair in ((a, b), (b, c), (a, c))
    }
    assert len(edges) == 208


def test_circle_is_a_closed_ring_that_moves_straight_down(trajectory: Trajectory) -> None:
    ring, edges = trajectory.collider_positions, trajectory.collider_edges
    assert ring is not None
    assert edges is not None
    assert Counter(edges.ravel().tolist()) == dict.fromkeys(range(COLLIDER_NODES), 2)
    centres = ring.astype(float).mean(1)
    assert np.allclose(np.linalg.norm(ring - centres[:, None], axis=-1), PARAMETERS.radius, rtol=1e-5)
    assert np.allclose(np.diff(centres, axis=0), [0, -SPEED * FRAME], atol=1e-4)
    assert ring[:, 0, 1] == pytest.approx(ring[..., 1].min(1))  # node 0 is the lowest
    # Before the recording the circle went down for eleven frames from where it touched the top.
    assert ring[0, 0, 1] == pytest.approx(BASE + HEIGHT - HIDDEN_FRAMES * SPEED * FRAME, abs=1e-4)
    assert trajectory.loads["start"] == pytest.approx([25.0, BASE + HEIGHT + PARAMETERS.radius])


def test_recording_begins_with_a_history(trajectory: Trajectory) -> None:
    """At frame 0 the first material has been dented, and only it matters."""
    moved = np.linalg.norm(trajectory.positions[0] - trajectory.mesh.rest_positions, axis=-1)
    assert moved.max() > 8
    other = DeformableBlock().simulate(replace(PARAMETERS, poisson_ratios=(0.0, -0.9)))
    assert np.array_equal(other.positions[0], trajectory.positions[0])
    assert np.abs(other.positions[1] - trajectory.positions[1]).max() > 1


def test_incompressible_bulges_and_auxetic_shrinks(trajectory: Trajectory) -> None:
    def width(made: Trajectory) -> float:
        x = made.positions[-1].reshape(9, 9, 2)[4, :, 0]  # at half height
        return float(x[-1] - x[0])

    rest = trajectory.mesh.rest_positions.reshape(9, 9, 2)[4, [0, -1], 0]
    auxetic = DeformableBlock().simulate(replace(PARAMETERS, poisson_ratios=(0.0, -0.9)))
    assert width(auxetic) < 0.8 * np.ptp(rest) < np.ptp(rest) * 1.1 < width(trajectory)


def test_same_parameters_give_the_same_bytes(trajectory: Trajectory) -> None:
    make_block.cache_clear()
    assert DeformableBlock().simulate(PARAMETERS).content_hash() == trajectory.content_hash()


def test_mirrored_parameters_mirror_the_motion(trajectory: Trajectory) -> None:
    mirrored = DeformableBlock().simulate(replace(PARAMETERS, start=-PARAMETERS.start))
    flipped = mirrored.positions.reshape(-1, 9, 9, 2)[:, :, ::-1] * (-1, 1)
    assert np.abs(flipped - trajectory.positions.reshape(-1, 9, 9, 2)).max() < 0.01


def test_fast_is_close_to_default(trajectory: Trajectory) -> None:
    fast = DeformableBlock().simulate(PARAMETERS, "fast")
    moved = np.linalg.norm(trajectory.positions - trajectory.mesh.rest_positions)
    assert np.linalg.norm(fast.positions - trajectory.positions) < 0.01 * moved


# --- options ----------------------------------------------------------------------------------------------


def test_plane_strain_is_an_option(trajectory: Trajectory) -> None:
    scene = get_scene("deformable_block", plane="strain")
    assert scene.variant == {"plane": "strain"}
    assert DeformableBlock().variant == {}
    strained = scene.simulate(PARAMETERS, "fast")
    assert scene.check(strained) == []
    # Nothing can move out of the plane, so the block is stiffer and bulges more.
    assert strained.diagnostics["max_contact_force"] > 1.1 * trajectory.diagnostics["max_contact_force"]


def test_a_misspelt_plane_is_refused() -> None:
    with pytest.raises(GeneratorError, match="unknown plane 'sterss'; known: strain, stress"):
        get_scene("deformable_block", plane="sterss")


# --- checks -----------------------------------------------------------------------------------------------


def spoiled(trajectory: Trajectory, **changes: Any) -> list[str]:
    return DeformableBlock().check(replace(trajectory, **changes))


def test_checks_see_bad_positions(trajectory: Trajectory) -> None:
    def with_node(frame: int, node: int, shift: tuple[float, float]) -> np.ndarray:
        positions = trajectory.positions.copy()
        positions[frame:, node] += shift
        return positions

    broken = trajectory.positions.copy()
    broken[3, 4, 0] = np.nan
    for positions, expected in (
        (broken, "frame 3: positions are not finite; "),
        (with_node(5, 4, (0.1, 0)), "frame 5: a clamped node moves by 0.1 mm; "),
        (with_node(7, 40, (60, 0)), "frame 7: a triangle turns over, "),
        (with_node(20, 40, (0, 7)), "frame 20: a node jumps by "),
    ):
        assert spoiled(trajectory, positions=positions)[0].startswith(expected)


def test_checks_see_what_is_recorded(trajectory: Trajectory) -> None:
    """Not only what the solver says of itself: a ring that has gone, or a block that it does not move."""
    assert trajectory.collider_positions is not None
    ring = trajectory.collider_positions.copy()
    ring[5, 3] = np.nan
    assert spoiled(trajectory, collider_positions=ring)[0].startswith("frame 5: positions are not finite; ")
    still = np.repeat(trajectory.positions[:1], len(trajectory.positions), axis=0)
    assert "inside the circle of radius" in spoiled(trajectory, positions=still)[0]


@pytest.mark.parametrize(
    ("diagnostic", "value", "message"),
    [
        ("max_penetration", 4.0, "sinks in by 4.00 mm"),
        ("max_force_drop", 0.6, "contact force has fallen by 60%: "),
    ],
)
def test_checks_see_bad_contact(trajectory: Trajectory, diagnostic: str, value: float, message: str) -> None:
    (problem,) = spoiled(trajectory, diagnostics={**trajectory.diagnostics, diagnostic: value})
    assert message in problem


def test_force_drop() -> None:
    """The first two transitions may relax the force; later it must not collapse, and never vanish."""
    assert max_force_drop(np.array([9.0, 4, 5, 6, 7])) == (0, 2)
    assert max_force_drop(np.array([9.0, 4, 5, 8, 2, 9])) == (pytest.approx(0.75), 4)
    assert max_force_drop(np.array([9.0, 0, 5, 6, 7])) == (1, 1)


def test_a_circle_smaller_than_the_cells_punches_through_and_is_rejected() -> None:
    """It slips between contact points; the solver does not notice, the check does."""
    scene = DeformableBlock()
    problems = scene.check(scene.simulate(replace(PARAMETERS, radius=2.0), "fast"))
    assert any("punches through" in problem for problem in problems)


def test_a_lost_step_is_an_error_that_names_the_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tolerance below round-off is never reached."""
    hopeless = replace(DeformableBlock.fidelities["fast"], tolerance=1e-30)
    monkeypatch.setitem(DeformableBlock.fidelities, "fast", hopeless)
    with pytest.raises(SolverError, match=r"^frame -10 .*8 bisections.*residual.*smallest J \d"):
        DeformableBlock().simulate(PARAMETERS, "fast")
