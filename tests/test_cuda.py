"""On a GPU: every method trains, predicts and goes on record as on a CPU, but for rounding."""

from pathlib import Path

import numpy as np
import pytest
import torch
from model_cases import make_case

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.leaderboard.campaign import Job, carry_out, read_plan
from m3gn_bench.model import build_model, load_preset, model_names
from m3gn_bench.tasks import get_task
from m3gn_bench.training import train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
KINDS = ["sheet_deformation", "tissue_manipulation", "falling_teddy"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", model_names())
def test_trains_to_the_same_weights(name: str, kind: str, tmp_path: Path) -> None:
    """Five steps, whose rounding no method can have amplified much."""
    task = get_task(kind)
    cases, held_out = ([make_case(kind, seed) for seed in seeds] for seeds in (range(4), range(10, 12)))
    budget = {"training.steps": 5, "training.validations": 1}
    config = load_preset(name, "smoke", task, budget)
    if not build_model(config, task).is_learned:
        pytest.skip(f"{name} does not learn")
    errors = {}
    for device in ("cpu", "cuda"):
        out = tmp_path / device
        described = train(config, task, cases, held_out, out, seed=0, dataset_hash="none", device=device)
        assert described.device == device
        model, _ = load_checkpoint(out)
        model.to(device)
        moved = [case.to(torch.device(device)) for case in held_out]
        found = evaluate_model(model, moved, task.context_sizes[:2])
        errors[device] = np.array([e.mse for e in found.values()])
    assert np.allclose(errors["cuda"], errors["cpu"], rtol=1e-2)


def test_a_plan_is_carried_out(smoke_file: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'track = "trial"\ntier = "smoke"\n[[runs]]\ntasks = ["sheet_deformation"]\nmodels = ["m3gn"]\n'
        'preset = "smoke"\nsteps = 3\n'
    )
    (planned,) = read_plan(plan)
    outcomes = [carry_out(Job(planned, smoke_file, tmp_path / d, d)) for d in ("cpu", "cuda")]
    records = []
    for outcome in outcomes:
        assert outcome.error is None
        assert outcome.record is not None
        records.append(outcome.record)
    assert [record.evaluation_device for record in records] == ["cpu", "cuda"]
    for on_cpu, on_cuda in zip(*(record.results for record in records), strict=True):
        assert np.allclose(on_cpu.trajectory_mse, on_cuda.trajectory_mse, rtol=1e-2)
