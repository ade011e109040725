"""Ablations do what their names say, and trivial baselines agree with a calculation by hand."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from model_cases import KINDS, build, make_case, predict
from torch import Tensor

from m3gn_bench.baselines.ablations import (
    BayesianEncoder,
    M3GNOnScaledVelocity,
    M3GNStep,
    NodeMaximumEncoder,
    NodeMaximumTransformerEncoder,
    TransformerEncoder,
    bayesian_aggregation,
    pair_weights,
)
from m3gn_bench.baselines.mgn import StepSimulator
from m3gn_bench.baselines.trivial import NearestNeighbour, NeighbourConfig, mesh_fingerprints
from m3gn_bench.data import Case, join
from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.m3gn import M3GN, ContextConfig, ContextEncoder
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.tasks import get_task

# One kind without a collider, one with.
every_kind = pytest.mark.parametrize("kind", ["sheet_deformation", "deformable_block"])


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """More threads only make such small networks slower."""
    torch.set_num_threads(1)


# Named variants


@pytest.mark.parametrize(
    ("name", "parent", "key", "value"),
    [
        ("m3gn_history", "m3gn", "history", True),
        ("m3gn_no_history", "m3gn", "history", False),
        ("mgn_no_history", "mgn", "history", 0),
        ("m3gn_noise_5e-4", "m3gn", "context_noise", 5e-4),
        ("m3gn_noise_1e-3", "m3gn", "context_noise", 1e-3),
        ("m3gn_noise_1e-2", "m3gn", "context_noise", 1e-2),
    ],
)
@pytest.mark.parametrize("preset", ["smoke", "compact", "paper"])
def test_a_variant_differs_from_its_parent_in_one_value(
    name: str, parent: str, key: str, value: Any, preset: str
) -> None:
    """It shares the parent's preset, and what the user says has the last word."""
    task = get_task("deformable_block")
    config, original = load_preset(name, preset, task), load_preset(parent, preset, task)
    assert getattr(original.model, key) != value
    assert config.model.model_dump() == original.model.model_dump() | {key: value}
    assert config.training == original.training
    other = getattr(original.model, key)
    assert load_preset(name, preset, task, {f"model.{key}": other}).model == original.model


def paper_count(name: str, kind: str) -> int:
    task = get_task(kind)
    with torch.device("meta"):
        return build_model(load_preset(name, "paper", task), task).parameter_count()


@every_kind
def test_parameter_counts_follow_from_the_parts(kind: str) -> None:
    """Those of the paper's table, and by hand what an ablation adds to them."""
    m3gn, mgn, mgn_mp = (paper_count(name, kind) for name in ("m3gn", "mgn", "mgn_mp"))
    latent, width, size = 64, 128, 32
    encoder = m3gn - mgn_mp - latent * width
    attention, hidden, norms = 4 * (size * size + size), 2 * 4 * size * size + 5 * size, 2 * 2 * size
    transformer = 4 * (attention + hidden + norms) + 2 * size + size + 2 * latent * size + size + latent
    history = width * get_task(kind).dimension
    assert paper_count("m3gn_node_max", kind) == m3gn
    assert paper_count("m3gn_transformer", kind) == m3gn + transformer
    assert paper_count("m3gn_node_max_transformer", kind) == m3gn + transformer
    assert paper_count("np_mp", kind) == m3gn + (width + 1) * latent
    assert paper_count("m3gn_step", kind) == encoder + mgn + latent * width
    assert paper_count("np_step", kind) == encoder + (width + 1) * latent + mgn + latent * width
    assert paper_count("m3gn_history", kind) - paper_count("m3gn_no_history", kind) == history
    assert paper_count("mgn_no_history", kind) == mgn - 2 * history


# Aggregation of the context

PAIRS = 6


def encoder_of(kind: type[ContextEncoder], task_name: str, **settings: Any) -> ContextEncoder:
    torch.manual_seed(0)
    config = ContextConfig(width=16, message_passing_steps=1, latent_size=8, **settings)
    return kind(get_task(task_name), config).eval()


def batch_of(kind: str) -> Case:
    return join([make_case(kind, 0), make_case(kind, 1, size=5)])


def random_latents(case: Case, encoder: ContextEncoder) -> Tensor:
    nodes = case.body.nodes + case.body.collider_nodes
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.normal(size=(PAIRS, nodes, 8 * encoder.outputs_per_latent))).float()


def aggregate(encoder: ContextEncoder, case: Case, latents: Tensor, pairs: Tensor) -> Tensor:
    with torch.inference_mode():
        return encoder.aggregate(latents, pairs, case.body, None)


def body_of_all_nodes(case: Case) -> Tensor:
    return torch.cat([case.body.body_of_node, case.body.body_of_collider_node])


@every_kind
def test_node_maximum_is_that_of_each_trajectory(kind: str) -> None:
    case, encoder = batch_of(kind), encoder_of(NodeMaximumEncoder, kind)
    latents = random_latents(case, encoder)
    found = aggregate(encoder, case, latents, torch.arange(PAIRS)).numpy()
    owner = body_of_all_nodes(case).numpy()
    by_hand = [latents.numpy()[:, owner == body].max((0, 1)) for body in (0, 1)]
    assert not np.array_equal(*by_hand)
    np.testing.assert_array_equal(found, np.stack(by_hand)[owner])


@every_kind
@pytest.mark.parametrize(
    ("encoder_class", "shared"),
    [
        (ContextEncoder, False),
        (TransformerEncoder, False),
        (BayesianEncoder, False),
        (NodeMaximumEncoder, True),
        (NodeMaximumTransformerEncoder, True),
    ],
)
def test_whose_description_a_node_reaches(
    kind: str, encoder_class: type[ContextEncoder], shared: bool
) -> None:
    """What one node's latent vectors change: the node's description, or that of its whole trajectory."""
    case, encoder = batch_of(kind), encoder_of(encoder_class, kind)
    owner, latents, pairs = body_of_all_nodes(case), random_latents(case, encoder), torch.arange(PAIRS)
    before = aggregate(encoder, case, latents, pairs)
    same = torch.stack([(before[owner == body] == before[owner == body][0]).all() for body in (0, 1)])
    assert same.tolist() == [shared] * 2
    chosen = case.body.node_counts[0]  # the first node of the second body
    latents[:, chosen] += 5
    changed = (aggregate(encoder, case, latents, pairs) - before).abs().amax(1) > 1e-5
    reached = owner == 1 if shared else torch.arange(len(owner)) == chosen
    assert torch.equal(changed, reached)


@every_kind
@pytest.mark.parametrize(
    ("encoder_class", "ordered"),
    [
        (ContextEncoder, False),
        (NodeMaximumEncoder, False),
        (BayesianEncoder, False),
        (TransformerEncoder, True),
        (NodeMaximumTransformerEncoder, True),
    ],
)
def test_only_transformers_know_the_order_of_frames(
    kind: str, encoder_class: type[ContextEncoder], ordered: bool
) -> None:
    case, encoder = batch_of(kind), encoder_of(encoder_class, kind)
    latents, pairs = random_latents(case, encoder), torch.arange(PAIRS)
    order = torch.tensor([3, 0, 4, 1, 2, 5])
    before = aggregate(encoder, case, latents, pairs)
    shuffled = aggregate(encoder, case, latents[order], pairs)
    with_times = aggregate(encoder, case, latents[order], order)
    assert bool((shuffled - before).abs().max() > 1e-2) == ordered
    assert (with_times - before).abs().max() < 1e-5


# Neural processes


def product_of_gaussians(
    observations: Sequence[float], variances: Sequence[float], weights: Sequence[float]
) -> tuple[float, float]:
    """Mean and variance of N(z; 0, 1) prod_k N(r_k; z, variance_k)^w_k, by summation over a fine grid."""
    z = np.linspace(-12, 12, 400_001)
    log_density = -(z**2) / 2
    for r, variance, weight in zip(observations, variances, weights, strict=True):
        log_density -= weight * (r - z) ** 2 / (2 * variance)
    density = np.exp(log_density - log_density.max())
    density /= density.sum()
    mean = (density * z).sum()
    return mean, (density * (z - mean) ** 2).sum()


@pytest.mark.parametrize(
    ("observations", "variances", "weights"),
    [
        ([0.7], [1.0], [1.0]),
        ([1.5, -0.5, 0.2], [0.3, 2.0, 0.05], [1.0, 1.0, 1.0]),
        ([2.0, -1.0], [0.5, 0.1], [4.0, 1.0]),
    ],
)
def test_bayesian_aggregation_is_the_product_of_gaussians(
    observations: list[float], variances: list[float], weights: list[float]
) -> None:
    columns = (torch.tensor(values)[:, None] for values in (observations, variances))
    mean, variance = bayesian_aggregation(*columns, torch.tensor(weights))
    expected = product_of_gaussians(observations, variances, weights)
    assert (float(mean), float(variance)) == pytest.approx(expected, rel=1e-5)


def test_limits_of_bayesian_aggregation() -> None:
    """Nothing known leaves the prior; an exact observation among vague ones is the answer."""
    observations = torch.tensor([[3.0], [-2.0]])
    vague = bayesian_aggregation(observations, torch.full((2, 1), 1e12), torch.ones(2))
    assert [float(value) for value in vague] == pytest.approx([0.0, 1.0], abs=1e-9)
    exact = bayesian_aggregation(observations, torch.tensor([[1e-12], [1.0]]), torch.ones(2))
    assert [float(value) for value in exact] == pytest.approx([3.0, 0.0], abs=1e-6)


@pytest.mark.parametrize(("size", "read"), [(12, 4), (12, 2), (3, 4), (2, 2)])
def test_weights_of_random_pairs_estimate_the_sum_over_all(size: int, read: int) -> None:
    """In the mean over draws every pair counts once, the last one always."""
    encoder = encoder_of(BayesianEncoder, "sheet_deformation", max_training_context_pairs=read)
    rng, draws = np.random.default_rng(0), 2000
    counts = np.zeros(size - 1)
    for _ in range(draws):
        pairs = encoder.choose_pairs(size, rng)
        weights = pair_weights(pairs).numpy()
        assert weights.sum() == pytest.approx(size - 1)
        counts[pairs.numpy()] += weights / draws
    spread = np.sqrt(max(0, (size - 2) / (read - 1) - 1) / draws)  # of an indicator, over its probability
    assert np.abs(counts - 1).max() <= 4 * spread + 1e-4
    assert counts[-1] == pytest.approx(1)


def test_weights_when_all_pairs_or_only_the_last_are_read() -> None:
    assert pair_weights(torch.arange(9)).tolist() == [1.0] * 9
    assert pair_weights(torch.tensor([8])).tolist() == [9.0]


@every_kind
def test_samples_have_the_posteriors_moments(kind: str) -> None:
    """Training draws from the distribution whose mean prediction takes; all randomness is the generator's."""
    case, encoder = make_case(kind, 0), encoder_of(BayesianEncoder, kind)
    latents, pairs = random_latents(case, encoder), torch.arange(PAIRS)
    rng = np.random.default_rng(0)
    samples = torch.stack([encoder.aggregate(latents, pairs, case.body, rng) for _ in range(2000)]).numpy()
    r, s = np.split(latents.numpy().astype(np.float64), 2, axis=-1)
    precision = 1 / (np.log1p(np.exp(s)) + 1e-4)
    variance = 1 / (1 + precision.sum(0))
    mean = variance * (precision * r).sum(0)
    np.testing.assert_allclose(aggregate(encoder, case, latents, pairs).numpy(), mean, atol=1e-5)
    assert np.abs((samples.mean(0) - mean) / np.sqrt(variance / 2000)).max() < 5
    assert np.abs(samples.var(0) / variance - 1).max() < 5 * np.sqrt(2 / 2000)
    again = encoder.aggregate(latents, pairs, case.body, np.random.default_rng(0)).numpy()
    np.testing.assert_array_equal(again, samples[0])


# Noisy observations

SIGMA = 0.01


@every_kind
def test_noise_is_the_same_whenever_a_body_is_seen(kind: str) -> None:
    """Alone or in a batch, in training or prediction; a longer context shows more of the same recording."""
    encoder = encoder_of(ContextEncoder, kind, context_noise=SIGMA)
    first, second = make_case(kind, 0), make_case(kind, 1, size=5)
    scale = torch.tensor(0.1)

    def describe(case: Case, size: int = 8) -> Tensor:
        with torch.inference_mode():
            return encoder(case.context(size), scale, None)[: case.body.nodes]

    with torch.inference_mode():
        in_training = encoder(first.context(8), scale, np.random.default_rng(3))[: first.body.nodes]
    assert torch.equal(describe(first), describe(first))
    assert torch.equal(describe(first), in_training)
    together = describe(join([first, second]))
    alone = torch.cat([describe(first), describe(second)])
    assert (together - alone).abs().max() < 1e-5
    shorter, longer = (encoder._observed(first.context(size)) - first.positions[:size] for size in (7, 8))
    assert torch.equal(shorter, longer[:7])
    others = encoder._observed(second.context(7)) - second.positions[:7]
    common = min(first.body.nodes, second.body.nodes)
    assert not torch.equal(shorter[:, :common], others[:, :common])


@every_kind
def test_noise_has_the_named_size(kind: str) -> None:
    encoder = encoder_of(ContextEncoder, kind, context_noise=SIGMA)
    cases = [make_case(kind, seed) for seed in range(4)]
    fixed = cases[0].body.fixed
    noise = torch.stack([encoder._observed(c.context(15)) - c.positions[:15] for c in cases])
    free = noise[:, :, ~fixed].double()
    assert (noise[:, :, fixed] == 0).all()
    assert abs(float(free.mean())) < 5 * SIGMA / free.numel() ** 0.5
    assert float(free.std()) == pytest.approx(SIGMA, rel=5 / (2 * free.numel()) ** 0.5)


class NoDescription(ContextEncoder):
    """Reads the context and keeps quiet about it."""

    def aggregate(self, latents: Tensor, *others: object) -> Tensor:
        return torch.zeros_like(latents[0])


class M3GNWithoutDescription(M3GN):
    """M3GN whose simulator depends on nothing but what it reads itself."""

    encoder_class = NoDescription


@every_kind
def test_the_anchor_is_exact_under_noise(kind: str) -> None:
    """Noise reaches a prediction through the task description only."""
    task, case = get_task(kind), make_case(kind, 3)
    clean, noisy = load_preset("m3gn", "smoke", task), load_preset("m3gn_noise_1e-2", "smoke", task)
    paths = {}
    for model_class in (M3GN, M3GNWithoutDescription):
        for config in (clean, noisy):
            torch.manual_seed(1)
            paths[model_class, config.model_name] = predict(model_class(task, config.model), case, 8)
    assert not torch.equal(paths[M3GN, "m3gn"], paths[M3GN, "m3gn_noise_1e-2"])
    without = [paths[M3GNWithoutDescription, config.model_name] for config in (clean, noisy)]
    assert torch.equal(*without)


# Steps with a description


@every_kind
@pytest.mark.parametrize("name", ["m3gn_step", "np_step"])
def test_steps_know_more_of_the_context_than_the_last_movements(name: str, kind: str) -> None:
    """MeshGraphNets read the anchor and the two frames before it; frames before those change only z."""
    case = make_case(kind, 3)
    other = case.positions.clone()
    other[1:5, ~case.body.fixed] += 0.01
    changed = replace(case, positions=other)
    training = [make_case(kind, seed) for seed in range(2)]
    with_context, without = build(name, kind, training), build("mgn", kind, training)
    assert torch.equal(predict(without, case, 8), predict(without, changed, 8))
    difference = predict(with_context, case, 8) - predict(with_context, changed, 8)
    assert difference[:, ~case.body.fixed].abs().max() > 1e-5


@every_kind
def test_steps_are_trained_from_the_anchor_on(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random moments of each body, from the anchor to the last but one frame, and with the context's z."""
    task, batch = get_task(kind), batch_of(kind)
    config = load_preset("m3gn_step", "smoke", task, {"model.moments_per_step": 50})
    model = build_model(config, task)
    assert isinstance(model, M3GNStep)
    sizes, drawn = [], []

    def loss(
        self: StepSimulator, case: Case, moments: Tensor, scale: Tensor, rng: object, extra: Tensor
    ) -> Tensor:
        drawn.append(moments)
        assert extra.shape == (case.body.nodes + case.body.collider_nodes, config.model.latent_size)  # type: ignore[attr-defined]
        return extra.sum()

    cut = Case.context
    monkeypatch.setattr(Case, "context", lambda self, size: sizes.append(size) or cut(self, size))
    monkeypatch.setattr(StepSimulator, "loss", loss)
    for seed in range(20):
        model.training_loss(batch, np.random.default_rng(seed))
    assert len(set(sizes)) > 5
    for size, moments in zip(sizes, drawn, strict=True):
        assert moments.shape == (50, 2)
        assert moments.min() >= size - 1
        assert moments.max() <= task.frames - 2
        assert not torch.equal(moments[:, 0], moments[:, 1])
    assert min(int(moments.min()) - size for size, moments in zip(sizes, drawn, strict=True)) == -1


# Trivial baselines


every_task = pytest.mark.parametrize("kind", KINDS)
several_meshes = [(seed, 4 + seed % 2) for seed in range(6)]


@every_task
def test_scaled_velocity_is_a_fit_by_least_squares(kind: str) -> None:
    """Against numpy's, on the coordinates of all trajectories."""
    cases = [make_case(kind, seed, size=4) for seed in range(5)]
    new = make_case(kind, 7, size=5)
    model = build("scaled_velocity", kind, cases)
    for size in (2, 8):
        paths = np.concatenate([case.positions.double().flatten(1).numpy() for case in cases], axis=1)
        velocity, moved = paths[size - 1] - paths[size - 2], paths[size:] - paths[size - 1]
        factors = np.linalg.lstsq(velocity[:, None], moved.T, rcond=None)[0][0]
        anchor, before = new.positions[size - 1].numpy(), new.positions[size - 2].numpy()
        expected = anchor + factors[:, None, None] * (anchor - before)
        np.testing.assert_allclose(predict(model, new, size).numpy(), expected, atol=1e-5)


@every_kind
def test_what_starts_from_scaled_velocity_predicts_what_it_leaves(kind: str) -> None:
    """All of it, from the first frame on: with nothing learned, the primitives add no movement of their own."""
    cases = [make_case(kind, seed) for seed in range(3)]
    model = build("m3gn_scaled_velocity", kind, cases)
    assert isinstance(model, M3GNOnScaledVelocity)
    with torch.no_grad():
        model.simulator.network.readout.weight.zero_()
        model.simulator.network.readout.bias[1:] = 0
    alone = predict(build("scaled_velocity", kind, cases), cases[0], 5)
    assert torch.allclose(predict(model, cases[0], 5), alone, atol=1e-6)


def test_scaled_velocity_is_exact_where_all_follow_one_law_and_stands_still_where_all_rest() -> None:
    kind = "sheet_deformation"
    times = torch.linspace(0, 1, get_task(kind).frames, dtype=torch.float64)[:, None, None]
    cases = []
    for seed in range(3):
        case = make_case(kind, seed)
        direction = case.positions[-1] - case.positions[0]
        cases.append(replace(case, positions=(case.positions[0] + times.sqrt() * direction).float()))
    model = build("scaled_velocity", kind, cases[:2])
    torch.testing.assert_close(predict(model, cases[2], 5), cases[2].future(5), atol=1e-5, rtol=0)
    resting = [replace(case, positions=case.positions[:1].expand_as(case.positions)) for case in cases]
    assert torch.equal(
        predict(build("scaled_velocity", kind, resting), cases[2], 5)[-1], cases[2].positions[4]
    )


@every_task
def test_mean_trajectory_is_the_mean_on_the_same_mesh(kind: str) -> None:
    cases = [make_case(kind, seed, size=size) for seed, size in several_meshes]
    new = [make_case(kind, 7, size=5), make_case(kind, 8)]
    found = predict(build("mean_trajectory", kind, cases), join(new), 8).split(
        [case.body.nodes for case in new], dim=1
    )
    for case, path, training in zip(new, found, (cases[1::2], cases[::2]), strict=True):
        positions = np.mean([other.positions.double().numpy() for other in training], axis=0)
        expected = case.positions[7].numpy() + positions[8:] - positions[7]
        expected[:, case.body.fixed.numpy()] = case.positions[7, case.body.fixed].numpy()
        np.testing.assert_allclose(path.numpy(), expected, atol=1e-6)


@every_task
def test_nearest_neighbour_continues_an_identical_trajectory_exactly(kind: str) -> None:
    cases = [make_case(kind, seed, size=size) for seed, size in several_meshes]
    model = build("nearest_neighbour", kind, cases)
    for case in (join(cases[3:5]), *cases):
        assert torch.equal(predict(model, case, 8), case.future(8))


@every_task
def test_nearest_neighbour_is_the_closest_over_the_context(kind: str) -> None:
    """By hand, for several sizes of context."""
    cases = [make_case(kind, seed) for seed in range(4)]
    model = build("nearest_neighbour", kind, cases)
    chosen = set()
    for seed, size in ((8, 2), (9, 5), (10, 10), (11, 20), (12, 30)):
        new = make_case(kind, seed)
        context, free = new.positions.numpy()[:size], ~new.body.fixed.numpy()
        distances = [np.mean((case.positions.numpy()[:size] - context) ** 2) for case in cases]
        chosen.add(int(np.argmin(distances)))
        closest = cases[np.argmin(distances)].positions.numpy()
        expected = context[-1] + closest[size:] - closest[size - 1]
        expected[:, ~free] = context[-1, ~free]
        np.testing.assert_allclose(predict(model, new, size).numpy(), expected, atol=1e-6)
    assert len(chosen) > 1


def test_nearest_neighbour_keeps_trajectories_evenly_spread() -> None:
    kind = "sheet_deformation"
    cases = [make_case(kind, seed) for seed in range(5)] + [make_case(kind, 5, size=5)]
    model = NearestNeighbour(get_task(kind), NeighbourConfig(trajectories_per_mesh=2))
    model.prepare(cases)
    assert model.kept.tolist() == [2, 1]
    (kept,) = model.recall(cases[0].body)
    assert torch.equal(kept, torch.stack([cases[0].positions, cases[2].positions], dim=1))


def test_meshes_are_the_same_if_their_edges_are() -> None:
    """Whatever their shape, and wherever they stand in a batch; as many nodes are not enough."""
    kind = "deformable_block"
    first, second, larger = make_case(kind, 0), make_case(kind, 1), make_case(kind, 2, size=5)
    assert not torch.equal(first.body.rest_positions, second.body.rest_positions)
    one, other, large = mesh_fingerprints(join([first, second, larger]).body)
    assert one == other == mesh_fingerprints(first.body)[0]
    assert large == mesh_fingerprints(larger.body)[0] != one
    cut = replace(first.body, edges=first.body.edges[:, 2:])
    assert mesh_fingerprints(cut)[0] != one


@every_task
@pytest.mark.parametrize("name", ["mean_trajectory", "nearest_neighbour"])
def test_an_unknown_mesh_is_refused(name: str, kind: str) -> None:
    known, unknown = make_case(kind, 0), make_case(kind, 1, size=5)
    model = build(name, kind, [known])
    message = rf"body 2 of 2 has a mesh of {unknown.body.nodes} nodes .* none of the 1 meshes"
    with pytest.raises(DatasetError, match=message):
        predict(model, join([known, unknown]), 8)
