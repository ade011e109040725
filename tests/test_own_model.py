"""The example of a model of one's own: installed as a plugin, listed, trained and evaluated by the commands."""

from pathlib import Path

import pytest
from installed import command, install

from m3gn_bench.data import load_cases
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.model import build_model, load_preset, model_names
from m3gn_bench.tasks import get_task

ROOT = Path(__file__).parent.parent
EXAMPLE = ROOT / "examples" / "own_model"
NAME = "damped_velocity"


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which the example is installed."""
    return install(EXAMPLE, tmp_path_factory.mktemp("own_model"))


def test_is_listed_for_every_task(environment: dict[str, str]) -> None:
    listed = command(environment, "list")
    tasks = {task["name"] for task in listed["tasks"]}
    own = [model for model in listed["models"] if model["name"] == NAME]
    assert {model["task"] for model in own} == tasks
    assert {model["parameters"] for model in own} == {3 * 16 + 1}


def test_learns_and_is_evaluated(environment: dict[str, str], smoke_file: Path, tmp_path: Path) -> None:
    """A checkpoint of the plugin is loaded by another process, and beats what needs no learning."""
    common = "--model", NAME, "--task", "sheet_deformation", "--tier", "smoke", "--data", smoke_file.parent
    rate = "training.learning_rate=1e-2"
    learned = command(environment, "train", *common, "--steps", 200, "--set", rate, "--out", tmp_path / "run")
    assert learned["steps"] == 200
    done = command(environment, "evaluate", *common, "--checkpoint", tmp_path / "run")
    task = get_task("sheet_deformation")
    cases = load_cases(smoke_file, task, "test")
    for name in ("stand_still", "constant_velocity"):
        model = build_model(load_preset(name, "smoke", task), task)
        errors = evaluate_model(model, cases, task.context_sizes)
        for row in done["results"]:
            assert row["mse"] < 0.8 * errors[row["context"]].mse.mean(), name


def test_belongs_to_nobody_else() -> None:
    """The environment that runs the tests does not know the plugin: it was found where it was installed."""
    assert NAME not in model_names()


def test_is_short() -> None:
    """At most 30 lines of code, as promised."""
    lines = (EXAMPLE / "own_model.py").read_text().splitlines()
    code = [line for line in lines if line.strip() and not line.strip().startswith(('"""', "#"))]
    assert len(code) <= 30


@pytest.mark.parametrize("name", ["own_model.py", "pyproject.toml"])
def test_documentation_shows_the_files_themselves(name: str) -> None:
    blocks = (ROOT / "docs" / "models.md").read_text().split("```")[1::2]
    shown = [block.partition("\n")[2] for block in blocks]
    assert (EXAMPLE / name).read_text() in shown
