"""Every model on every kind of task: size, symmetries, no look into the future, batches, checkpoints."""

import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from model_cases import (
    KINDS,
    OURS,
    OUTPUTS,
    build,
    make_case,
    make_model,
    permute,
    predict,
    reference,
    stored_numbers,
    training_cases,
    transform,
    usual_size,
)

from m3gn_bench.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from m3gn_bench.data import Case, join
from m3gn_bench.errors import CheckpointError, ConfigError
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.m3gn import M3GN, ContextConfig, ContextEncoder, TrajectorySimulator
from m3gn_bench.model import Model, build_model, get_model_class, load_preset, model_names
from m3gn_bench.tasks import TASKS, get_task

# How many frames, the anchor and those before it, a model reads; all others read the whole context.
FRAMES_READ = {
    "stand_still": 1,
    "constant_velocity": 2,
    "scaled_velocity": 2,
    "mean_trajectory": 1,
    "mgn": 3,
    "mgn_material": 3,
    "mgn_no_history": 1,
    "mgn_mp": 2,
    "egno": 2,
    "mango": 7,  # in the smoke preset: three frames per block, and the one before for a movement
}
TOLD_MATERIAL = {"mgn_material"}
OBSERVING_NOISE = {"m3gn_noise_5e-4", "m3gn_noise_1e-3", "m3gn_noise_1e-2"}  # it belongs to place and number
ROTATION_EQUIVARIANT = {"egno", "stand_still", "constant_velocity", "scaled_velocity"}
REMEMBERING = {"mean_trajectory", "nearest_neighbour"}  # compare with the training data node by node

LEARNED = [
    name
    for name in OURS
    if build_model(load_preset(name, "smoke", TASKS["mixed_objects"]), TASKS["mixed_objects"]).is_learned
]
every_kind = pytest.mark.parametrize("kind", KINDS)
every_model = pytest.mark.parametrize("name", model_names())
exact_model = pytest.mark.parametrize("name", [n for n in model_names() if n not in OBSERVING_NOISE])
learned_model = pytest.mark.parametrize("name", LEARNED)
CLOSE = 2e-5


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """More threads only make such small networks slower."""
    torch.set_num_threads(1)


@every_kind
@every_model
def test_predicts_every_frame_after_the_anchor(name: str, kind: str) -> None:
    """From the smallest context of the task to the largest possible."""
    task, case = get_task(kind), make_case(kind, 3)
    for size in (min(task.context_sizes), task.frames - 1):
        path = predict(make_model(name, kind), case, size)
        assert path.shape == case.future(size).shape
        assert path.dtype == torch.float32
        assert torch.isfinite(path).all()


@pytest.mark.parametrize("kind", KINDS[:3])
@every_model
def test_fixed_nodes_stay(name: str, kind: str) -> None:
    fixed, path = make_case(kind, 3).body.fixed, reference(name, kind)
    assert fixed.any()
    assert torch.equal(path[:, fixed], make_case(kind, 3).positions[:1, fixed].expand(len(path), -1, -1))


@every_kind
@every_model
def test_future_frames_change_nothing(name: str, kind: str) -> None:
    """No leak: everything of the mesh after the anchor is replaced by garbage."""
    case, size = make_case(kind, 3), usual_size(kind)
    spoiled = case.positions.clone()
    spoiled[size:] = torch.nan
    found = predict(make_model(name, kind), replace(case, positions=spoiled), size)
    assert torch.equal(found, reference(name, kind))


@every_kind
@every_model
def test_reads_the_frames_that_it_should(name: str, kind: str) -> None:
    """The counterpart of the leak test: the oldest frame that a model is known to read matters, none before."""
    case, size = make_case(kind, 3), usual_size(kind)
    oldest = size - FRAMES_READ.get(name, size)

    def paths(begin: int, end: int) -> list[torch.Tensor]:
        """Predictions with these frames replaced by the last frame of either of two other trajectories."""
        found = []
        for other in training_cases(kind)[:2]:
            replaced = case.positions.clone()
            moved = other.positions[-1] - other.body.rest_positions
            replaced[begin:end] = case.body.rest_positions + moved * ~case.body.fixed[:, None]
            found.append(predict(make_model(name, kind), replace(case, positions=replaced), size))
        return found

    # A neighbour is nearest, and noise is drowned out, only if the context as a whole is another.
    whole = name == "nearest_neighbour" or name in OBSERVING_NOISE
    assert not torch.equal(*paths(oldest, size - 1 if whole else oldest + 1))
    assert torch.equal(*paths(0, oldest))


@every_kind
@exact_model
def test_translation_equivariant(name: str, kind: str) -> None:
    """Wherever the whole scene is; where the ground is at z = 0, in the other directions.

    What a model remembers of the training data moves along.
    """
    case, size = make_case(kind, 3), usual_size(kind)
    shift = torch.tensor([0.5, -0.25, 1.0])[: case.positions.shape[-1]]
    if get_task(kind).height_feature:
        shift[-1] = 0
    matrix = torch.eye(len(shift))
    training = [transform(c, matrix, shift) for c in training_cases(kind)]
    model = build(name, kind, training) if name in REMEMBERING else make_model(name, kind)
    moved = predict(model, transform(case, matrix, shift), size)
    assert (moved - shift - reference(name, kind)).abs().max() < CLOSE


def rotation_error(name: str, kind: str) -> float:
    """By how much the prediction for a rotated scene differs from the rotated prediction."""
    case, rng = make_case(kind, 3), np.random.default_rng(4)
    matrix = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if case.positions.shape[-1] == 2 or get_task(kind).height_feature:  # in the plane, or about the vertical
        matrix = np.eye(3)
        matrix[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    turn = torch.tensor(matrix * np.sign(np.linalg.det(matrix)), dtype=torch.float32)
    turn = turn[: case.positions.shape[-1], : case.positions.shape[-1]]
    rotated = transform(case, turn, torch.zeros(len(turn)))
    found = predict(make_model(name, kind), rotated, usual_size(kind))
    return float((found - reference(name, kind) @ turn.T).abs().max())


@every_kind
@pytest.mark.parametrize("name", sorted(ROTATION_EQUIVARIANT))
def test_rotation_equivariant(name: str, kind: str) -> None:
    """Whichever way the whole scene is turned; where there is a ground, about the vertical."""
    assert rotation_error(name, kind) < CLOSE


@every_kind
def test_rotation_matters_to_models_that_read_vectors(kind: str) -> None:
    """The counterpart: the check does tell models apart."""
    assert rotation_error("m3gn", kind) > 10 * CLOSE


@learned_model
def test_height_above_the_ground_matters(name: str) -> None:
    """Without that a falling body could not know when it lands."""
    kind, shift = "falling_teddy", torch.tensor([0.0, 0.0, 0.5])
    raised = transform(make_case(kind, 3), torch.eye(3), shift)
    moved = predict(make_model(name, kind), raised, usual_size(kind))
    assert (moved - shift - reference(name, kind)).abs().max() > CLOSE


@every_kind
@exact_model
def test_node_order_does_not_matter(name: str, kind: str) -> None:
    """Neither of the mesh nor of the collider; what a model remembers is renumbered along."""
    case, size = make_case(kind, 3), usual_size(kind)
    rng = np.random.default_rng(0)
    order = torch.from_numpy(rng.permutation(case.body.nodes))
    collider_order = torch.from_numpy(rng.permutation(case.body.collider_nodes))
    training = [permute(c, order, collider_order) for c in training_cases(kind)[:3]]
    model = build(name, kind, training) if name in REMEMBERING else make_model(name, kind)
    found = predict(model, permute(case, order, collider_order), size)
    assert (found - reference(name, kind)[:, order]).abs().max() < CLOSE


@every_kind
@every_model
def test_batch_equals_one_by_one(name: str, kind: str) -> None:
    """Bodies and colliders of different size."""
    cases = [make_case(kind, 3), make_case(kind, 4, size=5), make_case(kind, 5)]
    model, size = make_model(name, kind), usual_size(kind)
    together = predict(model, join(cases), size)
    alone = torch.cat([predict(model, case, size) for case in cases], dim=1)
    assert (together - alone).abs().max() < CLOSE


@every_kind
@every_model
def test_material_reaches_only_models_that_may_see_it(name: str, kind: str) -> None:
    case = make_case(kind, 3)
    other = replace(case, body=replace(case.body, material=case.body.material + 0.5))
    found = predict(make_model(name, kind), other, usual_size(kind))
    assert torch.equal(found, reference(name, kind)) == (name not in TOLD_MATERIAL)


@every_kind
@every_model
def test_a_context_does_not_lead_to_later_frames(name: str, kind: str) -> None:
    """Nor does a prediction spoil a case for training."""
    made, model = make_case(kind, 3), build(name, kind, training_cases(kind))
    case = replace(made, body=replace(made.body))  # which nobody else has used
    seen = case.context(3).positions
    assert seen.untyped_storage().nbytes() == seen.nbytes
    evaluate_model(model, [case], [5])
    if model.is_learned:
        model.training_loss(case, np.random.default_rng(0)).backward()


@learned_model
def test_data_that_never_move_are_refused(name: str) -> None:
    kind = "deformable_block"
    case = make_case(kind, 3)
    resting = replace(case, positions=case.positions[:1].expand(case.frames, -1, -1))
    with pytest.raises(ConfigError, match="no free node of the training trajectories moves"):
        build(name, kind, [resting])


def training_batch(kind: str) -> Case:
    """Two trajectories of different size."""
    return join([make_case(kind, 0), make_case(kind, 1, size=5)])


@every_kind
@learned_model
def test_loss_is_differentiable_and_uses_only_the_given_randomness(name: str, kind: str) -> None:
    model, batch = build(name, kind, training_cases(kind)).train(), training_batch(kind)
    losses = []
    for seed, other in ((7, 1), (7, 2), (8, 2)):
        torch.manual_seed(other)
        np.random.seed(other)  # noqa: NPY002
        losses.append(model.training_loss(batch, np.random.default_rng(seed)))
    assert torch.equal(losses[0], losses[1])
    assert not torch.equal(losses[0], losses[2])
    losses[0].backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert torch.isfinite(parameter.grad).all(), parameter_name


@every_kind
@every_model
def test_prediction_uses_no_randomness(name: str, kind: str) -> None:
    torch.manual_seed(5)
    state = torch.get_rng_state()
    found = predict(make_model(name, kind), make_case(kind, 3), usual_size(kind))
    assert torch.equal(found, reference(name, kind))
    assert torch.equal(torch.get_rng_state(), state)


WITH_PRIMITIVES = [
    name
    for name in LEARNED
    if any(isinstance(m, TrajectorySimulator) for m in make_model(name, "sheet_deformation").modules())
]


@every_kind
@pytest.mark.parametrize("name", WITH_PRIMITIVES)
@pytest.mark.parametrize("logit", [-50.0, 50.0])
def test_gradients_are_finite_at_the_limits_of_tau(name: str, kind: str, logit: float) -> None:
    model = build(name, kind, training_cases(kind)).train()
    for module in model.modules():
        if isinstance(module, TrajectorySimulator):
            with torch.no_grad():
                module.network.readout.bias[0] = logit
    loss = model.training_loss(training_batch(kind), np.random.default_rng(7))
    loss.backward()
    assert torch.isfinite(loss)
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert torch.isfinite(parameter.grad).all(), parameter_name


def test_descriptions_are_the_maximum_over_pairs_that_are_read_one_by_one() -> None:
    model = make_model("m3gn", "sheet_deformation")
    assert isinstance(model, M3GN)
    case = make_case("sheet_deformation", 2)
    encoder, context, scale = model.encoder, case.context(10), model.velocity_scale
    with torch.inference_mode():
        everything, some = (
            encoder.encode(context, pairs, scale) for pairs in (torch.arange(9), torch.tensor([2, 5]))
        )
        assert (everything[[2, 5]] - some).abs().max() < CLOSE
        assert (everything[2] - everything[5]).abs().max() > 1e-4
        told = encoder.aggregate(everything, torch.arange(9), case.body, None)
    assert torch.equal(told, everything.max(0).values)


def test_training_reads_one_to_so_many_pairs() -> None:
    """The last one always, the others and their number at random; prediction reads all."""
    config = ContextConfig(width=8, message_passing_steps=1, latent_size=4, max_training_context_pairs=3)
    encoder = ContextEncoder(get_task("sheet_deformation"), config)
    rng, draws = np.random.default_rng(0), 600
    chosen = [tuple(encoder.choose_pairs(10, rng).tolist()) for _ in range(draws)]
    assert all(pairs[-1] == 8 and list(pairs) == sorted(set(pairs)) for pairs in chosen)
    for number in (1, 2, 3):
        assert sum(len(pairs) == number for pairs in chosen) == pytest.approx(draws / 3, abs=50)
    assert {pairs[0] for pairs in chosen} == set(range(9))
    assert encoder.choose_pairs(10, None).tolist() == list(range(9))
    assert encoder.choose_pairs(2, rng).tolist() == [0]


@every_kind
@pytest.mark.parametrize("name", OURS)
def test_outputs_are_the_stored_ones(name: str, kind: str) -> None:
    """Fixed seed, fixed case. A change means that shipped checkpoints mean something else.

    If that is intended, `python tests/model_cases.py` writes the stored outputs anew.
    """
    stored = json.loads(OUTPUTS.read_text())[kind]
    assert stored_numbers(name, kind) == pytest.approx(stored[name], rel=1e-4, abs=1e-6)


def test_only_existing_models_have_stored_outputs() -> None:
    for kind, stored in json.loads(OUTPUTS.read_text()).items():
        assert sorted(stored) == OURS, kind


def describe(name: str, kind: str) -> Checkpoint:
    config = load_preset(name, "smoke", get_task(kind))
    return Checkpoint(
        task=kind,
        seed=1,
        config=config.to_json(),
        config_hash=config.hash(),
        steps=0,
        best_step=0,
        minutes=0.0,
        validation_error=None,
        dataset_hash="",
        device="cpu",
        threads=1,
        package_version="test",
    )


@every_kind
@every_model
def test_checkpoint_round_trip_is_exact(name: str, kind: str, tmp_path: Path) -> None:
    model, case = make_model(name, kind), make_case(kind, 3)
    save_checkpoint(tmp_path, model.state_dict(), describe(name, kind))
    loaded, description = load_checkpoint(tmp_path)
    assert description.config.model_name == name
    assert type(loaded) is get_model_class(name)
    assert torch.equal(predict(loaded, case, usual_size(kind)), reference(name, kind))


def test_damaged_checkpoints_are_refused(tmp_path: Path) -> None:
    model: Model = make_model("mgn", "sheet_deformation")
    save_checkpoint(tmp_path, model.state_dict(), describe("mgn", "sheet_deformation"))
    weights = tmp_path / "weights.safetensors"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CheckpointError, match="SHA-256"):
        load_checkpoint(tmp_path)
    (tmp_path / "checkpoint.json").write_text("{")
    with pytest.raises(CheckpointError, match="damaged"):
        load_checkpoint(tmp_path)
    with pytest.raises(CheckpointError, match="no checkpoint"):
        load_checkpoint(tmp_path / "nowhere")


@exact_model
def test_predicts_in_double_precision(name: str) -> None:
    """What single precision says, more precisely; the studies of stability ask for it."""
    kind = "deformable_block"
    case = make_case(kind, 3)
    single = build(name, kind, [case])
    precise = copy.deepcopy(single).double()
    found = predict(precise, case.to(torch.float64), 8)
    assert found.dtype == torch.float64
    torch.testing.assert_close(found.float(), predict(single, case, 8), atol=1e-3, rtol=1e-3)
