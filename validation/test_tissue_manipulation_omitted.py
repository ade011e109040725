"""What the tissue scene leaves out (`physics.py` says by how much), and how much there is to infer.

`pytest -s` prints what was measured.
"""

from dataclasses import replace

import numpy as np
from physics_variants import crosses_itself, tissue_outline
from tissue_cases import CASES, displacements, draw, march

from m3gn_bench.generators.tissue_manipulation import (
    MATERIALS,
    TissueManipulation,
    TissueParameters,
    surface,
)


def test_march_without_changes_is_the_scene() -> None:
    """Else what `physics.py` says of gravity, inertia and damping would be said of a second implementation."""
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
