"""Several processes that share batches compute what one computes that has them whole."""

import json
import os
import subprocess
import sys
from pathlib import Path

import distributed_run
import numpy as np
import pytest
import torch
from distributed_run import MODELS, STEPS
from model_cases import KINDS, OURS, build, make_case, make_model, training_cases
from safetensors.torch import load_file

from m3gn_bench.checkpoint import read_description
from m3gn_bench.data import Case, join
from m3gn_bench.distributed import ALONE, Group, torchrun_group
from m3gn_bench.errors import CheckpointError, ConfigError
from m3gn_bench.model import Model
from m3gn_bench.training import as_one

TORCHRUN = Path(sys.executable).parent / "torchrun"
LEARNED = [name for name in OURS if make_model(name, KINDS[0]).is_learned]
BATCH = ((0, 4), (1, 5), (2, 4), (3, 5), (4, 5))  # seed and size


def batch_of(kind: str) -> list[Case]:
    """Bodies, and colliders, of different size."""
    return [make_case(kind, seed, size=size) for seed, size in BATCH]


# --- without processes ------------------------------------------------------------------------------------


def loss_and_gradient(
    model: Model, shares: list[tuple[Case, float]]
) -> tuple[float, torch.Tensor, list[str]]:
    """Sums over shares, each of which starts with the same random generator; and its states at the end."""
    weights = as_one(model.parameters())
    total, states = 0.0, []
    for case, part in shares:
        rng = np.random.default_rng(7)
        loss = part * model.training_loss(case, rng)
        loss.backward()
        total += loss.item()
        states.append(repr(rng.bit_generator.state))
    assert weights.grad is not None
    return total, weights.grad, states


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", LEARNED)
def test_shares_add_up_to_the_batch(name: str, kind: str) -> None:
    """The same loss and gradient, and the same random numbers used up, with two processes and with four."""
    torch.set_num_threads(1)
    model, batch = build(name, kind, training_cases(kind)).train(), batch_of(kind)
    loss, gradient, (state,) = loss_and_gradient(model, [ALONE.share(batch)])
    for size in (2, 4):
        shares = [Group(rank, size).share(batch) for rank in range(size)]
        assert sum((share.keys for share, _ in shares), ()) == tuple(
            key for case in batch for key in case.keys
        )
        found_loss, found, states = loss_and_gradient(model, shares)
        assert found_loss == pytest.approx(loss, rel=1e-5)
        assert (found - gradient).abs().max() < 1e-4 * gradient.abs().max()
        assert states == [state] * size


def test_draws_of_shares_are_those_of_the_batch() -> None:
    batch = batch_of("deformable_block")
    whole = join(batch).body
    shares = [Group(rank, 3).share(batch)[0].body for rank in range(3)]
    for kind, axis, count in (
        ("drawn_per_body", 1, len(BATCH)),
        ("drawn_per_node", 0, whole.nodes),
        ("drawn_per_collider_node", 0, whole.collider_nodes),
    ):

        def draw(number: int, axis: int = axis, count: int = count) -> np.ndarray:
            assert number == count
            values = np.arange(2 * number)
            return values.reshape(2, number) if axis else values.reshape(number, 2)

        parts = [getattr(body, kind)(draw) for body in shares]
        assert np.array_equal(np.concatenate(parts, axis), getattr(whole, kind)(draw))


def test_too_many_processes_for_a_batch() -> None:
    with pytest.raises(ConfigError, match=r"batch of 5 .* 6 processes; .*6 or more .*training.batch_size"):
        Group(0, 6).share(batch_of("sheet_deformation"))


@pytest.mark.parametrize(
    ("device", "message"), [("cuda:1", "cpu or cuda"), ("cpu", "start them with torchrun")]
)
def test_a_group_that_cannot_be(device: str, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that all processes would fight for; an environment that tells of processes but not where they are."""
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match=message), torchrun_group(device):
        pass


# --- with processes ---------------------------------------------------------------------------------------


def torchrun(*command: object) -> subprocess.CompletedProcess[str]:
    """Two processes of this machine."""
    return subprocess.run(
        [str(TORCHRUN), "--standalone", "--nproc-per-node", "2", *map(str, command)],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=240,
    )


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "weights.safetensors")


def test_two_processes_train_as_one_does(tmp_path: Path) -> None:
    """Also where the first process died and the run went on; only then all is bit for bit the same."""
    folders = {what: tmp_path / what for what in ("alone", "undisturbed", "die")}
    for folder in folders.values():
        folder.mkdir()
    for name in MODELS:
        distributed_run.training(name, folders["alone"])
    script = distributed_run.__file__
    assert torchrun(script, folders["die"], "die").returncode != 0
    for what in ("undisturbed", "die"):
        done = torchrun(script, folders[what], "train")
        assert done.returncode == 0, done.stderr
        for rank in range(2):
            found = json.loads((folders[what] / f"{rank}.json").read_text())
            assert found == {"size": 2, "refused": True, "ended": True}

    for name in MODELS:
        alone, together, resumed = (weights(folder / name) for folder in folders.values())
        for key, value in alone.items():
            assert torch.allclose(together[key], value, rtol=1e-3, atol=2e-5), (name, key)
            assert torch.equal(together[key], resumed[key]), (name, key)
        first, second = (read_description(folders[what] / name) for what in ("alone", "undisturbed"))
        assert (first.processes, second.processes) == (1, 2)
        assert second.best_step == first.best_step
        assert second.validation_error == pytest.approx(first.validation_error, rel=1e-3)
    assert second.steps == STEPS


def test_the_command_with_torchrun(smoke_file: Path, tmp_path: Path) -> None:
    """A budget of time ends for all at the same step; only one process speaks; batches must be large enough."""
    command = [
        "train",
        "--task",
        "sheet_deformation",
        "--model",
        "m3gn",
        "--preset",
        "smoke",
        "--tier",
        "smoke",
    ]
    command += ["--data", smoke_file.parent, "--minutes", "0.01", "--json", "--out", tmp_path / "run"]
    done = torchrun("-m", "m3gn_bench", *command, "--set", "training.batch_size=2")
    assert done.returncode == 0, done.stderr
    described = json.loads(done.stdout)
    assert (described["processes"], described["config"]["training"]["batch_size"]) == (2, 2)
    assert 0.01 <= described["minutes"] < 0.05
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"checkpoint.json", "weights.safetensors"}

    refused = torchrun("-m", "m3gn_bench", *command, "--set", "training.batch_size=1")
    assert refused.returncode != 0
    assert "error: a batch of 1 trajectories is too small for 2 processes" in refused.stderr


def test_a_run_of_several_processes_is_not_that_of_one(tmp_path: Path) -> None:
    """Its time and its rounding are other ones."""
    distributed_run.training("mgn", tmp_path)
    path = tmp_path / "mgn" / "checkpoint.json"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"processes": 2}))
    with pytest.raises(CheckpointError, match="another finished run"):
        distributed_run.training("mgn", tmp_path)
