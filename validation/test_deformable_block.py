"""Deformable Block: contact against Hertz, locking, order in time, accuracy of the levels, random and extreme draws."""

import re
import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from block_cases import (
    displacements,
    draw,
    draws_with,
    hammered,
    press_half_space,
    pressed_by_circle,
    punch,
    punched,
    simulated,
)
from sheet_cases import relative_error
from skfem import ElementQuad2, ElementQuadS2, ElementTriP1, MeshQuad, MeshTri

from m3gn_bench.datasets.schema import Fidelity
from m3gn_bench.generators.deformable_block import (
    POISSON_RATIOS,
    SPEED,
    YOUNGS_MODULUS,
    BlockParameters,
    DeformableBlock,
)
from m3gn_bench.generators.errors import SolverError
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Setting

# -- contact -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poisson_ratio", POISSON_RATIOS)
@pytest.mark.parametrize("setting", ["plane stress", "plane strain"])
def test_hertz(setting: Setting, poisson_ratio: float) -> None:
    """Line contact: peak pressure sqrt(P E* / pi R) within 2 %, pressure profile within 15 % in the mean square (the
    contact ends inside a cell).

    K. L. Johnson, Contact Mechanics, section 4.2; E* = E in plane stress, E / (1 - nu^2) in plane strain. The
    force P is the measured one, so the finite depth of the block does not enter.
    """
    radius, force, x, pressure = press_half_space(poisson_ratio, setting)
    modulus = 1.0 if setting == "plane stress" else 1 / (1 - poisson_ratio**2)
    peak = np.sqrt(force * modulus / (np.pi * radius))
    half_width = np.sqrt(4 * force * radius / (np.pi * modulus))
    assert 1.2 < half_width < 1.6  # of 120: a half-space; and more than six cells of 0.2
    assert pressure.max() == pytest.approx(peak, rel=0.02)
    profile = peak * np.sqrt(np.clip(1 - (x / half_width) ** 2, 0, None))
    assert np.linalg.norm(pressure - profile) < 0.15 * np.linalg.norm(profile)


# -- locking -----------------------------------------------------------------------------------------------


def test_no_locking() -> None:
    """nu = 0.4999 in plane strain: the scene's element on its 8 x 8 cells against full biquadratics on 32 x 32.

    Linear triangles on the same nodes are there to show that the case would reveal locking.
    """
    law = NeoHookean.from_youngs_modulus(1.0, 0.4999, "plane strain")
    reference = punched(*punch(MeshQuad, ElementQuad2(), 32, 5), law)
    assert relative_error(punched(*punch(MeshQuad, ElementQuadS2(), 8, 3), law), reference) < 0.05
    assert relative_error(punched(*punch(MeshTri, ElementTriP1(), 8, 1), law), reference) > 0.5


# -- time --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("poisson_ratio", POISSON_RATIOS)
def test_second_order_in_time(poisson_ratio: float) -> None:
    """The scene's block, material, density and damping under a smooth motion of its top."""
    law = DeformableBlock().law(YOUNGS_MODULUS, poisson_ratio)
    ends = [hammered(law, steps) for steps in (4, 8, 16, 32)]
    errors = [np.linalg.norm(a - b) for a, b in pairwise(ends)]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 1.8).all(), orders
    assert orders[-1] < 2.3


@pytest.mark.parametrize("poisson_ratio", POISSON_RATIOS)
def test_one_step_per_frame_is_enough_under_the_circle(poisson_ratio: float) -> None:
    """With contact the order is uneven, for every point's first touch is a kink; but the error is tiny."""
    parameters = next(p for p in map(draw, range(99)) if p.poisson_ratios[0] == poisson_ratio)
    fine = pressed_by_circle(parameters, 16)
    assert relative_error(pressed_by_circle(parameters, 1), fine) < 1e-3


def test_steps_after_the_change_of_material_are_small_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times as many steps everywhere: 0.3 % of the path, 2 % of every frame but 1, in which all is in motion."""
    default = DeformableBlock.fidelities["default"]
    finer = replace(
        default,
        hidden_steps=4 * default.hidden_steps,
        transient_steps=tuple(4 * steps for steps in default.transient_steps),
        steps=4 * default.steps,
    )
    monkeypatch.setitem(DeformableBlock.fidelities, "finer", finer)
    scene = DeformableBlock()
    for poisson_ratio in POISSON_RATIOS:
        for parameters in draws_with(poisson_ratio, 2):
            fine = displacements(scene.simulate(parameters, "finer"))  # type: ignore[arg-type]
            coarse = displacements(simulated(parameters))
            assert relative_error(coarse, fine) < 0.003
            assert max(relative_error(a, b) for a, b in zip(coarse[2:], fine[2:], strict=True)) < 0.02


# -- accuracy of the levels --------------------------------------------------------------------------------


@pytest.mark.parametrize(("level", "allowed"), [("fast", 0.03), ("default", 0.03)])
@pytest.mark.parametrize("poisson_ratio", POISSON_RATIOS)
def test_levels_against_reference(level: Fidelity, allowed: float, poisson_ratio: float) -> None:
    """Relative L2 error of the displacement of all recorded nodes over the whole path."""
    for parameters in draws_with(poisson_ratio, 3):
        found, reference = simulated(parameters, level), simulated(parameters, "reference")
        error = relative_error(displacements(found), displacements(reference))
        assert error < allowed, f"{parameters}: {error:.2%}"


# -- random draws ------------------------------------------------------------------------------------------


def test_random_draws_are_valid_and_fast() -> None:
    """90 draws of another seed than the dataset's: none rejected, none bisected, 0.3 s of CPU time each.

    The time is measured with the blocks' meshes made, as they are from a worker's tenth trajectory on; the
    limit here is twice that, so that a slow or busy machine does not fail it.
    """
    scene = DeformableBlock()
    seconds = []
    for index in range(90):
        start = time.process_time()
        trajectory = scene.simulate(draw(index))
        seconds.append(time.process_time() - start)
        assert scene.check(trajectory) == [], f"draw {index}"
        assert trajectory.diagnostics["bisections"] == 0, f"draw {index}"
    assert np.mean(seconds[9:]) < 0.6


# -- extremes ----------------------------------------------------------------------------------------------

ORDINARY = BlockParameters(widths=(200.0, 180.0), poisson_ratios=(0.0, 0.49), radius=30.0, start=20.0)
VALID: dict[str, dict[str, Any]] = {
    "incompressible": {"poisson_ratios": (0.0, 0.4999)},
    "auxetic, then incompressible": {"poisson_ratios": (-0.9, 0.4999)},
    "strongly auxetic": {"poisson_ratios": (0.0, -0.95)},
    "incompressible, then strongly auxetic": {"poisson_ratios": (0.4999, -0.95)},
    "ten times softer": {"youngs_modulus": YOUNGS_MODULUS / 10},
    "ten times softer, auxetic": {"youngs_modulus": YOUNGS_MODULUS / 10, "poisson_ratios": (0.49, -0.9)},
    "ten times stiffer": {"youngs_modulus": YOUNGS_MODULUS * 10},
    "ten times stiffer, auxetic": {"youngs_modulus": YOUNGS_MODULUS * 10, "poisson_ratios": (0.49, -0.9)},
    "same material twice": {"poisson_ratios": (0.49, 0.49)},
    "smallest circle at the edge": {"radius": 15.0, "start": 63.0},
    "largest circle at the edge": {"radius": 60.0, "start": -63.0},
}


@pytest.mark.parametrize("name", VALID)
def test_extreme_materials_and_circles_are_valid(name: str) -> None:
    assert DeformableBlock().check(simulated(replace(ORDINARY, **VALID[name]))) == []


@pytest.mark.parametrize("name", [name for name in VALID if "edge" not in name])
def test_extreme_materials_are_valid_in_plane_strain(name: str) -> None:
    """Here a small circle at the edge squeezes the corner of the nearly incompressible block away."""
    assert DeformableBlock().check(simulated(replace(ORDINARY, **VALID[name]), "default", "strain")) == []


@pytest.mark.parametrize("poisson_ratios", [(0.0, 0.49), (0.49, -0.9), (-0.9, 0.0)])
@pytest.mark.parametrize("start", [0.0, 20.0, 60.0])
def test_twice_the_speed_is_refused(start: float, poisson_ratios: tuple[float, float]) -> None:
    """The circle would go down by 147 of 200 mm, further than the block can be pressed: it squeezes out.

    The checks, or the solver, say what went wrong and in which frame.
    """
    parameters = replace(ORDINARY, start=start, speed=2 * SPEED, poisson_ratios=poisson_ratios)
    try:
        trajectory = simulated(parameters)
    except SolverError as error:
        reasons = [str(error)]
    else:
        assert np.isfinite(trajectory.positions).all()
        reasons = DeformableBlock().check(trajectory)
    assert reasons
    assert all(re.match(r"frame \d+\b", reason) for reason in reasons), reasons
