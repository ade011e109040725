"""What `m3gn-bench profile` measures is what it says, and `m3gn-bench list` shows the paper's sizes."""

import json
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner, Result
from model_cases import make_case, training_cases
from torch import Tensor

from m3gn_bench.cli import cli
from m3gn_bench.data import Case, Context
from m3gn_bench.m3gn import ContextConfig, ContextEncoder
from m3gn_bench.model import PRESETS, Model, ModelConfig, build_model, load_preset, model_names
from m3gn_bench.profiling import Profile, Run, TimedModel, fastest_batch, profile_models, ratios
from m3gn_bench.tasks import TASKS, get_task

TASK = get_task("deformable_block")
CASES = [make_case(TASK.name, seed) for seed in (3, 4)]
CONTEXT = 30  # few frames are left to roll out


class Sleeper(Model):
    """Encodes for 20 ms and simulates for 30 ms, whatever the batch; holds and makes tensors of known size."""

    def __init__(self) -> None:
        super().__init__(TASK, ModelConfig())
        self.encoder = SleepingEncoder(TASK, ContextConfig(width=1, message_passing_steps=1, latent_size=1))
        self.register_buffer("held", torch.zeros(250_000))  # 1 MB

    def predict(self, context: Context) -> Tensor:
        """The anchor, after a while."""
        self.encoder()
        first = torch.zeros(1_000_000)  # 4 MB
        second = first + 1  # 8 MB
        del first
        third = second + 1  # 8 MB again: the first is gone
        time.sleep(0.03)
        return context.positions[-1].expand(context.horizon, -1, -1) + 0 * third[0]


class SleepingEncoder(ContextEncoder):
    def forward(self) -> None:  # type: ignore[override]
        """Takes 20 ms."""
        time.sleep(0.02)


def profiled(names: Sequence[str], batches: Sequence[int] = (1, 2)) -> list[Profile]:
    return profile_models(
        names,
        TASK,
        "smoke",
        CASES,
        CONTEXT,
        training_cases=lambda: training_cases(TASK.name),
        batches=batches,
        repetitions=1,
    )


def operations_by_hand(model: Model, nodes: int, edges: int) -> int:
    """Two for each multiplication and addition in one call of MGN's network."""
    network = model.simulator.network  # type: ignore[union-attr]
    width, blocks = network.hidden.out_features, len(network.blocks)  # type: ignore[union-attr, arg-type]
    node_input, edge_input = network.embed_nodes.in_features, network.embed_edges.in_features  # type: ignore[union-attr]
    outputs = network.readout.out_features  # type: ignore[union-attr]
    # The first block's products with embeddings are taken on inputs, with products of two weights. (Products with
    # biases, of a matrix and a vector, are not counted.)
    per_edge = (blocks - 1) * width**2 + 2 * width * edge_input
    per_node = (4 * blocks - 2) * width**2 + 3 * width * node_input + width**2 + width * outputs
    composed = width * width * edge_input + 2 * width * width * node_input
    return int(2 * (edges * per_edge + nodes * per_node + composed))


def test_time_is_split_at_the_context_encoder() -> None:
    model = TimedModel(Sleeper(), CONTEXT)
    for batch in (1, 2):
        run = model.run(CASES, batch)
        assert 0.02 / batch <= run.encoding
        assert 0.05 / batch <= run.total
        assert run.encoding + 0.03 / batch <= run.total
        assert run.cpu < run.total  # it sleeps


def test_a_batch_larger_than_the_trajectories_repeats_them() -> None:
    model = TimedModel(Sleeper(), CONTEXT)
    predicted: list[Case] = []
    model.predict = predicted.append  # type: ignore[method-assign]
    model.run(CASES, 4)
    assert [case.keys for case in predicted] == [2 * (*CASES[0].keys, *CASES[1].keys)]


def test_peak_memory_is_that_of_tensors_alive_at_once() -> None:
    model = TimedModel(Sleeper(), CONTEXT)
    weights = sum(weight.nbytes for weight in model.model.encoder.parameters())  # type: ignore[union-attr]
    assert 9_000_000 <= model.peak_memory(CASES[0]) - weights < 9_000_000 + 10_000


@pytest.mark.parametrize(
    ("seconds", "tried"),
    [
        ({1: 1.0, 4: 0.5, 16: 0.4, 32: 0.3}, [1, 4, 16, 32]),
        ({1: 1.0, 4: 0.5, 16: 0.6, 32: 0.1}, [1, 4, 16]),  # it became worse
        ({1: 1.0, 4: 1.05, 16: 0.9, 32: 0.8}, [1, 4, 16, 32]),  # about the same is not worse
    ],
)
def test_search_for_the_best_batch(seconds: dict[int, float], tried: list[int]) -> None:
    model = TimedModel(Sleeper(), CONTEXT)
    model.run = lambda cases, batch: Run(0.0, seconds[batch], 0.0)  # type: ignore[method-assign]
    assert fastest_batch(model, CASES, list(seconds)) == {batch: seconds[batch] for batch in tried}


def test_profile_of_several_models() -> None:
    profiles = profiled(["mgn", "nearest_neighbour", "m3gn", "mgn"])
    assert [p.model for p in profiles] == ["m3gn", "mgn", "nearest_neighbour"]
    m3gn, mgn, neighbour = profiles
    for p in profiles:
        for seconds in (p.single, p.batched):
            assert seconds.fastest == seconds.total == seconds.slowest  # one repetition
            assert seconds.encoding + seconds.simulation == pytest.approx(seconds.total)
        assert p.single.batch == 1
        assert p.batched.batch == min(p.batches, key=p.batches.__getitem__)
        assert p.parameters == build_model(load_preset(p.model, "smoke", TASK), TASK).parameter_count()
        assert p.peak_memory > 4 * p.parameters
    assert 0 < m3gn.single.encoding < m3gn.single.total
    assert mgn.single.encoding == neighbour.single.encoding == 0
    assert neighbour.operations == 0
    compared = ratios(profiles)
    assert (compared[0].single, compared[0].batched, compared[0].operations) == (1, 1, 1)
    assert compared[1].single == pytest.approx(mgn.single.total / m3gn.single.total)
    assert compared[1].operations == pytest.approx(mgn.operations / m3gn.operations)


def test_operations_are_counted() -> None:
    """Sheet Deformation's graph stays the same, so all of MGN's steps cost the same."""
    task = get_task("sheet_deformation")
    cases = [make_case(task.name, 3), make_case(task.name, 4, size=5)]
    model = build_model(load_preset("mgn", "smoke", task), task)
    expected = [
        (task.frames - CONTEXT) * operations_by_hand(model, case.body.nodes, case.body.edges.shape[1])
        for case in cases
    ]
    assert expected[1] > 1.3 * expected[0]
    assert TimedModel(model, CONTEXT).operations(cases) == pytest.approx(sum(expected) / 2, rel=1e-9)


def run_cli(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_command(smoke_file: Path) -> None:
    arguments = ["profile", "--task", "sheet_deformation", "--model", "mgn", "--preset", "smoke"]
    arguments += ["--repetitions", "1", "--trajectories", "1", "--threads", "1", "--context", "2"]
    arguments += ["--data", str(smoke_file.parent)]
    shown = run_cli(*arguments, "--json")
    assert shown.exit_code == 0, shown.output
    record = json.loads(shown.stdout)
    assert [m["model"] for m in record["models"]] == ["m3gn", "mgn"]
    assert record["context"] == 2
    assert record["models"][1]["ratios"]["operations"] > 10
    text = run_cli(*arguments)
    assert text.exit_code == 0
    assert "context encoding" in text.stdout
    assert "total [s]" in text.stdout


def test_list_shows_the_papers_sizes() -> None:
    """All sixteen published parameter counts are ours."""
    shown = run_cli("list", "--json")
    assert shown.exit_code == 0, shown.output
    models = json.loads(shown.stdout)["models"]
    assert {(m["name"], m["preset"], m["task"]) for m in models} == {
        (name, preset, task) for name in model_names() for preset in PRESETS for task in TASKS
    }
    published = [m for m in models if m["published_parameters"] is not None]
    assert len(published) == 16
    assert all(m["preset"] == "paper" and m["published_parameters"] == m["parameters"] for m in published)
    assert "1259394 = paper" in run_cli("list").stdout
