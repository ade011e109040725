"""The command line. Exit codes: 0 fine, 1 something was found wrong, 2 could not run, 130 interrupted."""

import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from m3gn_bench.console import DATA, JSON, WORKERS, Report, table
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.study_commands import render_studies, stability, tradeoff
from m3gn_bench.version import __version__

if TYPE_CHECKING:
    from m3gn_bench.profiling import Profile, Ratios

# Modules that need torch or a simulator are imported inside the commands, so that --help stays instant.

THREADS = click.option(
    "--threads",
    type=click.IntRange(min=1),
    default=os.cpu_count() or 1,
    help="Of torch.  [default: all cores]",
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="m3gn-bench")
def cli() -> None:
    """Regenerate the M3GN benchmark's data, train models on it, and score them."""


def run(arguments: Sequence[str] | None = None) -> None:
    """Entry point: turns every error that a user can act on into one line and an exit code."""
    try:
        sys.exit(cli.main(args=arguments, prog_name="m3gn-bench", standalone_mode=False))
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted; run the same command again to go on", err=True)
        sys.exit(130)
    except BenchError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    except OSError as error:  # permissions, a full disk, a vanished folder
        click.echo(
            f"error: {error.strerror or error}{f': {error.filename}' if error.filename else ''}", err=True
        )
        sys.exit(2)


@cli.command("list")
@JSON
def list_command(as_json: bool) -> None:
    """Scenes, tasks, tiers, models and presets, with the number of parameters of each."""
    from m3gn_bench.datasets.schema import TIERS, tier_sizes
    from m3gn_bench.generators.scene import get_scene, scene_names
    from m3gn_bench.model import PRESETS, model_names
    from m3gn_bench.published import published_parameters
    from m3gn_bench.sizes import parameter_counts
    from m3gn_bench.tasks import TASKS

    scenes: list[dict[str, Any]] = [
        {
            "name": scene.name,
            "version": scene.dataset_version,
            "frames": scene.frames,
            "sizes": scene.paper_sizes,
            "fidelities": list(scene.fidelities),
        }
        for scene in map(get_scene, scene_names())
    ]
    tasks: list[dict[str, Any]] = [
        {
            "name": task.name,
            "title": task.title,
            "scene": task.scene,
            "frames": task.frames,
            "transitions": task.frames - 1,
            "dimension": task.dimension,
            "context_sizes": task.context_sizes,
            "tiers": {
                tier: {
                    split: scene.task_size(task.name, split, size)
                    for split, size in tier_sizes(tier, scene.paper_sizes).items()
                }
                for tier in TIERS
            },
        }
        for task in TASKS.values()
        for scene in [get_scene(task.scene)]
    ]
    counts = parameter_counts()
    models = [
        {
            "name": name,
            "preset": preset,
            "task": task,
            "parameters": count,
            "published_parameters": published_parameters(task, name, preset),
        }
        for (name, preset, task), count in counts.items()
    ]

    def shown_count(name: str, preset: str, task: str) -> str:
        published, count = published_parameters(task, name, preset), counts[name, preset, task]
        if published is None:
            return str(count)
        return f"{count} = paper" if published == count else f"{count}, paper {published}"

    Report(as_json).finish(
        {
            "scenes": scenes,
            "tasks": tasks,
            "tiers": list(TIERS),
            "presets": list(PRESETS),
            "models": models,
        },
        table(
            "Scenes",
            ["scene", "version", "frames", "paper tier (train/val/test)", "fidelities"],
            [
                [
                    s["name"],
                    s["version"],
                    s["frames"],
                    "/".join(map(str, s["sizes"].values())),
                    ", ".join(s["fidelities"]),
                ]
                for s in scenes
            ],
        ),
        table(
            "Tasks",
            ["task", "frames", "context sizes", *(f"{tier} (train/val/test)" for tier in TIERS)],
            [
                [
                    t["name"],
                    t["frames"],
                    ", ".join(map(str, t["context_sizes"])),
                    *("/".join(map(str, sizes.values())) for sizes in t["tiers"].values()),
                ]
                for t in tasks
            ],
        ),
        table(
            "Models: trainable parameters",
            ["model", "task", *PRESETS],
            [
                [name, task, *(shown_count(name, p, task) for p in PRESETS)]
                for name in model_names()
                for task in TASKS
            ],
        ),
    )


@cli.command()
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
    "--mesh",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="Falling teddy: drop the object in this file instead (a closed surface, or tetrahedra), scaled to 0.5 m.",
)
@click.option("--plane", default=None, help="Deformable block: stress (default) or strain.")
@click.option("--split", "splits", multiple=True, help="Only this split (may be given several times).")
@click.option(
    "--seed", type=click.IntRange(min=0), default=None, help="Of the dataset.  [default: the leaderboard's]"
)
@WORKERS
@DATA
@JSON
def generate(
    scene_name: str,
    tier: str,
    out: Path | None,
    fidelity: str,
    solver: str | None,
    mesh: Path | None,
    plane: str | None,
    splits: tuple[str, ...],
    seed: int | None,
    workers: int,
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
    options = {key: value for key, value in (("solver", solver), ("plane", plane)) if value is not None}
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


@cli.command()
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


@cli.command()
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


@cli.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--split", default="test", show_default=True, help="train, validation or test.")
@click.option("--index", type=int, default=0, show_default=True, help="Which trajectory of the split.")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    help="A .png shows frames side by side, a .gif one after the other.",
)
@click.option(
    "--frames",
    default=None,
    help="How many, evenly spaced, or a list such as 0,10,20.  [default: 6 in a .png, all in a .gif]",
)
@click.option("--fps", type=int, default=20, show_default=True, help="Of a .gif: frames per second.")
@click.option(
    "--colour",
    default=None,
    help="What colours show: displacement, height (displacement upwards) or area (over that at rest).  "
    "[default: depends on the scene]",
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
    as_json: bool,
) -> None:
    """Draw a trajectory of a dataset FILE, with matplotlib; no display is needed."""
    from m3gn_bench.view import view as draw

    report = Report(as_json)
    with report.progress(f"drawing {output.name}") as on_progress:
        viewed = draw(
            file,
            output,
            split=split,
            index=index,
            frames=frames,
            fps=fps,
            colour=colour,
            on_progress=on_progress,
        )
    report.finish(
        {"file": str(output), "trajectory": viewed.trajectory, "frames": viewed.frames},
        f"{output}: {viewed.trajectory}, {len(viewed.frames)} frames",
    )


@cli.command()
@click.argument("file", type=click.Path(path_type=Path))
@JSON
def card(file: Path, as_json: bool) -> None:
    """Write the numbers of a dataset FILE into its scene's card, and record its hashes."""
    from m3gn_bench.datasets.card import CARDS, fill, numbers
    from m3gn_bench.datasets.file import open_file, read_metadata
    from m3gn_bench.datasets.recorded import record, require_own
    from m3gn_bench.datasets.writer import write_bytes_atomically
    from m3gn_bench.generators.material_effect import material_effect
    from m3gn_bench.generators.scene import get_scene

    require_own(file)
    with open_file(file) as opened:
        scene = get_scene(read_metadata(opened).scene)
    effect = f"{material_effect(scene):.3g}"
    path = CARDS / f"{scene.name}.md"
    block = numbers(file, [("softest against stiffest material, mean squared difference, scaled", effect)])
    write_bytes_atomically(path, fill(path.read_text(), block).encode())
    recorded = record(file)
    Report(as_json).finish(
        {"card": str(path), "record": str(recorded)}, f"{path}: written\n{recorded}: written"
    )


@cli.command()
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
    from m3gn_bench.generators.scene import get_scene, scene_names

    names = scene_names()
    scene = get_scene(scene_name or names[date.today().toordinal() % len(names)])
    read_record(scene.name).require(scene.dataset_version, tier)  # before the work, not after it
    report = Report(as_json)
    with TemporaryDirectory() as folder, report.progress(f"simulating {scene.name}") as on_progress:
        made = generate_dataset(scene, tier, Path(folder), workers=workers, on_progress=on_progress)
        outcome = compare(made.file)
    agreement = (
        "bit-identical to the record"
        if outcome.identical
        else f"not bit-identical; largest difference {outcome.largest_difference:.1e} in scaled units in "
        f"{outcome.trajectories} trajectories (allowed {outcome.tolerance:g}, for processors that round differently)"
    )
    report.finish(
        outcome.model_dump(mode="json") | {"ok": outcome.ok, "content_hash": made.content_hash},
        f"{scene.name}, tier {tier}, {made.trajectories} trajectories: {agreement}\n"
        + ("the dataset is reproduced" if outcome.ok else "this is NOT the recorded dataset"),
    )
    sys.exit(0 if outcome.ok else 1)


@cli.command()
@click.option("--task", required=True, help="What to train on.")
@click.option("--model", required=True, help="Which model.")
@click.option("--preset", default="compact", show_default=True, help="smoke, compact or paper.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of weights and sampling."
)
@click.option("--minutes", type=float, default=None, help="Budget: CPU minutes of training steps.")
@click.option("--steps", type=int, default=None, help="Budget: optimiser steps.")
@click.option("--tier", default="paper", show_default=True, help="Which data.")
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), required=True, help="Folder of the run."
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Override a preset's value.")
@click.option(
    "--threads", type=click.IntRange(min=1), default=1, show_default=True, help="Of torch, on the CPU."
)
@click.option("--device", default="cpu", show_default=True, help="A torch device.")
@click.option("--tensorboard", is_flag=True, help="Write curves to the run's folder.")
@WORKERS
@DATA
@JSON
def train(
    task: str,
    model: str,
    preset: str,
    seed: int,
    minutes: float | None,
    steps: int | None,
    tier: str,
    out: Path,
    settings: tuple[str, ...],
    threads: int,
    device: str,
    tensorboard: bool,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Train a model and leave a checkpoint. A run that was interrupted goes on where it stopped."""
    from m3gn_bench.data import load_cases
    from m3gn_bench.datasets.file import content_hash, open_file
    from m3gn_bench.model import build_model, load_preset
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import get_task
    from m3gn_bench.training import Progress, require_budget, tensorboard_observer, usable_device
    from m3gn_bench.training import train as train_model

    report = Report(as_json)
    spec = get_task(task)
    overrides = _parse_settings(settings)
    overrides |= {f"training.{k}": v for k, v in (("minutes", minutes), ("steps", steps)) if v is not None}
    config = load_preset(model, preset, spec, overrides)
    # Whatever can be refused is refused before data are simulated.
    require_budget(config, build_model(config, spec).is_learned)
    usable_device(device)
    curves = tensorboard_observer(out) if tensorboard else None
    with report.progress(f"simulating {spec.scene}") as on_progress:
        path = find_or_generate(
            spec, tier, data, splits=("train", "validation"), workers=workers, on_progress=on_progress
        )
    with open_file(path) as file:
        dataset_hash = content_hash(file, tier, ("train", "validation"))
    training, validation = (load_cases(path, spec, split, tier) for split in ("train", "validation"))
    with report.progress(f"training {model}") as on_progress:

        def observe(progress: Progress) -> None:
            on_progress(round(1000 * progress.fraction), 1000)
            if curves:
                curves(progress)

        done = train_model(
            config,
            spec,
            training,
            validation,
            out,
            seed=seed,
            dataset_hash=dataset_hash,
            device=device,
            threads=threads,
            observe=observe,
        )
    error = (
        "none" if done.validation_error is None else f"{done.validation_error:.4g} (step {done.best_step})"
    )
    report.finish(
        {"checkpoint": str(out), **done.model_dump(mode="json")},
        f"checkpoint        {out}",
        f"steps             {done.steps} in {done.minutes:.1f} min",
        f"validation error  {error}",
    )


def _parse_settings(settings: Sequence[str]) -> dict[str, Any]:
    """Values of --set, in TOML's notation."""
    values: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        try:
            (values[key.strip()],) = tomllib.loads(f"value = {text}").values()
        except (tomllib.TOMLDecodeError, ValueError):
            raise click.BadParameter(
                f"{setting!r} is no KEY=VALUE with a TOML value, e.g. training.learning_rate=1e-3"
            ) from None
        if not equals:
            raise click.BadParameter(f"{setting!r} has no '='")
    return values


@cli.command()
@click.option("--model", required=True, help="Which model.")
@click.option(
    "--task", "task_name", default=None, help="Which task.  [default: all with a shipped checkpoint]"
)
@click.option("--tier", default="quick", show_default=True, help="Which test trajectories.")
@click.option("--preset", default="compact", show_default=True, help="Which shipped checkpoint.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which shipped checkpoint."
)
@click.option(
    "--checkpoint",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="A training run's folder.  [default: the checkpoint that ships with the project]",
)
@click.option("--contexts", default=None, help="Context sizes, e.g. 2,5,10.  [default: the task's]")
@click.option("--split", default="test", show_default=True, help="train, validation or test.")
@click.option("--track", default="compact", show_default=True, help="Leaderboard track for --record.")
@click.option(
    "--record",
    "record_home",
    type=click.Path(path_type=Path, file_okay=False),
    default=None,
    help="Also write a result record below this folder (in a checkout: leaderboard).",
)
@THREADS
@WORKERS
@DATA
@JSON
def evaluate(
    model: str,
    task_name: str | None,
    tier: str,
    preset: str,
    seed: int,
    checkpoint: Path | None,
    contexts: str | None,
    split: str,
    track: str,
    record_home: Path | None,
    threads: int,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Score a model over context sizes, beside the number on the leaderboard.

    Test trajectories are simulated first if they are not there yet.
    """
    from m3gn_bench.checkpoint import load_checkpoint, read_description
    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.data import load_cases
    from m3gn_bench.datasets.file import content_hash, open_file, stored_hashes
    from m3gn_bench.datasets.schema import as_split
    from m3gn_bench.errors import CheckpointError, ConfigError
    from m3gn_bench.evaluation import evaluate_model
    from m3gn_bench.leaderboard.record import (
        HASH_DIGITS,
        ContextResult,
        ResultRecord,
        checkpoint_folder,
        find_record,
        read_records,
        write_record,
    )
    from m3gn_bench.model import get_model_class, model_names
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import TASKS, get_task

    report = Report(as_json)
    use_cpu(threads)
    get_model_class(model)
    part = as_split(split)
    sizes = None if contexts is None else _parse_contexts(contexts)
    if record_home is not None and (part != "test" or sizes is not None):
        raise ConfigError("--record takes the test split at the task's own context sizes")
    if checkpoint is not None:
        described = read_description(checkpoint)
        if described.config.model_name != model:
            raise CheckpointError(f"{checkpoint} holds a {described.config.model_name}, not a {model}")
        if task_name not in (None, described.task):
            raise CheckpointError(f"{checkpoint} was trained on {described.task}, not on {task_name}")
        folders = {described.task: checkpoint}
    else:
        names = list(TASKS) if task_name is None else [get_task(task_name).name]
        folders = {name: checkpoint_folder(name, model, preset, seed) for name in names}
        if task_name is None:
            folders = {name: folder for name, folder in folders.items() if folder.is_dir()}
        missing = [name for name, folder in folders.items() if not folder.is_dir()]
        if missing or not folders:
            raise CheckpointError(
                f"no checkpoint of {model} (preset {preset}, seed {seed}) ships with the project"
                f"{f' for {missing[0]}' if missing else ''}; train one and pass --checkpoint. "
                f"Models: {', '.join(model_names())}"
            )

    recorded = read_records()
    rows: list[dict[str, Any]] = []
    for name, folder in folders.items():
        task = get_task(name)
        loaded, described = load_checkpoint(folder)
        with report.progress(f"simulating {task.scene}") as on_progress:
            path = find_or_generate(
                task,
                tier,
                data,
                splits=(part,),
                workers=workers,
                on_progress=on_progress,
            )
        cases = load_cases(path, task, part, tier)
        start = time.perf_counter()
        with report.progress(f"evaluating {name}") as on_progress:
            errors = evaluate_model(loaded, cases, sizes or task.context_sizes, on_progress)
        seconds = time.perf_counter() - start
        results = [ContextResult.from_errors(context, e) for context, e in errors.items()]
        keys = tuple(case.keys[0] for case in cases)
        with open_file(path) as file:
            dataset_hash = content_hash(file, tier, (part,))
            hashes = stored_hashes(file)
        record = ResultRecord(
            track=track,
            task=name,
            model=model,
            preset=described.config.preset,
            seed=described.seed,
            parameters=loaded.parameter_count(),
            tier=tier,
            split=split,
            dataset_hash=dataset_hash,
            keys=keys,
            trajectory_hashes=tuple(hashes[key][:HASH_DIGITS] for key in keys),
            package_version=__version__,
            commit=_commit(),
            evaluation_device="cpu",
            evaluation_seconds=seconds,
            checkpoint=described,
            results=tuple(results),
        )
        if record_home is not None:
            write_record(record, record_home)
        reference = find_record(recorded, name, model, record.preset, record.seed)
        rows += [
            {
                "task": name,
                "model": model,
                "preset": record.preset,
                "seed": record.seed,
                "context": r.context,
                "mse": r.mse,
                "mse_free_nodes": r.mse_free_nodes,
                "ci95": r.ci95,
                "per_timestep_mse": r.per_timestep_mse,
                "trajectories": len(keys),
                "recorded_mse": reference.mse_over(r.context, keys)
                if reference and split == "test"
                else None,
            }
            for r in results
        ]
    report.finish(
        {"model": model, "tier": tier, "split": split, "results": rows},
        table(
            f"{model}: full-rollout MSE x 1e6, {split} split",
            [
                "task",
                "context",
                "mse",
                "95 % interval",
                "free nodes",
                "trajectories",
                "recorded",
                "difference",
            ],
            [
                [
                    row["task"],
                    row["context"],
                    f"{row['mse'] * 1e6:.4g}",
                    f"{row['ci95'][0] * 1e6:.3g} .. {row['ci95'][1] * 1e6:.3g}",
                    f"{row['mse_free_nodes'] * 1e6:.4g}",
                    row["trajectories"],
                    *(
                        ("none", "")
                        if row["recorded_mse"] is None
                        else (
                            f"{row['recorded_mse'] * 1e6:.4g}",
                            f"{row['mse'] / row['recorded_mse'] - 1:+.1e}",
                        )
                    ),
                ]
                for row in rows
            ],
        ),
    )


def _parse_contexts(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise click.BadParameter(f"--contexts {text!r} is no list of numbers such as 2,5,10") from None


@cli.command()
@click.option("--task", "task_name", required=True, help="What to predict.")
@click.option(
    "--model", "models", required=True, multiple=True, help="Which model (may be given several times)."
)
@click.option("--preset", default="paper", show_default=True, help="smoke, compact or paper.")
@click.option("--context", type=int, default=None, help="Context frames.  [default: the task's fewest]")
@click.option("--tier", default="smoke", show_default=True, help="Which test trajectories.")
@click.option(
    "--trajectories", type=click.IntRange(min=1), default=4, show_default=True, help="How many of them."
)
@click.option(
    "--repetitions", type=click.IntRange(min=1), default=5, show_default=True, help="Of every timing."
)
@click.option("--device", default="cpu", show_default=True, help="A torch device.")
@THREADS
@WORKERS
@DATA
@JSON
def profile(
    task_name: str,
    models: tuple[str, ...],
    preset: str,
    context: int | None,
    tier: str,
    trajectories: int,
    repetitions: int,
    device: str,
    threads: int,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Time and memory that predictions take, beside M3GN's in the same run.

    One trajectory at a time, and in the batches that take least time per trajectory. Models are untrained: time
    does not depend on how good their weights are. Test trajectories are simulated first if they are not there yet.
    """
    import torch

    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.data import load_cases
    from m3gn_bench.model import get_model_class
    from m3gn_bench.profiling import profile_models, ratios
    from m3gn_bench.published import published_parameters
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import get_task
    from m3gn_bench.training import usable_device

    report = Report(as_json)
    use_cpu(threads)
    task = get_task(task_name)
    for name in models:
        get_model_class(name)
    where = usable_device(device)
    with report.progress(f"simulating {task.scene}") as on_progress:
        path = find_or_generate(
            task, tier, data, splits=("train", "test"), workers=workers, on_progress=on_progress
        )
    cases = load_cases(path, task, "test", tier)[:trajectories]
    frames = task.context_sizes[0] if context is None else context
    with report.progress("profiling") as on_progress:
        profiles = profile_models(
            models,
            task,
            preset,
            cases,
            frames,
            training_cases=lambda: load_cases(path, task, "train", tier),
            repetitions=repetitions,
            device=where,
            on_progress=on_progress,
        )
    compared = list(zip(profiles, ratios(profiles), strict=True))

    def row(label: str, number: "Callable[[Profile, Ratios], str]") -> list[object]:
        return [label, *(number(p, r) for p, r in compared)]

    report.finish(
        {
            "task": task.name,
            "preset": preset,
            "context": frames,
            "tier": tier,
            "trajectories": len(cases),
            "repetitions": repetitions,
            "device": device,
            "threads": threads,
            "torch": torch.__version__,
            "models": [
                asdict(p)
                | {
                    "ratios": asdict(r),
                    "published_parameters": published_parameters(task.name, p.model, preset),
                }
                for p, r in compared
            ],
        },
        table(
            f"{task.title}, context {frames}, preset {preset}, {device}, {threads} thread(s): per trajectory",
            ["", *(p.model for p in profiles)],
            [
                row("one at a time: context encoding [s]", lambda p, r: f"{p.single.encoding:.4f}"),
                row("one at a time: simulation [s]", lambda p, r: f"{p.single.simulation:.4f}"),
                row("one at a time: total [s]", lambda p, r: f"{p.single.total:.4f}"),
                row(
                    "    fastest .. slowest", lambda p, r: f"{p.single.fastest:.4f} .. {p.single.slowest:.4f}"
                ),
                row("    over M3GN's", lambda p, r: f"{r.single:.2f}"),
                row("batched: trajectories at once", lambda p, r: str(p.batched.batch)),
                row("batched: context encoding [s]", lambda p, r: f"{p.batched.encoding:.4f}"),
                row("batched: simulation [s]", lambda p, r: f"{p.batched.simulation:.4f}"),
                row("batched: total [s]", lambda p, r: f"{p.batched.total:.4f}"),
                row(
                    "    fastest .. slowest",
                    lambda p, r: f"{p.batched.fastest:.4f} .. {p.batched.slowest:.4f}",
                ),
                row("    over M3GN's", lambda p, r: f"{r.batched:.2f}"),
                row("operations [Gflop]", lambda p, r: f"{p.operations / 1e9:.2f}"),
                row("    over M3GN's", lambda p, r: f"{r.operations:.2f}"),
                row("peak memory of tensors [MB]", lambda p, r: f"{p.peak_memory / 1e6:.1f}"),
                row("parameters", lambda p, r: str(p.parameters)),
            ],
        ),
    )


for command in (tradeoff, stability, render_studies):
    cli.add_command(command)


def _commit() -> str | None:
    """The commit of the checkout that this code runs from, marked if files differ; None if installed."""
    checkout = Path(__file__).parents[1]
    if not (checkout / "pyproject.toml").is_file():
        return None
    git = ["git", "-C", str(checkout)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        # Records and checkpoints are what is being made: they change no number.
        code = [".", ":!leaderboard/records", ":!leaderboard/checkpoints", ":!leaderboard/LEADERBOARD.md"]
        status = subprocess.run(
            [*git, "status", "--porcelain", "-uno", "--", *code], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+changes" if status.stdout.strip() else "")


@cli.group()
def leaderboard() -> None:
    """Show the leaderboard, make its tables, re-derive its numbers."""


@leaderboard.command()
@click.option("--task", "task_name", default=None, help="Only this task.")
@JSON
def show(task_name: str | None, as_json: bool) -> None:
    """All result records."""
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.tasks import get_task

    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records() if task_name in (None, r.task)]
    rows: list[list[object]] = [
        [
            r.task,
            r.model,
            r.preset,
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
            ["task", "model", "preset", "seed", "context", "mse", "free nodes"],
            rows,
        ),
    )


@leaderboard.command()
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="[default: the project's own]",
)
@click.option("--check", is_flag=True, help="Write nothing; exit code 1 if the page is out of date.")
@JSON
def render(output: Path | None, check: bool, as_json: bool) -> None:
    """Make the Markdown tables from the records."""
    from m3gn_bench.datasets.writer import write_bytes_atomically
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.leaderboard.render import TABLE
    from m3gn_bench.leaderboard.render import render as render_page

    path = output or TABLE
    records = read_records()
    content = render_page(records).encode()
    current = path.is_file() and path.read_bytes() == content
    if not check:
        write_bytes_atomically(path, content)
    verdict = ("up to date" if current else "OUT OF DATE") if check else "written"
    Report(as_json).finish(
        {"file": str(path), "records": len(records), "up_to_date": current or not check},
        f"{path}: {verdict}, {len(records)} records",
    )
    sys.exit(1 if check and not current else 0)


@leaderboard.command("check")
@click.option("--task", "task_name", default=None, help="Only this task.")
@click.option("--trajectories", type=click.IntRange(min=1), default=3, show_default=True, help="Per record.")
@click.option("--offset", type=int, default=None, help="Which of them.  [default: changes from day to day]")
@JSON
def check_command(task_name: str | None, trajectories: int, offset: int | None, as_json: bool) -> None:
    """Re-derive numbers from nothing and compare with the records; exit code 1 where they differ."""
    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.leaderboard.check import RELATIVE_TOLERANCE, check_records
    from m3gn_bench.leaderboard.record import read_records
    from m3gn_bench.tasks import get_task

    use_cpu(os.cpu_count() or 1)
    if task_name is not None:
        get_task(task_name)
    records = [r for r in read_records() if task_name in (None, r.task)]
    report = Report(as_json)
    with report.progress("re-deriving") as on_progress:
        outcome = check_records(
            records,
            trajectories=trajectories,
            offset=date.today().toordinal() if offset is None else offset,
            on_progress=on_progress,
        )
    largest = max((c.relative_difference for c in outcome.compared), default=0.0)
    identical = sum(c.same_trajectory for c in outcome.compared)
    lines = [*outcome.problems]
    lines += [
        f"{c.task}/{c.model}-{c.preset}-s{c.seed}, context {c.context}, {c.trajectory}: "
        f"recorded {c.recorded:.6g}, re-derived {c.rederived:.6g}"
        for c in outcome.compared
        if not c.ok
    ]
    lines += [
        f"{len(outcome.compared)} errors of {len(records)} records compared; largest relative difference "
        f"{largest:.1e} (allowed {RELATIVE_TOLERANCE:g}); {identical} on bit-identical trajectories",
        "every sampled number was re-derived" if outcome.ok else "the leaderboard does NOT hold",
    ]
    report.finish(outcome.model_dump(mode="json"), "\n".join(lines))
    sys.exit(0 if outcome.ok else 1)
