"""Everything in one go: the whole load in one increment, the whole path in one frame, twice the force."""

from dataclasses import replace

import numpy as np
import pytest
from block_cases import draw as draw_block
from sheet_cases import OPPOSITE, SAME, case, equilibria, relative_error
from tissue_cases import CASES

from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.generators.deformable_block import BASE, HEIGHT, DeformableBlock, make_block
from m3gn_bench.generators.falling import FallingTeddy
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.sheet_deformation import MIN_PRINCIPAL_STRAIN, SheetDeformation
from m3gn_bench.generators.solvers.explicit import ExplicitSolid
from m3gn_bench.generators.tissue_manipulation import TissueManipulation


@pytest.mark.parametrize("youngs_modulus", [10.0, 1000.0])
def test_sheet_with_the_whole_load_at_once(youngs_modulus: float) -> None:
    """An equilibrium does not depend on the increments that led to it."""
    parameters = case(youngs_modulus, SAME)
    _, _, gradual = equilibria(parameters, refinement=1, tolerance=1e-8, increments=50)
    _, _, at_once = equilibria(parameters, refinement=1, tolerance=1e-8, increments=1)
    assert relative_error(at_once[-1], gradual[-1]) < 1e-5


@pytest.mark.parametrize("forces", [SAME, OPPOSITE], ids=["same", "opposite"])
@pytest.mark.parametrize("youngs_modulus", [10.0, 100.0, 1000.0])
def test_sheet_under_twice_the_force(youngs_modulus: float, forces: tuple[float, float]) -> None:
    """Valid, or refused for a reason: never in silence beyond what the material law can bear."""
    scene = SheetDeformation()
    parameters = case(youngs_modulus, (2 * forces[0], 2 * forces[1]))
    trajectory = scene.simulate(parameters)
    problems = scene.check(trajectory)
    print(f"E {youngs_modulus}, {forces}: {problems or 'valid'}")
    assert np.isfinite(trajectory.positions).all()
    beyond = trajectory.diagnostics["min_principal_strain"] < MIN_PRINCIPAL_STRAIN
    assert beyond == any("compressive membrane strain" in problem for problem in problems)
    once = scene.simulate(case(youngs_modulus, forces))
    deeper = np.abs(trajectory.positions[-1, :, 2]).max() / np.abs(once.positions[-1, :, 2]).max()
    assert 1.2 < deeper < 2.0  # it stiffens


def test_block_pressed_in_a_single_step() -> None:
    """40 mm in one step of 27 frames: solved, by bisections if need be."""
    parameters = replace(draw_block(1), poisson_ratios=(0.0, 0.49))
    block = make_block(parameters.widths, 8)
    dynamics, disc = DeformableBlock().prepare(parameters, block.body, block.contact_points, 1e-5)
    end = 40.0 / parameters.speed
    dynamics.advance(end, 1, "frame 1 of 1")
    print(f"{dynamics.newton.statistics.bisections} bisections")
    depth = BASE + HEIGHT - (disc.centre(end)[1] - disc.radius)
    assert depth == pytest.approx(40.0)
    sunk = -dynamics.displacement.reshape(-1, 2)[:, 1].min()
    assert sunk == pytest.approx(depth, rel=0.1)
    assert dynamics.time == pytest.approx(end)


@pytest.mark.parametrize("parameters", CASES)
def test_tissue_pulled_twice_as_fast(parameters: object) -> None:
    """Half the frames per way: the checks hold."""
    scene = TissueManipulation()
    trajectory = scene.simulate(replace(parameters, speed=2 * parameters.speed))  # type: ignore[type-var, attr-defined]
    assert scene.check(trajectory) == []


def test_a_fall_in_one_frame() -> None:
    """The same substeps give the same bits, however many frames are recorded on the way."""
    scene = FallingTeddy()
    parameters = draw(scene, "test", 0, DATASET_SEED)
    body = scene.body("teddy")
    start = 0.5 * body.vertices
    start = start - [0, 0, start[:, 2].min()]
    solid = ExplicitSolid(
        start,
        body.tetrahedra,
        density=1000.0,
        youngs_modulus=parameters.youngs_modulus,
        poisson_ratio=parameters.poisson_ratio,
        viscosity=100.0,
        friction=0.5,
    )
    landing = np.tile([0.0, 0.0, -3.0], (solid.nodes, 1))
    frames = solid.run(start, landing, frames=16, frame_time=1 / 64, substeps=64)
    one = solid.run(start, landing, frames=1, frame_time=16 / 64, substeps=16 * 64)
    assert np.array_equal(one.positions[-1], frames.positions[-1])
