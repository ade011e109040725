"""What can be turned to trade a scene's speed for its accuracy, one knob at a time around the default fidelity.

A scene is judged over a window of frames by the distance of its recorded nodes from a reference: the finest of
three meshes, with fine steps. Every discretisation has a companion on the same mesh with fine steps, which splits
its error: what steps and tolerances leave open is the difference from the companion, what the mesh leaves open is
the companion's difference from the reference.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.generators.errors import GeneratorError

Knob = Literal["fidelity", "time step", "mesh", "element", "tolerance", "solver"]


@dataclass(frozen=True)
class Setting:
    """One way to simulate a scene.

    Attributes:
        knob: which one is turned.
        label: to what.
        level: the discretisation.
        options: of the scene, where they differ.
    """

    knob: Knob
    label: str
    level: Any
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Unique among a scene's settings."""
        return f"{self.knob}: {self.label}"


@dataclass(frozen=True)
class Knobs:
    """How a scene's trade-off is measured.

    Attributes:
        draws: indices of trajectories of the test split, spread over materials and objects.
        first, last: the frames over which distances are taken.
        frames: that a reference needs.
        timed_frames: of settings of which not the whole trajectory is timed; they show what a frame costs.
        size: what distances are divided by [the scene's unit of length]; None: by the displacement.
        time_margin: times closer than this factor count as equal. It lies in the widest gap, below 1.5, between ratios
            of times on which the front depends (three studies of each task), so that their noise does not change it.
        settings: all ways to simulate; "fidelity: default" is among them.
        meshes: three levels with fine steps, from coarse to fine; the last is the reference.
        cell_sizes: of their meshes, relative to the first.
        with_fine_steps: the companion of a level.
        full_length: settings of which whole trajectories are timed; of others, the cost of a frame is measured.
        models_by: the fidelity that judges models, over all frames after their context, where contexts outlast the
            window and the reference cannot be run to the end; None: the reference, in the window.
    """

    draws: tuple[int, ...]
    first: int
    last: int
    frames: int
    size: float | None
    time_margin: float
    settings: tuple[Setting, ...]
    meshes: tuple[Any, ...]
    cell_sizes: tuple[float, float, float]
    with_fine_steps: Callable[[Any], Any]
    timed_frames: int = 0
    full_length: Callable[[Setting], bool] = lambda setting: True
    models_by: str | None = None


def _fidelities(scene: Any) -> tuple[Setting, ...]:
    return tuple(Setting("fidelity", name, level) for name, level in scene.fidelities.items())


def _sheet_deformation() -> Knobs:
    from m3gn_bench.generators.sheet_deformation import SheetDeformation

    default = SheetDeformation.fidelities["default"]

    def fine(level: Any) -> Any:
        return replace(level, tolerance=1e-8)

    return Knobs(
        draws=(0, 4, 8),  # E = 10, 180 and 1000 MPa
        first=1,
        last=50,
        frames=51,
        size=None,
        time_margin=1.15,
        settings=(
            *_fidelities(SheetDeformation),
            *(Setting("tolerance", f"{t:g}", replace(default, tolerance=t)) for t in (1e-2, 1e-3, 1e-6)),
            Setting("mesh", "even, 14 x 14", replace(default, border_layer=False)),
            Setting("mesh", "even, 28 x 28", replace(default, border_layer=False, refinement=2)),
            Setting("mesh", "32 x 32", replace(default, refinement=2)),
        ),
        meshes=tuple(fine(replace(default, refinement=k)) for k in (1, 2, 3)),
        cell_sizes=(1, 1 / 2, 1 / 3),
        with_fine_steps=fine,
    )


def _deformable_block() -> Knobs:
    from m3gn_bench.generators.deformable_block import DeformableBlock

    levels = DeformableBlock.fidelities
    default, reference = levels["default"], levels["reference"]

    def times(factor: int) -> Any:
        return replace(
            default,
            hidden_steps=factor,
            steps=factor,
            transient_steps=tuple(factor * steps for steps in default.transient_steps),
        )

    def fine(level: Any) -> Any:
        return replace(reference, cells=level.cells, element=level.element)

    return Knobs(
        draws=(0, 1, 2),  # the three second ratios
        first=0,
        last=38,
        frames=39,
        size=None,
        time_margin=1.37,
        settings=(
            *_fidelities(DeformableBlock),
            Setting("time step", "1 per frame", replace(default, transient_steps=())),
            Setting(
                "time step", "8, 4, 4, 2, 2, 2, then 1", replace(default, transient_steps=(8, 4, 4, 2, 2, 2))
            ),
            Setting("time step", "half the default's", times(2)),
            *(Setting("tolerance", f"{t:g}", replace(default, tolerance=t)) for t in (1e-1, 1e-3, 1e-5)),
            Setting("mesh", "16 x 16", replace(default, cells=16)),
            *(
                Setting(
                    "element", f"{element}, {cells} x {cells}", replace(default, element=element, cells=cells)
                )
                for element, cells in (
                    ("linear triangles", 8),
                    ("linear triangles", 16),
                    ("linear triangles", 32),
                    ("bilinear", 8),
                    ("bilinear", 16),
                    ("biquadratic", 8),
                )
            ),
        ),
        meshes=tuple(replace(reference, cells=cells) for cells in (8, 16, 32)),
        cell_sizes=(1, 1 / 2, 1 / 4),
        with_fine_steps=fine,
    )


def _tissue_manipulation() -> Knobs:
    from m3gn_bench.generators.tissue_manipulation import TissueManipulation

    default = TissueManipulation.fidelities["default"]

    def fine(level: Any) -> Any:
        return replace(level, tolerance=1e-7)

    def cells(*numbers: int) -> str:
        return " x ".join(map(str, numbers))

    return Knobs(
        draws=(0, 1, 2),  # the three materials
        first=1,
        last=100,
        frames=101,
        size=None,
        time_margin=1.2,
        settings=(
            *_fidelities(TissueManipulation),
            Setting("time step", "half the default's", replace(default, steps=2)),
            *(Setting("tolerance", f"{t:g}", replace(default, tolerance=t)) for t in (1e-2, 1e-3, 1e-4)),
            *(
                Setting("mesh", cells(*numbers), replace(default, cells=numbers))
                for numbers in ((6, 1, 8), (6, 1, 24), (6, 1, 32), (12, 1, 16), (12, 1, 32))
            ),
            *(
                Setting(
                    "element",
                    f"trilinear, {cells(*numbers)}",
                    replace(default, element="trilinear", cells=numbers),
                )
                for numbers in ((6, 1, 16), (12, 2, 32))
            ),
        ),
        meshes=tuple(fine(replace(default, cells=(6 * k, 2, 16 * k))) for k in (1, 2, 3)),
        cell_sizes=(1, 1 / 2, 1 / 3),
        with_fine_steps=fine,
    )


def _falling(scene: Any, draws: tuple[int, ...]) -> Knobs:
    from m3gn_bench.generators.falling import HEIGHT, SIZE, flight_frames

    default = scene.fidelities["default"]
    quadratic = scene.fidelities["reference"]
    contact = flight_frames(HEIGHT)

    def fine(level: Any) -> Any:
        # At most a fifth of the default's step on every mesh: a cell cut in half has half the stable step, a quadratic
        # one less than a fourth.
        largest = 0.7 if level.element == "quadratic" else 0.175
        return replace(level, courant=min(0.85, largest * level.parts))

    def sweeps(iterations: int, substeps: int) -> Setting:
        level = replace(default, vbd_iterations=iterations, vbd_substeps=substeps, element="linear")
        label = f"newton-vbd, {iterations} x {substeps}"
        return Setting("solver", label, level, {"solver": "newton-vbd"})

    return Knobs(
        draws=draws,
        first=contact,
        last=contact + 2,  # the impact's first 0.03 s: a frame of the reference takes more than a minute
        frames=contact + 3,
        timed_frames=contact + 16,
        size=SIZE,
        time_margin=1.08,
        settings=(
            # `fast` is the default's discretisation: nothing faster is sound.
            Setting("fidelity", "default", default),
            Setting("fidelity", "reference", quadratic),
            *(Setting("time step", f"{c:g} of the limit", replace(default, courant=c)) for c in (0.6, 0.15)),
            Setting("mesh", "in eight", replace(default, parts=2)),
            Setting("element", "linear", replace(default, element="linear")),
            Setting("element", "linear, in eight", replace(default, element="linear", parts=2)),
            *(sweeps(*numbers) for numbers in ((10, 10), (2, 40), (2, 80))),
        ),
        meshes=tuple(fine(replace(quadratic, parts=k)) for k in (1, 2, 3)),
        cell_sizes=(1, 1 / 2, 1 / 3),
        with_fine_steps=fine,
        full_length=lambda setting: (
            setting.knob != "solver" and setting.level.parts == 1 and setting.level.element != "quadratic"
        ),
        models_by="reference",
    )


def _falling_teddy() -> Knobs:
    from m3gn_bench.generators.falling import FallingTeddy

    return _falling(FallingTeddy, (0, 2))  # E = 568 and 233 kPa, nu = 0.14 and 0.42


def _mixed_objects() -> Knobs:
    from m3gn_bench.generators.falling import MixedObjects

    return _falling(MixedObjects, (1, 5))  # bunny and cone


_KNOBS: dict[str, Callable[[], Knobs]] = {
    "sheet_deformation": _sheet_deformation,
    "sheet_deformation_ood": lambda: replace(
        _sheet_deformation(), draws=(0, 1, 8)
    ),  # E = 10, 30 and 1000 MPa
    "deformable_block": _deformable_block,
    "tissue_manipulation": _tissue_manipulation,
    "falling_teddy": _falling_teddy,
    "mixed_objects": _mixed_objects,
}


def knobs_of(task: str) -> Knobs:
    """The knobs of a task's scene. Raises GeneratorError if it has none (lists those that have)."""
    if task not in _KNOBS:
        raise GeneratorError(unknown_name("knobs of task", task, list(_KNOBS)))
    return _KNOBS[task]()
