"""Numerical stability at the extremes, of simulators and of learned models.

Each simulator cell (see `generators.extremes`) is *correct*, with its error against a finer simulation; *refused*,
by the solver or the scene's checks, with the frame, the quantity and a remedy; or *wrong*: too far from the finer
simulation, or not finite. Each model cell gives a model what lies at the ends of its training, or beyond; its
prediction is *bounded*, or *wrong*: not finite, or further from the anchor than `MODEL_BOUND`.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import Case, Context, case_from
from m3gn_bench.datasets.schema import DATASET_SEED, Record, trajectory_key
from m3gn_bench.errors import ConfigError
from m3gn_bench.provenance import machine
from m3gn_bench.studies import Cell, OnProgress, Result, Shipped, Study, distance
from m3gn_bench.tasks import Task

if TYPE_CHECKING:
    import torch

    from m3gn_bench.generators.extremes import Extreme, Extremes

MODEL_BOUND = 10.0  # scaled units, in which a scene is two wide
REASONED = re.compile(r"frame -?\d+.*: .+; .+")  # frame, quantity, remedy

Verdict = Literal["correct", "refused", "bounded", "wrong"]


class Judged(Record):
    """A cell and its verdict.

    Attributes:
        subject: "simulator", or the model's name.
        cell: what is extreme about it.
        verdict: see the module.
        error: of a simulator against the finer simulation, of a model against the simulator; relative to the
            displacement or to the object's size (simulators), to the displacement after the anchor (models).
        detail: why it was refused, or is wrong; for models what was measured.
        weights_sha256: of a model.
    """

    subject: str
    cell: str
    verdict: Verdict
    error: float | None = None
    detail: str = ""
    weights_sha256: str | None = None


class Stability(Record):
    """The grid of a task.

    Attributes:
        allowed: largest error of a correct simulation.
        cells: simulators first.
    """

    task: str
    scene: str
    dataset_version: str
    package_version: str
    machine: str
    allowed: float
    unit: str
    cells: tuple[Judged, ...]

    @property
    def wrong(self) -> list[Judged]:
        """Cells that should not be."""
        return [cell for cell in self.cells if cell.verdict == "wrong"]


def measure(
    task: Task,
    checkpoints: Sequence[Shipped],
    state: Path,
    *,
    extremes: "Extremes | None" = None,
    workers: int = 1,
    on_progress: OnProgress = lambda done, total: None,
) -> tuple[Stability, Study]:
    """Judge every cell of a task; call `finish` of the study that is returned once the result is kept.

    Args:
        task: which one.
        checkpoints: trained models of that task.
        state: folder for results so far; an interrupted run goes on from there.
        extremes: another grid than the scene's own.
        workers: processes for the simulations.
        on_progress: called with the numbers of cells done and in total.
    """
    from m3gn_bench.generators.extremes import extremes_of
    from m3gn_bench.generators.scene import get_scene
    from m3gn_bench.generators.workers import run_jobs
    from m3gn_bench.version import __version__

    scene = get_scene(task.scene)
    grid = extremes or extremes_of(task.scene)
    study = Study(
        state,
        {
            "task": task.name,
            "dataset_version": scene.dataset_version,
            "cells": [repr(cell) for cell in grid.cells],
            "bounds": [grid.allowed, grid.size, MODEL_BOUND],
            "simulators": scene.simulator_versions(),
        },
    )
    # Tasks that share a scene share its grid: it belongs to the one that bears its name.
    simulated = grid.cells if task.name == scene.name else ()
    cells = [
        Cell(
            f"simulator: {one.name}",
            partial(_as_result, judge, task.scene, one, grid.allowed, grid.size),
            timed=False,
        )
        for one in simulated
    ]
    cells += [
        Cell(f"{one.key}: {name}", partial(_as_result, judge_model, task, one, name))
        for one in checkpoints
        for name in MODEL_CELLS
    ]
    use_cpu(1)
    with threadpool_limits(1):
        results = study.measure(cells, on_progress, partial(run_jobs, workers=workers))
    return Stability(
        task=task.name,
        scene=scene.name,
        dataset_version=scene.dataset_version,
        package_version=__version__,
        machine=machine(),
        allowed=grid.allowed,
        unit="displacement" if grid.size is None else "size of the object",
        cells=tuple(
            Judged.model_validate({k: v for k, v in results[cell.name].values.items() if k != "key"})
            for cell in cells
        ),
    ), study


def _as_result(judging: Callable[..., Judged], *arguments: Any) -> Result:
    with threadpool_limits(1):
        return Result(judging(*arguments).model_dump())


# -- simulators --------------------------------------------------------------------------------------------


def judge(scene_name: str, cell: "Extreme", allowed: float, size: float | None) -> Judged:
    """Simulate a cell and, unless it is refused, the same on the finer mesh.

    Args:
        scene_name: of the scene.
        cell: of its grid.
        allowed, size: see `generators.extremes.Extremes`.
    """
    from m3gn_bench.generators.errors import GeneratorError, ParameterError, SolverError, problem
    from m3gn_bench.generators.scene import get_scene

    def judged(verdict: Verdict, error: float | None = None, detail: str = "") -> Judged:
        return Judged(subject="simulator", cell=cell.name, verdict=verdict, error=error, detail=detail)

    def refused(reason: str) -> Judged:
        if REASONED.fullmatch(reason):
            return judged("refused", detail=reason)
        return judged("wrong", detail=f"refused without frame, quantity or remedy: {reason}")

    try:
        scene = get_scene(scene_name, **cell.options)
        trajectory = scene.simulate_with(cell.parameters, cell.level, cell.frames)
    except ParameterError as error:  # before the first step; the message says what is allowed
        return refused(problem(0, str(error), "choose a value that is allowed"))
    except SolverError as error:
        return refused(str(error))
    except (
        GeneratorError
    ) as error:  # of a name, or a library; the message says what exists, or how to install it
        return refused(problem(0, str(error), "choose one that exists"))
    problems = scene.check(trajectory)
    if problems:
        return refused(problems[0])
    fine = {k: v for k, v in cell.options.items() if k != "solver"}
    try:
        reference = get_scene(scene_name, **fine).simulate_with(
            cell.parameters, cell.reference, cell.last + 1
        )
    except SolverError as error:
        return judged("wrong", detail=f"valid, but not on the finer mesh: {error}")
    if cell.last + 1 >= scene.frames:  # a body in mid-impact is not judged by how it ends
        problems = scene.check(reference)
        if problems:
            return judged("wrong", detail=f"valid, but not on the finer mesh: {problems[0]}")
    window = slice(cell.first, cell.last + 1)
    found, truth = trajectory.positions[window], reference.positions[window]
    unit = distance(truth, reference.mesh.rest_positions) if size is None else size
    apart = distance(found, truth)
    error_found = apart / unit if apart else 0.0  # nothing moves where forces cancel
    # A comparison with NaN is false, so it counts as wrong.
    correct = error_found <= allowed
    return judged(
        "correct" if correct else "wrong", error_found, "" if correct else "far from the finer mesh"
    )


# -- models ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Given:
    """What a model is given, and what it is judged by.

    Attributes:
        context: as the model sees it.
        truth: what the simulator says, in usual units; None where it says nothing.
        factor, shift: from usual units to those that the model sees; the shift has shape [dim], or is 0.
    """

    context: Context
    truth: "torch.Tensor | None"
    factor: float = 1.0
    shift: "torch.Tensor | float" = 0.0

    def usual(self, positions: "torch.Tensor") -> "torch.Tensor":
        """Positions that the model sees or predicts, in usual units."""
        return (positions - self.shift) / self.factor


def judge_model(task: Task, checkpoint: Shipped, name: str) -> Judged:
    """Let a model predict under one extreme condition."""
    import torch

    model, description = load_checkpoint(checkpoint.folder)
    given = MODEL_CELLS[name](task)
    if given.context.positions.dtype == torch.float64:
        model.double()
    judged = partial(Judged, subject=checkpoint.name, cell=name, weights_sha256=description.weights_sha256)
    try:
        with torch.inference_mode():
            predicted = given.usual(model.predict(given.context))
    except ConfigError as refusal:
        return judged(verdict="refused", detail=str(refusal))
    if len(predicted) != given.context.horizon:
        return judged(verdict="wrong", detail=f"{len(predicted)} frames instead of {given.context.horizon}")
    anchor = given.usual(given.context.positions[-1])
    furthest = float((predicted - anchor).abs().max())
    error = None
    if given.truth is not None:
        moved = distance(given.truth.numpy(), anchor.expand_as(given.truth).numpy())
        error = distance(predicted.numpy(), given.truth.numpy()) / moved
    finite = np.isfinite(furthest) and (error is None or np.isfinite(error))
    return judged(
        verdict="bounded" if finite and furthest <= MODEL_BOUND else "wrong",
        error=error if finite else None,
        detail=f"at most {furthest:.3g} from the anchor",
    )


@lru_cache(maxsize=8)
def _case(task: Task, material: int | None = None) -> Case:
    """The first test trajectory; or the same with the softest (0) or the stiffest (1) of the scene's materials."""
    from m3gn_bench.generators.generate import draw
    from m3gn_bench.generators.scene import get_scene

    scene = get_scene(task.scene)
    parameters = draw(scene, "test", 0, DATASET_SEED)
    if material is not None:
        parameters = scene.extreme_materials(parameters)[material]
    return case_from(task, scene, scene.simulate(parameters), trajectory_key("test", 0))


def _given(case: Case, size: int, factor: float = 1.0, shift: "torch.Tensor | float" = 0.0) -> Given:
    return Given(_map(case, lambda t: t * factor + shift).context(size), case.future(size), factor, shift)


def _map(case: Case, change: "Callable[[torch.Tensor], torch.Tensor]") -> Case:
    """The same case with all positions changed."""
    body = replace(case.body, rest_positions=change(case.body.rest_positions))
    return Case(body, change(case.positions), change(case.collider_path), case.keys)


def _longer(task: Task, factor: int) -> Given:
    """Far past the horizon that models are trained on; the collider stays where it ends."""
    import torch

    case, size, frames = _case(task), task.middle_context, factor * task.frames
    stays = case.collider_path[-1:].expand(frames - task.frames, -1, -1)
    path = torch.cat([case.collider_path, stays])
    return Given(Context(case.body, case.positions[:size], frames - size, path, case.keys), None)


def _shifted(task: Task) -> Given:
    """Ten scenes away; where the ground is at height zero, along the ground."""
    import torch

    shift = torch.full((task.dimension,), 20.0)
    if task.height_feature:
        shift[-1] = 0
    return _given(_case(task), task.middle_context, shift=shift)


def _double(task: Task) -> Given:
    """Everything in double precision."""
    import torch

    case, size = _case(task), task.middle_context
    return Given(case.to(torch.float64).context(size), case.future(size))


MODEL_CELLS: dict[str, Callable[[Task], Given]] = {
    "context of two frames": lambda task: _given(_case(task), 2),
    "context of all frames but one": lambda task: _given(_case(task), task.frames - 1),
    "four times the horizon": lambda task: _longer(task, 4),
    "a tenth of the size": lambda task: _given(_case(task), task.middle_context, factor=0.1),
    "ten times the size": lambda task: _given(_case(task), task.middle_context, factor=10.0),
    "shifted by ten scenes": _shifted,
    "softest material of the scene": lambda task: _given(_case(task, material=0), task.middle_context),
    "stiffest material of the scene": lambda task: _given(_case(task, material=1), task.middle_context),
    "double precision": _double,
}
