"""Graphs: which nodes are connected, and what nodes and edges are told, against direct computations."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_cases import KINDS, make_case, make_model, predict
from torch import Tensor

import m3gn_bench.graph
import m3gn_bench.m3gn
from m3gn_bench.baselines.mgn import MeshGraphNet
from m3gn_bench.data import Body, join
from m3gn_bench.graph import CONTACT_RADIUS, Graph, build_graph, contact_pairs
from m3gn_bench.m3gn import M3GN
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.tasks import TASKS, get_task

# Edge features; node features of MGN, of M3GN's context network, of its simulator (from the paper's counts).
LENGTHS = {
    "sheet_deformation": (9, 9, 6, 67),
    "sheet_deformation_ood": (9, 9, 6, 67),
    "deformable_block": (10, 6, 6, 70),
    "tissue_manipulation": (11, 8, 8, 72),
    "falling_teddy": (9, 8, 5, 66),
    "mixed_objects": (9, 8, 5, 66),
}


def loose_body(nodes: int, collider_nodes: int, dimension: int) -> Body:
    """Nodes without any edges."""
    return Body(
        rest_positions=torch.zeros(nodes, dimension),
        edges=torch.zeros(2, 0, dtype=torch.long),
        static_features=torch.zeros(nodes, 0),
        fixed=torch.zeros(nodes, dtype=torch.bool),
        material=torch.zeros(1, 1),
        collider_edges=torch.zeros(2, 0, dtype=torch.long),
        node_counts=(nodes,),
        collider_counts=(collider_nodes,),
    )


def brute_force(body: Body, positions: Tensor, collider: Tensor) -> set[tuple[int, int]]:
    """Contacts by looking at every pair of nodes at every moment, in double precision."""
    found = set()
    nodes = body.nodes + body.collider_nodes
    owners = np.repeat(np.arange(len(body.node_counts)), body.node_counts)
    collider_owners = np.repeat(np.arange(len(body.collider_counts)), body.collider_counts)
    for moment, (mesh, rigid) in enumerate(zip(positions.numpy(), collider.numpy(), strict=True)):
        for i, place in enumerate(mesh.astype(np.float64)):
            for j, other in enumerate(rigid.astype(np.float64)):
                if owners[i] == collider_owners[j] and np.sqrt(np.sum((place - other) ** 2)) < CONTACT_RADIUS:
                    found.add((moment * nodes + i, moment * nodes + body.nodes + j))
    return found


def as_set(pairs: Tensor) -> set[tuple[int, int]]:
    found = set(map(tuple, pairs.T.tolist()))
    assert len(found) == pairs.shape[1]  # each once
    return found


def moments_graph(kind: str, moments: Tensor, added: int = 0) -> tuple[Graph, Body, Tensor, Tensor]:
    """The graph of two joined cases at some moments, with the positions that it was built from."""
    case = join([make_case(kind, 3), make_case(kind, 4, size=5)])
    positions, path = case.positions[moments], case.collider_path[moments]
    features = torch.zeros(len(moments), case.body.nodes + case.body.collider_nodes, added)
    return build_graph(get_task(kind), case.body, positions, path, features), case.body, positions, path


def contact_moments(kind: str) -> Tensor:
    """Frames without contact and with it, in the case that `moments_graph` uses."""
    return torch.tensor([0, 10, get_task(kind).frames - 1])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("spread", [0.2, 0.5, 1.5])
def test_contacts_equal_brute_force(dimension: int, spread: float) -> None:
    """Three bodies on top of each other at four moments: none sees another's collider or another moment."""
    rng = np.random.default_rng([dimension, int(10 * spread)])
    sizes = (17, 9), (5, 1), (24, 13)
    body = replace(
        loose_body(46, 23, dimension),
        node_counts=tuple(nodes for nodes, _ in sizes),
        collider_counts=tuple(nodes for _, nodes in sizes),
    )
    positions, collider = (
        torch.from_numpy(rng.normal(0, spread, (4, nodes, dimension)).astype(np.float32))
        for nodes in (46, 23)
    )
    expected = brute_force(body, positions, collider)
    assert as_set(contact_pairs(body, positions, collider)) == expected
    assert 0 < len(expected) < 4 * (17 * 9 + 5 + 24 * 13)


def test_contact_means_closer_than_the_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    """Exactly at the radius is no contact; the next smaller float32 is."""
    below, above = np.nextafter(np.float32(0.3), np.float32(0)), np.float32(0.3)
    assert float(below) < CONTACT_RADIUS < float(above)
    body = loose_body(2, 1, 2)
    places = torch.tensor([[[0.0, below], [0.0, above]]])
    assert contact_pairs(body, places, torch.zeros(1, 1, 2)).tolist() == [[0], [2]]
    monkeypatch.setattr(m3gn_bench.graph, "CONTACT_RADIUS", 0.25)
    places = torch.tensor([[[0.25, 0.0], [np.nextafter(np.float32(0.25), np.float32(0)), 0.0]]])
    assert contact_pairs(body, places, torch.zeros(1, 1, 2)).tolist() == [[1], [2]]


def test_no_contact_at_all() -> None:
    body = loose_body(5, 3, 2)
    pairs = contact_pairs(body, torch.zeros(2, 5, 2), torch.full((2, 3, 2), 9.0))
    assert pairs.shape == (2, 0)
    assert pairs.dtype == torch.long


def test_what_diverges_touches_nothing() -> None:
    """A rollout that blows up goes on to its end, where its error is named."""
    places = torch.tensor([[[0.0, 0.1], [0.0, np.inf], [np.nan, 0.0], [0.0, 3e38]]])
    pairs = contact_pairs(loose_body(4, 2, 2), places, torch.zeros(1, 2, 2))
    assert as_set(pairs) == {(0, 4), (0, 5)}


def test_number_of_neighbours_is_not_capped() -> None:
    """Every one of 300 mesh nodes touches every one of 150 collider nodes."""
    rng = np.random.default_rng(0)
    places = torch.from_numpy(rng.uniform(-0.05, 0.05, (1, 450, 3)).astype(np.float32))
    found = as_set(contact_pairs(loose_body(300, 150, 3), places[:, :300], places[:, 300:]))
    assert found == {(i, 300 + j) for i in range(300) for j in range(150)}


@pytest.mark.parametrize("kind", ["deformable_block", "tissue_manipulation"])
def test_edges_are_those_documented(kind: str) -> None:
    """Of each type, in the order of its one-hot code, at every moment; both directions of each."""
    task = get_task(kind)
    graph, body, positions, path = moments_graph(kind, contact_moments(kind))
    nodes = body.nodes + body.collider_nodes
    contacts = brute_force(body, positions, path)
    touching = {pair[0] // nodes for pair in contacts}
    assert touching
    assert len(touching) < 3 or kind == "tissue_manipulation"  # the ring is out of reach at first

    def at_all_moments(edges: Tensor, start: int) -> set[tuple[int, int]]:
        return {
            (m * nodes + start + s, m * nodes + start + r)
            for m in range(len(positions))
            for s, r in edges.T.tolist()
        }

    expected = [at_all_moments(body.edges, 0)]
    if task.collider_has_edges:
        expected.append(at_all_moments(body.collider_edges, body.nodes))
    expected += [{(j, i) for i, j in contacts}, contacts]
    types = graph.edge_features[:, : task.edge_types]
    assert torch.equal(types.sum(1), torch.ones(len(types)))
    for number, pairs in enumerate(expected):
        of_type = types[:, number] == 1
        found = as_set(torch.stack([graph.senders, graph.receivers])[:, of_type])
        assert found == pairs, number
    everything = set().union(*expected)
    assert everything == {(r, s) for s, r in everything}


@pytest.mark.parametrize("kind", KINDS)
def test_edge_vectors(kind: str) -> None:
    """Sender minus receiver and its length, now and, on mesh edges only, at rest."""
    task = get_task(kind)
    graph, body, positions, path = moments_graph(kind, contact_moments(kind))
    place = torch.cat([positions, path], dim=1).flatten(0, 1)
    rest = torch.cat([body.rest_positions, torch.full((body.collider_nodes, task.dimension), torch.nan)])
    rest = rest.repeat(len(positions), 1)
    kinds, vectors = graph.edge_features.split([task.edge_types, 2 * (task.dimension + 1)], dim=1)
    rest_part, now_part = vectors.split(task.dimension + 1, dim=1)
    on_mesh = kinds[:, 0] == 1
    for part, points, edges in ((rest_part, rest, on_mesh), (now_part, place, slice(None))):
        expected = points[graph.senders[edges]] - points[graph.receivers[edges]]
        assert torch.equal(part[edges, :-1], expected)
        assert torch.allclose(part[edges, -1], expected.square().sum(1).sqrt(), rtol=1e-6, atol=0)
    assert (rest_part[~on_mesh] == 0).all()
    assert on_mesh.any()
    assert on_mesh.all() == (not task.has_collider)


@pytest.mark.parametrize("kind", KINDS)
def test_node_features(kind: str) -> None:
    """Type, static features (zero on the collider), the height at the moment, then what the model adds."""
    task, moments = get_task(kind), contact_moments(kind)
    graph, body, positions, _ = moments_graph(kind, moments, added=2)
    features = graph.node_features.unflatten(0, (len(moments), -1))
    mesh, collider = features.split([body.nodes, body.collider_nodes], dim=1)
    one_hot = torch.eye(task.node_types)
    static = len(task.static_features)
    begin, end = task.node_types, task.node_types + static
    assert torch.equal(mesh[..., :begin], one_hot[0].expand(len(moments), body.nodes, -1))
    assert torch.equal(mesh[..., begin:end], body.static_features.expand(len(moments), -1, -1))
    assert torch.equal(mesh[..., end:-2], positions[..., -1:] if task.height_feature else positions[..., :0])
    assert torch.equal(collider[..., :begin], one_hot[-1].expand(len(moments), body.collider_nodes, -1))
    assert (collider[..., begin:] == 0).all()
    assert features.shape[-1] == task.node_features + 2


@pytest.mark.parametrize("kind", KINDS)
def test_inverse_degree_makes_means(kind: str) -> None:
    """Nodes that receive nothing have a mean of nothing, not a division by zero."""
    graph, *_ = moments_graph(kind, contact_moments(kind))
    degrees = [int((graph.receivers == node).sum()) for node in range(len(graph.node_features))]
    assert torch.equal(graph.inverse_degree[:, 0], 1 / torch.tensor(degrees).clamp(min=1))


@pytest.mark.parametrize("kind", KINDS)
def test_several_moments_are_a_union(kind: str) -> None:
    """The network's output at three moments together equals that at each alone."""
    moments = contact_moments(kind)
    network = make_model("mgn", kind).simulator.network
    added = network.embed_nodes.in_features - get_task(kind).node_features
    with torch.inference_mode():
        together = network(moments_graph(kind, moments, added)[0])
        alone = [network(moments_graph(kind, moment[None], added)[0]) for moment in moments]
    assert (together - torch.cat(alone)).abs().max() < 1e-5


@pytest.mark.parametrize("name", TASKS)
def test_lengths_are_the_papers(name: str) -> None:
    task = TASKS[name]
    with torch.device("meta"):
        mgn = build_model(load_preset("mgn", "paper", task), task)
        m3gn = build_model(load_preset("m3gn", "paper", task), task)
    networks = mgn.simulator.network, m3gn.encoder.network, m3gn.simulator.network  # type: ignore[union-attr]
    edges, *nodes = LENGTHS[name]
    assert [network.embed_nodes.in_features for network in networks] == nodes  # type: ignore[union-attr]
    assert [network.embed_edges.in_features for network in networks] == [edges] * 3  # type: ignore[union-attr]
    assert task.edge_features == edges


def test_rollout_sees_the_collider_when_it_comes_into_reach() -> None:
    """Two paths that differ from one frame on: predictions are the same up to it, and differ right after."""
    case, size, arrival = make_case("deformable_block", 3), 10, 20
    away = case.collider_path[:1].expand(case.frames, -1, -1).clone()
    coming = away.clone()
    coming[arrival:] += case.positions[9, -1] - away[0, 0]  # the ring's lowest node to a corner of the block
    model = make_model("mgn", "deformable_block")
    assert isinstance(model, MeshGraphNet)
    stays, arrives = (predict(model, replace(case, collider_path=path), size) for path in (away, coming))
    after = arrival - size + 1  # predictions begin with frame `size`; the first that follows the arrival
    assert torch.equal(stays[:after], arrives[:after])
    assert not torch.equal(stays[after], arrives[after])


def test_rollout_sees_the_collider_leave() -> None:
    """It is known one movement ahead; once it is out of reach, where it goes makes no difference."""
    case, size, leaves = make_case("deformable_block", 3), 10, 20
    stay = case.collider_path[:1] + (case.positions[9, -1] - case.collider_path[0, 0])
    stay = stay.expand(case.frames, -1, -1)
    leave = stay.clone()
    leave[leaves:] += 3.0
    wander = leave.clone()
    wander[leaves + 5 :] += 1.0
    model = make_model("mgn", "deformable_block")
    stays, left, wandered = (
        predict(model, replace(case, collider_path=path), size) for path in (stay, leave, wander)
    )
    assert torch.equal(left, wandered)
    assert torch.equal(stays[: leaves - size], left[: leaves - size])
    assert not torch.equal(stays[leaves - size], left[leaves - size])


@pytest.mark.parametrize("kind", ["deformable_block", "tissue_manipulation"])
def test_trajectory_models_know_where_the_collider_ends(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On collider nodes: the last position relative to that at the graph's moment. Zero on mesh nodes."""
    task, case, size = get_task(kind), make_case(kind, 3), 6
    seen: list[Tensor] = []

    def record(task: object, body: object, positions: object, collider: object, features: Tensor) -> Graph:
        seen.append(features)
        return build_graph(task, body, positions, collider, features)  # type: ignore[arg-type]

    monkeypatch.setattr(m3gn_bench.m3gn, "build_graph", record)
    model = make_model("m3gn", kind)
    assert isinstance(model, M3GN)
    predict(model, case, size)
    context_features, anchor_features = seen
    end = case.collider_path[-1]
    for features, moments in ((context_features, range(size - 1)), (anchor_features, [size - 1])):
        remaining = features[..., : task.dimension]
        assert len(features) == len(moments)
        assert (remaining[:, : case.body.nodes] == 0).all()
        for found, moment in zip(remaining, moments, strict=True):
            assert torch.equal(found[case.body.nodes :], end - case.collider_path[moment])
