"""The commands that make, check and show datasets; part of the command line (see `cli`)."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import click

from m3gn_bench.console import DATA, EXECUTOR, JSON, SEED, WORKERS, Report

if TYPE_CHECKING:
    from m3gn_bench.generators.scene import Scene


@click.command()
@click.argument("scene_name", metavar="SCENE")
@click.option("--tier", default="quick", show_default=True, help="smoke, quick or paper.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Folder.  [default: as --data]",
)
@click.option("--fidelity", default="default", show_default=True, help="fast, default or reference.")
@click.option(
    "--solver", default=None, help="Falling teddy, mixed objects: explicit (default) or newton-vbd."
)
@click.option(
    "--device",
    default=None,
    help="Falling teddy, mixed objects: cpu (default), or cuda, many at once into a dataset of its own.",
)
@click.option(
    "--mesh",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="Falling teddy: drop the object in this file instead (a closed surface, or tetrahedra), scaled to 0.5 m.",
)
@click.option("--plane", default=None, help="Deformable block: stress (default) or strain.")
@click.option("--split", "splits", multiple=True, help="Only this split (may be given several times).")
@click.option("--seed", type=SEED, default=None, help="Of the dataset.  [default: the leaderboard's]")
@WORKERS
@EXECUTOR
@DATA
@JSON
def generate(
    scene_name: str,
    tier: str,
    out: Path | None,
    fidelity: str,
    solver: str | None,
    device: str | None,
    mesh: Path | None,
    plane: str | None,
    splits: tuple[str, ...],
    seed: int | None,
    workers: int,
    executor: str,
    data: Path,
    as_json: bool,
) -> None:
    """Simulate a SCENE's dataset (or that of a task). An interrupted run goes on where it stopped."""
    from m3gn_bench.datasets.schema import DATASET_SEED, SPLITS, as_split
    from m3gn_bench.generators.generate import generate as generate_dataset
    from m3gn_bench.generators.scene import get_scene
    from m3gn_bench.tasks import TASKS

    report = Report(as_json)
    name = TASKS[scene_name].scene if scene_name in TASKS else scene_name
    given = {"solver": solver, "device": device, "plane": plane}
    options = {key: value for key, value in given.items() if value is not None}
    if mesh is None:
        scene = get_scene(name, **options)
    else:
        from m3gn_bench.generators.objects import read_or_keep_object

        get_scene(name, **options, mesh=None)  # complains before the work if there is no such scene or option
        scene = get_scene(name, **options, mesh=read_or_keep_object(mesh, out or data))
    with report.progress(f"simulating {scene.name}") as on_progress:
        made = generate_dataset(
            scene,
            tier,
            out or data,
            workers=workers,
            splits=[as_split(split) for split in splits] or SPLITS,
            fidelity=fidelity,  # type: ignore[arg-type]
            seed=DATASET_SEED if seed is None else seed,
            executor=executor,
            on_progress=on_progress,
        )
    rejected = [rejection.model_dump() for rejection in made.rejected]
    record: dict[str, object] = {
        "file": str(made.file),
        "content_hash": made.content_hash,
        "trajectories": made.trajectories,
        "generated": made.generated,
        "rejected": rejected,
        "cpu_seconds_per_trajectory": made.cpu_seconds_per_trajectory,
        "megabytes": made.file.stat().st_size / 1e6,
    }
    lines = [
        f"file           {made.file} ({made.file.stat().st_size / 1e6:.1f} MB)",
        f"content hash   {made.content_hash}",
        f"trajectories   {made.trajectories} ({made.generated} simulated now)",
        f"CPU time       {made.cpu_seconds_per_trajectory:.2f} s per trajectory",
        f"rejected       {len(rejected)} draws",
    ]
    lines += [f"  {r.key}, attempt {r.attempt}: {r.reason}" for r in made.rejected]
    report.finish(record, "\n".join(lines))


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--strict", is_flag=True, help="Let warnings fail the check too.")
@JSON
def validate(file: Path, strict: bool, as_json: bool) -> None:
    """Check a dataset FILE from top to bottom; exit code 1 if something is wrong with it."""
    from m3gn_bench.datasets.validator import validate as validate_file

    report = Report(as_json)
    with report.progress(f"checking {file.name}") as on_progress:
        outcome = validate_file(file, strict=strict, on_progress=on_progress)
    lines = [f"{p.code}  {p.where}: {p.message}" for p in outcome.problems]
    verdict = f"{file}: {outcome.trajectories} trajectories, " + ("valid" if outcome.ok else "NOT valid")
    report.finish(outcome.model_dump(mode="json"), "\n".join([*lines, verdict]))
    sys.exit(0 if outcome.ok else 1)


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@JSON
def info(file: Path, as_json: bool) -> None:
    """What a dataset FILE holds and where it comes from."""
    from m3gn_bench.datasets.file import damage_as_dataset_error, open_file, read_metadata, tier_hashes

    with open_file(file) as opened:
        metadata = read_metadata(opened)
        with damage_as_dataset_error(str(file)):
            splits = {
                task: {split: len(keys) for split, keys in group.items()}
                for task, group in opened["splits"].items()
            }
        hashes = tier_hashes(opened)
    record: dict[str, object] = {
        "file": str(file),
        "megabytes": file.stat().st_size / 1e6,
        **metadata.model_dump(mode="json"),
        "transitions": metadata.transitions,
        "splits": splits,
        "tier_hashes": hashes,
    }
    width = max(map(len, record))
    Report(as_json).finish(record, "\n".join(f"{name:{width}}  {value}" for name, value in record.items()))


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--split", default="test", show_default=True, help="train, validation or test.")
@click.option("--index", type=int, default=0, show_default=True, help="Which trajectory of the split.")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="A .png shows frames side by side, a .gif or .mp4 one after the other.",
)
@click.option(
    "--frames",
    default=None,
    help="How many, evenly spaced, or a list such as 0,10,20.  [default: 6 in a .png (4 with models), else all]",
)
@click.option("--fps", type=int, default=20, show_default=True, help="Of a .gif or .mp4: frames per second.")
@click.option(
    "--colour",
    default=None,
    help="What colours show: displacement, height (displacement upwards), area (over that at rest), or "
    "distance (of models from the truth).  [default: distance with models, else what suits the scene]",
)
@click.option(
    "--model",
    "models",
    multiple=True,
    help="Draw this model's prediction beside the truth, from the checkpoint that ships with the project "
    "(may be given several times).",
)
@click.option(
    "--checkpoint",
    "checkpoints",
    type=click.Path(path_type=Path, file_okay=False),
    multiple=True,
    help="Draw the prediction of a training run in this folder, too (may be given several times).",
)
@click.option(
    "--task",
    "task_name",
    default=None,
    help="What the models were trained on.  [default: the runs' task, else the first of the file's scene]",
)
@click.option(
    "--context",
    type=int,
    default=None,
    help="How many frames the models see.  [default: the middle one of the task's sizes]",
)
@JSON
def view(
    file: Path,
    split: str,
    index: int,
    output: Path,
    frames: str | None,
    fps: int,
    colour: str | None,
    models: tuple[str, ...],
    checkpoints: tuple[Path, ...],
    task_name: str | None,
    context: int | None,
    as_json: bool,
) -> None:
    """Draw a trajectory of a dataset FILE, alone or beside what models predict; no display is needed."""
    from m3gn_bench.view import Comparison
    from m3gn_bench.view import view as draw

    report = Report(as_json)
    comparison = None
    if models or checkpoints:
        task, folders = _checkpoints(file, task_name, models, checkpoints)
        comparison = Comparison(task, folders, context)
    elif task_name is not None or context is not None:
        raise click.UsageError("--task and --context are for models: give --model or --checkpoint, too")
    with report.progress(f"drawing {output.name}") as on_progress:
        viewed = draw(
            file,
            output,
            split=split,
            index=index,
            frames=frames,
            fps=fps,
            colour=colour,
            comparison=comparison,
            on_progress=on_progress,
        )
    shown = f"{output}: {viewed.trajectory}, {len(viewed.frames)} frames"
    if comparison is not None:
        shown += f" of {', '.join(viewed.panels)}; context {viewed.context}"
    report.finish({"file": str(output), **asdict(viewed)}, shown)


def _checkpoints(
    file: Path, task_name: str | None, models: Sequence[str], runs: Sequence[Path]
) -> tuple[str, dict[str, Path]]:
    """The task of models that are to be drawn, and their folders by title.

    Args:
        file: the dataset file.
        task_name: their task, or None for the first run's, or else the first one of the file.
        models: those whose checkpoints ship with the project.
        runs: folders of other trained models.
    """
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.datasets.file import open_file, read_splits
    from m3gn_bench.errors import CheckpointError
    from m3gn_bench.leaderboard.record import SHIPPED, checkpoint_folder, shipped_models
    from m3gn_bench.model import get_model_class
    from m3gn_bench.tasks import get_task

    described = {run: read_description(run) for run in runs}
    for name in models:
        get_model_class(name)
    if task_name is not None:
        task = get_task(task_name).name
    elif described:
        task = next(iter(described.values())).task
    else:
        with open_file(file) as opened:
            task = get_task(next(iter(read_splits(opened)))).name

    folders = {name: checkpoint_folder(task, name, SHIPPED) for name in models}
    missing = [name for name, folder in folders.items() if not folder.is_dir()]
    if missing:
        names = ", ".join(shipped_models(task))
        raise CheckpointError(
            f"no checkpoint of {missing[0]} on {task} ships with the project"
            f"{f' (there are {names})' if names else ''}; train one and pass --checkpoint"
        )
    for run, description in described.items():
        name = description.config.model_name
        folders[f"{name}, {run}" if name in folders else name] = run
    return task, folders


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@JSON
def card(file: Path, as_json: bool) -> None:
    """Write the numbers of a dataset FILE into its scene's card, and record it."""
    from m3gn_bench.datasets.card import CARDS, fill, numbers
    from m3gn_bench.datasets.file import open_file, read_metadata
    from m3gn_bench.datasets.recorded import record, require_own
    from m3gn_bench.datasets.writer import write_bytes_atomically
    from m3gn_bench.generators.material_effect import material_effect

    require_own(file)
    with open_file(file) as opened:
        scene = _recorded_scene(read_metadata(opened).scene)
    effect = f"{material_effect(scene):.3g}"
    path = CARDS / f"{scene.name}.md"
    block = numbers(file, [("softest against stiffest material, mean squared difference, scaled", effect)])
    recorded = record(file)  # which may refuse
    write_bytes_atomically(path, fill(path.read_text(), block).encode())
    Report(as_json).finish(
        {"card": str(path), "record": str(recorded)}, f"{path}: written\n{recorded}: written"
    )


def _recorded_scene(name: str) -> "Scene":
    """A scene whose card and hashes the project holds: one of our own."""
    from m3gn_bench.generators.errors import GeneratorError
    from m3gn_bench.generators.scene import OWN_SCENES, get_scene

    scene = get_scene(name)
    if name not in OWN_SCENES:
        raise GeneratorError(
            f"{name} is the scene of another package: its card and its hashes are not kept here, but only those of "
            f"{', '.join(sorted(OWN_SCENES))}"
        )
    return scene


@click.command()
@click.argument("scene_name", metavar="[SCENE]", required=False)
@click.option("--tier", default="quick", show_default=True, help="smoke, quick or paper.")
@WORKERS
@JSON
def reproduce(scene_name: str | None, tier: str, workers: int, as_json: bool) -> None:
    """Generate a SCENE's dataset from nothing and compare it with the recorded one; exit code 1 if it differs.

    Without SCENE, the one whose turn it is today.
    """
    from m3gn_bench.datasets.recorded import compare, read_record
    from m3gn_bench.generators.generate import generate as generate_dataset
    from m3gn_bench.generators.scene import OWN_SCENES

    names = list(OWN_SCENES)
    scene = _recorded_scene(scene_name or names[date.today().toordinal() % len(names)])
    read_record(scene.name).require(scene.dataset_version, tier)  # before the work, not after it
    report = Report(as_json)
    with TemporaryDirectory() as folder, report.progress(f"simulating {scene.name}") as on_progress:
        made = generate_dataset(scene, tier, Path(folder), workers=workers, on_progress=on_progress)
        outcome = compare(made.file)
    agreement = (
        "bit-identical to the record"
        if outcome.identical
        else f"not bit-identical; largest difference {outcome.largest_difference:.1e} in scaled units, at "
        f"{outcome.where} (allowed {outcome.tolerance:g}, for processors that round differently)"
    )
    report.finish(
        outcome.model_dump(mode="json") | {"ok": outcome.ok, "content_hash": made.content_hash},
        f"{scene.name}, tier {tier}, {made.trajectories} trajectories: {agreement}\n"
        + ("the dataset is reproduced" if outcome.ok else "this is NOT the recorded dataset"),
    )
    sys.exit(0 if outcome.ok else 1)
