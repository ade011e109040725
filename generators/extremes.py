"""Each scene at its extremes: materials, loads and speeds, meshes and steps, placements, and long runs.

A cell of the grid is a simulation that must either agree with a reference, the same on a finer mesh, within the
scene's bound, or be refused with a reason. The bounds are what the cards state of the default fidelity on its
worst draws, with room for what lies beyond the scenes' ranges.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.generators.errors import GeneratorError


@dataclass(frozen=True)
class Extreme:
    """One cell of the grid.

    Attributes:
        name: unique among the scene's.
        parameters: of the simulation.
        level: its discretisation.
        frames: how many; None: as many as the scene has.
        first, last: frames over which it is compared with the reference.
        reference: the finer discretisation.
        options: of the scene, where they differ (the reference has the same, but the default solver).
    """

    name: str
    parameters: Any
    level: Any
    frames: int | None
    first: int
    last: int
    reference: Any
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Extremes:
    """A scene's grid.

    Attributes:
        cells: of it.
        allowed: largest error of a correct cell: root mean square distance over `size`.
        size: [the scene's unit of length]; None: the reference's root mean square displacement.
    """

    cells: tuple[Extreme, ...]
    allowed: float
    size: float | None


def _sheet_deformation() -> Extremes:
    from m3gn_bench.generators.sheet_deformation import SheetDeformation, SheetParameters

    levels = SheetDeformation.fidelities
    usual = SheetParameters(100.0, ((50.0, 60.0), (95.0, 85.0)), (-200.0, 200.0))
    middle = (70.0, 70.0)

    def cell(name: str, level: Any = levels["default"], frames: int | None = None, **changes: Any) -> Extreme:
        last = (frames or SheetDeformation.frames) - 1
        return Extreme(name, replace(usual, **changes), level, frames, 1, last, levels["reference"])

    def forces(name: str, size: float, youngs_modulus: float) -> Extreme:
        return cell(name, youngs_modulus=youngs_modulus, forces=(-200.0 * size, 200.0 * size))

    return Extremes(
        cells=(
            cell("E = 1 MPa, a tenth of the softest", youngs_modulus=1.0),
            cell("E = 10 MPa, the softest", youngs_modulus=10.0),
            cell("E = 1 GPa, the stiffest", youngs_modulus=1e3),
            cell("E = 10 GPa", youngs_modulus=1e4),
            cell("E = 1000 GPa", youngs_modulus=1e6),
            cell("E = 0", youngs_modulus=0.0),
            forces("a tenth of the force, E = 10 MPa", 0.1, 10.0),
            forces("a tenth of the force, E = 1 GPa", 0.1, 1e3),
            forces("ten times the force, E = 10 MPa", 10.0, 10.0),
            forces("ten times the force, E = 1 GPa", 10.0, 1e3),
            cell("both forces at one place", centres=(middle, middle), forces=(200.0, 200.0)),
            cell("forces that cancel", centres=(middle, middle)),
            cell("opposite forces 5 mm apart", centres=((67.5, 70.0), (72.5, 70.0)), youngs_modulus=10.0),
            cell("a force that touches the border", centres=((10.0, 70.0), middle)),
            cell("a force on the border", centres=((0.0, 70.0), middle)),
            cell("both forces in a corner", centres=((20.0, 20.0), (20.0, 20.0)), forces=(200.0, 200.0)),
            cell("lowest fidelity", levels["fast"]),
            cell("even mesh", replace(levels["default"], border_layer=False)),
            cell("long run: four times the load", frames=201),
        ),
        allowed=0.01,
        size=None,
    )


def _deformable_block() -> Extremes:
    from m3gn_bench.generators.deformable_block import (
        SPEED,
        YOUNGS_MODULUS,
        BlockParameters,
        DeformableBlock,
    )

    levels = DeformableBlock.fidelities
    usual = BlockParameters(widths=(200.0, 180.0), poisson_ratios=(0.0, 0.49), radius=30.0, start=20.0)

    def cell(
        name: str,
        level: Any = levels["default"],
        frames: int | None = None,
        options: dict[str, Any] | None = None,
        **changes: Any,
    ) -> Extreme:
        last = (frames or DeformableBlock.frames) - 1
        parameters = replace(usual, **changes)
        return Extreme(name, parameters, level, frames, 0, last, levels["reference"], options or {})

    return Extremes(
        cells=(
            cell("nu = 0.4999, near-incompressible", poisson_ratios=(0.0, 0.4999)),
            cell("nu = 0.5", poisson_ratios=(0.0, 0.5)),
            cell("nu = -0.95, auxetic", poisson_ratios=(0.0, -0.95)),
            cell("nu = -1", poisson_ratios=(0.0, -1.0)),
            cell("from nu = 0.4999 to -0.95", poisson_ratios=(0.4999, -0.95)),
            cell("a tenth of E", youngs_modulus=YOUNGS_MODULUS / 10),
            cell("ten times E", youngs_modulus=YOUNGS_MODULUS * 10),
            cell("a tenth of the speed", speed=SPEED / 10),
            cell("twice the speed", speed=SPEED * 2),
            cell("ten times the speed", speed=SPEED * 10),
            cell("at rest", speed=0.0),
            cell("smallest circle at the corner", radius=15.0, start=90.0),
            cell("largest circle at the corner", radius=60.0, start=90.0),
            cell("a circle of 2 mm", radius=2.0),
            cell("a circle beside the block", start=150.0),
            cell("plane strain", options={"plane": "strain"}, poisson_ratios=(0.0, 0.4)),
            cell("lowest fidelity", levels["fast"]),
            cell("one step per frame", replace(levels["default"], transient_steps=())),
            cell("32 x 32 cells", replace(levels["default"], cells=32)),
            cell("long run: 55 frames", frames=55),
        ),
        allowed=0.08,
        size=None,
    )


def _tissue_manipulation() -> Extremes:
    from m3gn_bench.generators.tissue_manipulation import (
        MATERIALS,
        PATCHES,
        SPEED,
        TissueManipulation,
        TissueParameters,
    )

    default = TissueManipulation.fidelities["default"]
    reference = replace(default, cells=(12, 1, 32))
    usual = TissueParameters(0.49, 30e3, patch=2, angle=25.0)

    def cell(name: str, level: Any = default, frames: int | None = None, **changes: Any) -> Extreme:
        last = (frames or TissueManipulation.frames) - 1
        return Extreme(name, replace(usual, **changes), level, frames, 1, last, reference)

    return Extremes(
        cells=(
            cell("nu = 0.4999, near-incompressible", poisson_ratio=0.4999),
            cell("nu = 0.5", poisson_ratio=0.5),
            cell("nu = -0.95, auxetic", poisson_ratio=-0.95),
            cell("a thousandth of E", youngs_modulus=30.0),
            cell("a thousand times E", youngs_modulus=3e7),
            cell("a tenth of the pull", speed=SPEED / 10),
            cell("twice the pull", speed=2 * SPEED),
            cell("ten times the pull", speed=10 * SPEED),
            cell("no pull", speed=0.0),
            cell("first patch, across", patch=0, angle=0.0),
            cell("last patch, across", patch=PATCHES - 1, angle=180.0, poisson_ratio=0.0),
            cell("a push straight down", patch=9, angle=-90.0, poisson_ratio=MATERIALS[1][0]),
            cell("lowest fidelity", TissueManipulation.fidelities["fast"]),
            cell("6 x 1 x 32 cells", replace(default, cells=(6, 1, 32))),
            cell("two steps per frame", replace(default, steps=2)),
            cell("long run: twice the frames", frames=201),
        ),
        allowed=0.05,
        size=None,
    )


FLAT, UPSIDE_DOWN = (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)
ON_EDGE, ON_SIDE = (0.2, 0.0, 0.0, 0.96**0.5), (0.5**0.5, 0.0, 0.0, 0.5**0.5)


def _falling_cells(scene: Any, usual: Any, kinds: dict[str, dict[str, Any]]) -> tuple[Extreme, ...]:
    from m3gn_bench.generators.falling import flight_frames

    default = scene.fidelities["default"]
    reference = scene.fidelities["reference"]
    cells = []
    for name, kind in kinds.items():
        changes = dict(kind)
        level = changes.pop("level", default)
        frames, options = changes.pop("frames", None), changes.pop("options", {})
        parameters = replace(usual, **changes)
        first = flight_frames(parameters.height)
        # 0.1 s after the impact: tumbling that follows magnifies every difference.
        cells.append(Extreme(name, parameters, level, frames, first, first + 9, reference, options))
    return tuple(cells)


def _falling_teddy() -> Extremes:
    from m3gn_bench.generators.falling import SIZE, FallingTeddy, FallParameters

    default = FallingTeddy.fidelities["default"]
    single = replace(default, element="linear")
    stiff = {
        "youngs_modulus": 1e6,
        "poisson_ratio": 0.499,
    }  # only where steps are short does their limit bind
    return Extremes(
        cells=_falling_cells(
            FallingTeddy,
            FallParameters("teddy", (0.3, 0.4, 0.5, 0.5**0.5), 3e5, 0.3),
            {
                "E = 1e5 Pa, nu = 0, the softest": {"youngs_modulus": 1e5, "poisson_ratio": 0.0},
                "E = 1e6 Pa, nu = 0.499, the stiffest": stiff,
                "nu = 0.4999, near-incompressible": {"poisson_ratio": 0.4999},
                "nu = 0.5": {"poisson_ratio": 0.5},
                "nu = -0.3, auxetic": {"poisson_ratio": -0.3},
                "a tenth of the softest E": {"youngs_modulus": 1e4},
                "ten times the stiffest E": {"youngs_modulus": 1e7},
                "from 2 mm": {"height": 0.002},
                "from 0.2 m, ten times as high": {"height": 0.2},
                "from 5 m": {"height": 5.0},
                "at rest on the floor": {"height": 0.0},
                "upright": {"orientation": FLAT},
                "upside down": {"orientation": UPSIDE_DOWN},
                "lowest fidelity": {"level": FallingTeddy.fidelities["fast"], **stiff},
                "a step beyond the limit of stability": {"level": replace(default, courant=1.5), **stiff},
                "an eighth of the step": {"level": replace(default, courant=default.courant / 8), **stiff},
                "single precision (newton-vbd)": {
                    "level": single,
                    "options": {"solver": "newton-vbd"},
                    "frames": 43,
                },
                "long run: 6 s": {"frames": 601},
            },
        ),
        allowed=0.1,
        size=SIZE,
    )


def _mixed_objects() -> Extremes:
    from m3gn_bench.generators.falling import SIZE, FallParameters, MixedObjects

    soft = {"youngs_modulus": 1e5, "poisson_ratio": 0.0}
    return Extremes(
        cells=_falling_cells(
            MixedObjects,
            FallParameters("traffic_cone", FLAT, 2e5, 0.45),
            {
                "cone flat on its base": {},
                "cone on an edge": {"orientation": ON_EDGE},
                "cone on its side": {"orientation": ON_SIDE},
                "cone on its tip": {"orientation": UPSIDE_DOWN},
                "cone at rest on the floor": {"height": 0.0},
                "cone, nu = 0.4999": {"poisson_ratio": 0.4999},
                **{f"softest {name}": {"object": name, **soft} for name in MixedObjects.objects[1:]},
                "stiffest worm": {"object": "gummy_worm_1", "youngs_modulus": 1e6, "poisson_ratio": 0.499},
                "worm from 5 m": {"object": "gummy_worm_2", "height": 5.0},
                "no such object": {"object": "dodo"},
            },
        ),
        allowed=0.1,
        size=SIZE,
    )


_EXTREMES: dict[str, Callable[[], Extremes]] = {
    "sheet_deformation": _sheet_deformation,
    "deformable_block": _deformable_block,
    "tissue_manipulation": _tissue_manipulation,
    "falling_teddy": _falling_teddy,
    "mixed_objects": _mixed_objects,
}


def has_extremes(scene: str) -> bool:
    """Whether a scene has a grid: our own have."""
    return scene in _EXTREMES


def extremes_of(scene: str) -> Extremes:
    """The grid of a scene. Raises GeneratorError if it has none (lists those that have)."""
    if not has_extremes(scene):
        raise GeneratorError(unknown_name("extremes of scene", scene, list(_EXTREMES)))
    return _EXTREMES[scene]()
