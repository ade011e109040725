"""What the tissue scene leaves out, by how much, and how much there is to infer: the numbers in its card.

Every check holds a measured effect between bounds, so that the card cannot go stale unnoticed; `pytest -s`
prints what was measured. Errors are relative L2 norms of the displacement over the whole path, on the default
mesh.
"""

from dataclasses import replace

import numpy as np
import pytest
from physics_variants import crosses_itself, tissue_outline
from tissue_cases import CASES, DENSITY, GRAVITY, displacements, draw, march, relative_error

from m3gn_bench.generators.tissue_manipulation import (
    MATERIALS,
    TissueManipulation,
    TissueParameters,
    surface,
)

NAMES = [f"nu {case.poisson_ratio}" for case in CASES]
EFFECTS: dict[str, dict[str, object]] = {
    "gravity": {"acceleration": (0.0, 0.0, -GRAVITY)},
    "inertia": {"density": DENSITY},
    "stiffness damping 0.1 s": {"stiffness_damping": 0.1},
}
EXPECTED = {  # relative effect on the path, per material
    "gravity": (0.034, 0.013, 0.030),
    "inertia": (0.0012, 0.0004, 0.0015),
    "stiffness damping 0.1 s": (0.00008, 0.00009, 0.00018),
}


@pytest.mark.parametrize("case", range(3), ids=NAMES)
@pytest.mark.parametrize("name", EFFECTS)
def test_effect_of_what_is_left_out(name: str, case: int) -> None:
    """Gravity that acts from the first frame on; inertia; Rayleigh's damping of the original."""
    with_it = march(CASES[case], **EFFECTS[name])  # type: ignore[arg-type]
    without = displacements(CASES[case])
    effect, largest = relative_error(with_it, without), np.linalg.norm(with_it - without, axis=-1).max(1)
    print(f"{name}: {effect:.2%}, at the end {relative_error(with_it[-1], without[-1]):.2%}, "
          f"largest {largest.max():.2f} mm in frame {largest.argmax()}, {largest[20:].max():.3f} after 20")  # fmt: skip
    assert effect == pytest.approx(EXPECTED[name][case], rel=0.3)


def test_march_without_changes_is_the_scene() -> None:
    """Else the effects above would be those of a second implementation."""
    assert np.abs(march(CASES[0]) - displacements(CASES[0])).max() < 2e-4  # the solver's tolerance


def test_tissue_does_not_touch_itself() -> None:
    """Without inverted cells and out-of-plane motion, the front face's rim is where contact would begin."""
    figure_eight = np.array([[0, 0], [1, 1], [1, 0], [0, 1]], dtype=float)
    assert crosses_itself(figure_eight)
    assert not crosses_itself(tissue_outline(surface().rest_positions))
    for index in range(9):
        moved = displacements(draw(index)) + surface().rest_positions
        assert not any(crosses_itself(tissue_outline(frame)) for frame in moved)


def test_materials_differ() -> None:
    """Mean squared difference, in scaled units, between the same pulls of two materials."""
    pulls = [draw(index) for index in range(6)]
    means = {}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        squares = [
            np.mean((displacements(_with(pull, a)) - displacements(_with(pull, b))) ** 2, axis=(1, 2))
            for pull in pulls
        ]
        per_frame = np.mean(squares, axis=0) / TissueManipulation.scale_length**2
        means[a, b] = per_frame.mean()
        print(
            f"{MATERIALS[a][0]} and {MATERIALS[b][0]}: {per_frame.mean():.2e}, last frame {per_frame[-1]:.2e}"
        )
    moved = [np.mean((displacements(_with(p, 1))) ** 2) / TissueManipulation.scale_length**2 for p in pulls]
    print(f"movement itself {np.mean(moved):.2e}")
    assert min(means.values()) > 1e-5
    assert min(means.values()) > 1e-3 * np.mean(moved)


def _with(pull: TissueParameters, material: int) -> TissueParameters:
    nu, E = MATERIALS[material]
    return replace(pull, poisson_ratio=nu, youngs_modulus=E)
