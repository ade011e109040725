"""The commands that study speed, accuracy and stability; part of the command line (see `cli`)."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from m3gn_bench.console import DATA, JSON, WORKERS, Report, table

if TYPE_CHECKING:
    from m3gn_bench.studies import Shipped
    from m3gn_bench.tasks import Task

CHECKPOINTS = click.option(
    "--checkpoint",
    "folders",
    type=click.Path(path_type=Path, file_okay=False),
    multiple=True,
    help="A training run's folder (may be given several times).  [default: checkpoints that ship with the project]",
)
RECORD = click.option(
    "--record",
    "record_home",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Also write a record below this folder (in a checkout: docs/studies).",
)


def _checkpoints(task: "Task", folders: tuple[Path, ...]) -> "list[Shipped]":
    """The trained models of a task that were asked for, or that ship with the project (preset compact, seed 0)."""
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.errors import CheckpointError
    from m3gn_bench.leaderboard.pace import training_seconds
    from m3gn_bench.leaderboard.record import SHIPPED, checkpoint_folder, shipped_models
    from m3gn_bench.model import build_model, load_preset
    from m3gn_bench.studies import Shipped

    if not folders:
        names = shipped_models(task.name)
        learned = [n for n in names if build_model(load_preset(n, SHIPPED, task), task).is_learned]
        folders = tuple(checkpoint_folder(task.name, n, SHIPPED) for n in learned)
    found = []
    for folder in folders:
        described = read_description(folder)
        if described.task != task.name:
            raise CheckpointError(f"{folder} was trained on {described.task}, not on {task.name}")
        config = described.config
        found.append(Shipped(config.model_name, config.preset, folder, training_seconds(described)))
    return found


@click.command()
@click.argument("task_name", metavar="TASK")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="Also draw a figure.",
)
@CHECKPOINTS
@RECORD
@WORKERS
@DATA
@JSON
def tradeoff(
    task_name: str,
    output: Path | None,
    folders: tuple[Path, ...],
    record_home: Path | None,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Speed against accuracy: every way to get a trajectory of TASK, measured here and now.

    Takes some minutes; an interrupted run goes on where it stopped.
    """
    from m3gn_bench.datasets.writer import require_writable
    from m3gn_bench.figures import require_drawable, save
    from m3gn_bench.generators.knobs import knobs_of
    from m3gn_bench.study_page import advice, draw
    from m3gn_bench.tasks import get_task
    from m3gn_bench.tradeoff import measure

    report = Report(as_json)
    task = get_task(task_name)
    knobs = knobs_of(task.name)
    shipped = _checkpoints(task, folders)
    if output is not None:
        require_drawable(output)
        require_writable(output.parent)
    if record_home is not None:
        require_writable(record_home)
    _alone(data)
    with report.progress(f"measuring {task.name}") as on_progress:
        result, study = measure(
            task,
            shipped,
            data / f"tradeoff-{task.name}.partial",
            knobs=knobs,
            workers=workers,
            on_progress=on_progress,
        )
    if record_home is not None:
        _write(record_home / f"tradeoff-{task.name}.json", result.model_dump_json(indent=1))
    if output is not None:
        save(draw(result), output)

    def percent(value: float | None) -> str:
        return "" if value is None else f"{100 * value:.3g}"

    report.finish(
        {**result.model_dump(mode="json"), "advice": advice(result)},
        table(
            f"{task.title}: error [%], relative to the {result.unit}",
            ["simulator", "time [s]", "error", "of steps", "of the mesh", "front", "refused"],
            [
                [
                    f"{s.knob}: {s.label}",
                    "" if s.seconds is None else f"{s.seconds:.3g}",
                    *map(percent, (s.error, s.error_of_steps, s.error_of_mesh)),
                    "yes" if s.on_front else "by parts" if s.on_front_by_parts else "",
                    len(s.refused) or "",
                ]
                for s in result.simulators
            ],
        ),
        table(
            f"{task.title}: learned models, error [%]"
            + ("" if result.models_by is None else f", to the end, by fidelity {result.models_by}"),
            ["model, context", "time [s]", "error", "to the data", "of the data", "front", "pays off after"],
            [
                [
                    f"{m.model}, {m.context}",
                    f"{m.seconds:.3g}",
                    *map(percent, (m.error, m.error_to_data, m.error_of_data)),
                    "yes" if m.on_front else "",
                    m.pays_off,
                ]
                for m in result.models
            ],
        ),
        *advice(result),
        *([f"figure: {output}"] if output else []),
    )
    study.finish()


@click.command()
@click.argument("task_name", metavar="[TASK]", required=False)
@CHECKPOINTS
@RECORD
@WORKERS
@DATA
@JSON
def stability(
    task_name: str | None,
    folders: tuple[Path, ...],
    record_home: Path | None,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Simulators and models at their extremes; exit code 1 if any cell is wrong.

    Without TASK, that of the checkpoint, or every task whose scene says what its extremes are. Takes some minutes each;
    an interrupted run goes on where it stopped.
    """
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.datasets.writer import require_writable
    from m3gn_bench.generators.extremes import extremes_of, has_extremes
    from m3gn_bench.stability import measure
    from m3gn_bench.tasks import TASKS, get_task

    report = Report(as_json)
    if task_name is not None:
        tasks = [get_task(task_name)]
    elif folders:
        tasks = [get_task(read_description(folders[0]).task)]
    else:
        tasks = [task for task in TASKS.values() if has_extremes(task.scene)]
    chosen = [(task, extremes_of(task.scene), _checkpoints(task, folders)) for task in tasks]
    if record_home is not None:
        require_writable(record_home)
    _alone(data)
    results, studies = [], []
    for task, grid, shipped in chosen:
        with report.progress(f"judging {task.name}") as on_progress:
            result, study = measure(
                task,
                shipped,
                data / f"stability-{task.name}.partial",
                extremes=grid,
                workers=workers,
                on_progress=on_progress,
            )
        results.append(result)
        studies.append(study)
        if record_home is not None:
            _write(record_home / f"stability-{task.name}.json", result.model_dump_json(indent=1))
    wrong = sum(len(result.wrong) for result in results)
    report.finish(
        {"tasks": [result.model_dump(mode="json") for result in results], "wrong": wrong},
        *(
            table(
                f"{task.title} (correct: within {result.allowed:.0%} of the {result.unit})",
                ["cell", "verdict", "error"],
                [
                    [f"{c.subject}: {c.cell}", c.verdict, "" if c.error is None else f"{c.error:.2%}"]
                    for c in result.cells
                ],
            )
            for task, result in zip(tasks, results, strict=True)
        ),
        *(f"{c.subject}: {c.cell}: {c.detail}" for result in results for c in result.cells if c.detail),
        f"{sum(len(r.cells) for r in results)} cells, {wrong} wrong",
    )
    for study in studies:
        study.finish()
    sys.exit(1 if wrong else 0)


@click.command("render-studies")
@click.argument("docs", type=click.Path(path_type=Path, file_okay=False), default=Path("docs"))
@click.option("--check", is_flag=True, help="Write nothing; exit code 1 if the page is out of date.")
@JSON
def render_studies(docs: Path, check: bool, as_json: bool) -> None:
    """Make DOCS/tradeoff.md and its figures from the records in DOCS/studies.  [default: docs]"""
    from m3gn_bench.errors import ConfigError
    from m3gn_bench.figures import require_drawable, save
    from m3gn_bench.study_page import draw, read_records, render

    tradeoffs, stabilities = read_records(docs / "studies")
    if not tradeoffs:
        raise ConfigError(
            f"no records in {docs / 'studies'}; make some with 'm3gn-bench tradeoff TASK --record'"
        )
    page, content = docs / "tradeoff.md", render(tradeoffs, stabilities)
    current = page.is_file() and page.read_text() == content
    if not check:
        require_drawable(docs / "studies" / "tradeoff.svg")
        _write(page, content)
        for study in tradeoffs:
            save(draw(study), docs / "studies" / f"tradeoff-{study.task}.svg")
    verdict = ("up to date" if current else "OUT OF DATE") if check else "written"
    Report(as_json).finish(
        {"file": str(page), "records": len(tradeoffs) + len(stabilities), "up_to_date": current or not check},
        f"{page}: {verdict}, {len(tradeoffs)} trade-offs, {len(stabilities)} grids",
    )
    sys.exit(1 if check and not current else 0)


def _alone(data: Path) -> None:
    """For as long as the command runs, no other study does in that folder: they would disturb each other's times."""
    from m3gn_bench.datasets.writer import reserved

    click.get_current_context().with_resource(reserved(data / ".studies", "measures", data))


def _write(path: Path, text: str) -> None:
    from m3gn_bench.datasets.writer import write_bytes_atomically

    write_bytes_atomically(path, (text.rstrip("\n") + "\n").encode())
