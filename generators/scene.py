"""What a scene is, and which scenes there are."""

import logging
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.datasets.plugins import blamed_on_package, load, plugins, usable
from m3gn_bench.datasets.schema import Fidelity, Split
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.generators.errors import GeneratorError, SolverError


class Scene(Protocol):
    """A physical set-up: how to draw its parameters, how to simulate it, what a valid trajectory is."""

    name: ClassVar[str]
    dataset_version: ClassVar[str]  # raised whenever any number in the dataset changes
    tasks: ClassVar[tuple[str, ...]]  # the benchmark tasks that split this scene's trajectories
    paper_sizes: ClassVar[dict[Split, int]]
    frames: ClassVar[int]
    dt: ClassVar[float]
    time_unit: ClassVar[str]
    length_unit: ClassVar[str]
    material_units: ClassVar[dict[str, str]]
    load_units: ClassVar[dict[str, str]]
    scale_centre: ClassVar[tuple[float, ...]]
    scale_length: ClassVar[float]
    fidelities: ClassVar[dict[str, Any]]

    @property
    def variant(self) -> dict[str, str]:
        """Options (fields of the scene) that differ from the benchmark's, in words; {} for the benchmark's."""
        ...

    def sample(self, rng: np.random.Generator, index: int) -> Any:
        """Draw parameters. Factors that a split must cover evenly cycle with `index`."""
        ...

    def simulate(self, parameters: Any, fidelity: Fidelity = "default") -> Trajectory:
        """Simulate; raises SolverError where no solution is found."""
        ...

    def simulate_with(self, parameters: Any, level: Any, frames: int | None = None) -> Trajectory:
        """The same with a discretisation of one's own (like those in `fidelities`), or of another length."""
        ...

    def check(self, trajectory: Trajectory) -> list[str]:
        """Reasons why the trajectory must not enter a dataset; empty if it may.

        Each names the frame, what is wrong by how much, and a remedy (see `errors.problem`).
        """
        ...

    def extreme_materials(self, parameters: Any) -> tuple[Any, Any]:
        """The same draw with the softest and with the stiffest material (where nu alone varies: the smallest
        and the largest)."""
        ...

    def tasks_of(self, split: Split, material: dict[str, float]) -> list[str]:
        """The tasks in whose `split` a trajectory with this material takes part."""
        ...

    def task_size(self, task: str, split: Split, trajectories: int) -> int:
        """How many of the first `trajectories` of a split take part in a task."""
        ...

    def simulator_versions(self) -> dict[str, str]:
        """Versions of the libraries whose code shapes the numbers."""
        ...


@runtime_checkable
class SimulatesTogether(Protocol):
    """A scene that can simulate several trajectories at once."""

    @property
    def together(self) -> int:
        """How many at once are worth while."""
        ...

    def simulate_together(
        self, draws: Sequence[Any], level: Any, frames: int | None = None
    ) -> list[Trajectory | SolverError]:
        """What `simulate_with` returns or raises for each of these draws."""
        ...


class Leveled:
    """Part of a scene that simulates with discretisations which have names."""

    fidelities: ClassVar[dict[str, Any]]

    def simulate(self, parameters: Any, fidelity: Fidelity = "default") -> Trajectory:
        """Simulate all frames of the scene.

        Raises:
            SolverError: no solution was found; names the frame.
        """
        return self.simulate_with(parameters, self.fidelities[fidelity])

    def simulate_with(self, parameters: Any, level: Any, frames: int | None = None) -> Trajectory:
        """To be defined by the scene."""
        raise NotImplementedError


class SingleTask:
    """Part of a scene all of whose trajectories take part in its one task."""

    tasks: ClassVar[tuple[str, ...]]

    def tasks_of(self, split: Split, material: dict[str, float]) -> list[str]:
        """One task, whatever the split and the material."""
        return list(self.tasks)

    def task_size(self, task: str, split: Split, trajectories: int) -> int:
        """All of them."""
        return trajectories


# It warns of how it stores the nodes of every finer mesh.
logging.getLogger("skfem").setLevel(logging.ERROR)


class SimulatedWithScikitFem:
    """Part of a scene whose solver stands on scikit-fem."""

    def simulator_versions(self) -> dict[str, str]:
        """Versions of scikit-fem, scipy and numpy."""
        return {name: version(name) for name in ("scikit-fem", "scipy", "numpy")}


# Imported on demand: a scene loads only the simulator that it needs.
OWN_SCENES = {
    "sheet_deformation": "m3gn_bench.generators.sheet_deformation:SheetDeformation",
    "deformable_block": "m3gn_bench.generators.deformable_block:DeformableBlock",
    "tissue_manipulation": "m3gn_bench.generators.tissue_manipulation:TissueManipulation",
    "falling_teddy": "m3gn_bench.generators.falling:FallingTeddy",
    "mixed_objects": "m3gn_bench.generators.falling:MixedObjects",
}


# What a scene must have; that a class defines all of it shows only once it is used.
_MEMBERS = (*Scene.__annotations__, *(name for name in vars(Scene) if not name.startswith("_")))


def scene_names() -> list[str]:
    """All scenes: our own, then those of other packages, whether they can be used or not."""
    return [*OWN_SCENES, *(name for name in plugins("scene") if name not in OWN_SCENES)]


def usable_scenes() -> dict[str, Scene]:
    """All scenes as the benchmark has them, without those of packages that cannot be used."""
    own = {name: get_scene(name) for name in OWN_SCENES}
    return own | dict(usable("scene", get_scene, OWN_SCENES))


def get_scene(name: str, **options: Any) -> Scene:
    """The scene of that name, with options where they differ from the benchmark's.

    Raises:
        GeneratorError: no such scene (lists all), or it has no such option (lists its own).
        PluginError: it belongs to another package, which cannot be used (names the package).
    """
    if name in OWN_SCENES:
        module, attribute = OWN_SCENES[name].split(":")
        scene: Scene = _make(getattr(import_module(module), attribute), name, options)
        return scene
    if name not in plugins("scene"):
        raise GeneratorError(unknown_name("scene", name, scene_names()))
    make = load("scene", name)
    with blamed_on_package("scene", name):
        scene = _make(make, name, options)
        missing = [member for member in _MEMBERS if not hasattr(scene, member)]
        if missing:
            raise TypeError(f"it is no Scene, for it has no {', '.join(missing)}")
        if scene.name != name:
            raise ValueError(f"the scene calls itself {scene.name!r}")
    return scene


def _make(make: Any, name: str, options: dict[str, Any]) -> Any:
    """Call a scene's class, or what returns a scene, with options that it knows."""
    known = list(signature(make).parameters)
    for option in options:
        if option not in known:
            raise GeneratorError(
                unknown_name(f"option of {name}", option, known)
                if known
                else f"{name} has no options, so no {option!r} either"
            )
    return make(**options)
