"""The commands of the leaderboard; part of the command line (see `cli`)."""

import sys
import tempfile
from collections.abc import Sequence
from contextlib import closing
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING

import click

from m3gn_bench.console import DATA, DEVICE, EXECUTOR, JSON, WORKERS, OnProgress, Report, table
from m3gn_bench.provenance import usable_cores

if TYPE_CHECKING:
    from m3gn_bench.leaderboard.campaign import Outcome, PlannedRun


BOARD = click.option(
    "--home",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="The leaderboard's folder, where records go (in a checkout: leaderboard).",
)
ANY_BOARD = click.option(
    "--home",
    type=click.Path(path_type=Path, file_okay=False, exists=True),
    default=None,
    help="A leaderboard's folder.  [default: the project's own]",
)


@click.group()
def leaderboard() -> None:
    """Show the leaderboard, make its tables, re-derive its numbers."""


@leaderboard.command()
@ANY_BOARD
@click.option("--task", "task_name", default=None, help="Only this task.")
@JSON
def show(home: Path | None, task_name: str | None, as_json: bool) -> None:
    """All result records."""
    from m3gn_bench.leaderboard.record import HOME, read_records
    from m3gn_bench.tasks import get_task

    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records(home or HOME) if task_name in (None, r.task)]
    rows: list[list[object]] = [
        [
            r.track,
            r.task,
            r.split,
            r.model,
            r.preset,
            r.variant,
            r.seed,
            result.context,
            f"{result.mse * 1e6:.4g}",
            f"{result.mse_free_nodes * 1e6:.4g}",
        ]
        for r in records
        for result in r.results
    ]
    Report(as_json).finish(
        {"records": [record.model_dump(mode="json") for record in records]},
        table(
            "Full-rollout MSE x 1e6",
            ["track", "task", "split", "model", "preset", "variant", "seed", "context", "mse", "free nodes"],
            rows,
        ),
    )


@leaderboard.command()
@ANY_BOARD
@click.option("--check", is_flag=True, help="Write nothing; exit code 1 if a page is out of date.")
@JSON
def render(home: Path | None, check: bool, as_json: bool) -> None:
    """Make the pages LEADERBOARD.md and CLAIMS.md and their figures (extra `plot`) from the records."""
    from m3gn_bench.datasets.writer import write_bytes_atomically
    from m3gn_bench.figures import require_drawable, save
    from m3gn_bench.leaderboard.claims import render_claims
    from m3gn_bench.leaderboard.figures import draw_board
    from m3gn_bench.leaderboard.record import HOME, read_records
    from m3gn_bench.leaderboard.render import FIGURES
    from m3gn_bench.leaderboard.render import render as render_page
    from m3gn_bench.leaderboard.summary import titles

    folder = home or HOME
    records = read_records(folder)
    if not check:
        require_drawable(folder / "figure.svg")
    current = {}
    shown = {path.name for path in (folder / FIGURES).glob("*.png")}
    pages = {"LEADERBOARD.md": render_page(records, shown), "CLAIMS.md": render_claims(records)}
    for name, text in pages.items():
        path, content = folder / name, text.encode()
        current[str(path)] = path.is_file() and path.read_bytes() == content
        if not check:
            write_bytes_atomically(path, content)
    if not check:
        for task in titles(records):
            figure = draw_board(records, "compact", task)
            if figure is not None:
                save(figure, folder / FIGURES / f"{task}.svg")

    def verdict(is_current: bool) -> str:
        return ("up to date" if is_current else "OUT OF DATE") if check else "written"

    Report(as_json).finish(
        {"files": current, "records": len(records), "up_to_date": not check or all(current.values())},
        *(f"{name}: {verdict(is_current)}, {len(records)} records" for name, is_current in current.items()),
    )
    sys.exit(1 if check and not all(current.values()) else 0)


@leaderboard.command()
@ANY_BOARD
@click.option("--task", "task_name", default=None, help="Only this task.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder of the pictures (in a checkout: leaderboard/figures).",
)
@click.option("--tier", default="paper", show_default=True, help="Which test trajectories.")
@WORKERS
@DATA
@JSON
def pictures(
    home: Path | None,
    task_name: str | None,
    output: Path,
    tier: str,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Draw what the shipped checkpoints do: final frames over the truth, and M3GN's task descriptions (t-SNE).

    Test trajectories are simulated first if they are not there yet. Needs the extra `plot`.
    """
    from m3gn_bench.checkpoint import load_checkpoint
    from m3gn_bench.data import load_cases
    from m3gn_bench.figures import require_drawable, save
    from m3gn_bench.leaderboard.pictures import draw_latents, draw_overlays
    from m3gn_bench.leaderboard.record import HOME, checkpoint_folder, read_records
    from m3gn_bench.leaderboard.render import PICTURES
    from m3gn_bench.m3gn import M3GN
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import TASKS, get_task

    report = Report(as_json)
    folder = home or HOME
    require_drawable(output / "picture.png")
    names = list(TASKS) if task_name is None else [get_task(task_name).name]
    records = [r for r in read_records(folder) if r.ships and r.track == "compact" and r.checkpoint.steps > 0]
    written = []
    for name in names:
        task = get_task(name)
        shown = [record for record in records if record.task == name]
        m3gn = next((record for record in shown if record.model == "m3gn"), None)
        if m3gn is None:
            continue
        with report.progress(f"simulating {task.scene}") as on_progress:
            path = find_or_generate(
                task, tier, data, splits=("test",), workers=workers, on_progress=on_progress
            )
        save(draw_overlays(shown, task, path, tier, folder), output / f"overlay-{name}.png")
        model, _ = load_checkpoint(checkpoint_folder(name, "m3gn", m3gn.preset, m3gn.seed, folder))
        assert isinstance(model, M3GN)
        cases = load_cases(path, task, "test", tier)
        save(draw_latents(model, cases, task.middle_context), output / f"latent-{name}.png")
        written += [str(output / f"{kind}-{name}.png") for kind in PICTURES]
    report.finish({"files": written}, *written, f"{len(written)} pictures")


@leaderboard.command("check")
@ANY_BOARD
@click.option("--task", "task_name", default=None, help="Only this task.")
@click.option(
    "--records",
    "count",
    type=click.IntRange(min=1),
    default=12,
    show_default=True,
    help="How many of those with a checkpoint, of all tasks.",
)
@click.option("--trajectories", type=click.IntRange(min=1), default=3, show_default=True, help="Per record.")
@click.option(
    "--offset",
    type=int,
    default=None,
    help="Which records and trajectories.  [default: changes from day to day]",
)
@click.option("--retrain/--no-retrain", default=True, help="Also train a small model of every method again.")
@WORKERS
@JSON
def check_command(
    home: Path | None,
    task_name: str | None,
    count: int,
    trajectories: int,
    offset: int | None,
    retrain: bool,
    workers: int,
    as_json: bool,
) -> None:
    """Re-derive numbers from nothing and compare with the records; exit code 1 where they differ.

    Trajectories are simulated again. Models are the checkpoints that ship with the leaderboard, and the small ones of
    its plan smoke, if it has one, which are trained again.
    """
    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.leaderboard.campaign import read_plan
    from m3gn_bench.leaderboard.check import (
        TOLERANCES,
        CheckReport,
        Comparison,
        check_records,
        check_statements,
        compare_with_retrained,
        sample,
    )
    from m3gn_bench.leaderboard.record import HOME, read_records
    from m3gn_bench.tasks import get_task

    folder = home or HOME
    use_cpu(usable_cores())
    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records(folder) if task_name in (None, r.task)]
    report = Report(as_json)
    shipped = [record for record in records if record.ships]
    today = date.today().toordinal() if offset is None else offset
    sampled, rounds = sample(shipped, count, today)
    with report.progress("re-deriving") as on_progress:
        found = check_records(
            sampled, trajectories=trajectories, offset=rounds, home=folder, on_progress=on_progress
        )
    compared, problems = list(found.compared), [*check_statements(records), *found.problems]
    plan = folder / "plans" / "smoke.toml"
    if retrain and (home is None or plan.is_file()):  # another board need not have one
        planned = [run for run in read_plan(plan) if task_name in (None, run.task)]
        with report.progress("training again") as on_progress:
            again = compare_with_retrained(records, _train_again(planned, workers, on_progress))
        compared += again.compared
        problems += again.problems
    outcome = CheckReport.of(compared, problems)

    def runs(comparisons: Sequence[Comparison]) -> int:
        return len({(c.track, c.task, c.run) for c in comparisons})

    lines = [*outcome.problems]
    lines += [
        f"{c.task}/{c.run}, {c.kind}, context {c.context}, {c.trajectory}: "
        f"recorded {c.recorded:.6g}, re-derived {c.rederived:.6g}"
        for c in outcome.compared
        if not c.ok
    ]
    for kind, tolerance in TOLERANCES.items():
        of_kind = [c for c in outcome.compared if c.kind == kind]
        if of_kind:
            largest = max(c.relative_difference for c in of_kind)
            lines.append(
                f"{kind}: {len(of_kind)} errors of {runs(of_kind)} records compared; largest relative difference "
                f"{largest:.1e} (allowed {tolerance:g}); {sum(c.same_trajectory for c in of_kind)} on bit-identical "
                "trajectories"
            )
    left = len(records) - runs(outcome.compared)
    if left:
        unseen = len(shipped) - runs([c for c in outcome.compared if c.kind == "shipped checkpoint"])
        lines.append(
            f"{left} records were not looked at: {unseen} are sampled by other values of --offset, the others can only "
            f"be re-derived by training (see the plans in {plan.parent})"
        )
    if not outcome.compared and not outcome.problems:
        lines.append("there is nothing to compare: no record has a checkpoint here, or is of track smoke")
    lines.append("every sampled number was re-derived" if outcome.ok else "the leaderboard does NOT hold")
    report.finish(outcome.model_dump(mode="json"), "\n".join(lines))
    sys.exit(0 if outcome.ok else 1)


def _train_again(planned: "Sequence[PlannedRun]", workers: int, on_progress: OnProgress) -> "list[Outcome]":
    """What comes of some runs in an empty folder."""
    from m3gn_bench.generators.workers import run_jobs
    from m3gn_bench.leaderboard.campaign import Job, carry_out
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import get_task

    made = []
    with tempfile.TemporaryDirectory() as name:
        empty = Path(name)
        files = {
            task: find_or_generate(get_task(task), "smoke", empty / "data", workers=workers)
            for task in {run.task for run in planned}
        }
        jobs = [Job(run, files[run.task], empty / "runs") for run in planned]
        with closing(run_jobs(carry_out, jobs, workers)) as outcomes:
            for done, outcome in enumerate(outcomes, 1):
                made.append(outcome)
                on_progress(done, len(planned))
    return made


@leaderboard.command()
@click.argument("record", type=click.Path(path_type=Path, dir_okay=False))
@BOARD
@click.option("--replace", is_flag=True, help="Replace the record of the same name.")
@JSON
def submit(record: Path, home: Path, replace: bool, as_json: bool) -> None:
    """Check a RECORD that somebody else made and add it to the leaderboard; exit code 1 if it is refused.

    RECORD is a file that `m3gn-bench evaluate --record FOLDER` wrote.
    """
    from m3gn_bench.datasets.errors import BenchError
    from m3gn_bench.errors import ConfigError
    from m3gn_bench.leaderboard.record import read_record, read_records, write_record
    from m3gn_bench.leaderboard.submission import Verdict, review

    if not home.is_dir():
        raise ConfigError(f"there is no leaderboard {home}, whose records this one could be compared with")
    board, path = read_records(home), None
    try:
        # Its author may have kept the checkpoint beside the record; this board does not.
        submitted = read_record(record).model_copy(update={"ships": False})
    except BenchError as error:
        verdict = Verdict(problems=(str(error),), remarks=())
    else:
        verdict = review(submitted, board, replace)
        path = None if verdict.problems else write_record(submitted, home)
    Report(as_json).finish(
        {"file": None if path is None else str(path), **verdict.model_dump(mode="json")},
        *(f"refused: {problem}" for problem in verdict.problems),
        *(f"note: {remark}" for remark in verdict.remarks),
        *([] if path is None else [f"written {path}; now run 'm3gn-bench leaderboard render'"]),
    )
    sys.exit(1 if verdict.problems else 0)


@click.command()
@click.argument("plan", type=click.Path(path_type=Path, dir_okay=False))
@BOARD
@click.option(
    "--runs",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("runs"),
    show_default=True,
    help="Folder of training runs, finished or not.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=usable_cores(),
    help="Processes, each of which trains with one thread.  [default: all cores]",
)
@DEVICE
@EXECUTOR
@click.option("--status", is_flag=True, help="Only show what is done and what is left.")
@DATA
@JSON
def campaign(
    plan: Path,
    home: Path,
    runs: Path,
    workers: int,
    device: str,
    executor: str,
    status: bool,
    data: Path,
    as_json: bool,
) -> None:
    """Train and score all runs of a plan that have no record yet.

    PLAN is a TOML file such as leaderboard/plans/compact.toml. Datasets are generated first where they are missing.
    What is interrupted or killed goes on when the same command is run again. Exit code 1 if runs failed.
    """
    from m3gn_bench.datasets.writer import reserved
    from m3gn_bench.generators.executors import parse_executor
    from m3gn_bench.generators.workers import run_jobs
    from m3gn_bench.leaderboard.campaign import Job, carry_out, read_plan, require_own_folders
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.sources import dataset_version, find_or_generate
    from m3gn_bench.tasks import get_task
    from m3gn_bench.training import usable_device

    report = Report(as_json)
    if (
        parse_executor(executor).kind == "process" and not status
    ):  # a cluster's workers may have what its head has not
        usable_device(device)
    planned = read_plan(plan)
    versions = {run.task: dataset_version(get_task(run.task)) for run in planned}
    records = read_records(home)
    require_own_folders(planned, records)
    states = [run.state(records, versions[run.task]) for run in planned]
    todo = [run for run, state in zip(planned, states, strict=True) if state != "done"]
    problems: dict[str, str] = {}
    if not status and todo:
        with reserved(runs, "carries out a campaign", runs):
            files = {}
            for name in dict.fromkeys(run.task for run in todo):
                task = get_task(name)
                with report.progress(f"simulating {task.scene}") as on_progress:
                    files[name] = find_or_generate(
                        task,
                        todo[0].tier,
                        data,
                        workers=workers,
                        executor=executor,
                        on_progress=on_progress,
                    )
            # Workers of a cluster start in folders of their own.
            jobs = (Job(run, files[run.task].absolute(), runs.absolute(), device) for run in todo)
            training = run_jobs(carry_out, jobs, min(workers, len(todo)), executor=executor, shared=runs)
            with (
                report.progress(f"training {len(todo)} runs") as on_progress,
                closing(training) as outcomes,
            ):
                on_progress(0, len(todo))
                for done, outcome in enumerate(outcomes, 1):
                    outcome.keep(home)
                    if outcome.error is not None:
                        problems[f"{outcome.run.task}/{outcome.run.name}"] = outcome.error
                    on_progress(done, len(todo))
        records = read_records(home)
        states = [run.state(records, versions[run.task]) for run in planned]
    counts = {state: states.count(state) for state in ("done", "outdated", "to do")}
    rows: list[list[object]] = [
        [run.task, run.name, state]
        for run, state in zip(planned, states, strict=True)
        if state != "done" or not status
    ]
    report.finish(
        {
            "plan": str(plan),
            "counts": counts,
            "runs": [
                {"task": run.task, "name": run.name, "state": state}
                for run, state in zip(planned, states, strict=True)
            ],
            "problems": problems,
        },
        *([table("Left" if status else "Runs", ["task", "run", "state"], rows)] if rows else []),
        *(f"{name} failed: {problem}" for name, problem in problems.items()),
        ", ".join(f"{count} {state}" for state, count in counts.items()),
    )
    sys.exit(1 if problems else 0)
