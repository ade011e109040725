"""What `benchmarks` compares computes the same, and what plans read of it is there."""

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pace
import pytest
import torch
from model_cases import make_case, training_cases
from primitives_fit import fit_error
from rigid_errors import PARTS, rigid_parts
from scipy.spatial.transform import Rotation
from step_errors import path
from toppling import level_paths, regression
from training_step import loss, pair_of_models, time_steps
from usual_m3gn import PlainM3GN

from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.leaderboard.pace import read_pace
from m3gn_bench.m3gn import M3GN
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.movement_primitives import ProDMP
from m3gn_bench.tasks import get_task

WITHOUT_AND_WITH_COLLIDER = ("sheet_deformation", "deformable_block")


def models(kind: str) -> tuple[M3GN, PlainM3GN]:
    return pair_of_models(get_task(kind), "smoke", training_cases(kind))


def relative_difference(found: list[torch.Tensor], expected: list[torch.Tensor]) -> float:
    largest = max(float(value.abs().max()) for value in expected)
    return max(float((a - b).abs().max()) for a, b in zip(found, expected, strict=True)) / largest


@pytest.mark.parametrize("context", [2, 5])
@pytest.mark.parametrize("kind", WITHOUT_AND_WITH_COLLIDER)
def test_usual_m3gn_is_the_same_function(kind: str, context: int) -> None:
    ours, usual = models(kind)
    case = make_case(kind, 3)
    with torch.inference_mode():
        expected = ours.predict(case.context(context))
        found = usual.predict(case.context(context))
    moved = expected - case.positions[context - 1]
    assert float((found - expected).abs().max()) < 1e-5 * float(moved.abs().max())


@pytest.mark.parametrize("context", [2, 5])
@pytest.mark.parametrize("kind", WITHOUT_AND_WITH_COLLIDER)
def test_usual_m3gn_has_the_same_gradients(kind: str, context: int) -> None:
    ours, usual = models(kind)
    case = make_case(kind, 3)
    losses = [loss(model, case, context) for model in (ours, usual)]
    for value in losses:
        value.backward()
    assert losses[1].item() == pytest.approx(losses[0].item(), rel=1e-5)
    expected = {name: weight.grad for name, weight in ours.named_parameters() if weight.grad is not None}
    found = usual.gradients()
    assert set(found) == set(expected)
    assert relative_difference([found[name] for name in expected], list(expected.values())) < 1e-5


def test_both_take_the_same_training_steps() -> None:
    """After three timed steps of each, the same prediction: what is timed is training, of both alike."""
    kind = "sheet_deformation"
    ours, usual = models(kind)
    case = make_case(kind, 3)
    before = ours.predict(case.context(5)).detach()
    seconds = time_steps({"ours": ours, "usual": usual}, case, 5, 1)
    after = [model.predict(case.context(5)).detach() for model in (ours, usual)]
    assert all(len(values) == 1 for clocks in seconds.values() for values in clocks.values())
    assert np.all(
        [value > 0 for clocks in seconds.values() for values in clocks.values() for value in values]
    )
    step = float((after[0] - before).abs().max())
    assert step > 0
    assert float((after[1] - after[0]).abs().max()) < 0.01 * step


@pytest.mark.parametrize("context", [2, 5])
def test_fitted_primitives_find_what_primitives_made(context: int) -> None:
    """But for float32's rounding; and of noise they leave the share that they have no parameters for."""
    case, tau, functions = make_case("falling_teddy", 3), 0.7, 8
    primitives = ProDMP(functions)
    steps, unit = case.frames - context, case.frames - 1
    responses = primitives.responses(torch.arange(1, steps + 1) / unit, torch.tensor([tau]))[0]
    anchor = case.positions[context - 1]
    velocity = (anchor - case.positions[context - 2]) * unit
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(*anchor.shape, functions + 1, generator=generator)
    made = anchor + primitives.movement(responses, weights, velocity)

    def error(future: torch.Tensor) -> float:
        positions = torch.cat([case.positions[:context], future])
        return fit_error(primitives, replace(case, positions=positions), context, tau)

    moved = float((made - anchor).square().mean())
    assert error(made) < 1e-10 * moved
    noise = 0.1 * torch.randn(made.shape, generator=generator)
    left = (steps - functions - 1) / steps * float(noise.square().mean())
    assert error(made + noise) == pytest.approx(left, rel=0.1)


@pytest.mark.parametrize("context", [2, 5])
@pytest.mark.parametrize("kind", WITHOUT_AND_WITH_COLLIDER)
def test_steps_from_a_models_own_state_are_its_rollout_and_from_the_true_one_are_single(
    kind: str, context: int
) -> None:
    task, case = get_task(kind), make_case(kind, 3)
    model = build_model(load_preset("mgn", "smoke", task), task, seed=1)
    with torch.inference_mode():
        rollout, single, true_positions, true_movements = (
            path(model, case, context, *true)
            for true in ((False, False), (True, True), (True, False), (False, True))
        )
        assert torch.equal(rollout, model.predict(case.context(context)))
        steps = [
            model.predict(case.context(seen))[0] - case.positions[seen - 1]
            for seen in range(context, case.frames)
        ]
    expected = case.positions[context - 1] + torch.stack(steps).cumsum(0)
    assert float((single - expected).abs().max()) < 1e-5
    made = (rollout, single, true_positions, true_movements)
    assert all(torch.equal(a[0], rollout[0]) for a in made)
    assert all(not torch.allclose(a[1], b[1]) for a, b in combinations(made, 2))


def test_rigid_errors_are_told_apart() -> None:
    """Shifted, turned about its middle or swollen: one part each; and the parts are the whole."""
    rng = np.random.default_rng(0)
    truth = rng.standard_normal((3, 20, 3))
    middle = truth.mean(1, keepdims=True)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5])
    wrong = {
        "level": truth + np.array([0.3, 0.4, 0.0]),
        "upright": truth + np.array([0.0, 0.0, 0.5]),
        "turn": middle + turn.apply((truth - middle).reshape(-1, 3)).reshape(truth.shape),
        "shape": middle + 1.1 * (truth - middle),
    }
    for part, predicted in wrong.items():
        found = rigid_parts(predicted, truth)
        assert found[part] == pytest.approx(np.square(predicted - truth).mean())
        assert all(found[other] == pytest.approx(0, abs=1e-12) for other in PARTS if other != part)
    anything = rng.standard_normal(truth.shape)
    assert sum(rigid_parts(anything, truth).values()) == pytest.approx(np.square(anything - truth).mean())


def test_regression_finds_a_smooth_function() -> None:
    inputs, asked = (np.linspace(0, 3, count)[:, None] for count in (30, 17))
    outputs, wanted = (np.stack([np.sin(x), np.cos(x)], axis=1) for x in (inputs, asked))
    assert np.allclose(regression(inputs, outputs, asked, 0.5, 1e-6), wanted, atol=1e-3)


def test_bodies_turned_about_the_vertical_go_the_same_way_in_their_own_axes() -> None:
    """Two drops that differ by such a turn, of a body without symmetry: the regression sees one."""
    scene, task = get_scene("falling_teddy"), get_task("falling_teddy")
    turn = Rotation.from_rotvec([0, 0, 1.1])
    drop = draw(scene, "test", 0, DATASET_SEED)
    turned = replace(drop, orientation=tuple((turn * Rotation.from_quat(drop.orientation)).as_quat()))
    drops = [scene.simulate(parameters, "default") for parameters in (drop, turned)]
    inputs, paths = level_paths(task, drops, 20)
    assert np.allclose(inputs[0], inputs[1], atol=1e-6)
    assert np.abs(paths[0]).max() > 0.1
    assert np.allclose(paths[0], paths[1], atol=1e-3)


def test_paces_are_measured_for_every_model(
    smoke_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a plan reads them."""
    monkeypatch.setattr(pace, "TURNS", 1)
    monkeypatch.setattr(pace, "SECONDS", 0.0)
    threads = torch.get_num_threads()
    models = {("smoke", "sheet_deformation"): ["m3gn", "mgn"]}
    found = pace.measure("smoke", "sheet_deformation", models, "smoke", smoke_file.parent)
    torch.set_num_threads(threads)
    path = tmp_path / "pace.jsonl"
    path.write_text(json.dumps({"preset": "smoke", "task": "sheet_deformation", **found}) + "\n")
    known = read_pace(path)
    for model in models["smoke", "sheet_deformation"]:
        assert known.steps("smoke", "sheet_deformation", model, 10) > 100
