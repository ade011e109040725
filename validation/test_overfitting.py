"""Every learned model can fit what it is shown: four trajectories, far better than standing still.

Real trajectories of Deformable Block, the smallest networks, one fixed anchor: what is left is whether a model's
own parts and its training loss work together. A context of five frames is past the transient after the change of
material.
"""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.data import Case, load_cases
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.generators.generate import generate
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.model import build_model, get_model_class, load_preset, model_names
from m3gn_bench.tasks import get_task
from m3gn_bench.training import train

CONTEXT = 5
TASK = replace(get_task("deformable_block"), training_context=(CONTEXT, CONTEXT), context_sizes=(CONTEXT,))
OURS = [n for n in model_names() if get_model_class(n).__module__.startswith("m3gn_bench.")]
LEARNED = [n for n in OURS if build_model(load_preset(n, "smoke", TASK), TASK).is_learned]

# Steps of the whole batch, learning rate, and hyper-parameters where the preset "smoke" has others.
WITH_PRIMITIVES = 400, 5e-3, {"initial_tau": 0.5}
WITH_CONTEXT = 350, 5e-3, {"training_context_pairs": CONTEXT - 1}  # all: prediction reads all
STEP_WISE = 800, 3e-3, {"noise": 1e-4}
SETTINGS = {
    "mgn_mp": WITH_PRIMITIVES,
    "mgn": STEP_WISE,
    "mgn_material": STEP_WISE,
    "mgn_no_history": STEP_WISE,
    "m3gn_step": (400, 3e-3, {"noise": 1e-4, "training_context_pairs": CONTEXT - 1}),
    "np_step": (400, 3e-3, {"noise": 1e-4, "training_context_pairs": CONTEXT - 1}),
    "m3gn_replan": (150, 5e-3, {"training_context_pairs": CONTEXT - 1, "training_segments": 4}),
    "mango": (150, 3e-3, {}),
    "egno": (150, 5e-3, {}),
}
# Models that feed velocities back integrate the error of each step, so that small errors grow with the horizon, and
# without a history there is no velocity. A step of the neural operators takes as long as ten of the others': they are
# stopped while they still get better (EGNO 3.8 % after 300 steps, MaNGO 1.5 % after 250).
ALLOWED = {
    "mgn": 0.05,
    "mgn_material": 0.05,
    "m3gn_step": 0.05,
    "np_step": 0.05,
    "mgn_no_history": 0.25,
    "mango": 0.03,
    "egno": 0.1,
}


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    """The first four training trajectories."""
    folder = tmp_path_factory.mktemp("data")
    file = generate(get_scene("deformable_block"), "smoke", folder, splits=["train"]).file
    return load_cases(file, TASK, "train", "smoke")[:4]


def error(model: torch.nn.Module, cases: list[Case]) -> float:
    """Mean full-rollout MSE."""
    return float(evaluate_model(model, cases, [CONTEXT])[CONTEXT].mse.mean())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", LEARNED)
def test_overfits(name: str, cases: list[Case], tmp_path: Path) -> None:
    """To below 1 % of the error of standing still (some: see ALLOWED)."""
    steps, rate, model = SETTINGS.get(name, WITH_CONTEXT)
    settings = {
        "training.steps": steps,
        "training.learning_rate": rate,
        "training.batch_size": len(cases),
        "training.validations": 1,
        **{f"model.{key}": value for key, value in model.items()},
    }
    config = load_preset(name, "smoke", TASK, settings)
    train(config, TASK, cases, cases, tmp_path, seed=0, dataset_hash="none")
    trained, done = load_checkpoint(tmp_path)
    standing_still = error(build_model(load_preset("stand_still", "smoke", TASK), TASK), cases)
    ratio = error(trained, cases) / standing_still
    print(f"{name}: {ratio:.2%} after {steps} steps in {60 * done.minutes:.0f} s")
    assert ratio < ALLOWED.get(name, 0.01)
