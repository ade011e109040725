"""Records, tables, and the check: it must pass on the truth and fail on every planted error."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from safetensors.torch import load_file, save_file

from m3gn_bench import leaderboard_commands, sources
from m3gn_bench.checkpoint import read_description
from m3gn_bench.cli import run
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.generators import sheet_deformation
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.leaderboard import check, consistency, record, render, submission, summary
from m3gn_bench.leaderboard.record import ResultRecord, checkpoint_folder, read_records, write_record
from m3gn_bench.metrics import TrajectoryErrors
from m3gn_bench.model import RunConfig
from m3gn_bench.tasks import get_task


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory, smoke_file: Path) -> Path:
    """A leaderboard of two models, made by the commands that make the real one."""
    home = tmp_path_factory.mktemp("board")
    data = ["--data", str(smoke_file.parent), "--tier", "smoke"]
    for model in ("mgn", "stand_still"):
        folder = checkpoint_folder("sheet_deformation", model, "smoke", home=home)
        task = ["--task", "sheet_deformation", "--model", model]
        for command in (
            ["train", *task, *data, "--preset", "smoke", "--steps", "3", "--out", str(folder)],
            ["evaluate", *task, *data, "--checkpoint", str(folder), "--record", str(home), "--track", "test"],
        ):
            with pytest.raises(SystemExit) as stop:
                run(command)
            assert not stop.value.code
    return home


@pytest.fixture(autouse=True)
def fresh_simulations() -> Iterator[None]:
    """Planted errors in a generator must not survive in the cache, nor the truth hide them."""
    sources._simulate.cache_clear()
    yield
    sources._simulate.cache_clear()


def run_check(records: list[ResultRecord], home: Path) -> check.CheckReport:
    return check.check_records(records, trajectories=1, offset=0, home=home)


def test_check_rederives_every_number(board: Path) -> None:
    report = run_check(read_records(board), board)
    assert report.ok, report
    assert len(report.compared) == 2 * 3  # models, context sizes
    assert all(c.same_trajectory for c in report.compared)


def test_planted_error_in_a_record_is_found(board: Path) -> None:
    """One percent on everything at one context size: consistent in itself, so only re-deriving finds it."""
    records = read_records(board)
    wrong = records[0].model_dump()
    result = wrong["results"][1]
    for name in ("mse", "mse_free_nodes"):
        result[name] *= 1.01
    for name in ("per_timestep_mse", "trajectory_mse", "trajectory_mse_free_nodes"):
        result[name] = [1.01 * value for value in result[name]]
    report = run_check([ResultRecord.model_validate(wrong), *records[1:]], board)
    assert not report.ok
    assert sum(not c.ok for c in report.compared) == 1


@pytest.mark.parametrize("name", ["mse", "mse_free_nodes", "per_timestep_mse", "trajectory_mse"])
def test_numbers_that_do_not_follow_from_the_errors_are_refused(board: Path, name: str) -> None:
    wrong = read_records(board)[0].model_dump()
    value = wrong["results"][1][name]
    wrong["results"][1][name] = 1.01 * value if isinstance(value, float) else [1.01 * v for v in value]
    with pytest.raises(ValidationError, match="does not follow"):
        ResultRecord.model_validate(wrong)


def test_diverging_predictions_are_named() -> None:
    """A model that blows up is a finding for its author, not a traceback and not a record."""
    errors = np.array([1.0, np.nan, np.inf])
    with pytest.raises(BenchError, match="context 5 the predictions of 2 of 3"):
        record.ContextResult.from_errors(5, TrajectoryErrors(errors, errors, errors[:, None]))


def test_a_record_needs_one_error_per_trajectory(board: Path) -> None:
    wrong = read_records(board)[0].model_dump()
    wrong["keys"] = wrong["keys"][:-1]
    with pytest.raises(ValidationError, match="differ in number"):
        ResultRecord.model_validate(wrong)


def test_planted_error_in_a_generator_is_found(board: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sheet_deformation, "THICKNESS", 2.02)
    report = run_check(read_records(board), board)
    assert not report.ok
    assert not any(c.same_trajectory for c in report.compared)


def test_planted_error_in_weights_is_found(board: Path, tmp_path: Path) -> None:
    """A checkpoint that was replaced is not the recorded one, even if it is consistent in itself."""
    shutil.copytree(board / "checkpoints", tmp_path / "checkpoints")
    path = checkpoint_folder("sheet_deformation", "mgn", "smoke", home=tmp_path) / "weights.safetensors"
    weights = load_file(path)
    weights["simulator.network.readout.bias"] += 1e-3
    save_file(weights, path)
    report = run_check([one for one in read_records(board) if one.model == "mgn"], tmp_path)
    assert not report.ok
    (problem,) = report.problems
    assert "SHA-256" in problem


def test_a_model_that_is_not_there_is_named(board: Path, tmp_path: Path) -> None:
    """Beside what else was found."""
    honest = next(r for r in read_records(board) if r.model == "stand_still")
    shutil.copytree(board / "checkpoints", tmp_path / "checkpoints")
    original, copied = (
        checkpoint_folder("sheet_deformation", model, "smoke", home=tmp_path)
        for model in ("stand_still", "gone")
    )
    shutil.copytree(original, copied)
    description = copied / "checkpoint.json"
    description.write_text(description.read_text().replace('"stand_still"', '"gone"'))
    gone = honest.model_copy(update={"model": "gone"})
    report = run_check([gone, honest], tmp_path)
    assert len(report.compared) == 3
    (problem,) = report.problems
    assert "unknown model 'gone'" in problem


def test_planted_error_in_a_model_is_found(board: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from m3gn_bench.baselines.mgn import StepSimulator

    original = StepSimulator.forward
    monkeypatch.setattr(StepSimulator, "forward", lambda self, *args: 1.1 * original(self, *args))
    report = run_check([r for r in read_records(board) if r.model == "mgn"], board)
    assert not report.ok


def fewer(values: dict[str, Any], count: int) -> dict[str, Any]:
    """Only the trajectories of lowest error, consistent in itself."""
    kept = np.argsort(values["results"][1]["trajectory_mse"])[:count]
    for name in ("keys", "trajectory_hashes"):
        values[name] = [values[name][place] for place in kept]
    for result in values["results"]:
        for name in ("trajectory_mse", "trajectory_mse_free_nodes"):
            result[name] = [result[name][place] for place in kept]
        mean = float(np.mean(result["trajectory_mse"]))
        result["per_timestep_mse"] = [mean * x / result["mse"] for x in result["per_timestep_mse"]]
        result["mse"], result["mse_free_nodes"] = mean, float(np.mean(result["trajectory_mse_free_nodes"]))
    return values


def described(values: dict[str, Any], **changes: object) -> dict[str, Any]:
    """With other statements of its checkpoint."""
    return values | {"checkpoint": values["checkpoint"] | changes}


@pytest.mark.parametrize(
    ("plant", "reason"),
    [
        (lambda values: fewer(values, 2), "number of trajectories: 2, not 4"),
        (lambda values: values | {"dataset_version": "9.9"}, "dataset version: 9.9"),
        (lambda values: values | {"parameters": 7}, "parameters: 7"),
        (lambda values: values | {"seed": 3}, "checkpoint's task, model, preset and seed"),
        (lambda values: values | {"results": values["results"][1:]}, "context sizes"),
        (lambda values: values | {"split": "exam"}, "unknown split 'exam'"),
        (lambda values: described(values, best_step=4), "best_step: 4, not one of 3 steps"),
        (lambda values: described(values, best_step=-1), "best_step: -1, not one of 3 steps"),
        (lambda values: described(values, minutes=-1.0), "minutes: -1.0, not a time that training takes"),
        (lambda values: described(values, minutes=np.inf), "minutes: inf, not a time that training takes"),
        (lambda values: described(values, minutes=np.nan), "minutes: nan, not a time that training takes"),
        (
            lambda values: values | {"keys": [f"train_{index:05}" for index in range(4)]},
            "trajectories: train_00000 is none of the test split of tier smoke",
        ),
    ],
)
def test_what_a_record_says_wrongly_of_itself_is_found(
    board: Path, plant: Callable[[Any], Any], reason: str
) -> None:
    """Every number that is left is right, so comparing them would not tell."""
    honest = next(r for r in read_records(board) if r.model == "mgn")
    assert check.check_statements([honest]) == []
    (problem,) = check.check_statements([honest, ResultRecord.model_validate(plant(honest.model_dump()))])
    assert reason in problem


@pytest.mark.parametrize(
    ("model", "plant", "options", "kinds", "reason"),
    [
        ("stand_still", lambda one: one, [], {"shipped checkpoint", "trained again"}, None),
        ("constant_velocity", lambda one: one, [], {"shipped checkpoint"}, "there is no record of it"),
        (
            "stand_still",
            lambda one: one.model_copy(update={"dataset_version": "9.9"}),
            ["--no-retrain"],
            {"shipped checkpoint"},
            "dataset version: 9.9",
        ),
        (
            "stand_still",
            lambda one: with_errors(one, 0, 1.01),
            ["--no-retrain"],
            {"shipped checkpoint"},
            "recorded and re-derived differ",
        ),
    ],
    ids=["nothing", "a run without a record", "a statement", "errors"],
)
def test_the_command_fails_where_a_record_does(
    board: Path,
    smoke_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    plant: Callable[[ResultRecord], ResultRecord],
    options: list[str],
    kinds: set[str],
    reason: str | None,
) -> None:
    """By its exit code, which CI goes by, whatever is wrong."""
    home = tmp_path / "home"
    shutil.copytree(board, home, ignore=shutil.ignore_patterns("mgn-*"))  # whose rollouts take long
    plan = home / "plans" / "smoke.toml"
    plan.parent.mkdir()
    plan.write_text(
        'track = "test"\ntier = "smoke"\n[[runs]]\ntasks = ["sheet_deformation"]\n'
        f'models = ["{model}"]\npreset = "smoke"\nshipped_seeds = [0]\n'
    )
    if reason is not None:  # else the data are made for training, too, as users have it
        monkeypatch.setattr(sources, "find_or_generate", lambda *_, **__: smoke_file)
    (honest,) = read_records(home)
    write_record(plant(honest), home)
    command = ["leaderboard", "check", "--home", str(home), "--trajectories", "1", "--offset", "0"]
    with pytest.raises(SystemExit) as stop:
        run([*command, "--workers", "1", "--json", *options])
    outcome = json.loads(capsys.readouterr().out)
    assert (stop.value.code, outcome["ok"]) == ((0, True) if reason is None else (1, False))
    assert {c["kind"] for c in outcome["compared"]} == kinds
    different = sum(not c["ok"] for c in outcome["compared"])
    assert different in (0, 3)  # none, or one trajectory at every context size
    found = [*outcome["problems"], *["recorded and re-derived differ"] * bool(different)]
    assert len(found) == (reason is not None)
    assert all(str(reason) in problem for problem in found)


def test_a_board_without_a_plan_is_checked(
    board: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its checkpoints are; there is nothing to train again."""
    home = tmp_path / "home"
    shutil.copytree(board, home, ignore=shutil.ignore_patterns("mgn-*"))
    with pytest.raises(SystemExit) as stop:
        run(["leaderboard", "check", "--home", str(home), "--trajectories", "1", "--json"])
    outcome = json.loads(capsys.readouterr().out)
    assert (stop.value.code, outcome["problems"]) == (0, [])
    assert [(one["run"], one["kind"]) for one in outcome["compared"]] == [
        ("stand_still-smoke-s0", "shipped checkpoint")
    ] * 3


@pytest.mark.parametrize("count", [1, 2, 5, 12, 99])
def test_repeated_checks_sample_every_record(count: int) -> None:
    """At most so many at a time, of several tasks where there are several, and none left out by all."""
    records = [r for r in read_records() if r.ships]
    turns = -(-len(records) // count)
    samples = [check.sample(records, count, offset)[0] for offset in range(739_000, 739_000 + turns)]
    assert all(0 < len(chosen) <= count for chosen in samples)
    assert sorted(r.task + r.name for chosen in samples for r in chosen) == sorted(
        r.task + r.name for r in records
    )
    if count == 12:
        assert all(len({r.task for r in chosen}) >= 4 for chosen in samples)


def test_repeated_checks_come_to_every_trajectory() -> None:
    """Of every record, with the command's own numbers, though those have common factors with the board's."""
    options = {option.name: option.default for option in leaderboard_commands.check_command.params}
    records = [record for record in read_records() if record.ships][:55]
    seen: dict[str, set[int]] = {}
    for day in range(739_000, 739_000 + 5 * 45):
        sampled, rounds = check.sample(records, options["count"], day)
        for one in sampled:
            seen.setdefault(f"{one.task}/{one.name}", set()).update(
                check.chosen(135, options["trajectories"], rounds)
            )
    assert seen == {f"{one.task}/{one.name}": set(range(135)) for one in records}


def test_missing_checkpoint_and_empty_board_are_problems(board: Path, tmp_path: Path) -> None:
    assert not run_check([], board).ok
    report = run_check(read_records(board), tmp_path)
    assert not report.ok
    assert "does not ship" in report.problems[0]


def test_record_says_where_its_numbers_come_from(board: Path) -> None:
    stored = next(r for r in read_records(board) if r.model == "mgn")
    assert stored.checkpoint == read_description(
        checkpoint_folder("sheet_deformation", "mgn", "smoke", home=board)
    )
    for result in stored.results:
        assert result.mse == pytest.approx(np.mean(result.trajectory_mse), rel=1e-6)
        assert result.mse_free_nodes == pytest.approx(result.mse * 225 / 169, rel=1e-5)  # 56 clamped nodes
        assert len(result.per_timestep_mse) == 51 - result.context
        assert np.mean(result.per_timestep_mse) == pytest.approx(result.mse, rel=1e-6)


def test_recorded_error_over_a_prefix(board: Path) -> None:
    stored = read_records(board)[0]
    result = stored.results[0]
    assert stored.mse_over(2, stored.keys[:2]) == pytest.approx(np.mean(result.trajectory_mse[:2]))
    assert stored.mse_over(2, ["test_99999"]) is None
    assert stored.mse_over(3, stored.keys) is None


def test_records_round_trip_and_bad_ones_are_named(board: Path, tmp_path: Path) -> None:
    stored = read_records(board)[0]
    path = write_record(stored, tmp_path)
    assert read_records(tmp_path) == [stored]
    content = json.loads(path.read_text())
    del content["dataset_hash"]
    path.write_text(json.dumps(content))
    with pytest.raises(BenchError, match=rf"{path.name}.*dataset_hash"):
        read_records(tmp_path)


def test_page_holds_every_recorded_number_in_order(board: Path) -> None:
    records = read_records(board)
    page = render.render(records)
    rows = [line for line in page.splitlines() if line.startswith(("| mgn ", "| stand_still "))]
    assert len(rows) == 4
    for stored in records:
        (cells,) = [row.split(" | ") for row in rows if row.startswith(f"| {stored.model} ") and "[" in row]
        for result, cell in zip(stored.results, cells[4:7], strict=True):
            assert float(cell.split()[0]) == pytest.approx(result.mse * 1e6, rel=0.005)
    better, worse = sorted(records, key=lambda r: r.results[1].mse)
    assert page.index(f"| {better.model} ") < page.index(f"| {worse.model} ")


def with_errors(record: ResultRecord, seed: int, factor: float) -> ResultRecord:
    """The record of another seed whose errors are so many times as large."""
    values = record.model_dump() | {"seed": seed}
    for result in values["results"]:
        for name in ("mse", "mse_free_nodes"):
            result[name] *= factor
        for name in ("per_timestep_mse", "trajectory_mse", "trajectory_mse_free_nodes"):
            result[name] = [factor * value for value in result[name]]
    return ResultRecord.model_validate(values)


def test_seeds_are_put_together(board: Path) -> None:
    """Means and intervals are over seeds and trajectories, and models are compared on both."""
    one = next(r for r in read_records(board) if r.model == "mgn")
    records = [one, with_errors(one, 1, 3.0)]
    (entry,) = summary.entries(records, one.track, one.task)
    assert entry.seeds == 2
    estimate = entry.estimate(5)
    assert estimate.mean == pytest.approx(2 * one.results[1].mse)
    assert estimate.low < one.results[1].mse < 3 * one.results[1].mse < estimate.high
    single, large = (summary.Entry((r,)) for r in records)
    assert summary.probability_of_less(single, large, 5) == 1
    assert summary.probability_of_less(single, single, 5) == 0.5
    # Of two seeds one is as good as the single one, the other worse.
    assert 0.5 < summary.probability_of_less(single, entry, 5) < 1
    with pytest.raises(ValueError, match="different trajectories"):
        summary.probability_of_less(single, summary.Entry((one.model_copy(update={"keys": ()}),)), 5)


def test_shipped_records_and_page_agree(capsys: pytest.CaptureFixture[str]) -> None:
    """The committed page is what the committed records give, and checkpoints are where records say."""
    with pytest.raises(SystemExit) as stop:
        run(["leaderboard", "render", "--check"])
    assert stop.value.code == 0, capsys.readouterr().out
    shipped = read_records()
    assert shipped
    rows: dict[tuple[str, ...], set[str]] = {}
    for stored in shipped:
        row = stored.track, stored.task, stored.model, stored.preset, stored.variant
        rows.setdefault(row, set()).add(stored.checkpoint.config_hash)
    assert all(len(hashes) == 1 for hashes in rows.values())  # seeds of a row have the same settings
    folders = set()
    for stored in shipped:
        if stored.ships:
            folder = record.checkpoint_folder(stored.task, stored.model, stored.preset, stored.seed)
            assert read_description(folder) == stored.checkpoint
            folders.add(folder)
    assert folders == {path.parent for path in (record.HOME / "checkpoints").rglob("checkpoint.json")}
    assert sum(path.stat().st_size for folder in folders for path in folder.iterdir()) < 25 * 2**20


def test_shipped_records_are_of_these_datasets() -> None:
    """A change of a scene asks for new records."""
    for stored in read_records():
        assert stored.dataset_version == get_scene(get_task(stored.task).scene).dataset_version, stored.name


Changes = Callable[[ResultRecord], dict[str, Any]]


def checkpoint(**changes: object) -> Changes:
    return lambda record: {"track": "test", "checkpoint": record.checkpoint.model_copy(update=changes)}


def training(**changes: object) -> Changes:
    def change(record: ResultRecord) -> dict[str, Any]:
        config = record.checkpoint.config
        changed = config.model_copy(update={"training": config.training | changes})
        return checkpoint(config=changed)(record)

    return change


def other_settings(record: ResultRecord) -> dict[str, Any]:
    """Another learning rate than the preset's, and a hash that says so, on a board of its own."""
    changed = training(learning_rate=1e-4)(record)["checkpoint"]
    config = RunConfig.from_json(changed.config.model_dump())
    return {"checkpoint": changed.model_copy(update={"config_hash": config.hash()})}


def not_installed(record: ResultRecord, width: int | None = None) -> ResultRecord:
    """What it would be of a model that only its author has, on the same board."""
    stated = record.checkpoint.config.model_dump()
    stated["model_name"] = "mine"
    stated["model"] |= {} if width is None else {"width": width}
    training = {key: value for key, value in stated["training"].items() if key not in ("minutes", "steps")}
    content = json.dumps(stated | {"training": training}, sort_keys=True)
    config = record.checkpoint.config.model_validate(stated)
    changes = {"config": config, "config_hash": hashlib.sha256(content.encode()).hexdigest()}
    changed = record.checkpoint.model_copy(update=changes)
    return record.model_copy(update={"track": "test", "model": "mine", "checkpoint": changed})


def another_seed(record: ResultRecord) -> ResultRecord:
    """What training with another seed might end in."""
    changed = record.checkpoint.model_copy(update={"seed": 1, "weights_sha256": "1" * 64})
    return with_errors(record, 1, 1.01).model_copy(update={"checkpoint": changed})


def longer(record: ResultRecord) -> dict[str, Any]:
    """Trained for more steps than the others of its row, and says so; another seed."""
    changed = training(steps=600)(record)["checkpoint"].model_copy(update={"steps": 600, "seed": 1})
    return {"track": "test", "seed": 1, "checkpoint": changed}


def per_timestep(longer: int) -> Changes:
    """Errors over so many frames more."""

    def change(record: ResultRecord) -> dict[str, Any]:
        return {
            "results": tuple(
                r.model_copy(update={"per_timestep_mse": r.per_timestep_mse[:longer]}) for r in record.results
            )
        }

    return change


@pytest.fixture
def submitted(board: Path) -> ResultRecord:
    """Whatever state the checkout of these tests is in, it comes from a commit."""
    made = next(r for r in read_records(board) if r.model == "mgn")
    trained = made.checkpoint.model_copy(update={"commit": "c0ffee"})
    return made.model_copy(update={"track": "theirs", "commit": "c0ffee", "checkpoint": trained})


def test_a_submission_is_taken(board: Path, submitted: ResultRecord, tmp_path: Path) -> None:
    """By the command that its author is told to use, beside what is there."""
    home = tmp_path / "home"
    shutil.copytree(board / "records", home / "records")
    path = write_record(submitted, tmp_path / "theirs")
    with pytest.raises(SystemExit) as stop:
        run(["leaderboard", "submit", str(path), "--home", str(home)])
    assert stop.value.code == 0
    assert submitted.ships
    assert submitted.model_copy(update={"ships": False}) in read_records(home)
    with pytest.raises(SystemExit) as stop:
        run(["leaderboard", "submit", str(path), "--home", str(home)])
    assert stop.value.code == 1  # it is there already


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"task": "sheet"}, "unknown task 'sheet'"),
        ({"split": "validation"}, "boards are of the test split"),
        ({"dataset_version": "0.9"}, "dataset version: 0.9"),
        ({"parameters": 7}, "parameters: 7, not"),
        ({"seed": 3}, "checkpoint's task, model, preset and seed"),
        ({"keys": ("test_00003", "test_00002", "test_00001", "test_00000")}, "other trajectories"),
        ({"track": "test"}, "already"),
        ({"record_schema": 1}, "record_schema"),
        ({"track": "test", "seed": 1, "tier": "quick"}, "tier is quick, but smoke"),
        (training(steps=600), "steps: 3, not the 600 of its settings"),
        (training(steps=None, minutes=1e-9), "minutes: "),
        (longer, "its budget is {'minutes': None, 'steps': 600}, but"),
        ({"materials": {"youngs_modulus": (10.0,)}}, "name them by a variant"),
        (checkpoint(materials={"youngs_modulus": (10.0,)}), "materials: {}, not {'youngs_modulus': (10.0,)}"),
        ({"preset": "huge"}, "unknown preset 'huge'; known: compact"),
        (checkpoint(config_hash="0"), "config_hash: 0, not"),
        (training(optimizer="sgd"), "configuration: none of mgn"),
        (per_timestep(-1), "frames that errors are of"),
        (checkpoint(steps=0, best_step=0), "steps: 0, but mgn learns"),
        (checkpoint(steps=-1, best_step=-1), "best_step: -1, not one of -1 steps"),
        ({"parameters": 0}, "steps: 3, but mgn has no parameters that could learn"),
        (training(steps=None), "budget of its settings: steps None and minutes None"),
        (training(weight_decay=None), "configuration: none of mgn"),
        (
            lambda record: longer(record) | {"variant": "long"},
            "its budget is {'minutes': None, 'steps': 600}, but",
        ),
        ({"track": "test", "seed": 1, "preset": "compact"}, "preset is compact, but smoke"),
        ({"dataset_hash": "0"}, "dataset_hash is that of other trajectories"),
        (other_settings, "not those of preset 'smoke'; name what differs by a variant"),
    ],
)
def test_what_is_wrong_with_a_submission_is_named(
    board: Path, submitted: ResultRecord, changes: Any, reason: str
) -> None:
    if callable(changes):
        changes = changes(submitted)
    verdict = submission.review(submitted.model_copy(update=changes), read_records(board))
    assert any(reason in problem for problem in verdict.problems), verdict


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        (checkpoint(), None),
        (checkpoint(config_hash="0"), "config_hash: 0, not"),
        (training(steps=600), "steps: 3, not the 600 of its settings"),
        (training(steps=None, minutes=1e-9), "minutes: "),
        (training(rate=1.0), "configuration: none of mine"),
        (checkpoint(steps=0, best_step=0), "steps: 0, but mine learns"),
        (checkpoint(best_step=4), "best_step: 4"),
        ({"preset": "huge", "track": "theirs"}, "unknown preset 'huge'"),
    ],
)
def test_what_needs_no_model_is_checked_without_it(
    board: Path, submitted: ResultRecord, changes: Any, reason: str | None
) -> None:
    """As for one that is installed."""
    honest = not_installed(submitted)
    if callable(changes):
        changes = changes(honest)
    others = [record for record in read_records(board) if record.model != "mgn"]
    problems = submission.review(honest.model_copy(update=changes), others).problems
    assert len(problems) == (reason is not None), problems
    assert all(str(reason) in problem for problem in problems)


def test_hashes_can_be_derived_where_no_model_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """From what records say, whatever there is in it."""
    monkeypatch.setattr(consistency, "model_names", list)
    assert check.check_statements(read_records()) == []


def test_a_copied_seed_is_found(board: Path, submitted: ResultRecord) -> None:
    """By its weights or by its errors, on whatever track; what does not learn is the same for every seed."""
    records = read_records(board)
    second = another_seed(submitted).model_copy(update={"track": "test"})
    assert submission.review(second, records).problems == ()
    same_errors = submitted.results
    same_weights = second.checkpoint.model_copy(
        update={"weights_sha256": submitted.checkpoint.weights_sha256}
    )
    for changes, reason in (
        (
            {"results": same_errors},
            "its errors are, to the last digit, those of mgn-smoke-s0 in track 'test'",
        ),
        ({"checkpoint": same_weights}, "its weights are those of mgn-smoke-s0 in track 'test'"),
    ):
        for track in ("test", "theirs"):
            copied = second.model_copy(update=changes | {"track": track})
            (problem,) = submission.review(copied, records).problems
            assert reason in problem
    renamed = not_installed(submitted)
    (problem,) = submission.review(renamed, records).problems
    assert "its weights are those of mgn-smoke-s0" in problem
    for allowed in (renamed, submitted):  # on another track
        assert submission.review(allowed.model_copy(update={"track": "theirs"}), records).problems == ()
    still = next(record for record in records if record.model == "stand_still")
    seed = still.checkpoint.model_copy(update={"seed": 1})
    again = still.model_copy(update={"seed": 1, "checkpoint": seed})
    assert submission.review(again, records).problems == ()


@pytest.mark.parametrize("width", [99, None])
def test_a_submission_that_its_board_cannot_be_made_with_is_refused(
    board: Path, submitted: ResultRecord, tmp_path: Path, width: int | None
) -> None:
    """One whose settings differ from its row's behind the same hash: by a value, or by what goes without saying."""
    first = not_installed(submitted)
    stated = not_installed(another_seed(submitted), width).checkpoint
    if width is None:
        training = {key: value for key, value in stated.config.training.items() if key != "weight_decay"}
        stated = stated.model_copy(update={"config": stated.config.model_copy(update={"training": training})})
    stated = stated.model_copy(update={"config_hash": first.checkpoint.config_hash})
    second = not_installed(another_seed(submitted)).model_copy(update={"checkpoint": stated})
    home = tmp_path / "home"
    shutil.copytree(board / "records", home / "records", ignore=shutil.ignore_patterns("mgn-*"))
    for one, code in ((first, 0), (second, 1)):
        path = write_record(one, tmp_path / "theirs")
        with pytest.raises(SystemExit) as stop:
            run(["leaderboard", "submit", str(path), "--home", str(home)])
        assert stop.value.code == code
    (problem,) = submission.review(second, read_records(home)).problems
    reason = (
        "config_hash: "
        if width
        else "the board cannot be made with it: test/sheet_deformation: mine-smoke-s1"
    )
    assert problem.startswith(reason)
    render.render(read_records(home))


def test_where_it_was_trained_counts_where_budgets_are_minutes(board: Path, submitted: ResultRecord) -> None:
    """Steps are the same on a GPU; minutes are not."""

    def problems(change: Changes) -> str:
        peers = [r.model_copy(update=change(r)) for r in read_records(board) if r.model == "mgn"]
        record = submitted.model_copy(update={"track": "test", "seed": 1} | change(submitted))
        on_gpu = record.checkpoint.model_copy(update={"device": "cuda"})
        return str(submission.review(record.model_copy(update={"checkpoint": on_gpu}), peers).problems)

    assert "device is cuda, but cpu" in problems(training(steps=None, minutes=1.0))
    assert "cuda" not in problems(training(steps=3))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"variant": "x/../../evil"}, "variant"),
        ({"track": "../evil"}, "track"),
        ({"keys": ("test_00000",) * 4}, "twice"),
        ({"evaluation_seconds": 0.0}, "evaluation_seconds"),
        ({"evaluation_seconds": np.inf}, "evaluation_seconds"),
        ({"parameters": -1}, "parameters"),
    ],
)
def test_records_that_cannot_be_are_refused(
    submitted: ResultRecord, changes: dict[str, object], reason: str
) -> None:
    with pytest.raises(ValidationError, match=reason):
        ResultRecord.model_validate(submitted.model_dump() | changes)
    with pytest.raises(ValidationError, match="greater than or equal"):
        with_errors(submitted, 0, -1.0)


def test_a_board_compares_like_with_like(board: Path) -> None:
    """Older data do not count beside newer ones, and other trajectories are refused."""
    one, other = read_records(board)
    for older, newer in (("1.9", "1.10"), ("1.0b", "1.0"), ("1", "1.1")):
        old = one.model_copy(update={"dataset_version": older})
        new = other.model_copy(update={"dataset_version": newer})
        assert [row.label for row in summary.entries([old, new], one.track, one.task)] == [new.model]
    with pytest.raises(BenchError, match="tier quick"):
        summary.entries([one, other.model_copy(update={"tier": "quick"})], one.track, one.task)
    with pytest.raises(BenchError, match="of preset large, but"):
        summary.entries([one, other.model_copy(update={"preset": "large"})], one.track, one.task)
    for changes in ({"keys": one.keys[::-1]}, {"materials": {"youngs_modulus": (10.0,)}}, longer(one)):
        seed = one.model_copy(update=changes | {"seed": 1})
        with pytest.raises(BenchError, match="has other trajectories or settings than"):
            summary.entries([one, seed], one.track, one.task)


def test_what_is_replaced_does_not_count(board: Path, submitted: ResultRecord) -> None:
    """Where it is the only record of its row, a new one may have another budget."""
    new = submitted.model_copy(update=training(steps=600)(submitted))
    new = new.model_copy(update={"checkpoint": new.checkpoint.model_copy(update={"steps": 600})})
    problems = submission.review(new, read_records(board)).problems
    assert any("its budget is" in problem for problem in problems)
    kept = [one.model_copy(update={"ships": False}) for one in read_records(board)]
    assert submission.review(new, kept, replace=True).problems == ()


def test_what_ships_is_not_replaced_by_a_record_alone(board: Path, submitted: ResultRecord) -> None:
    """Its checkpoint would be that of no record."""
    new = submitted.model_copy(update={"track": "test"})
    (problem,) = submission.review(new, read_records(board), replace=True).problems
    assert "sheet_deformation/mgn-smoke-s0 ships with its checkpoint" in problem
    assert "into checkpoints/sheet_deformation/mgn-smoke-s0 of the leaderboard" in problem


def test_a_trial_is_taken_beside_trials_only(board: Path, submitted: ResultRecord) -> None:
    keys = tuple(key.replace("test", "validation") for key in submitted.keys)
    trial = submitted.model_copy(update={"track": "trials", "split": "validation", "keys": keys})
    other = trial.model_copy(update={"seed": 1})
    records = read_records(board)
    assert any("boards are of the test split" in p for p in submission.review(trial, records).problems)
    assert not any("split" in p for p in submission.review(trial, [*records, other]).problems)


def test_a_submission_on_other_bits_is_remarked(board: Path, submitted: ResultRecord) -> None:
    hashes = ("0" * 16, *submitted.trajectory_hashes[1:])
    other = another_seed(submitted).model_copy(update={"track": "test", "trajectory_hashes": hashes})
    verdict = submission.review(other, read_records(board))
    assert not verdict.problems
    (remark,) = verdict.remarks
    assert "1 of 4 trajectories differ" in remark


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"package_version": "99"}, "made with version 99"),
        (checkpoint(dataset_hash="0"), "nothing on the board was trained on the same bits"),
        (checkpoint(minutes=1e3), "is its machine so much slower?"),
        (checkpoint(steps=10**6), "are its steps so much cheaper?"),
        ({"track": "test", "parameters": 10**6}, "is that the size of preset 'smoke'?"),
        ({}, "no track 'theirs' yet, so a new board begins with it; known: test"),
        (checkpoint(commit="c0ffee+changes"), "trained by code with changes that no commit holds"),
        ({"commit": "c0ffee+changes"}, "scored by code with changes that no commit holds"),
        ({"model": "theirs"}, "theirs is not installed here"),
    ],
)
def test_what_readers_of_a_submission_should_know_is_remarked(
    board: Path, submitted: ResultRecord, changes: Any, reason: str
) -> None:
    if callable(changes):
        changes = changes(submitted)
    verdict = submission.review(submitted.model_copy(update=changes), read_records(board))
    assert any(reason in remark for remark in verdict.remarks), verdict


def test_minutes_are_compared_on_one_device(board: Path, submitted: ResultRecord) -> None:
    """Those of a CPU say nothing about those of a GPU, whatever else the board has."""

    def trained(device: str, minutes: float, seed: int = 0) -> ResultRecord:
        return submitted.model_copy(
            update=checkpoint(device=device, minutes=minutes)(submitted) | {"seed": seed}
        )

    known = [trained("cpu", 10.0), trained("cuda", 0.5, seed=1)]
    for device, minutes, is_long in (
        ("cuda", 0.7, False),
        ("cuda", 0.8, True),
        ("cuda:1", 0.8, True),
        ("cpu", 14.0, False),
        ("cpu", 16.0, True),
        ("mps", 99.0, False),
    ):
        remarks = str(submission.review(trained(device, minutes, seed=2), known).remarks)
        assert ("is its machine so much slower?" in remarks) == is_long, (device, minutes)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_steps_of_a_model_that_the_board_does_not_have_are_stated(
    board: Path, submitted: ResultRecord, device: str
) -> None:
    """Beside M3GN's, whatever trained the board's; those of a model that it has must be the same."""
    peers = [record.model_copy(update=checkpoint(device=device)(record)) for record in read_records(board)]
    m3gn = peers[0].model_copy(
        update={"model": "m3gn", "checkpoint": peers[0].checkpoint.model_copy(update={"steps": 7})}
    )
    mine = not_installed(submitted)

    def asked(record: ResultRecord, known: list[ResultRecord]) -> list[str]:
        return [one for one in submission.review(record, known).remarks if "fair budget" in one]

    assert asked(mine, peers) == [
        "its board has no other mine: are 3 steps a fair budget beside the 3 at most of others?"
    ]
    assert asked(mine, [*peers, m3gn]) == [
        "its board has no other mine: are 3 steps a fair budget beside the 7 of m3gn?"
    ]
    assert asked(mine, [*peers, m3gn, another_seed(mine)]) == []


def test_a_submission_that_cannot_be_read_is_refused(
    board: Path, submitted: ResultRecord, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As found wrong, with JSON; one of another schema is told so."""
    path = write_record(submitted, tmp_path)
    text = path.read_text()
    without = json.loads(text)
    del without["machine"]
    for content, reason in (
        (text.replace('"mse": ', '"mse": 1'), "does not follow"),
        (json.dumps(without | {"record_schema": 2}), "record_schema is 2, and this version reads 3"),
    ):
        path.write_text(content)
        with pytest.raises(SystemExit) as stop:
            run(["leaderboard", "submit", str(path), "--home", str(board), "--json"])
        outcome = json.loads(capsys.readouterr().out)
        assert (stop.value.code, outcome["file"]) == (1, None)
        assert reason in outcome["problems"][0]


def test_a_record_is_not_replaced_by_accident(
    board: Path, smoke_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor does one of other settings pass for the preset's."""
    folder = checkpoint_folder("sheet_deformation", "stand_still", "smoke", home=board)
    home = tmp_path / "home"
    score = ["evaluate", "--model", "stand_still", "--checkpoint", str(folder), "--record", str(home)]
    score += ["--data", str(smoke_file.parent), "--tier", "smoke", "--track", "test"]
    for more, code, message in (
        ([], 0, ""),
        ([], 2, "give --replace to replace it"),
        (["--replace"], 0, ""),
        (["--variant", "a/b"], 2, "make file names"),
        (["--variant", "again"], 0, ""),
    ):
        with pytest.raises(SystemExit) as stop:
            run([*score, *more])
        assert (stop.value.code or 0) == code
        assert message in capsys.readouterr().err
    assert [r.variant for r in read_records(home)] == ["again", ""]
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    description = other / "checkpoint.json"
    honest = json.loads(description.read_text())
    for changes in ({"config_hash": "0" + honest["config_hash"]}, {"materials": {"youngs_modulus": [10.0]}}):
        description.write_text(json.dumps(honest | changes))
        with pytest.raises(SystemExit) as stop:
            run([*score, "--checkpoint", str(other), "--replace"])
        assert stop.value.code == 2
        assert "name what differs with --variant" in " ".join(capsys.readouterr().err.split())


def test_show_lists_what_is_on_record(board: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = read_records(board)
    show = ["leaderboard", "show", "--home", str(board)]
    for task, expected in (("sheet_deformation", known), ("deformable_block", [])):
        with pytest.raises(SystemExit):
            run([*show, "--task", task, "--json"])
        shown = json.loads(capsys.readouterr().out)["records"]
        assert [ResultRecord.model_validate(one) for one in shown] == expected
    with pytest.raises(SystemExit):
        run(show)
    rows = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("│")]
    numbers = {(model.strip(), int(context), float(mse)) for *_, model, _, _, _, context, mse, _ in rows}
    assert numbers == {
        (one.model, result.context, float(f"{result.mse * 1e6:.4g}"))
        for one in known
        for result in one.results
    }


@pytest.mark.parametrize(
    ("model", "version", "is_there"),
    [("mgn", None, True), ("mgn", "of old", False), ("stand_still", None, False)],
)
def test_evaluation_repeats_what_is_on_record(
    board: Path,
    smoke_file: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    model: str,
    version: str | None,
    is_there: bool,
) -> None:
    """And shows it beside what it finds, where the board has the model on these trajectories."""
    (recorded,) = (record for record in read_records(board) if record.model == "mgn")
    known = [recorded.model_copy(update={"dataset_version": version or recorded.dataset_version})]
    monkeypatch.setattr(record, "read_records", lambda: known)
    folder = checkpoint_folder("sheet_deformation", model, "smoke", home=board)
    evaluate = ["evaluate", "--model", model, "--checkpoint", str(folder), "--threads", "1", "--json"]
    evaluate += ["--tier", "smoke", "--data", str(smoke_file.parent), "--track", "test"]
    outputs = []
    for _ in range(2):
        with pytest.raises(SystemExit):
            run(evaluate)
        outputs.append(json.loads(capsys.readouterr().out)["results"])
    rows = outputs[0]
    assert outputs[1] == rows  # to the bit, which records do not keep
    assert [row["context"] for row in rows] == [2, 5, 10]
    for row, result in zip(rows, known[0].results, strict=True):
        said = [row[name] for name in ("task", "model", "preset", "seed", "trajectories")]
        assert said == ["sheet_deformation", model, "smoke", 0, 4]
        assert len(row["per_timestep_mse"]) == 51 - row["context"]
        low, high = row["ci95"]
        assert low < row["mse"] < high
        assert row["recorded_mse"] == (pytest.approx(result.mse, rel=1e-8) if is_there else None)
        if is_there:
            assert row["mse"] == pytest.approx(result.mse, rel=1e-8)
            assert row["mse_free_nodes"] == pytest.approx(result.mse_free_nodes, rel=1e-8)
