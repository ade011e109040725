"""The example of a task of one's own: installed as a plugin, simulated, learned and put on a board by the commands.

And what becomes of packages that cannot be used: one line that names them, where they are needed.
"""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from installed import command, install

from m3gn_bench import doctor, model, tasks
from m3gn_bench.cli import run
from m3gn_bench.data import mesh_edges
from m3gn_bench.datasets import plugins
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.scene import OWN_SCENES, get_scene, scene_names, usable_scenes
from m3gn_bench.sources import usable_tasks
from m3gn_bench.tasks import OWN_TASKS, TASKS

EXAMPLE = Path(__file__).parent.parent / "examples" / "own_task"
NAME = "spring_pendulum"


# --- installed, and used by the commands ------------------------------------------------------------------


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which the example is installed."""
    return install(EXAMPLE, tmp_path_factory.mktemp("own_task"))


def test_from_nothing_to_the_board(environment: dict[str, str], tmp_path: Path) -> None:
    data, board = ("--data", tmp_path / "data"), tmp_path / "board"
    made = command(environment, "generate", NAME, "--tier", "smoke", "--workers", 1, *data)
    assert (made["trajectories"], made["rejected"]) == (16, [])
    checked = command(environment, "validate", made["file"], "--strict")
    assert (checked["ok"], checked["problems"]) == (True, [])
    for learner in ("m3gn", "mgn"):
        out = tmp_path / learner
        which = "--model", learner, "--task", NAME, "--preset", "smoke"
        budget = "--steps", 10, "--set", "training.validations=1"
        done = command(environment, "train", *which, "--tier", "smoke", *budget, "--out", out, *data)
        assert done["steps"] == 10
        score = (
            "--tier",
            "smoke",
            "--track",
            "smoke",
            "--threads",
            1,
            "--record",
            board,
            "--variant",
            "validated once",
        )
        found = command(environment, "evaluate", *which, "--checkpoint", out, *score, *data)
        assert [(row["task"], row["context"]) for row in found["results"]] == [
            (NAME, context) for context in (2, 5, 10)
        ]
    rendered = command(environment, "leaderboard", "render", "--home", board)
    assert rendered["records"] == 2
    page = (board / "LEADERBOARD.md").read_text()
    assert "### Spring Pendulum" in page
    assert "| m3gn (validated once) | 1 | 27 183 |" in page
    assert "| mgn (validated once) | 1 | 12 194 |" in page

    # Where the package is not installed, its rows are still there.
    with pytest.raises(SystemExit):
        run(["leaderboard", "render", "--home", str(board)])
    assert (board / "LEADERBOARD.md").read_text() == page.replace("### Spring Pendulum", f"### {NAME}")


def test_belongs_to_nobody_else() -> None:
    """The environment that runs the tests does not know the plugin: it was found where it was installed."""
    assert NAME not in TASKS
    assert NAME not in scene_names()


# --- packages on the path of this process -----------------------------------------------------------------

Add = Callable[..., None]


@pytest.fixture
def add(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Add]:
    """Installs packages of one module (path or text) with lines of entry points, for one test."""
    caches = plugins.plugins, plugins.leave_out, tasks.task_of_package, model.get_model_class
    modules = []

    def forget() -> None:
        for cached in caches:
            cached.cache_clear()

    def install_here(name: str, code: str, **entries: str) -> None:
        (tmp_path / f"{name}.py").write_text(code)
        info = tmp_path / f"{name}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 0.1\n"
        )
        groups = [f"[m3gn_bench.{kind}s]\n{entry}\n" for kind, entry in entries.items()]
        (info / "entry_points.txt").write_text("\n".join(groups))
        monkeypatch.syspath_prepend(tmp_path)
        modules.append(name)
        forget()

    yield install_here
    for name in modules:
        sys.modules.pop(name, None)
    monkeypatch.undo()
    forget()


@pytest.fixture
def pendulum(add: Add) -> Any:
    """The example's scene."""
    code = (EXAMPLE / "own_task.py").read_text()
    add("own_task", code, scene=f"{NAME} = own_task:SpringPendulum", task=f"{NAME} = own_task:TASK")
    return get_scene(NAME)


def outcome(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, list[str]]:
    """Exit code, standard output and lines of standard error of a command."""
    with pytest.raises(SystemExit) as stop:
        run(arguments)
    output, errors = capsys.readouterr()
    return int(stop.value.code or 0), output, errors.splitlines()


def test_is_listed_with_every_model(pendulum: Any, capsys: pytest.CaptureFixture[str]) -> None:
    listed = json.loads(outcome(capsys, "list", "--json")[1])
    assert [scene["name"] for scene in listed["scenes"]] == [*OWN_SCENES, NAME]
    (task,) = (task for task in listed["tasks"] if task["name"] == NAME)
    assert (task["title"], task["transitions"]) == ("Spring Pendulum", 40)
    assert task["tiers"]["paper"] == {"train": 200, "validation": 50, "test": 50}
    assert {m["name"] for m in listed["models"] if m["task"] == NAME} == {m["name"] for m in listed["models"]}


@pytest.mark.parametrize("index", range(3))
def test_solver_is_exact(pendulum: Any, index: int) -> None:
    """Tighter tolerances change less than the last digit that is stored; energy is conserved."""
    parameters = draw(pendulum, "test", index, 2025)
    fast, default, reference = (pendulum.simulate(parameters, level) for level in pendulum.fidelities)
    assert np.abs(default.positions - reference.positions).max() < 1e-6
    assert np.abs(fast.positions - reference.positions).max() < 1e-4
    assert reference.diagnostics["energy_drift"] < 1e-9
    assert pendulum.check(fast) == pendulum.check(default) == []
    assert "energy drifts by" in pendulum.check(pendulum.simulate_with(parameters, 0.3))[0]


def test_hanging_straight_and_stiff_it_swings_like_a_rod(pendulum: Any) -> None:
    """The period of small swings is that of a rigid body with the same masses."""
    trajectory = pendulum.simulate_with((1e5, 0.02), 1e-8, 21)
    rest = trajectory.mesh.rest_positions.astype(float)
    centre, inertia = rest.sum(0), (rest**2).sum()
    period = 2 * np.pi * np.sqrt(inertia / (9.81 * np.hypot(*centre)))
    motion = trajectory.positions[:, -1].astype(float) - trajectory.positions[0, -1]
    swing = np.linalg.norm(motion, axis=-1)
    turning = swing.argmax()  # where half a period is over
    assert turning * pendulum.dt == pytest.approx(period / 2, abs=pendulum.dt)


def test_springs_are_the_edges_of_the_mesh(pendulum: Any) -> None:
    own = sys.modules["own_task"]
    edges = mesh_edges(own.TRIANGLES).T
    assert {tuple(edge) for edge in edges if edge[0] < edge[1]} == set(own.SPRINGS)


def test_unknown_names_list_the_plugins(pendulum: Any, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["generate", "bending"], ["leaderboard", "show", "--task", "bending"]):
        code, _, (line,) = outcome(capsys, *arguments)
        assert code == 2
        assert NAME in line.partition("known: ")[2]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["generate", NAME, "--plane", "stress"], "has no options"),
        (["reproduce", NAME], "the scene of another package"),
        (["stability", NAME], f"unknown extremes of scene '{NAME}'; known: deformable_block"),
        (["tradeoff", NAME], f"unknown knobs of task '{NAME}'; known: deformable_block"),
        (["evaluate", "--model", "m3gn", "--task", NAME], "train one and pass --checkpoint"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_what_only_our_own_have(
    pendulum: Any,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    arguments: list[str],
    part: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, output, (line,) = outcome(capsys, *arguments)
    assert (code, output) == (2, "")
    assert part in line
    assert not (tmp_path / "data").exists()


def test_a_factory_with_options_and_a_function_that_gives_the_task(add: Add) -> None:
    code = (EXAMPLE / "own_task.py").read_text() + (
        "\n\ndef scene(masses: int = NODES) -> SpringPendulum:\n    return SpringPendulum()\n"
        "\n\ndef task() -> Task:\n    return TASK\n"
    )
    add("own_task", code, scene=f"{NAME} = own_task:scene", task=f"{NAME} = own_task:task")
    assert get_scene(NAME, masses=5).name == NAME
    assert TASKS[NAME].title == "Spring Pendulum"
    with pytest.raises(plugins.PluginError, match=r"package own-task .* unknown option .*known: masses"):
        get_scene(NAME, springs=5)


# --- packages that cannot be used -------------------------------------------------------------------------


@pytest.fixture
def broken(add: Add) -> None:
    """Two packages: one that cannot be imported, and one whose scene and task are none."""
    entries = {kind: f"absent_{kind} = no_import:X" for kind in ("scene", "task", "model")}
    add("no_import", "import a_library_that_is_not_there", **entries)
    add("no_scene", "X = int", scene="zero = no_scene:X", task="zero = no_scene:X")


def test_others_go_on(broken: None, caplog: pytest.LogCaptureFixture) -> None:
    """All that iterates does without them, and says so once."""
    for _ in range(2):
        assert list(TASKS) == [task.name for task, _ in usable_tasks()] == list(OWN_TASKS)
        assert list(usable_scenes()) == list(OWN_SCENES)
        assert "absent_model" not in model.usable_models()
    assert len(caplog.messages) == 5
    for kind in ("scene", "task", "model"):
        (line,) = (message for message in caplog.messages if f"absent_{kind}" in message)
        assert f"{kind} 'absent_{kind}' of the package no-import cannot be used" in line
        assert "No module named 'a_library_that_is_not_there'" in line


def test_list_goes_on(broken: None, capsys: pytest.CaptureFixture[str]) -> None:
    code, output, _ = outcome(capsys, "list", "--json")
    assert code == 0
    assert [task["name"] for task in json.loads(output)["tasks"]] == list(OWN_TASKS)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["generate", "absent_scene"], ["no-import", "a_library_that_is_not_there"]),
        (["leaderboard", "show", "--task", "absent_task"], ["no-import", "a_library_that_is_not_there"]),
        (["evaluate", "--model", "absent_model"], ["no-import", "a_library_that_is_not_there"]),
        (["generate", "zero"], ["no-scene", "it is no Task"]),
        (["leaderboard", "show", "--task", "zero"], ["no-scene", "it is no Task but of type int"]),
    ],
    ids=lambda value: " ".join(value[-2:]) if isinstance(value[0], str) else None,
)
def test_one_line_names_the_package(
    broken: None, capsys: pytest.CaptureFixture[str], arguments: list[str], parts: list[str]
) -> None:
    code, output, (line,) = outcome(capsys, *arguments)
    assert (code, output) == (2, "")
    for part in parts:
        assert part in line


def test_the_doctor_finds_them(broken: None, pendulum: Any) -> None:
    found = {(f.part, f.name): f.state for f in doctor.packages()}
    assert found == {
        ("scene", NAME): "fine",
        ("task", NAME): "fine",
        ("scene", "zero"): "wrong",
        ("task", "zero"): "wrong",
        **{(kind, f"absent_{kind}"): "wrong" for kind in ("scene", "task", "model")},
    }


def test_a_name_of_ours_is_taken(add: Add, caplog: pytest.LogCaptureFixture) -> None:
    code = (EXAMPLE / "own_task.py").read_text()
    add("own_task", code, scene="deformable_block = own_task:SpringPendulum", task="other = own_task:TASK")
    assert get_scene("deformable_block").length_unit == "mm"
    usable_scenes()
    assert "deformable_block" in caplog.messages[0]
    assert "the name is taken" in caplog.messages[0]
    with pytest.raises(plugins.PluginError, match="calls itself 'spring_pendulum'"):
        TASKS["other"]


def test_a_model_of_ours_is_not_replaced(add: Add, caplog: pytest.LogCaptureFixture) -> None:
    """Packages whose place on the path is before ours; and of two others that take the same name, one has it."""
    ours, packages = model.get_model_class("mgn"), {"taker-one", "taker-two"}
    for name in ("taker_one", "taker_two"):
        add(name, "class X: ...", model=f"mgn = {name}:X\nshared = {name}:X")
    assert model.get_model_class("mgn") is ours
    left_out = {("mgn", package) for package in packages}
    left_out |= {("shared", package) for package in packages - {plugins.package_of("model", "shared")}}
    assert len(left_out) == 3
    assert sorted(caplog.messages) == sorted(
        f"warning: left out: model '{name}' of the package {package}: the name is taken"
        for name, package in left_out
    )


def test_is_short() -> None:
    """Fewer than 80 lines of code, as promised."""
    lines = (EXAMPLE / "own_task.py").read_text().splitlines()
    code = [line for line in lines if line.strip() and not line.strip().startswith(('"""', "#"))]
    assert len(code) < 80
