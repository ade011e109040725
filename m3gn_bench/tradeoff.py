"""Speed against accuracy: every way to get a trajectory of a task, in one run on one machine.

Judged by one reference, the finest of three meshes (see `generators.knobs`), are simulators at every setting of every
knob, and learned models at every context size. A model is given the context that the benchmark's dataset
has, so the error of that data stands beside the model's own.

The error of a trajectory is the root mean square distance of its nodes from the reference over a window of
frames, divided by the root mean square displacement of the reference from rest or by the object's size. For a
model only the window's frames after the anchor count; where contexts outlast the window, because the finest mesh
cannot be run for long, all frames after the anchor count, judged by a fidelity that can. Times are CPU seconds of one
thread for a whole trajectory.
"""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.optimize import brentq
from threadpoolctl import threadpool_limits

from m3gn_bench.checkpoint import Checkpoint, load_checkpoint, read_description
from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import case_from
from m3gn_bench.datasets.schema import DATASET_SEED, Record, trajectory_key
from m3gn_bench.provenance import machine
from m3gn_bench.studies import Cell, OnProgress, Result, Shipped, Study, distance
from m3gn_bench.tasks import Task

if TYPE_CHECKING:
    from m3gn_bench.generators.knobs import Knobs, Setting
    from m3gn_bench.generators.scene import Scene

T = TypeVar("T")

# All are timed in rounds, in turns with all others: a slow minute of the machine spoils one round at most.
ROUNDS, MODEL_ROUNDS = 10, 4
ENOUGH = 0.5  # seconds of runs in a round, after which none is repeated
LONG = 5.0  # seconds in rounds before, after which a setting takes part in no other
# Closer ones count as equal (of times, see `Knobs.time_margin`). Errors of the same size differ from draw to draw.
ERROR_MARGIN = 1.01
# Of times one of which is extrapolated, because it comes from few runs: ratios differed by 1.4 between two studies.
EXTRAPOLATED_MARGIN = 2.0


class Simulated(Record):
    """One simulator setting; errors are means over the draws that were not refused.

    Attributes:
        knob, label: which setting.
        seconds: of CPU time per trajectory.
        error: distance from the reference.
        error_of_steps: distance from the same mesh with fine steps.
        error_of_mesh: distance of that from the reference.
        extrapolated: the time is that of fewer frames, and of each further one.
        refused: reasons, one for every draw that the scene's checks or the solver refused.
        on_front: no other way is better (see `pareto_front`) in time and error.
        on_front_by_parts: no other setting is better in time, error of steps and error of the mesh. What a mesh changes
            is another body, the same in all trajectories; what steps change is noise in the motion of that body.
    """

    knob: str
    label: str
    seconds: float | None
    error: float | None
    error_of_steps: float | None
    error_of_mesh: float | None
    extrapolated: bool = False
    refused: tuple[str, ...] = ()
    on_front: bool = False
    on_front_by_parts: bool = False


class Predicted(Record):
    """One learned model at one context size.

    Attributes:
        seconds: per trajectory predicted by itself, context encoding included.
        error: distance from the reference, or from what else judges models (`TradeOff.models_by`).
        error_to_data: distance from the dataset's trajectory, the default fidelity's.
        error_of_data: distance of that from the same judge, over the same frames.
        training_seconds: CPU seconds of training; None: nobody knows.
        weights_sha256: what of the models of that name and preset took part.
        rival: the fastest simulator setting that is at least as accurate, if there is one; of those that count as
            equally fast, the first.
        pays_off_after: number of trajectories after which training has paid for itself against the rival;
            None: never, because the rival is faster or there is none, or nobody knows what training cost.
        pays_off_with_data: the same if simulating the training data counts, too.
    """

    model: str
    preset: str
    context: int
    seconds: float
    error: float
    error_to_data: float
    error_of_data: float
    training_seconds: float | None
    weights_sha256: str
    rival: str | None = None
    pays_off_after: int | None = None
    pays_off_with_data: int | None = None
    on_front: bool = False

    @property
    def pays_off(self) -> str:
        """`pays_off_after` for tables."""
        if self.training_seconds is None:
            return "unknown"
        return "never" if self.pays_off_after is None else str(self.pays_off_after)


class Convergence(Record):
    """What three meshes say of the finest, which is the reference.

    Attributes:
        levels: the meshes' discretisations.
        cell_sizes: relative to the coarsest.
        distances: between the first and second, and between the second and third.
        order: p of an error C h^p that explains the distances; None if none does.
        remaining: the reference's own error that follows.
    """

    levels: tuple[str, ...]
    cell_sizes: tuple[float, ...]
    distances: tuple[float, float]
    order: float | None
    remaining: float | None


class TradeOff(Record):
    """The whole study of a task.

    Attributes:
        window: first and last frame by which simulators are judged.
        models_by: the fidelity that judges models, on all frames after their context; None: the reference, in the
            window.
        time_margin: times closer than this factor count as equal.
    """

    task: str
    scene: str
    dataset_version: str
    package_version: str
    machine: str
    draws: tuple[str, ...]
    window: tuple[int, int]
    models_by: str | None = None
    time_margin: float
    unit: str
    convergence: Convergence
    simulators: tuple[Simulated, ...]
    models: tuple[Predicted, ...]

    @property
    def default(self) -> Simulated:
        """The benchmark's own fidelity."""
        return default_of(self.simulators)

    def margin(self, way: Simulated | Predicted) -> float:
        """The factor by which a time has to differ from this way's to count as another."""
        extrapolated = isinstance(way, Simulated) and way.extrapolated
        return EXTRAPOLATED_MARGIN if extrapolated else self.time_margin

    def with_front(self) -> "TradeOff":
        """The same with every way marked that lies on a front; refused settings do not."""

        def finite(value: float | None) -> float:
            return math.inf if value is None else value

        totals = [
            (math.inf, math.inf) if s.refused else (finite(s.seconds), finite(s.error))
            for s in self.simulators
        ]
        # Errors over other frames, against another judge, are not to be compared.
        compared = self.models if self.models_by is None else ()
        ways: tuple[Simulated | Predicted, ...] = (*self.simulators, *compared)
        margins = [self.margin(way) for way in ways]
        front = pareto_front([*totals, *((m.seconds, m.error) for m in compared)], margins)
        parts = pareto_front(
            [
                (seconds, finite(s.error_of_steps), finite(s.error_of_mesh))
                for s, (seconds, _) in zip(self.simulators, totals, strict=True)
            ],
            margins[: len(self.simulators)],
        )
        simulators = tuple(
            s.model_copy(update={"on_front": on, "on_front_by_parts": by_parts})
            for s, on, by_parts in zip(self.simulators, front, parts, strict=False)
        )
        models_on_front = front[len(simulators) :] or [False] * len(self.models)
        marked = tuple(
            m.model_copy(update={"on_front": on}) for m, on in zip(self.models, models_on_front, strict=True)
        )
        return self.model_copy(update={"simulators": simulators, "models": marked})


def measure(
    task: Task,
    checkpoints: Sequence[Shipped],
    state: Path,
    *,
    knobs: "Knobs | None" = None,
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[TradeOff, Study]:
    """Measure a task's trade-off; call `finish` of the study that is returned once the result is kept.

    Args:
        task: which one.
        checkpoints: trained models of that task.
        state: folder for results so far; an interrupted run goes on from there.
        knobs: other settings and draws than the scene's own.
        workers: processes for what is not timed.
        on_progress: called with the numbers of measurements done and in total.
    """
    from m3gn_bench.generators.errors import GeneratorError
    from m3gn_bench.generators.knobs import knobs_of
    from m3gn_bench.generators.scene import get_scene
    from m3gn_bench.generators.workers import run_jobs
    from m3gn_bench.version import __version__

    scene = get_scene(task.scene)
    knobs = knobs or knobs_of(task.name)
    shipped = [(one, read_description(one.folder)) for one in checkpoints]
    bench = Bench(task, scene, knobs)
    study = Study(
        state,
        {
            "task": task.name,
            "dataset_version": scene.dataset_version,
            "knobs": repr([value for value in vars(knobs).values() if not callable(value)]),
            "full_length": [setting.name for setting in knobs.settings if knobs.full_length(setting)],
            "fidelities": repr(scene.fidelities),
            "simulators": scene.simulator_versions(),
            "machine": bench.machine,
        },
    )
    use_cpu(1)
    with threadpool_limits(1):
        run = partial(run_jobs, workers=workers)
        results = study.measure(bench.cells([one for one, _ in shipped], study), on_progress, run)
    simulators = bench.simulators(results)
    default = default_of(simulators)
    if default.refused or default.seconds is None:
        raise GeneratorError(f"the default fidelity is refused: {default.refused[0]}")
    data_seconds = default.seconds * sum(
        scene.task_size(task.name, split, scene.paper_sizes[split]) for split in ("train", "validation")
    )
    models = [
        _pay_off(
            bench.predicted(results, one, context, description),
            bench.simulators(results, max(context, knobs.first)),
            data_seconds,
            knobs.time_margin,
        )
        for one, description in shipped
        for context in task.context_sizes
    ]
    return TradeOff(
        task=task.name,
        scene=scene.name,
        dataset_version=scene.dataset_version,
        package_version=__version__,
        machine=bench.machine,
        draws=tuple(trajectory_key("test", index) for index in knobs.draws),
        window=(knobs.first, knobs.last),
        models_by=knobs.models_by,
        time_margin=knobs.time_margin,
        unit="displacement" if knobs.size is None else "size of the object",
        convergence=bench.convergence(results),
        simulators=tuple(simulators),
        models=tuple(models),
    ).with_front(), study


def default_of(simulators: Sequence[Simulated]) -> Simulated:
    """The benchmark's own fidelity among a scene's settings."""
    return next(s for s in simulators if (s.knob, s.label) == ("fidelity", "default"))


def pareto_front(points: Sequence[tuple[float, ...]], time_margins: Sequence[float]) -> list[bool]:
    """Which (seconds, error, ...) no other is better than: clearly in one respect, and clearly worse in none.

    Args:
        points: what is compared.
        time_margins: of each point; of two, the larger one says which seconds are clearly less.
    """

    def clearly_less(one: int, other: int) -> bool:
        time_margin = max(time_margins[one], time_margins[other])
        margins = (time_margin, *(ERROR_MARGIN for _ in points[one][1:]))
        return any(a * margin < b for a, b, margin in zip(points[one], points[other], margins, strict=True))

    def beats(one: int, other: int) -> bool:
        return clearly_less(one, other) and not clearly_less(other, one)

    numbers = range(len(points))
    return [math.isfinite(sum(points[n])) and not any(beats(other, n) for other in numbers) for n in numbers]


def observed_order(cell_sizes: Sequence[float], distances: tuple[float, float]) -> float | None:
    """p with distances[k] = C (cell_sizes[k]^p - cell_sizes[k + 1]^p), between 0.1 and 10; None if there is none."""
    coarse, middle, fine = cell_sizes

    def mismatch(order: float) -> float:
        expected = (coarse**order - middle**order) / (middle**order - fine**order)
        return expected - distances[0] / distances[1]

    if min(distances) <= 0 or mismatch(0.1) * mismatch(10.0) > 0:
        return None
    return float(brentq(mismatch, 0.1, 10.0))


def _pay_off(
    model: Predicted, simulators: Sequence[Simulated], data_seconds: float, time_margin: float
) -> Predicted:
    """After how many trajectories the model has cost less than the fastest simulator that is as accurate."""
    rivals = [
        (s.seconds, f"{s.knob}: {s.label}")
        for s in simulators
        if s.error is not None and s.seconds is not None and s.error <= model.error and not s.refused
    ]
    if not rivals:
        return model
    fastest, _ = min(rivals)
    seconds, rival = next(r for r in rivals if r[0] <= time_margin * fastest)
    found: dict[str, Any] = {"rival": rival}
    saved = seconds - model.seconds
    if saved > 0 and model.training_seconds is not None:
        found["pays_off_after"] = math.ceil(model.training_seconds / saved)
        found["pays_off_with_data"] = math.ceil((model.training_seconds + data_seconds) / saved)
    return model.model_copy(update=found)


class Bench:
    """The measurements of one task and what follows from them."""

    def __init__(self, task: Task, scene: "Scene", knobs: "Knobs") -> None:
        from m3gn_bench.generators.generate import draw

        self.task, self.scene, self.knobs = task, scene, knobs
        self.machine = machine()
        self.parameters = {i: draw(scene, "test", i, DATASET_SEED) for i in knobs.draws}
        self._simulated: dict[int, Any] = {}

    # -- measuring -------------------------------------------------------------------------------------

    def cells(self, shipped: Sequence[Shipped], study: Study) -> list[Cell]:
        """All that the study measures. Cheap ones first, so that a mistake shows early."""
        turns = [(setting, i) for i in self.knobs.draws for setting in self.knobs.settings]
        cells = [Cell(f"{setting.name} {i}", partial(self._timed, setting, i)) for setting, i in turns]
        cells += [
            Cell(_again_name(setting, i, number), partial(self._timed_again, setting, i, number, study))
            for number in range(1, ROUNDS)
            for setting, i in turns
        ]
        predictions = [
            (one, context, i)
            for one in shipped
            for context in self.task.context_sizes
            for i in self.knobs.draws
        ]
        cells += [Cell(_prediction_name(*which), partial(self._predict, *which)) for which in predictions]
        cells += [
            Cell(f"{_prediction_name(*which)}, round {number}", partial(self._predict_again, *which, study))
            for number in range(1, MODEL_ROUNDS)
            for which in predictions
        ]
        # Levels that are run for comparison only; several settings share a companion.
        compared = dict.fromkeys(
            [*(self._companion(s) for s in self.knobs.settings if not s.options), *self.knobs.meshes]
        )
        window = slice(self.knobs.first, self.knobs.last + 1)
        cells += [
            Cell(
                _untimed_name(level, i),
                partial(untimed, self.scene.name, self.parameters[i], level, self.knobs.frames, window),
                timed=False,
            )
            for level in compared
            for i in self.knobs.draws
        ]
        if shipped and self.knobs.models_by is not None:
            judge = self.scene.fidelities[self.knobs.models_by]
            cells += [
                Cell(
                    _judge_name(i),
                    partial(
                        untimed, self.scene.name, self.parameters[i], judge, self.scene.frames, slice(None)
                    ),
                    timed=False,
                )
                for i in self.knobs.draws
            ]
        return cells

    def _companion(self, setting: "Setting") -> Any:
        return self.knobs.with_fine_steps(setting.level)

    def _timed(self, setting: "Setting", index: int) -> Result:
        """CPU seconds (see `_time`), and the nodes in the window; or why it is refused."""
        from m3gn_bench.generators.errors import GeneratorError, SolverError
        from m3gn_bench.generators.scene import get_scene

        full = self.knobs.full_length(setting)
        try:
            scene = get_scene(self.task.scene, **setting.options)
            times, trajectory = self._time(scene, setting, index)
        except (SolverError, GeneratorError) as error:  # not solved; or a library is not installed
            return Result({"refused": str(error), "times": None})
        # A body that is seen in mid-impact only is not judged by how it ends.
        problems = scene.check(trajectory) if full else []
        return Result(
            {"refused": "; ".join(problems) or None, "times": times},
            {
                "positions": self._window(trajectory.positions),
                "rest": trajectory.mesh.rest_positions,
                **({"all": trajectory.positions} if self.knobs.models_by and full else {}),
            },
        )

    def _timed_again(self, setting: "Setting", index: int, number: int, study: Study) -> Result:
        """CPU seconds in a later round; None where earlier ones are enough, or it is refused."""
        from m3gn_bench.generators.scene import get_scene

        before = study.results[f"{setting.name} {index}"].values["times"]
        if before is None or number * max(sum(before), ENOUGH) >= LONG:
            return Result({"times": None})
        scene = get_scene(self.task.scene, **setting.options)
        return Result({"times": self._time(scene, setting, index)[0]})

    def _time(self, scene: "Scene", setting: "Setting", index: int) -> tuple[list[float], Any]:
        """CPU seconds of the frames that are timed; and, where these are not all, of the first ones alone.

        And the trajectory, as far as it was simulated.
        """
        if self.knobs.full_length(setting):
            seconds, trajectory = self._run(scene, setting.level, index, None)
            return [seconds], trajectory
        seconds, trajectory = self._run(scene, setting.level, index, self.knobs.timed_frames)
        return [seconds, self._run(scene, setting.level, index, self._first_frames)[0]], trajectory

    @property
    def _first_frames(self) -> int:
        return self.knobs.first + 1

    def _run(self, scene: "Scene", level: Any, index: int, frames: int | None) -> tuple[float, Any]:
        parameters = self.parameters[index]
        scene.simulate_with(parameters, level, self.knobs.first + 2)  # makes meshes, loads libraries
        return least_time(lambda: scene.simulate_with(parameters, level, frames))

    def _data(self, index: int) -> Any:
        """The dataset's trajectory, simulated when the first model asks for it."""
        if index not in self._simulated:
            self._simulated[index] = self.scene.simulate(self.parameters[index], "default")
        return self._simulated[index]

    def _window(self, positions: np.ndarray) -> np.ndarray:
        return positions[self.knobs.first : self.knobs.last + 1]

    def _predict(self, one: Shipped, context: int, index: int) -> Result:
        """CPU seconds of a prediction from the dataset's context, and its nodes in all frames after the anchor."""
        import torch

        model, _ = load_checkpoint(one.folder)
        data = self._data(index)
        seen = case_from(self.task, self.scene, data, trajectory_key("test", index)).context(context)
        with torch.inference_mode():
            seconds, predicted = least_time(lambda: model.predict(seen))
        positions = predicted.double().numpy() * self.scene.scale_length + np.array(self.scene.scale_centre)
        return Result({"seconds": seconds}, {"positions": positions, "data": data.positions[context:]})

    def _predict_again(self, one: Shipped, context: int, index: int, study: Study) -> Result:
        """CPU seconds in a later round; None where the first one was long enough."""
        before = study.results[_prediction_name(one, context, index)].values["seconds"]
        if before > ENOUGH:
            return Result({"seconds": None})
        return Result({"seconds": self._predict(one, context, index).values["seconds"]})

    # -- what follows ----------------------------------------------------------------------------------

    def _reference(self, results: dict[str, Result], index: int, level: int = -1) -> np.ndarray:
        return results[_untimed_name(self.knobs.meshes[level], index)].arrays["positions"]

    def _judge(self, results: dict[str, Result], index: int, first: int) -> np.ndarray:
        """The nodes by which models are judged, from frame `first` on."""
        if self.knobs.models_by is not None:
            return results[_judge_name(index)].arrays["positions"][first:]
        return self._reference(results, index)[first - self.knobs.first :]

    def _judges(self, setting: "Setting") -> bool:
        return (setting.knob, setting.label) == ("fidelity", self.knobs.models_by)

    def _unit(self, results: dict[str, Result], index: int, reference: np.ndarray) -> float:
        if self.knobs.size is not None:
            return self.knobs.size
        return distance(reference, results[f"fidelity: default {index}"].arrays["rest"])

    def simulators(self, results: dict[str, Result], first: int | None = None) -> list[Simulated]:
        """Means of every setting over the draws that are not refused, in the window.

        Or, without parts, on the frames by which a model is judged that begins at frame `first`. Where that is to the
        end, of settings that were run to the end, and of the judge.
        """
        settings = self.knobs.settings
        if first is not None and self.knobs.models_by is not None:
            settings = tuple(s for s in settings if self.knobs.full_length(s) or self._judges(s))
        found = []
        for setting in settings:
            made = {i: results[f"{setting.name} {i}"] for i in self.knobs.draws}
            good = [i for i, result in made.items() if result.values["refused"] is None]
            errors = np.array([self._errors(results, setting, i, first) for i in good])
            names = ("error", "of steps", "of mesh")
            means = dict(zip(names, errors.mean(0).tolist() if good else (), strict=False))
            found.append(
                Simulated(
                    knob=setting.knob,
                    label=setting.label,
                    seconds=statistics.mean(self._least(results, setting, i) for i in good) if good else None,
                    error=means.get("error"),
                    error_of_steps=means.get("of steps"),
                    error_of_mesh=means.get("of mesh"),
                    extrapolated=not self.knobs.full_length(setting),
                    refused=tuple(r.values["refused"] for r in made.values() if r.values["refused"]),
                )
            )
        return found

    def _least(self, results: dict[str, Result], setting: "Setting", index: int) -> float:
        """CPU seconds of a whole trajectory, by the least times of all rounds."""
        names = [f"{setting.name} {index}", *(_again_name(setting, index, r) for r in range(1, ROUNDS))]
        rounds = [times for name in names if (times := results[name].values["times"]) is not None]
        seconds, *first = (min(times) for times in zip(*rounds, strict=True))
        if not first:
            return seconds
        # Setting up costs once, frames cost each.
        each = (seconds - first[0]) / (self.knobs.timed_frames - self._first_frames)
        return first[0] + each * (self.scene.frames - self._first_frames)

    def _errors(
        self, results: dict[str, Result], setting: "Setting", index: int, first: int | None
    ) -> tuple[float, ...]:
        """Error in the window, and its parts by steps and by mesh (but of another solver, which has no companion).

        From frame `first` on, if it is not None, against what judges models, and without parts.
        """
        found = results[f"{setting.name} {index}"].arrays
        if first is not None and self._judges(setting):
            return (0.0,)
        if first is not None:
            judge = self._judge(results, index, first)
            positions = (
                found["all"][first:]
                if self.knobs.models_by
                else found["positions"][first - self.knobs.first :]
            )
            return (distance(positions, judge) / self._unit(results, index, judge),)
        reference, positions = self._reference(results, index), found["positions"]
        unit = self._unit(results, index, reference)
        total = distance(positions, reference) / unit
        if setting.options:
            return (total,)
        companion = results[_untimed_name(self._companion(setting), index)].arrays["positions"]
        return total, distance(positions, companion) / unit, distance(companion, reference) / unit

    def predicted(
        self, results: dict[str, Result], one: Shipped, context: int, description: Checkpoint
    ) -> Predicted:
        """Means over draws of a model at a context size."""
        first = max(context, self.knobs.first)
        errors, seconds = [], []
        for i in self.knobs.draws:
            name = _prediction_name(one, context, i)
            result = results[name]
            truth = self._judge(results, i, first)
            window = slice(first - context, first - context + len(truth))
            positions, data = (result.arrays[name][window] for name in ("positions", "data"))
            unit = self._unit(results, i, truth)
            errors.append(
                [distance(a, b) / unit for a, b in ((positions, truth), (positions, data), (data, truth))]
            )
            rounds = [name, *(f"{name}, round {number}" for number in range(1, MODEL_ROUNDS))]
            seconds.append(min(filter(None, (results[which].values["seconds"] for which in rounds))))
        error, to_data, of_data = np.mean(errors, axis=0).tolist()
        return Predicted(
            model=one.name,
            preset=one.preset,
            context=context,
            seconds=float(np.mean(seconds)),
            error=error,
            error_to_data=to_data,
            error_of_data=of_data,
            training_seconds=one.training_seconds,
            weights_sha256=description.weights_sha256,
        )

    def convergence(self, results: dict[str, Result]) -> Convergence:
        """Means over draws of the distances between the three meshes."""
        pairs = ((0, 1), (1, 2))
        distances = [
            statistics.mean(
                distance(self._reference(results, i, a), self._reference(results, i, b))
                / self._unit(results, i, self._reference(results, i))
                for i in self.knobs.draws
            )
            for a, b in pairs
        ]
        sizes = self.knobs.cell_sizes
        order = observed_order(sizes, (distances[0], distances[1]))
        remaining = None
        if order is not None:
            remaining = distances[1] * sizes[2] ** order / (sizes[1] ** order - sizes[2] ** order)
        return Convergence(
            levels=tuple(map(repr, self.knobs.meshes)),
            cell_sizes=sizes,
            distances=(distances[0], distances[1]),
            order=order,
            remaining=remaining,
        )


def least_time(run: Callable[[], T]) -> tuple[float, T]:
    """CPU seconds of the fastest of several runs, because whatever else the machine does only adds, and its result."""
    seconds: list[float] = []
    while sum(seconds) < ENOUGH:
        start = time.process_time()
        result = run()
        seconds.append(time.process_time() - start)
    return min(seconds), result


def untimed(scene_name: str, parameters: Any, level: Any, frames: int, window: slice) -> Result:
    """Nodes in a window of frames, by one thread."""
    from m3gn_bench.generators.scene import get_scene

    with threadpool_limits(1):
        trajectory = get_scene(scene_name).simulate_with(parameters, level, frames)
    return Result({}, {"positions": trajectory.positions[window]})


def _prediction_name(one: Shipped, context: int, index: int) -> str:
    return f"{one.key} {context} {index}"


def _again_name(setting: "Setting", index: int, number: int) -> str:
    return f"{setting.name} {index}, round {number}"


def _judge_name(index: int) -> str:
    return f"judge of models {index}"


def _untimed_name(level: Any, index: int) -> str:
    return f"{level} {index}"
