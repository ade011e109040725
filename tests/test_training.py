"""The training loop: it learns, it resumes to the same state, it refuses nonsense."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from model_cases import make_case
from safetensors.torch import load_file

import m3gn_bench.training
from m3gn_bench.checkpoint import Checkpoint, load_checkpoint
from m3gn_bench.data import Case
from m3gn_bench.errors import CheckpointError, ConfigError, TrainingError
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.model import Model, build_model, load_preset
from m3gn_bench.tasks import get_task
from m3gn_bench.training import STATE, Progress, Run, tensorboard_observer, train

TASK = get_task("sheet_deformation")
LEARNED = ["m3gn", "mgn", "mgn_material"]
CASES = [make_case(TASK.name, seed) for seed in range(4)]
HELD_OUT = [make_case(TASK.name, seed) for seed in range(10, 12)]


class Killed(BaseException):
    """Stands for a kill: nothing in the loop may catch it."""


def run(
    name: str, out: Path, steps: int, kill_at: int | None = None, seed: int = 0, **settings: object
) -> Checkpoint:
    overrides = {"training.steps": steps, "training.validations": 3, **settings}

    def observe(progress: Progress) -> None:
        if progress.step == kill_at:
            raise Killed

    return train(
        load_preset(name, "smoke", TASK, overrides),
        TASK,
        CASES,
        HELD_OUT,
        out,
        seed=seed,
        dataset_hash="none",
        observe=observe,
    )


@pytest.mark.parametrize("name", LEARNED)
def test_resumes_to_the_same_weights(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed twice, in different phases, and still bit for bit the run that was never killed."""
    monkeypatch.setattr(m3gn_bench.training, "SAVE_INTERVAL", 0.0)
    whole = run(name, tmp_path / "whole", 12)
    for kill_at in (3, 8):
        with pytest.raises(Killed):
            run(name, tmp_path / "killed", 12, kill_at)
        assert (tmp_path / "killed" / STATE).is_file()
    resumed = run(name, tmp_path / "killed", 12)
    ignore = {"minutes"}
    assert resumed.model_dump(exclude=ignore) == whole.model_dump(exclude=ignore)
    first, second = (load_file(tmp_path / folder / "weights.safetensors") for folder in ("whole", "killed"))
    assert all(torch.equal(first[key], second[key]) for key in first)
    assert not (tmp_path / "killed" / STATE).exists()


@pytest.mark.parametrize("name", LEARNED)
def test_learns(name: str, tmp_path: Path) -> None:
    """Weights after some training beat those of the first step by far, on the data trained on."""
    errors = []
    for steps in (1, 300):
        settings = (
            {"training.steps": steps, "model.noise": 1e-3} if "mgn" in name else {"training.steps": steps}
        )
        config = load_preset(name, "smoke", TASK, settings)
        done = train(config, TASK, CASES, CASES, tmp_path / str(steps), seed=0, dataset_hash="none")
        errors.append(done.validation_error)
    assert errors[1] < 0.5 * errors[0]


def test_curves_go_to_tensorboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which need not be installed here: only where, what and how often is asked."""
    written: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: Path) -> None:
            assert folder == tmp_path

        def add_scalar(self, name: str, value: float, step: int) -> None:
            written.append((name, value, step))

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    observe = tensorboard_observer(tmp_path)
    observe(Progress(step=99, loss=3.0))
    observe(Progress(step=100, loss=2.0))
    observe(Progress(step=200, loss=1.0, best_error=0.5))
    assert written == [("loss", 2.0, 100), ("loss", 1.0, 200), ("best validation error", 0.5, 200)]
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ConfigError, match="TensorBoard is not installed"):
        tensorboard_observer(tmp_path)


def test_best_weights_are_kept(tmp_path: Path) -> None:
    """The recorded validation error is that of the weights in the checkpoint."""
    done = run("m3gn", tmp_path, 20)
    model, _ = load_checkpoint(tmp_path)
    errors = evaluate_model(model, HELD_OUT, TASK.context_sizes)
    assert done.validation_error == pytest.approx(
        sum(float(e.mse.mean()) for e in errors.values()) / len(errors), rel=1e-6
    )


def test_seeds_differ_and_repeat(tmp_path: Path) -> None:
    hashes = [run("mgn", tmp_path / str(i), 3, seed=seed).weights_sha256 for i, seed in enumerate((0, 0, 1))]
    assert hashes[0] == hashes[1] != hashes[2]


def test_frozen_weights_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Decay would move them, too."""
    frozen = "simulator.network.readout.bias"
    made = []

    def build(*arguments: Any) -> Model:
        made.append(build_model(*arguments))
        made[0].get_parameter(frozen).requires_grad_(False).fill_(0.25)
        return made[0]

    monkeypatch.setattr(m3gn_bench.training, "build_model", build)
    run("mgn", tmp_path, 3, **{"training.weight_decay": 0.5})
    assert (made[0].get_parameter(frozen) == 0.25).all()


def first_steps(out: Path, **settings: object) -> Run:
    """A run of 100 steps before its first one."""
    config = load_preset("mgn", "smoke", TASK, {"training.steps": 100, **settings})
    model = build_model(config, TASK, seed=0)
    model.prepare(CASES)
    return Run(config, model, 0, out, {})


def test_learning_rate_warms_up_and_falls_as_a_cosine(tmp_path: Path) -> None:
    settings = {
        "training.learning_rate": 0.01,
        "training.warmup_steps": 10,
        "training.cosine_decay": True,
    }
    run = first_steps(tmp_path, **settings)
    rates = []
    for _ in range(101):
        rates.append(run.learning_rate())
        run.account(0.0)
    cosine = [0.005 * (1 + math.cos(math.pi * step / 100)) for step in range(101)]
    assert rates[:10] == pytest.approx([(step + 1) / 10 * cosine[step] for step in range(10)])
    assert rates[10:] == pytest.approx(cosine[10:])
    assert first_steps(tmp_path, **settings | {"training.cosine_decay": False}).learning_rate() == 0.001


def test_gradient_is_clipped(tmp_path: Path) -> None:
    norms = []
    for clip in (1e3, 1e-3):
        run = first_steps(tmp_path, **{"training.gradient_clip": clip})
        run.step(CASES)
        assert run.weights.grad is not None
        norms.append(float(run.weights.grad.norm()))
    assert 1e-2 < norms[0] < 1e3
    assert norms[1] == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_precision_is_that_of_the_settings(
    precision: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = first_steps(tmp_path, **{"training.precision": precision})
    loss, active = run.model.training_loss, []

    def watched(case: Case, rng: np.random.Generator) -> torch.Tensor:
        active.append(torch.is_autocast_enabled("cpu"))
        return loss(case, rng)

    monkeypatch.setattr(run.model, "training_loss", watched)
    before = run.weights.detach().clone()
    run.step(CASES)
    assert active == [precision == "bfloat16"]
    assert run.weights.dtype == torch.float32
    assert not torch.equal(run.weights, before)


def test_time_budget_ends(tmp_path: Path) -> None:
    config = load_preset("mgn", "smoke", TASK, {"training.minutes": 0.01})
    done = train(config, TASK, CASES, HELD_OUT, tmp_path, seed=0, dataset_hash="none")
    assert 0.01 <= done.minutes < 0.05
    assert done.steps > 1


def test_budget_is_required_and_single(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="budget"):
        train(load_preset("mgn", "smoke", TASK), TASK, CASES, HELD_OUT, tmp_path, seed=0, dataset_hash="")
    with pytest.raises(ConfigError, match="budget"):
        run("mgn", tmp_path, 3, **{"training.minutes": 1.0})


def test_other_runs_are_not_overwritten(tmp_path: Path) -> None:
    run("mgn", tmp_path, 2)
    assert run("mgn", tmp_path, 2).steps == 2  # the same run again is already done
    with pytest.raises(CheckpointError, match="another finished run"):
        run("mgn", tmp_path, 3)


def test_state_of_another_run_or_damaged_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(m3gn_bench.training, "SAVE_INTERVAL", 0.0)
    with pytest.raises(Killed):
        run("mgn", tmp_path, 6, kill_at=3)
    with pytest.raises(CheckpointError, match="other settings"):
        run("mgn", tmp_path, 7)
    (tmp_path / STATE).write_bytes(b"not a state")
    with pytest.raises(CheckpointError, match="damaged"):
        run("mgn", tmp_path, 6)


def test_divergence_is_loud(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="learning_rate"):
        run("mgn", tmp_path, 50, **{"training.learning_rate": 1e30, "training.warmup_steps": 0})


def test_checkpoint_is_plain_json(tmp_path: Path) -> None:
    run("stand_still", tmp_path, 1)
    record = json.loads((tmp_path / "checkpoint.json").read_text())
    assert record["steps"] == 0
    assert record["validation_error"] is None
    assert not math.isnan(record["minutes"])
