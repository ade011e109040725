"""Whatever is wrong with what a user asks for or hands in: one clear line and an exit code, no traceback."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from conftest import TetraWriter

from m3gn_bench.cli import run
from m3gn_bench.console import Report, table
from m3gn_bench.datasets.file import open_file, read_metadata
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.datasets.writer import reserved

TASK = "sheet_deformation"


class Outcome(NamedTuple):
    """Of a command."""

    code: int
    output: str
    errors: str


Command = Callable[..., Outcome]


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> Outcome:
    """Run the command line in this process; anything but SystemExit would be a traceback to the user."""
    with pytest.raises(SystemExit) as stop:
        run([str(argument) for argument in arguments])
    output, errors = capsys.readouterr()
    return Outcome(int(stop.value.code or 0), output, errors)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs the command line."""
    return lambda *arguments: call(capsys, *arguments)


def assert_one_line(outcome: Outcome, *parts: str) -> None:
    """Exit code 2, nothing on standard output, one line on standard error that holds the parts."""
    assert (outcome.code, outcome.output) == (2, "")
    (line,) = (
        line for line in outcome.errors.splitlines() if line and not line.startswith(("Usage:", "Try "))
    )
    assert line.lower().startswith("error: ")
    for part in parts:
        assert part in line


# --- names and values that do not exist -------------------------------------------------------------------

TRAIN = ["train", "--task", TASK, "--model", "m3gn", "--preset", "smoke", "--tier", "smoke", "--out", "run"]
EVALUATE = ["evaluate", "--task", TASK, "--model", "m3gn", "--tier", "smoke"]


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["generate", "bending"], ["scene 'bending'", "known: deformable_block, falling_teddy,"]),
        (["generate", TASK, "--solver", "explicit"], [f"{TASK} has no options", "'solver'"]),
        (["generate", "falling_teddy", "--solver", "x"], ["solver 'x'", "known: explicit, newton-vbd"]),
        (["generate", "falling_teddy", "--device", "x"], ["device 'x'", "known: cpu, cuda"]),
        (
            ["generate", "mixed_objects", "--mesh", "x.stl"],
            ["of mixed_objects 'mesh'", "known: device, solver"],
        ),
        (["generate", "falling_teddy", "--mesh", "absent.stl"], ["absent.stl", "no such file"]),
        (["generate", "deformable_block", "--plane", "flat"], ["plane 'flat'", "known: strain, stress"]),
        (["reproduce", "bending"], ["scene 'bending'", "known: deformable_block, falling_teddy,"]),
        (["reproduce", TASK, "--tier", "huge"], ["tier huge"]),
        (["generate", TASK, "--tier", "huge"], ["tier 'huge'", "known: paper, quick, smoke"]),
        (["generate", TASK, "--fidelity", "best"], ["fidelity 'best'", "known: default, fast, reference"]),
        (["generate", TASK, "--split", "dev"], ["split 'dev'", "known: test, train, validation"]),
        (["generate", TASK, "--workers", "0"], ["0 is not in the range x>=1"]),
        (["generate", TASK, "--workers", "two"], ["'two' is not a valid integer"]),
        (["generate", TASK, "--seed", "-1"], ["--seed"]),
        (["generate", TASK, "--seed", str(2**63)], ["--seed", "0<=x<=9223372036854775807"]),
        ([*TRAIN, "--task", "bending"], ["task 'bending'", "known: deformable_block, falling_teddy,"]),
        ([*TRAIN, "--model", "gpt"], ["model 'gpt'", "known: ", "m3gn, ", "mgn"]),
        ([*TRAIN, "--preset", "big"], ["preset 'big'", "known: compact, paper, smoke"]),
        ([*TRAIN, "--steps", "1", "--tier", "huge"], ["tier 'huge'", "known: paper, quick, smoke"]),
        ([*TRAIN, "--set", "training.foo=1"], ["'training.foo'", "known: ", "training.learning_rate"]),
        ([*TRAIN, "--set", "model.foo=1"], ["'model.foo'", "known: ", "model.width"]),
        ([*TRAIN, "--set", "training.learning_rate=-1"], ["learning_rate", "greater than 0"]),
        ([*TRAIN, "--set", "training.learning_rate=high"], ["TOML"]),
        ([*TRAIN, "--set", "training.learning_rate"], ["KEY=VALUE"]),
        ([*TRAIN, "--seed", str(2**63)], ["--seed", "0<=x<=9223372036854775807"]),
        ([*TRAIN, "--steps", "0"], ["steps", "greater than 0"]),
        ([*EVALUATE, "--task", "bending"], ["task 'bending'", "known: deformable_block, falling_teddy,"]),
        ([*EVALUATE, "--model", "gpt"], ["model 'gpt'", "known: ", "m3gn, ", "mgn"]),
        ([*EVALUATE, "--split", "dev"], ["split 'dev'", "known: test, train, validation"]),
        ([*EVALUATE, "--preset", "big"], ["preset 'big'", "known: compact, paper, smoke"]),
        (
            [*EVALUATE, "--seed", "9"],
            ["seed 9", "--checkpoint", "seed 0, there are ", "mgn_material"],
        ),
        ([*EVALUATE, "--contexts", "2,51"], ["context size 51 is out of range"]),
        (
            ["profile", "--task", TASK, "--model", "mgn", "--preset", "big"],
            ["preset 'big'", "known: compact, paper"],
        ),
        (
            ["profile", "--task", TASK, "--model", "mgn", "--context", "51"],
            ["context size 51 is out of range"],
        ),
        (["leaderboard", "render", "--home", "typo"], ["'typo' does not exist"]),
        (["leaderboard", "submit", "some.json", "--home", "typo"], ["there is no leaderboard typo"]),
        (
            ["leaderboard", "show", "--task", "bending"],
            ["task 'bending'", "known: deformable_block, falling_teddy,"],
        ),
        (["simulate"], ["No such command 'simulate'"]),
        (["generate"], ["Missing argument 'SCENE'"]),
        (["info", "absent.h5"], ["no dataset file at absent.h5"]),
        (["validate", "absent.h5"], ["no dataset file at absent.h5"]),
    ],
    ids=lambda value: " ".join(value[-2:]) if isinstance(value, list) else None,
)
def test_unknown_names_list_what_exists(
    command: Command, arguments: list[str], parts: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # an empty folder, so nothing but the arguments can be at fault
    assert_one_line(command(*arguments), *parts)
    assert list(tmp_path.iterdir()) == []


def test_no_budget(command: Command, smoke_file: Path, tmp_path: Path) -> None:
    outcome = command(*TRAIN[:-1], tmp_path, "--data", smoke_file.parent)
    assert_one_line(outcome, "budget", "training.minutes", "training.steps")


def test_folder_of_data_is_a_file(command: Command, smoke_file: Path) -> None:
    assert_one_line(command("generate", TASK, "--tier", "smoke", "--out", smoke_file), "is a file")


# --- files that are no datasets ---------------------------------------------------------------------------


def not_a_number(key: str, trajectory: Trajectory) -> Trajectory:
    trajectory.positions[1, 1, 1] = np.nan
    return trajectory


def inverted(key: str, trajectory: Trajectory) -> Trajectory:
    trajectory.mesh.cells[:] = trajectory.mesh.cells[:, [1, 0, 2, 3]]
    return trajectory


@pytest.fixture(scope="module")
def bad_files(
    tmp_path_factory: pytest.TempPathFactory, write_tetra: TetraWriter, tetra_metadata: Metadata
) -> Path:
    """A folder of damaged and foreign files."""
    folder = tmp_path_factory.mktemp("bad")
    valid = write_tetra(folder / "valid.h5")
    content = valid.read_bytes()
    (folder / "truncated").write_bytes(content[: len(content) // 2])
    (folder / "text").write_text("positions,1,2,3\n")
    with h5py.File(folder / "foreign", "w") as file:
        file["data"] = np.arange(3)
    with h5py.File(valid) as file:
        offset = file["trajectories/train_00001/positions"].id.get_chunk_info(0).byte_offset
    (folder / "bit-flipped").write_bytes(
        content[: offset + 40] + bytes([content[offset + 40] ^ 1]) + content[offset + 41 :]
    )
    shutil.copy(valid, folder / "wrong-version")
    with h5py.File(folder / "wrong-version", "r+") as file:
        file.attrs["schema_version"] = 99
    shutil.copy(valid, folder / "damaged-attribute")
    with h5py.File(folder / "damaged-attribute", "r+") as file:
        file.attrs["tier"] = "huge"
    write_tetra(folder / "nan", change=not_a_number)
    write_tetra(folder / "negative-volume", change=inverted)
    return folder


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("truncated", "E001 */: .*truncated or damaged"),
        ("text", "E001 */: .*cannot be opened as HDF5"),
        ("foreign", "E001 */: .*no m3gn-bench dataset"),
        ("bit-flipped", "E003 */trajectories/train_00001: .*damaged"),
        ("wrong-version", "E001 */: .*schema version 99, this m3gn-bench reads 1"),
        ("damaged-attribute", "E002 */: .*root attributes: tier"),
        ("nan", "E005 */trajectories/test_00000: positions holds 1 numbers that are not finite"),
        ("negative-volume", r"E007 */trajectories/test_00000: .*volume -0\.\d+"),
    ],
)
def test_validate_names_the_problem(command: Command, bad_files: Path, name: str, message: str) -> None:
    outcome = command("validate", bad_files / name)
    assert (outcome.code, outcome.errors) == (1, "")
    first, *_, last = outcome.output.splitlines()
    assert re.match(message, first), first
    assert last.endswith("NOT valid")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("truncated", "truncated or damaged"),
        ("text", "cannot be opened as HDF5"),
        ("foreign", "no m3gn-bench dataset"),
        ("wrong-version", "schema version 99"),
        ("damaged-attribute", "root attributes: tier"),
        (".", "is a folder; name a file in it: valid.h5"),
    ],
)
def test_info_of_files_that_are_no_datasets(
    command: Command, bad_files: Path, name: str, message: str
) -> None:
    assert_one_line(command("info", bad_files / name), message, str(bad_files / name))


@pytest.mark.parametrize("arguments", [["info"], ["validate"], ["export", "--format", "npz"]])
@pytest.mark.parametrize(
    ("files", "message"),
    [
        ([], r"{} is a folder without dataset files \(\*\.h5\); make one with 'm3gn-bench generate'$"),
        (["b.h5", "a.h5", "notes.txt"], r"{} is a folder; name a file in it: a\.h5, b\.h5$"),
        ([f"{k}.h5" for k in range(7)], r"{} is a folder; .*: 0\.h5, 1\.h5, 2\.h5, 3\.h5, 4\.h5 and 2 more$"),
    ],
    ids=["none", "two", "seven"],
)
def test_a_folder_where_a_file_is_needed(
    command: Command, arguments: list[str], files: list[str], message: str, tmp_path: Path
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    for name in files:
        (folder / name).touch()
    outcome = command(*arguments, folder)
    assert_one_line(outcome, str(folder))
    assert re.search(message.format(re.escape(str(folder))), outcome.errors.strip()), outcome.errors
    assert sorted(path.name for path in folder.iterdir()) == sorted(files)


# --- checkpoints ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, smoke_file: Path) -> Path:
    """A checkpoint of the smallest M3GN after two steps."""
    folder = tmp_path_factory.mktemp("run")
    arguments = [*TRAIN[:-1], str(folder), "--steps", "2", "--data", str(smoke_file.parent)]
    with pytest.raises(SystemExit) as stop:
        run([*arguments, "--set", "training.validation_trajectories=1"])
    assert not stop.value.code
    return folder


@pytest.fixture
def checkpoint(trained: Path, tmp_path: Path) -> Path:
    """A checkpoint that a test may damage."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def edit_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "parts"),
    [
        (lambda folder: shutil.rmtree(folder), ["no checkpoint in"]),
        (lambda folder: (folder / "checkpoint.json").unlink(), ["checkpoint.json is missing"]),
        (lambda folder: (folder / "checkpoint.json").write_text("{"), ["checkpoint.json is damaged"]),
        (
            lambda folder: (folder / "checkpoint.json").write_bytes(b"\xff\x00"),
            ["checkpoint.json is damaged"],
        ),
        (lambda folder: (folder / "weights.safetensors").unlink(), ["cannot read", "weights.safetensors"]),
        (lambda folder: flip_bit(folder / "weights.safetensors"), ["does not match the SHA-256"]),
        (
            lambda folder: edit_json(folder / "checkpoint.json", lambda r: r["config"].pop("model_name")),
            ["config.model_name"],
        ),
        (
            lambda folder: edit_json(folder / "checkpoint.json", lambda r: r["config"].pop("training")),
            ["config.training"],
        ),
        (
            lambda folder: edit_json(
                folder / "checkpoint.json", lambda r: r["config"]["model"].update(width=8)
            ),
            ["does not fit this version"],
        ),
        (
            lambda folder: edit_json(
                folder / "checkpoint.json", lambda r: r["config"]["model"].update(foo=8)
            ),
            ["does not fit this version"],
        ),
    ],
    ids=[
        "no folder",
        "no description",
        "description cut off",
        "description binary",
        "no weights",
        "weights damaged",
        "description without model",
        "description without training",
        "other width",
        "unknown parameter",
    ],
)
def test_damaged_checkpoints(
    command: Command,
    checkpoint: Path,
    smoke_file: Path,
    damage: Callable[[Path], object],
    parts: list[str],
) -> None:
    damage(checkpoint)
    outcome = command(*EVALUATE, "--checkpoint", checkpoint, "--data", smoke_file.parent, "--threads", 1)
    assert_one_line(outcome, *parts)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--model", "mgn"], ["holds a m3gn, not a mgn"]),
        (["--task", "sheet_deformation_ood"], ["trained on sheet_deformation, not on sheet_deformation_ood"]),
        (["--seed", "3"], ["is of seed 0, not of 3"]),
        (["--preset", "paper"], ["is of preset smoke, not of paper"]),
        (["--track", "my track"], ["--track 'my track': letters, digits and any of . - _ make file names"]),
        (["--contexts", "1"], ["context size 1 is out of range", "51 frames", "2 to 50"]),
        (["--contexts", "51"], ["context size 51 is out of range", "2 to 50"]),
        (["--contexts", "2,-3"], ["context size -3 is out of range"]),
        (["--contexts", "a,b"], ["--contexts 'a,b' is no list of numbers"]),
        (["--contexts", ""], ["--contexts '' is no list of numbers"]),
        (["--tier", "huge"], ["tier 'huge'", "known: paper, quick, smoke"]),
        (["--device", "cuda:99"], ["device 'cuda:99' cannot be used"]),
    ],
    ids=lambda value: " ".join(value) if "--" in value[0] else None,
)
def test_evaluate_refuses(
    command: Command, trained: Path, smoke_file: Path, arguments: list[str], parts: list[str]
) -> None:
    outcome = command(
        *EVALUATE, "--checkpoint", trained, "--data", smoke_file.parent, "--threads", 1, *arguments
    )
    assert_one_line(outcome, *parts)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--threads", "0"], ["threads"]),
        (["--device", "abacus"], ["device", "abacus"]),
        (["--device", "meta"], ["device 'meta' cannot be used"]),
        (["--device", "cuda:99"], ["device", "cuda:99"]),
        (["--seed", "-1"], ["seed"]),
    ],
    ids=lambda value: " ".join(value) if value[0].startswith("--") else None,
)
def test_train_refuses(
    command: Command, smoke_file: Path, tmp_path: Path, arguments: list[str], parts: list[str]
) -> None:
    data = ["--data", smoke_file.parent, "--steps", 2]
    assert_one_line(command(*TRAIN[:-1], tmp_path / "run", *data, *arguments), *parts)


def test_training_does_not_overwrite_another_run(command: Command, trained: Path, smoke_file: Path) -> None:
    before = (trained / "checkpoint.json").read_bytes()
    outcome = command(*TRAIN[:-1], trained, "--steps", 3, "--data", smoke_file.parent)
    assert_one_line(outcome, "another finished run", "use another folder")
    assert (trained / "checkpoint.json").read_bytes() == before


def test_a_folder_is_trained_in_once_at_a_time(command: Command, smoke_file: Path, tmp_path: Path) -> None:
    with reserved(tmp_path / "run", "trains", tmp_path / "run"):
        outcome = command(*TRAIN[:-1], tmp_path / "run", "--steps", 2, "--data", smoke_file.parent)
    assert_one_line(outcome, "another process trains in", "wait until it has finished")
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_can_be_written_nothing_is_simulated(
    command: Command, trained: Path, tmp_path: Path
) -> None:
    """Refused before the work, not after it."""
    (tmp_path / "file").touch()
    below, data = tmp_path / "file" / "folder", ["--data", tmp_path / "data"]
    evaluate = [*EVALUATE, "--checkpoint", trained, "--record", below, "--variant", "short"]
    studies = [[study, "sheet_deformation", "--record", below] for study in ("tradeoff", "stability")]
    figure = ["tradeoff", "sheet_deformation", "--output", below / "figure.svg"]
    for arguments in ([*TRAIN[:-1], below, "--steps", 2], evaluate, *studies, figure):
        assert_one_line(command(*arguments, *data), "cannot write to", "folder", "Not a directory")
        assert not (tmp_path / "data").exists()


def test_damaged_data_is_not_trained_on(command: Command, smoke_file: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    copy = Path(shutil.copy(smoke_file, data))
    with h5py.File(copy, "r+") as file:
        file["trajectories/train_00003/loads/nodal_forces"][100, 2] += np.float32(1)
    outcome = command(*TRAIN[:-1], tmp_path / "run", "--steps", 2, "--data", data)
    assert_one_line(outcome, "train_00003 does not match its content hash")
    assert not (tmp_path / "run").exists()


# --- output for programs ----------------------------------------------------------------------------------


def parse(outcome: Outcome, code: int = 0) -> dict[str, Any]:
    """The one JSON object that is all of standard output."""
    assert (outcome.code, outcome.errors) == (code, "")
    record = json.loads(outcome.output)
    assert isinstance(record, dict)
    return record


SCENES = {  # training trajectories of the paper tier
    "sheet_deformation": 630,
    "deformable_block": 675,
    "tissue_manipulation": 600,
    "falling_teddy": 700,
    "mixed_objects": 1800,
}


@pytest.mark.parametrize("terminal", [False, True])
def test_no_table_is_cut_by_a_narrow_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, terminal: bool
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sys.stdout.isatty", lambda: terminal)
    numbers = [f"{number}.2345e-06" for number in range(30)]
    Report(as_json=False).finish({}, table("errors [mm]", ["model", *numbers], [["m3gn", *numbers]]))
    title, *rows = capsys.readouterr().out.splitlines()
    assert "errors [mm]" in title
    for number in numbers:
        assert sum(number in row for row in rows) == 2


def test_list_as_json(command: Command) -> None:
    record = parse(command("list", "--json"))
    assert {scene["name"]: scene["sizes"]["train"] for scene in record["scenes"]} == SCENES
    assert record["tiers"] == ["smoke", "quick", "paper"]
    tasks = {task["name"]: task for task in record["tasks"]}
    assert set(tasks) == {*SCENES, "sheet_deformation_ood"}
    assert tasks[TASK]["tiers"]["paper"] == {"train": 630, "validation": 135, "test": 135}
    models = {(m["name"], m["preset"], m["task"]): m["parameters"] for m in record["models"]}
    names = {name for name, *_ in models}
    assert {"m3gn", "mgn", "stand_still"} <= names
    assert len(models) == len(record["models"]) == len(names) * 3 * len(tasks)
    assert models["stand_still", "paper", TASK] == 0
    assert 0 < models["m3gn", "smoke", TASK] < models["m3gn", "compact", TASK] < models["m3gn", "paper", TASK]


def test_generate_as_json(command: Command, smoke_file: Path, tmp_path: Path) -> None:
    arguments = ["generate", TASK, "--tier", "smoke", "--split", "test", "--workers", 1, "--out", tmp_path]
    record = parse(command(*arguments, "--fidelity", "fast", "--json"))
    path = Path(record["file"])
    assert path == tmp_path / "sheet_deformation-smoke-test-fast.h5"
    assert (record["trajectories"], record["generated"], record["rejected"]) == (4, 4, [])
    assert record["cpu_seconds_per_trajectory"] > 0
    assert record["megabytes"] == pytest.approx(path.stat().st_size / 1e6)
    with open_file(path) as file:
        assert record["content_hash"] == read_metadata(file).content_hash


def test_validate_as_json(command: Command, smoke_file: Path, bad_files: Path) -> None:
    record = parse(command("validate", smoke_file, "--strict", "--json"))
    assert record == {"file": str(smoke_file), "trajectories": 16, "ok": True, "problems": []}
    record = parse(command("validate", bad_files / "bit-flipped", "--json"), code=1)
    assert record["ok"] is False
    assert record["problems"][0]["code"] == "E003"
    assert record["problems"][0]["where"] == "/trajectories/train_00001"
    assert all(set(problem) == {"code", "where", "message"} for problem in record["problems"])


def test_info_as_json(command: Command, smoke_file: Path) -> None:
    record = parse(command("info", smoke_file, "--json"))
    with open_file(smoke_file) as file:
        metadata = read_metadata(file)
    assert record["content_hash"] == metadata.content_hash
    assert record["tier_hashes"] == {"smoke": metadata.content_hash}
    assert (record["scene"], record["seed"], record["frames"], record["transitions"]) == (TASK, 2025, 51, 50)
    assert record["splits"][TASK] == {"train": 8, "validation": 4, "test": 4}
    assert set(record["simulator_versions"]) == {"scikit-fem", "scipy", "numpy"}


def test_train_and_evaluate_as_json(command: Command, trained: Path, smoke_file: Path) -> None:
    data = ["--data", smoke_file.parent, "--json"]
    settings = ["--steps", 2, "--set", "training.validation_trajectories=1"]
    record = parse(command(*TRAIN[:-1], trained, *settings, *data))  # done already: tells of what is there
    assert (record["checkpoint"], record["steps"]) == (str(trained), 2)
    scores = parse(command(*EVALUATE, "--checkpoint", trained, *data, "--threads", 1, "--contexts", "2,50"))
    assert [(row["context"], row["trajectories"]) for row in scores["results"]] == [(2, 4), (50, 4)]
    assert all(0 < row["mse"] < row["mse_free_nodes"] for row in scores["results"])
