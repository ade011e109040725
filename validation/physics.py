"""Only what a scene requires: every physical term of every scene, switched on or off by itself.

A term stays in a scene only if its effect exceeds the error of the default discretisation, measured on the same
draws in the same norm. Terms that are left out are here too, so that what that costs is known.

    python validation/physics.py [SCENE]            # measure and print
    python validation/physics.py [SCENE] --record   # into physics.json (rows there are kept) and the cards
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import block_cases
import numpy as np
import tissue_cases
from block_cases import displacements
from physics_variants import (
    STANDARD_GRAVITY,
    AlteredBlock,
    Fall,
    block_outline,
    crosses_itself,
    fall,
    linear_sheet,
    linearised,
    sheet_with_inertia,
    sheet_with_weight,
    sheet_without_bending,
    tissue_outline,
    with_ground,
    without_damping,
    without_inertia,
)
from sheet_cases import relative_error
from threadpoolctl import threadpool_limits

from m3gn_bench.datasets.card import CARDS, fill
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.generators.falling import SIZE, FallingTeddy, FallParameters, MixedObjects
from m3gn_bench.generators.scene import get_scene, scene_names
from m3gn_bench.generators.sheet_deformation import SheetDeformation, SheetParameters
from m3gn_bench.generators.solvers.sparse import Array
from m3gn_bench.generators.tissue_manipulation import CELL_ORDER, surface

RECORD = Path(__file__).with_name("physics.json")
BEGIN = "<!-- physics: written by validation/physics.py, do not edit -->"
END = "<!-- end of physics -->"
SEED = 29  # not the datasets'


# -- how results are compared -------------------------------------------------------------------------------


def distance(found: Fall, usual: Fall) -> float:
    """Root mean square distance of the recorded nodes over the size, until 0.2 s after the impact."""
    return float(np.sqrt(((found.path - usual.path) ** 2).sum(-1).mean())) / SIZE


def vibration(found: Fall, usual: Fall) -> float:
    """Difference of the energy left in vibration 0.5 s after the impact, over the energy before it."""
    return abs(found.vibration - usual.vibration)


# -- draws, and how scenes simulate them --------------------------------------------------------------------


@dataclass(frozen=True)
class Setup:
    """How a scene is measured: its draws, and how it simulates them by default and best."""

    draws: tuple[Any, ...]
    usual: Callable[[Any], Any]
    reference: Callable[[Any], Any]


def sheet_draw(index: int) -> SheetParameters:
    """The modulus cycles with the index."""
    return SheetDeformation().sample(np.random.default_rng([SEED, index]), index)


DROPPED_RATIOS = (0.0, 0.25, 0.4, 0.47, 0.49, 0.499)


def drop(scene: FallingTeddy | MixedObjects, index: int) -> FallParameters:
    """Another object and another Poisson's ratio each, over the ratio's whole range."""
    drawn = scene.sample(np.random.default_rng([SEED, index]), index)
    return replace(drawn, poisson_ratio=DROPPED_RATIOS[index])


def of_scene(name: str, draws: Sequence[Any]) -> Setup:
    """A scene whose trajectories show all that is compared."""
    scene = get_scene(name)
    return Setup(
        tuple(draws),
        usual=lambda draw: displacements(scene.simulate(draw)),
        reference=lambda draw: displacements(scene.simulate(draw, "reference")),
    )


def of_drops(scene: FallingTeddy | MixedObjects) -> Setup:
    """A scene whose inner nodes are looked at, too."""
    return Setup(
        tuple(drop(scene, index) for index in range(len(DROPPED_RATIOS))),
        usual=partial(fall, level=DROP_LEVELS["default"]),
        reference=partial(fall, level=DROP_LEVELS["reference"]),
    )


DROP_LEVELS = FallingTeddy.fidelities
SETUPS: dict[str, Setup] = {
    "sheet_deformation": of_scene("sheet_deformation", [sheet_draw(index) for index in (0, 3, 8)]),
    "deformable_block": of_scene(
        "deformable_block",
        [draw for ratio in (-0.9, 0.0, 0.49) for draw in block_cases.draws_with(ratio, 3)],
    ),
    "tissue_manipulation": of_scene("tissue_manipulation", tissue_cases.CASES),
    "falling_teddy": of_drops(FallingTeddy()),
    "mixed_objects": of_drops(MixedObjects()),
}


# -- terms --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Term:
    """One row of a scene's table.

    Attributes:
        scene: its name.
        name: of the term. Several rows may measure the same one; `detail` tells them apart.
        in_scene: whether the scene has it.
        run: what `Setup.usual` does, with the term switched off if it is in the scene, else on.
        detail: what this row measures, where that is not the effect on the path of all draws.
        norm: how two results are compared.
        draws: which of the scene's; all if left out.
        reason: of a verdict that does not follow from the numbers.
    """

    scene: str
    name: str
    in_scene: bool
    run: Callable[[Any], Any]
    detail: str = ""
    norm: Callable[[Any, Any], float] = relative_error
    draws: tuple[int, ...] | None = None
    reason: str = ""

    @property
    def title(self) -> str:
        """The row's first column."""
        return f"{self.name} ({self.detail})" if self.detail else self.name

    @property
    def drawn(self) -> tuple[int, ...]:
        """Which of the scene's draws are measured."""
        return tuple(range(len(SETUPS[self.scene].draws))) if self.draws is None else self.draws


def block(**changes: Any) -> Callable[[Any], Array]:
    """The block with other physics."""
    return lambda draw: displacements(AlteredBlock(**changes).simulate(draw))


def if_untouched(scene: str, rest: Callable[[Any, Array], Array]) -> Callable[[Any], Array]:
    """The scene's own path, provided that no outline in it crosses itself: then self contact changes nothing."""

    def run(draw: Any) -> Array:
        path: Array = SETUPS[scene].usual(draw)
        if any(crosses_itself(outline) for outline in rest(draw, path)):
            raise ValueError(f"{scene} touches itself in {draw}: self contact must be modelled")
        return path

    return run


def block_outlines(draw: Any, path: Array) -> Array:
    """Of every frame."""
    rest = block_cases.make_block(draw.widths, 8).mesh.rest_positions
    return block_outline(rest + path)


def tissue_outlines(draw: Any, path: Array) -> Array:
    """Of every frame."""
    return tissue_outline(surface().rest_positions + path)


SHEET, BLOCK, TISSUE = "sheet_deformation", "deformable_block", "tissue_manipulation"
PLAIN = replace(DROP_LEVELS["default"], element="linear")
NEARLY_INCOMPRESSIBLE = tuple(i for i, ratio in enumerate(DROPPED_RATIOS) if ratio >= 0.49)
STATIC = "the original is a static analysis without a time scale"

TERMS: list[Term] = [
    Term(SHEET, "geometric nonlinearity", True, linear_sheet),
    Term(SHEET, "bending stiffness", True, sheet_without_bending, "all but a thousandth of it off"),
    Term(SHEET, "inertia", False, partial(sheet_with_inertia, duration=10.0), "1000 kg/m³, load in 10 s"),
    Term(SHEET, "inertia", False, partial(sheet_with_inertia, duration=1.0), "load in 1 s", reason=STATIC),
    Term(
        SHEET,
        "inertia",
        False,
        partial(sheet_with_inertia, duration=0.1, steps=8),
        "load in 0.1 s",
        reason=STATIC,
    ),
    Term(
        SHEET,
        "gravity",
        False,
        sheet_with_weight,
        "1000 kg/m³",
        reason="the paper's sheet bears two forces only",
    ),
    Term(BLOCK, "geometric nonlinearity", True, block(linear=True)),
    Term(BLOCK, "inertia and damping", True, block(alter=without_inertia)),
    Term(BLOCK, "damping", True, block(alter=without_damping)),
    Term(BLOCK, "contact of the sides with the ground", False, block(alter=with_ground)),
    Term(
        BLOCK,
        "gravity",
        False,
        block(weight=STANDARD_GRAVITY),
        reason="none in the original, as far as is known",
    ),
    Term(
        BLOCK,
        "friction of the circle, 0.1",
        False,
        block(friction=0.1),
        reason="the original has none",
    ),
    Term(
        BLOCK,
        "plane strain",
        False,
        block(plane="strain"),
        reason="another scene; an option of this one",
    ),
    Term(BLOCK, "self contact", False, if_untouched(BLOCK, block_outlines)),
    Term(
        TISSUE,
        "geometric nonlinearity",
        True,
        partial(tissue_cases.march, alter=partial(linearised, integration_order=CELL_ORDER)),
    ),
    Term(
        TISSUE,
        "inertia, mass damping",
        False,
        partial(tissue_cases.march, density=tissue_cases.DENSITY),
        "1070 kg/m³, 20 1/s",
    ),
    Term(
        TISSUE,
        "stiffness damping",
        False,
        partial(tissue_cases.march, stiffness_damping=0.1),
        "0.1 s",
    ),
    Term(
        TISSUE,
        "gravity",
        False,
        partial(tissue_cases.march, acceleration=(0.0, 0.0, -STANDARD_GRAVITY)),
        reason="with it E and the density would matter, of which nothing is known",
    ),
    Term(TISSUE, "self contact", False, if_untouched(TISSUE, tissue_outlines)),
]
for _name in ("falling_teddy", "mixed_objects"):
    TERMS += [
        Term(
            _name, "friction", True, partial(fall, level=DROP_LEVELS["default"], friction=0.0), norm=distance
        ),
        Term(
            _name,
            "viscosity",
            True,
            partial(fall, level=DROP_LEVELS["default"], viscosity=0.0),
            "energy left in vibration 0.5 s after the impact",
            vibration,
        ),
        Term(
            _name,
            "viscosity",
            True,
            partial(fall, level=DROP_LEVELS["default"], viscosity=0.0),
            norm=distance,
            reason="so early after the impact it changes less than the mesh does; see the row above",
        ),
        Term(
            _name,
            "nodal pressure",
            True,
            partial(fall, level=PLAIN),
            "Poisson's ratio 0.49 and 0.499",
            distance,
            NEARLY_INCOMPRESSIBLE,
        ),
        Term(
            _name,
            "nodal pressure",
            True,
            partial(fall, level=PLAIN),
            "Poisson's ratio up to 0.47",
            distance,
            tuple(i for i in range(len(DROPPED_RATIOS)) if i not in NEARLY_INCOMPRESSIBLE),
            "away from 0.5 it changes less than the mesh does, but without it the error is {error_switched}",
        ),
        Term(
            _name,
            "self contact",
            False,
            partial(fall, level=DROP_LEVELS["default"], pushed_apart=True),
            "nodes inside other parts moved out",
            distance,
        ),
    ]


# -- measuring ----------------------------------------------------------------------------------------------


@cache
def simulated(scene: str, which: str, index: int) -> tuple[Any, float]:
    """What the scene makes of a draw, at the level "usual" or "reference", and the CPU time it took [s]."""
    setup = SETUPS[scene]
    return timed(getattr(setup, which), setup.draws[index])


def timed(run: Callable[[Any], Any], draw: Any) -> tuple[Any, float]:
    """Result and CPU time [s], meshes and kernels not counted: they are made before."""
    run_once_before(draw)
    start = time.process_time()
    result = run(draw)
    return result, time.process_time() - start


@cache
def run_once_before(draw: Any) -> None:
    """Make what a draw shares with others."""
    name = next(name for name, setup in SETUPS.items() if draw in setup.draws)
    SETUPS[name].usual(draw)


def measured(term: Term, draws: Sequence[int] | None = None) -> dict[str, Any]:
    """Effects and errors per draw (also errors with the term switched, against the same reference), and mean CPU
    times [s] with and without the term."""
    effects, errors, errors_switched, usual_times, changed_times = [], [], [], [], []
    for index in term.drawn if draws is None else draws:
        usual, seconds = simulated(term.scene, "usual", index)
        reference, _ = simulated(term.scene, "reference", index)
        changed, changed_seconds = timed(term.run, SETUPS[term.scene].draws[index])
        effects.append(term.norm(changed, usual))
        errors.append(term.norm(usual, reference))
        errors_switched.append(term.norm(changed, reference))
        usual_times.append(seconds)
        changed_times.append(changed_seconds)
    pair = (np.mean(usual_times), np.mean(changed_times))
    with_it, without = pair if term.in_scene else pair[::-1]
    return {
        "effects": effects,
        "errors": errors,
        "errors_switched": errors_switched,
        "seconds_with": float(with_it),
        "seconds_without": float(without),
    }


def verdict(term: Term, row: dict[str, Any]) -> str:
    """What follows from a measured row; an effect counts if its mean exceeds that of the error."""
    matters = np.mean(row["effects"]) > np.mean(row["errors"])
    if term.in_scene:
        reason = term.reason.format(error_switched=percent(np.mean(row["errors_switched"])))
        return "needed" if matters else reason or "BELOW THE ERROR: to be removed"
    if not matters:
        return "left out: below the error" if max(row["effects"]) > 0 else "left out: never touched"
    return f"left out by choice: {term.reason or 'NO REASON'}"


def table(scene: str, rows: dict[str, Any]) -> str:
    """The scene's table in Markdown; rows not measured yet are missing."""
    lines = [
        "| term | in the scene | effect, mean (largest) | discretisation error | CPU time with / without | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for term in TERMS:
        row = rows.get(term.title)
        if term.scene != scene or row is None:
            continue
        cells = [
            term.title,
            "yes" if term.in_scene else "no",
            f"{percent(np.mean(row['effects']))} ({percent(max(row['effects']))})",
            percent(np.mean(row["errors"])),
            f"{row['seconds_with']:.2f} / {row['seconds_without']:.2f} s",
            verdict(term, row),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def percent(share: float) -> str:
    """To two digits."""
    value = 100 * float(share)
    if value == 0:
        return "0"
    digits = max(0, 1 - int(np.floor(np.log10(value))))
    return "below 0.0001 %" if value < 1e-4 else f"{value:.{min(digits, 4)}f} %"


def load() -> dict[str, dict[str, Any]]:
    """What is recorded, by scene and row, of those scenes whose data have not changed since."""
    stored = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    return {
        scene: found["rows"]
        for scene, found in stored.items()
        if found["dataset_version"] == get_scene(scene).dataset_version
    }


def save(recorded: dict[str, dict[str, Any]]) -> None:
    """Keep what `load` gives."""
    stored = {
        scene: {"dataset_version": get_scene(scene).dataset_version, "rows": rows}
        for scene, rows in recorded.items()
    }
    write_bytes_atomically(RECORD, (json.dumps(stored, indent=1, ensure_ascii=False) + "\n").encode())


def main(arguments: Sequence[str]) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="What every physical term changes, against the error.")
    parser.add_argument("scene", nargs="?", choices=scene_names(), help="all if left out")
    parser.add_argument("--record", action="store_true", help="keep in physics.json, and write the cards")
    options = parser.parse_args(arguments)
    recorded = load()
    for scene in [options.scene] if options.scene else scene_names():
        rows = recorded.setdefault(scene, {}) if options.record else {}
        for term in TERMS:
            if term.scene != scene or term.title in rows:
                continue
            rows[term.title] = measured(term)
            print(f"{scene}: {term.title}", file=sys.stderr, flush=True)
            if options.record:
                save(recorded)
        simulated.cache_clear()
        text = table(scene, rows)
        print(text)
        if options.record:
            card = CARDS / f"{scene}.md"
            write_bytes_atomically(card, fill(card.read_text(), text, BEGIN, END).encode())


if __name__ == "__main__":
    with threadpool_limits(1):
        main(sys.argv[1:])
