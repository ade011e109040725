"""Only what a scene requires: the rule, on what `physics.py` has recorded, and a cheap part measured again."""

import numpy as np
import pytest
from physics import BEGIN, END, SETUPS, TERMS, Term, load, table, verdict

from m3gn_bench.datasets.card import CARDS
from m3gn_bench.generators.scene import scene_names

RECORDED = load()
IN_SCENES = sorted({(term.scene, term.name) for term in TERMS if term.in_scene})
CHEAP = [  # scene, row, draw
    ("sheet_deformation", "geometric nonlinearity", 0),
    ("sheet_deformation", "gravity (1000 kg/m³)", 2),
    ("deformable_block", "geometric nonlinearity", 3),
    ("deformable_block", "inertia and damping", 0),
    ("deformable_block", "damping", 8),
    ("deformable_block", "contact of the sides with the ground", 4),
    ("tissue_manipulation", "geometric nonlinearity", 1),
    *(
        ("tissue_manipulation", row, index)
        for row in ("inertia, mass damping (1070 kg/m³, 20 1/s)", "stiffness damping (0.1 s)", "gravity")
        for index in range(3)
    ),
    ("falling_teddy", "friction", 2),
    ("falling_teddy", "viscosity (energy left in vibration 0.5 s after the impact)", 3),
    ("falling_teddy", "nodal pressure (Poisson's ratio 0.49 and 0.499)", 5),
    ("mixed_objects", "friction", 1),
    ("mixed_objects", "nodal pressure (Poisson's ratio 0.49 and 0.499)", 4),
]


def row_of(scene: str, title: str) -> Term:
    return next(term for term in TERMS if (term.scene, term.title) == (scene, title))


@pytest.mark.parametrize(("scene", "name"), IN_SCENES)
def test_every_term_in_a_scene_is_needed(scene: str, name: str) -> None:
    """By one measure at least; a row that shows less than the error says why, next to the row that shows more."""
    rows = [term for term in TERMS if (term.scene, term.name) == (scene, name)]
    verdicts = [verdict(term, RECORDED[scene][term.title]) for term in rows]
    assert "needed" in verdicts
    for term, found in zip(rows, verdicts, strict=True):
        assert found == "needed" or term.reason, f"{term.title}: {found}"


@pytest.mark.parametrize("scene", ["falling_teddy", "mixed_objects"])
def test_nodal_pressure_lessens_the_error_at_every_ratio(scene: str) -> None:
    """Against the finer mesh, also where it changes less than what the finer mesh does."""
    for title, row in RECORDED[scene].items():
        if title.startswith("nodal pressure"):
            assert np.mean(row["errors_switched"]) > 1.1 * np.mean(row["errors"]), title


@pytest.mark.parametrize("term", [t for t in TERMS if not t.in_scene], ids=lambda t: f"{t.scene}: {t.title}")
def test_what_is_left_out_has_a_reason(term: Term) -> None:
    """It changes less than the error, or somebody chose."""
    assert "NO REASON" not in verdict(term, RECORDED[term.scene][term.title])


@pytest.mark.parametrize("scene", scene_names())
def test_cards_show_what_is_recorded(scene: str) -> None:
    assert scene in RECORDED  # of its present version
    card = (CARDS / f"{scene}.md").read_text()
    assert f"{BEGIN}\n{table(scene, RECORDED[scene])}\n{END}" in card
    assert set(RECORDED[scene]) == {term.title for term in TERMS if term.scene == scene}


@pytest.mark.parametrize(("scene", "title", "index"), CHEAP)
def test_recorded_effects_are_measured_again(scene: str, title: str, index: int) -> None:
    """Within 2 %: runs repeat, but for the order of sums in other versions of libraries."""
    term, setup = row_of(scene, title), SETUPS[scene]
    recorded = RECORDED[scene][title]["effects"][term.drawn.index(index)]
    effect = term.norm(term.run(setup.draws[index]), setup.usual(setup.draws[index]))
    print(f"{scene}, {title}: {effect:.3g}, recorded {recorded:.3g}")
    assert effect == pytest.approx(recorded, rel=0.02)
