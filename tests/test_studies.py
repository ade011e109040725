"""Studies of speed, accuracy and stability: their bookkeeping, on grids small enough to run here."""

import json
import math
import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from m3gn_bench import stability, studies, study_commands, tradeoff
from m3gn_bench.checkpoint import load_checkpoint, read_description
from m3gn_bench.cli import cli
from m3gn_bench.data import case_from
from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.datasets.writer import reserved
from m3gn_bench.errors import ConfigError
from m3gn_bench.figures import save
from m3gn_bench.generators.deformable_block import DeformableBlock
from m3gn_bench.generators.extremes import Extreme, Extremes, extremes_of
from m3gn_bench.generators.generate import draw as draw_parameters
from m3gn_bench.generators.knobs import Knobs, Setting, knobs_of
from m3gn_bench.generators.scene import get_scene, scene_names
from m3gn_bench.generators.sheet_deformation import SheetDeformation
from m3gn_bench.generators.workers import run_jobs
from m3gn_bench.leaderboard import record
from m3gn_bench.leaderboard.pace import training_seconds
from m3gn_bench.leaderboard.record import checkpoint_folder
from m3gn_bench.model import model_names
from m3gn_bench.stability import MODEL_CELLS, REASONED
from m3gn_bench.studies import Cell, Result, Shipped, Study, distance
from m3gn_bench.study_page import advice, draw, is_converged, read_records, render
from m3gn_bench.tasks import TASKS, get_task

TASK = get_task("sheet_deformation")
M3GN = Shipped("m3gn", "compact", checkpoint_folder(TASK.name, "m3gn", "compact"), training_seconds=600.0)
DEFAULT = SheetDeformation.fidelities["default"]
SMALL = Knobs(
    draws=(4,),
    first=1,
    last=12,
    frames=13,
    size=None,
    time_margin=1.2,
    settings=(
        Setting("fidelity", "default", DEFAULT),
        Setting("tolerance", "0.1", replace(DEFAULT, tolerance=1e-1)),
        Setting("mesh", "even", replace(DEFAULT, border_layer=False)),
    ),
    meshes=tuple(replace(DEFAULT, refinement=k) for k in (1, 2, 3)),
    cell_sizes=(1, 1 / 2, 1 / 3),
    with_fine_steps=lambda level: replace(level, tolerance=1e-7),
)


# -- bookkeeping -------------------------------------------------------------------------------------------


def counted(calls: list[str], name: str, fails: bool = False) -> Cell:
    def measure() -> Result:
        if fails:
            raise KeyboardInterrupt
        calls.append(name)
        return Result({"name": name}, {"numbers": np.arange(3.0)})

    return Cell(name, measure)


def ignore(done: int, total: int) -> None:
    """No progress bar."""


def test_an_interrupted_study_goes_on(tmp_path: Path) -> None:
    calls: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        Study(tmp_path, {"a": 1}).measure([counted(calls, "one"), counted(calls, "two", fails=True)], ignore)
    study = Study(tmp_path, {"a": 1})
    results = study.measure([counted(calls, "one"), counted(calls, "two")], ignore)
    assert calls == ["one", "two"]
    assert results["one"].values["name"] == "one"
    assert np.array_equal(results["one"].arrays["numbers"], [0, 1, 2])
    study.finish()
    assert not tmp_path.exists()


def test_cells_without_a_time_run_in_processes(tmp_path: Path) -> None:
    """All of them, each once, and none again."""
    cells = [Cell(str(n), partial(Result, {"number": n}), timed=n == 0) for n in range(4)]
    study = Study(tmp_path, {})
    results = study.measure(cells, ignore, partial(run_jobs, workers=2))
    assert [results[str(n)].values["number"] for n in range(4)] == [0, 1, 2, 3]
    again = [counted([], cell.name, fails=True) for cell in cells]
    assert list(study.measure(again, ignore)) == ["0", "1", "2", "3"]


def test_results_of_other_settings_are_dropped(tmp_path: Path) -> None:
    calls: list[str] = []
    for settings in ({"a": 1}, {"a": 2}):
        Study(tmp_path, settings).measure([counted(calls, "one")], ignore)
    assert calls == ["one", "one"]


def test_results_of_other_code_are_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of code that no commit holds."""
    calls: list[str] = []
    for difference in ("an edit", "another"):
        monkeypatch.setattr(studies, "changes", lambda difference=difference: difference)
        Study(tmp_path, {}).measure([counted(calls, "one")], ignore)
    assert calls == ["one", "one"]


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write to"):
        Study(tmp_path / "file" / "study", {})


# -- what follows from measurements ------------------------------------------------------------------------


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.5])
@pytest.mark.parametrize("sizes", [(1, 1 / 2, 1 / 4), (1, 1 / 2, 1 / 3)])
def test_observed_order(order: float, sizes: tuple[float, ...]) -> None:
    errors = [size**order for size in sizes]
    found = tradeoff.observed_order(sizes, (errors[0] - errors[1], errors[1] - errors[2]))
    assert found == pytest.approx(order)


def test_no_order_where_nothing_converges() -> None:
    assert tradeoff.observed_order((1, 1 / 2, 1 / 4), (1.0, 2.0)) is None
    assert tradeoff.observed_order((1, 1 / 2, 1 / 4), (0.0, 0.0)) is None


def test_pareto_front() -> None:
    """Beaten by what is clearly better in one respect and as good in the other; what has no error is on no front."""
    points = [(1.0, 1.0), (10.0, 1.0), (2.0, 0.5), (3.0, 0.6), (2.05, 0.504), (1.05, 2.0), (0.5, math.inf)]
    assert tradeoff.pareto_front(points, [1.1] * 7) == [True, False, True, False, True, False, False]
    # What would be as fast as (1, 1), and less accurate, if times were less certain.
    slower = (0.9, 1.1)
    assert tradeoff.pareto_front([(1.0, 1.0), slower], [1.1, 1.1]) == [True, True]
    assert tradeoff.pareto_front([(1.0, 1.0), slower], [1.1, 2.0]) == [True, False]
    parts = [(1.0, 1.0, 1.0), (2.0, 1.0, 0.9), (2.0, 1.0, 1.0)]
    assert tradeoff.pareto_front(parts, [1.1] * 3) == [True, True, False]


# -- the grids ---------------------------------------------------------------------------------------------


def test_grids_are_large_enough() -> None:
    """At least 60 cells over the five scenes; names are unique."""
    grids = [extremes_of(name) for name in scene_names()]
    assert sum(len(grid.cells) for grid in grids) >= 60
    for grid in grids:
        assert len({cell.name for cell in grid.cells}) == len(grid.cells)


@pytest.mark.parametrize("name", TASKS)
def test_knobs_are_sound(name: str) -> None:
    """The default is among the settings, names are unique, meshes get finer."""
    knobs = knobs_of(name)
    names = [setting.name for setting in knobs.settings]
    assert "fidelity: default" in names
    assert len(set(names)) == len(names)
    assert sorted(knobs.cell_sizes, reverse=True) == list(knobs.cell_sizes)
    # Something judges what models predict, whatever the context.
    assert (
        knobs.models_by in get_scene(TASKS[name].scene).fidelities
        or max(TASKS[name].context_sizes) <= knobs.last
    )


BLOCK = next(cell for cell in extremes_of("deformable_block").cells if cell.name == "lowest fidelity")
FEW = replace(BLOCK, frames=6, last=5, reference=DeformableBlock.fidelities["default"])


def judged(cell: Extreme, allowed: float = 0.1) -> stability.Judged:
    return stability.judge("deformable_block", cell, allowed, None)


def test_verdicts() -> None:
    """A good simulation is correct, a locking element is wrong, the impossible is refused with all reasons."""
    good = judged(FEW)
    assert (good.verdict, good.error is not None and good.error < 0.02) == ("correct", True)
    locking = judged(replace(FEW, level=replace(FEW.level, element="linear triangles")), allowed=0.02)
    assert locking.verdict == "wrong"
    for changes in ({"poisson_ratios": (0.0, 0.5)}, {"speed": 0.0}, {"youngs_modulus": -1.0}):
        refused = judged(replace(FEW, parameters=replace(FEW.parameters, **changes)))
        assert refused.verdict == "refused"
        assert REASONED.fullmatch(refused.detail)


def test_what_is_not_finite_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even where a scene's checks are blind."""
    simulate = DeformableBlock.simulate_with

    def spoilt(self: DeformableBlock, *arguments: object) -> object:
        trajectory = simulate(self, *arguments)  # type: ignore[arg-type]
        trajectory.positions[3] = np.nan
        return trajectory

    monkeypatch.setattr(DeformableBlock, "simulate_with", spoilt)
    monkeypatch.setattr(DeformableBlock, "check", lambda self, trajectory: [])
    assert judged(FEW).verdict == "wrong"


def test_a_refusal_without_remedy_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DeformableBlock, "check", lambda self, trajectory: ["it failed"])
    assert judged(FEW).verdict == "wrong"


@pytest.mark.parametrize("name", MODEL_CELLS)
def test_a_model_at_its_extremes(name: str) -> None:
    found = stability.judge_model(TASK, M3GN, name)
    assert found.verdict == "bounded"


@pytest.mark.parametrize("name", [TASK.name, "falling_teddy"])
def test_models_do_not_mind_where_the_scene_is(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor how precise numbers are; above a ground the scene is shifted along it."""
    monkeypatch.setitem(
        MODEL_CELLS,
        "nothing extreme",
        lambda task: stability._given(stability._case(task), task.middle_context),
    )
    m3gn = Shipped("m3gn", "compact", checkpoint_folder(name, "m3gn", "compact"))
    usual, shifted, double = (
        stability.judge_model(get_task(name), m3gn, cell).error
        for cell in ("nothing extreme", "shifted by ten scenes", "double precision")
    )
    assert shifted == pytest.approx(usual, rel=1e-3)
    assert double == pytest.approx(usual, rel=1e-3)


# -- commands ----------------------------------------------------------------------------------------------


@pytest.fixture
def few_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rounds, and in each of them one run of everything."""
    monkeypatch.setattr(tradeoff, "ROUNDS", 2)
    monkeypatch.setattr(tradeoff, "MODEL_ROUNDS", 2)
    monkeypatch.setattr(tradeoff, "ENOUGH", 1e-9)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands measure small grids."""
    monkeypatch.setattr("m3gn_bench.generators.knobs.knobs_of", lambda task: SMALL)
    impossible = replace(FEW, name="nu = 0.5", parameters=replace(FEW.parameters, poisson_ratios=(0.0, 0.5)))
    grid = Extremes((FEW, impossible), 0.1, None)
    monkeypatch.setattr("m3gn_bench.generators.extremes.extremes_of", lambda scene: grid)


@pytest.mark.usefixtures("few_runs")
def test_an_interrupted_tradeoff_still_times_in_rounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether a setting is timed again depends on a time that may be from before the interruption."""

    knobs = replace(SMALL, last=3, frames=4, meshes=(DEFAULT,) * 3)  # cheap; nothing here depends on them

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(tradeoff.Bench, "_timed_again", stop)
        with pytest.raises(KeyboardInterrupt):
            tradeoff.measure(TASK, [], tmp_path, knobs=knobs)
    _, study = tradeoff.measure(TASK, [], tmp_path, knobs=knobs)
    names = [f"{knobs.settings[0].name} {index}, round 1" for index in knobs.draws]
    assert all(study.results[name].values["times"] for name in names)


@pytest.mark.usefixtures("small", "few_runs")
def test_commands_measure_record_and_render(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both studies and the page; then the page is up to date, until a record changes."""
    docs = tmp_path / "docs"

    def run(*arguments: str) -> tuple[int, dict[str, Any]]:
        done = CliRunner().invoke(cli, [*arguments, "--json"])
        return done.exit_code, json.loads(done.stdout)

    places = ["--workers", "1", "--data", str(tmp_path), "--record", str(docs / "studies")]
    figure = tmp_path / "figure.png"
    code, found = run("tradeoff", TASK.name, "-o", str(figure), "--checkpoint", str(M3GN.folder), *places)
    assert code == 0
    assert len(found.pop("advice")) == 3
    assert figure.stat().st_size > 5000
    (result,), _ = read_records(docs / "studies")
    assert result == result.with_front()
    assert found == result.model_dump(mode="json")
    assert_sound(result)
    # Two of the models that ship, and one that has learned nothing and is left out.
    monkeypatch.setattr(record, "shipped_models", lambda task: ["m3gn", "egno", "stand_still"])
    code, found = run("stability", "deformable_block", *places)
    assert {c["subject"] for c in found["tasks"][0]["cells"]} == {"simulator", "m3gn", "egno"}
    wrong = [(c["subject"], c["cell"]) for c in found["tasks"][0]["cells"] if c["verdict"] == "wrong"]
    # EGNO's messages read squared distances.
    assert wrong == [("egno", "ten times the size")]
    assert (code, found["wrong"]) == (1, 1)
    assert not list(tmp_path.glob("*.partial"))

    assert run("render-studies", str(docs))[0] == 0
    page = (docs / "tradeoff.md").read_text()
    assert "m3gn (compact)" in page
    sha = read_description(M3GN.folder).weights_sha256
    assert page.count(f"SHA-256 of the models' weights: m3gn {sha[:8]}") == 1
    assert run("render-studies", str(docs), "--check")[0] == 0
    recorded = docs / "studies" / f"tradeoff-{TASK.name}.json"
    recorded.write_text(recorded.read_text().replace("displacement", "size"))
    assert run("render-studies", str(docs), "--check")[0] == 1

    # A figure has room for all models that there are.
    (one, *_) = result.models
    many = tuple(one.model_copy(update={"model": name}) for name in model_names())
    drawn = draw(result.model_copy(update={"models": many}))
    assert {f"{name}, by context" for name in model_names()} <= {
        text.get_text() for text in drawn.legends[0].get_texts()
    }
    with pytest.raises(ConfigError, match="unknown picture format 'xyz'"):
        save(drawn, tmp_path / "figure.xyz")

    # Without the libraries for figures, nothing is written by half.
    (docs / "tradeoff.md").write_text("as it was")
    monkeypatch.setitem(sys.modules, "adjustText", None)
    assert "pip install 'm3gn-bench[plot]'" in str(
        CliRunner().invoke(cli, ["render-studies", str(docs)]).exception
    )
    assert (docs / "tradeoff.md").read_text() == "as it was"


def test_what_is_timed_in_part_is_extrapolated_from_the_least_times() -> None:
    """Ten frames more cost two seconds, so the 49 of a whole trajectory cost 9.8 on top of the first two."""
    knobs = replace(SMALL, timed_frames=12, full_length=lambda setting: False)
    bench = tradeoff.Bench(TASK, SheetDeformation(), knobs)
    rounds = [[5.0, 2.0], [4.0, 2.5], *[None] * (tradeoff.ROUNDS - 2)]
    names = ["fidelity: default 4", *(f"fidelity: default 4, round {n}" for n in range(1, tradeoff.ROUNDS))]
    results = {name: Result({"times": times}) for name, times in zip(names, rounds, strict=True)}
    assert bench._least(results, knobs.settings[0], 4) == pytest.approx(2 + 0.2 * 49)


def test_the_fastest_of_several_runs_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of runs that take 0.3, 0.1 and 0.2 seconds by a clock that is read before and after each."""
    clock = iter([0.0, 0.3, 1.0, 1.1, 2.0, 2.2])
    monkeypatch.setattr(tradeoff.time, "process_time", lambda: next(clock))
    results = iter("abc")
    assert tradeoff.least_time(lambda: next(results)) == (pytest.approx(0.1), "c")


@pytest.mark.usefixtures("few_runs")
def test_models_are_judged_to_the_end_where_contexts_outlast_the_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors are those that follow from trajectories and predictions made here; times are made up."""
    finer = replace(DEFAULT, refinement=2)  # cheaper than the scene's own
    monkeypatch.setitem(SheetDeformation.fidelities, "reference", finer)
    judge_setting = Setting("fidelity", "reference", finer)
    # Over three frames the loose tolerance happens to be better; its time is extrapolated, so counts from twice on.
    seconds_per_frame = dict(zip((s.name for s in SMALL.settings), (0.02, 0.05, 0.05), strict=True))
    seconds_per_frame[judge_setting.name] = 0.1
    simulate = cache(SheetDeformation().simulate_with)

    def run(
        bench: tradeoff.Bench, _: object, level: Any, index: int, frames: int | None
    ) -> tuple[float, Any]:
        trajectory = simulate(bench.parameters[index], level, frames)
        (name,) = (setting.name for setting in bench.knobs.settings if setting.level == level)
        return seconds_per_frame[name] * len(trajectory.positions), trajectory

    monkeypatch.setattr(tradeoff.Bench, "_run", run)
    knobs = replace(
        SMALL,
        time_margin=1.12,
        last=3,
        frames=4,
        meshes=(DEFAULT, DEFAULT, finer),  # what convergence they show is not asked here
        settings=(*SMALL.settings, judge_setting),
        timed_frames=8,
        full_length=lambda setting: setting.knob == "fidelity" and setting.label == "default",
        models_by="reference",
    )
    result, study = tradeoff.measure(TASK, [M3GN], tmp_path, knobs=knobs)
    scene = SheetDeformation()
    parameters = draw_parameters(scene, "test", knobs.draws[0], DATASET_SEED)
    data, truth = (scene.simulate(parameters, fidelity) for fidelity in ("default", "reference"))
    case = case_from(TASK, scene, data, "test_00004")
    model, _ = load_checkpoint(M3GN.folder)
    for predicted in result.models:
        with torch.inference_mode():
            path = model.predict(case.context(predicted.context)).double().numpy()
        path = path * scene.scale_length + np.array(scene.scale_centre)
        judge = truth.positions[predicted.context :]
        unit = distance(judge, truth.mesh.rest_positions)
        assert predicted.error == pytest.approx(distance(path, judge) / unit, rel=1e-5)
        of_data = distance(data.positions[predicted.context :], judge) / unit
        assert predicted.error_of_data == pytest.approx(of_data, rel=1e-5)
        # Of what was run to the end the default is the faster, and it is more accurate than the model.
        assert predicted.rival == "fidelity: default"
        assert not predicted.on_front
    assert result.default.on_front
    better_than_default = result.models[0].model_copy(update={"error": result.models[0].error_of_data / 2})
    rivals = tradeoff.Bench(TASK, scene, knobs).simulators(study.results, better_than_default.context)
    assert [(r.label, r.error == 0) for r in rivals] == [("default", False), ("reference", True)]
    assert tradeoff._pay_off(better_than_default, rivals, 0.0, 1.2).rival == "fidelity: reference"
    # Of two that are as fast as each other, noise does not choose.
    first = rivals[1].model_copy(update={"label": "first", "seconds": 1.05 * (rivals[1].seconds or 0)})
    assert tradeoff._pay_off(better_than_default, [first, rivals[1]], 0.0, 1.2).rival == "fidelity: first"
    lines = render([result], []).splitlines()
    assert any(line.startswith("Models are judged on all frames") for line in lines)
    assert lines.index("| --- | --: | --: | --: | --: | --: | --: | --- |") == 1 + next(
        number for number, line in enumerate(lines) if line.startswith("| model | context |")
    )


def assert_sound(result: tradeoff.TradeOff) -> None:
    """Errors are split into steps and mesh, and a model stands beside them."""
    default, loose, even = result.simulators
    assert default.error
    assert default.error == pytest.approx(
        default.error_of_mesh, rel=0.05
    )  # its tolerance leaves nothing open
    assert even.error
    assert even.error > 1.5 * default.error  # the clamp's boundary layer
    assert loose.refused or (loose.error or 0) > default.error
    convergence = result.convergence
    assert convergence.order
    assert convergence.order > 1
    assert convergence.remaining
    assert convergence.remaining < default.error
    assert [model.context for model in result.models] == [2, 5, 10]
    for model in result.models:
        assert model.error == pytest.approx(model.error_to_data, rel=0.1)
        assert model.error > model.error_of_data
        assert model.pays_off_after
        assert model.pays_off_with_data
        assert model.pays_off_after < model.pays_off_with_data
        rival = next(s for s in result.simulators if f"{s.knob}: {s.label}" == model.rival)
        assert model.pays_off_after == math.ceil(model.training_seconds / (rival.seconds - model.seconds))


def test_one_study_at_a_time(tmp_path: Path) -> None:
    """Two would disturb each other's times, and one would delete what the other has."""
    with reserved(tmp_path / ".studies", "measures", tmp_path):
        done = CliRunner().invoke(cli, ["stability", TASK.name, "--data", str(tmp_path)])
    assert "another process measures in" in str(done.exception)


@pytest.mark.usefixtures("small")
def test_a_wrong_cell_is_an_exit_code(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(DeformableBlock, "check", lambda self, trajectory: ["it failed"])
    monkeypatch.setattr(study_commands, "_checkpoints", lambda task, folders: [])
    done = CliRunner().invoke(
        cli, ["stability", "deformable_block", "--workers", "1", "--data", str(tmp_path)]
    )
    assert done.exit_code == 1
    assert "2 cells, 1 wrong" in done.stdout


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    (tmp_path / f"tradeoff-{TASK.name}.json").write_text("{}")
    with pytest.raises(ConfigError, match=f"tradeoff-{TASK.name}.json is no record"):
        read_records(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tradeoff", "falling_dodo"], "unknown task 'falling_dodo'; known: "),
        (["stability", "falling_dodo"], "unknown task 'falling_dodo'; known: "),
        (["tradeoff", "deformable_block", "--checkpoint", "nowhere"], "no checkpoint in nowhere"),
        (
            ["tradeoff", "deformable_block", "--checkpoint", str(M3GN.folder)],
            "was trained on sheet_deformation",
        ),
        (["stability", "--checkpoint", "nowhere"], "no checkpoint in nowhere"),
        (["render-studies", "nowhere"], "no records in nowhere"),
    ],
)
def test_mistakes_are_explained(arguments: list[str], message: str) -> None:
    done = CliRunner().invoke(cli, arguments)
    assert message in str(done.exception)


# -- what is on record -------------------------------------------------------------------------------------

RECORDS = Path(__file__).parents[1] / "docs" / "studies"


def test_recorded_tradeoffs() -> None:
    """Every task has one, with the default fidelity on the front, against a reference that is converged."""
    found, _ = read_records(RECORDS)
    assert [study.task for study in found] == list(TASKS)
    for study in found:
        assert not study.default.refused
        assert study.default.error
        assert study.default.on_front, study.task
        assert study == study.with_front(), study.task  # its marks follow from its times and errors
        assert is_converged(study), study.task
        assert study.dataset_version == get_scene(study.scene).dataset_version, study.task


def test_recorded_stability() -> None:
    """At least 60 cells of the five scenes and 20 of models, and what is refused has all its reasons.

    None is wrong but of models that are given lengths which no training can have prepared them for.
    """
    _, found = read_records(RECORDS)
    scenes = {study.scene: study for study in found}
    assert set(scenes) == set(scene_names())
    simulated = [c for study in scenes.values() for c in study.cells if c.subject == "simulator"]
    predicted = [c for study in found for c in study.cells if c.subject != "simulator"]
    assert len(simulated) >= 60
    assert len(predicted) >= 20
    assert [cell for cell in simulated if cell.verdict == "wrong"] == []
    unprepared = {"a tenth of the size", "ten times the size"}
    assert {cell.cell for cell in predicted if cell.verdict == "wrong"} <= unprepared
    assert all(REASONED.fullmatch(cell.detail) for cell in simulated if cell.verdict == "refused")


def test_training_costs_the_same_wherever_a_preset_was_trained() -> None:
    """The pace of one machine counts, not the minutes of an accelerator; other settings have other paces."""
    shipped = read_description(M3GN.folder)
    for device, minutes in (("cpu", 9.0), ("cuda", 0.1)):
        elsewhere = shipped.model_copy(update={"device": device, "minutes": minutes})
        assert training_seconds(elsewhere) == pytest.approx(600, rel=1e-3)
        other = elsewhere.model_copy(update={"config_hash": "of other settings"})
        assert training_seconds(other) == (540 if device == "cpu" else None)


def test_what_training_cost_may_be_unknown() -> None:
    tradeoffs, _ = read_records(RECORDS)
    study = next(one for one in tradeoffs if one.task == TASK.name)
    model = study.models[0].model_copy(
        update={"training_seconds": None, "pays_off_after": None, "pays_off_with_data": None}
    )
    assert model.pays_off == "unknown"
    unknown = study.model_copy(update={"models": (model,)})
    assert "Nobody knows what its training cost" in advice(unknown)[-1]


def test_studies_are_of_the_models_that_ship() -> None:
    tradeoffs, stabilities = read_records(RECORDS)
    judged = [(s.task, cell.subject, cell.weights_sha256) for s in stabilities for cell in s.cells]
    timed = [(s.task, model.model, model.weights_sha256) for s in tradeoffs for model in s.models]
    judged = [one for one in judged if one[1] != "simulator"]
    assert judged
    assert timed
    for task, model, found in [*judged, *timed]:
        shipped = read_description(checkpoint_folder(task, model, "compact"))
        assert found == shipped.weights_sha256, (task, model)


def test_the_page_is_up_to_date() -> None:
    assert render(*read_records(RECORDS)) == (RECORDS.parent / "tradeoff.md").read_text()
