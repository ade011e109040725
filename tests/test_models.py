"""Every model: size, symmetries, no look into the future, batches, checkpoints."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from m3gn_bench.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from m3gn_bench.data import Body, Case, join
from m3gn_bench.errors import CheckpointError
from m3gn_bench.model import Model, build_model, load_preset, model_names
from m3gn_bench.tasks import TASKS, get_task

TASK = get_task("sheet_deformation")
LEARNED = ["m3gn", "mgn", "mgn_material"]
PAPER_COUNTS = {"m3gn": 2_546_206, "mgn": 1_259_779}


def make_case(seed: int, side: int = 4) -> Case:
    """A small sheet with smooth random motion; no simulator involved."""
    rng = np.random.default_rng(seed)
    ticks = np.linspace(-1, 1, side)
    rest = np.array([(x, y, 0.0) for y in ticks for x in ticks])
    time = np.linspace(0, 1, TASK.frames)[:, None, None] ** rng.uniform(0.3, 0.8)
    border = np.abs(rest).max(1) > 0.99
    motion = rng.normal(0, 0.1, rest.shape) * ~border[:, None]
    neighbours = [
        (a, b)
        for a in range(len(rest))
        for b in range(len(rest))
        if a != b and np.linalg.norm(rest[a] - rest[b]) < 3 / side
    ]
    edges = torch.tensor(sorted(neighbours, key=lambda pair: pair[::-1])).T.contiguous()
    features = np.stack([rng.normal(0, 0.3, len(rest)), border], -1)
    body = Body(
        rest_positions=torch.tensor(rest, dtype=torch.float32),
        edges=edges,
        static_features=torch.tensor(features, dtype=torch.float32),
        fixed=torch.tensor(border),
        material=torch.full((1, 1), float(rng.uniform(-1, 1))),
        collider_edges=torch.zeros(2, 0, dtype=torch.long),
        node_counts=(len(rest),),
        collider_counts=(0,),
    )
    positions = torch.tensor(rest + time * motion, dtype=torch.float32)
    return Case(body, positions, positions[:, :0], (f"test_{seed:05d}",))


def make_model(name: str) -> Model:
    model = build_model(load_preset(name, "smoke", TASK), TASK, seed=1)
    model.prepare([make_case(0), make_case(1)])
    return model.eval()


@pytest.fixture(params=model_names())
def model(request: pytest.FixtureRequest) -> Model:
    return make_model(request.param)


def predict(model: Model, case: Case, size: int = 5) -> torch.Tensor:
    with torch.inference_mode():
        return model.predict(case.context(size))


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
@pytest.mark.parametrize("name", PAPER_COUNTS)
def test_parameter_counts_are_the_papers(name: str, task: object) -> None:
    built = build_model(load_preset(name, "paper", task), task)  # type: ignore[arg-type]
    assert built.parameter_count() == PAPER_COUNTS[name]


@pytest.mark.parametrize("size", [2, 10, TASK.frames - 1])
def test_predicts_every_frame_after_the_anchor(model: Model, size: int) -> None:
    case = make_case(2)
    path = predict(model, case, size)
    assert path.shape == case.future(size).shape
    assert torch.isfinite(path).all()


def test_fixed_nodes_stay(model: Model) -> None:
    case = make_case(2)
    path = predict(model, case)
    assert torch.equal(
        path[:, case.body.fixed], case.positions[:1, case.body.fixed].expand(len(path), -1, -1)
    )


def test_future_frames_change_nothing(model: Model) -> None:
    """No leak: everything after the anchor is replaced by garbage."""
    case = make_case(2)
    spoiled = case.positions.clone()
    spoiled[5:] = torch.nan
    assert torch.equal(predict(model, case), predict(model, replace(case, positions=spoiled)))


@pytest.mark.parametrize("name", LEARNED)
def test_context_matters(name: str) -> None:
    """The counterpart of the leak test: what is in the context does change the prediction."""
    model, case = make_model(name), make_case(2)
    moved = case.positions.clone()
    moved[3:5, ~case.body.fixed] += 0.01
    assert not torch.equal(predict(model, case), predict(model, replace(case, positions=moved)))


def test_translation_equivariant(model: Model) -> None:
    case = make_case(3)
    shift = torch.tensor([0.5, -0.25, 1.0])
    body = replace(case.body, rest_positions=case.body.rest_positions + shift)
    moved = replace(case, body=body, positions=case.positions + shift)
    assert (predict(model, moved) - shift - predict(model, case)).abs().max() < 2e-5


def test_node_order_does_not_matter(model: Model) -> None:
    case = make_case(3)
    order = torch.from_numpy(np.random.default_rng(0).permutation(case.body.nodes))
    place = torch.argsort(order)
    body = Body(
        rest_positions=case.body.rest_positions[order],
        edges=place[case.body.edges],
        static_features=case.body.static_features[order],
        fixed=case.body.fixed[order],
        material=case.body.material,
        collider_edges=case.body.collider_edges,
        node_counts=case.body.node_counts,
        collider_counts=case.body.collider_counts,
    )
    shuffled = Case(body, case.positions[:, order], case.collider_path, case.keys)
    expected = predict(model, case)[:, order]
    if type(model).__name__ == "MeanTrajectory":
        model.mean = model.mean[:, order]  # it knows its nodes by number
    assert (predict(model, shuffled) - expected).abs().max() < 2e-5


def test_batch_equals_one_by_one(model: Model) -> None:
    """Bodies of different size where the model allows it."""
    second = make_case(5) if type(model).__name__ == "MeanTrajectory" else make_case(5, side=5)
    cases = [make_case(4), second]
    together = predict(model, join(cases))
    alone = torch.cat([predict(model, case) for case in cases], dim=1)
    assert (together - alone).abs().max() < 2e-5


@pytest.mark.parametrize("name", LEARNED)
def test_loss_is_differentiable_and_uses_only_the_given_randomness(name: str) -> None:
    model, batch = make_model(name), join([make_case(0), make_case(1)])
    losses = [model.training_loss(batch, np.random.default_rng(7)) for _ in range(2)]
    assert torch.equal(losses[0], losses[1])
    losses[0].backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert torch.isfinite(parameter.grad).all(), parameter_name


def test_random_context_pairs_are_a_subset_of_all() -> None:
    """The maximum over some pairs never exceeds the maximum over all of them."""
    model = make_model("m3gn")
    context = make_case(2).context(10)
    with torch.inference_mode():
        everything, some = (
            model.encoder.encode(context, pairs, model.velocity_scale).amax(0)
            for pairs in (torch.arange(9), torch.tensor([2, 5]))
        )
    assert (everything - some).min() > -1e-5
    assert (everything - some).max() > 1e-4


def test_material_reaches_only_models_that_may_see_it() -> None:
    case = make_case(2)
    other = replace(case, body=replace(case.body, material=case.body.material + 0.5))
    assert torch.equal(predict(make_model("mgn"), case), predict(make_model("mgn"), other))
    assert torch.equal(predict(make_model("m3gn"), case), predict(make_model("m3gn"), other))
    with_material = make_model("mgn_material")
    assert not torch.equal(predict(with_material, case), predict(with_material, other))


@pytest.mark.parametrize(
    ("name", "stored"), [("m3gn", 0.01272806), ("mgn", 0.01221187), ("mgn_material", 0.00515547)]
)
def test_regression(name: str, stored: float) -> None:
    """Output of a fixed seed on a fixed case; a change means that shipped checkpoints mean something else."""
    case = make_case(2)
    moved = predict(make_model(name), case) - case.positions[4]
    assert float(moved.double().square().mean().sqrt()) == pytest.approx(stored, rel=1e-4)


def describe(name: str) -> Checkpoint:
    config = load_preset(name, "smoke", TASK)
    return Checkpoint(
        task=TASK.name,
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


@pytest.mark.parametrize("name", model_names())
def test_checkpoint_round_trip_is_exact(name: str, tmp_path: Path) -> None:
    model, case = make_model(name), make_case(2)
    save_checkpoint(tmp_path, model.state_dict(), describe(name))
    loaded, description = load_checkpoint(tmp_path)
    assert description.config.model_name == name
    assert torch.equal(predict(loaded, case), predict(model, case))


def test_damaged_checkpoints_are_refused(tmp_path: Path) -> None:
    model = make_model("mgn")
    save_checkpoint(tmp_path, model.state_dict(), describe("mgn"))
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
