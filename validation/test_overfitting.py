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

# Steps of the whole batch, learning rate, and settings where the preset "smoke" has others. The gradient is clipped
# for models that learn single steps: those right after the change of material are twenty times as large as others.
CLIPPED = {"training.gradient_clip": 0.1}
ALL_PAIRS = {"model.max_training_context_pairs": None}  # prediction reads all
# Small errors of a step grow with the horizon: a rollout needs a network that can undo them, and noise that asks it to.
ROLLOUT = CLIPPED | {"model.width": 64, "model.message_passing_steps": 4, "model.noise": 1e-3}
WITH_CONTEXT = 350, 5e-3, ALL_PAIRS
STEP_WISE = 1200, 5e-3, ALL_PAIRS | CLIPPED | {"model.noise": 1e-4}
SETTINGS: dict[str, tuple[int, float, dict[str, float | None]]] = {
    "mgn_mp": (400, 5e-3, {"model.initial_tau": 0.5}),
    "mgn": (3000, 3e-3, ROLLOUT),
    "mgn_material": (1500, 3e-3, ROLLOUT),
    "mgn_no_history": (2000, 5e-3, CLIPPED | {"model.message_passing_steps": 4, "model.noise": 1e-4}),
    "m3gn_step": STEP_WISE,
    "np_step": STEP_WISE,
    "m3gn_replan": (150, 5e-3, ALL_PAIRS | {"model.training_segments": 4}),
    "mango": (350, 1e-2, CLIPPED),
    "egno": (320, 1.5e-2, {"training.gradient_clip": 1.0, "model.layers": 3}),
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
    """To below 1 % of the error of standing still."""
    steps, rate, others = SETTINGS.get(name, WITH_CONTEXT)
    settings = {
        "training.steps": steps,
        "training.learning_rate": rate,
        "training.batch_size": len(cases),
        "training.validations": 1,
        **others,
    }
    config = load_preset(name, "smoke", TASK, settings)
    train(config, TASK, cases, cases, tmp_path, seed=0, dataset_hash="none")
    trained, done = load_checkpoint(tmp_path)
    standing_still = error(build_model(load_preset("stand_still", "smoke", TASK), TASK), cases)
    ratio = error(trained, cases) / standing_still
    print(f"{name}: {ratio:.2%} after {steps} steps in {60 * done.minutes:.0f} s")
    assert ratio < 0.01
