"""The commands that train, score and time models; part of the command line (see `cli`)."""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from m3gn_bench.console import DATA, DEVICE, JSON, SEED, WORKERS, Report, table
from m3gn_bench.provenance import usable_cores

if TYPE_CHECKING:
    from m3gn_bench.leaderboard.record import ResultRecord
    from m3gn_bench.profiling import Profile, Ratios

THREADS = click.option(
    "--threads",
    type=click.IntRange(min=1),
    default=usable_cores(),
    help="Of torch.  [default: all cores]",
)
DATASET = click.option(
    "--dataset",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="Use all of this file, whatever --tier and --data say; for imported data, for example.",
)


@click.command()
@click.option("--task", required=True, help="What to train on.")
@click.option("--model", required=True, help="Which model.")
@click.option("--preset", default="compact", show_default=True, help="smoke, compact or paper.")
@click.option("--seed", type=SEED, default=0, show_default=True, help="Of weights and sampling.")
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
@DEVICE
@click.option("--tensorboard", is_flag=True, help="Write curves to the run's folder.")
@DATASET
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
    dataset: Path | None,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Train a model and leave a checkpoint. A run that was interrupted goes on where it stopped.

    Several processes that torchrun started share every batch: see docs/scale.md.
    """
    from m3gn_bench.data import load_cases
    from m3gn_bench.datasets.file import content_hash, open_file
    from m3gn_bench.datasets.writer import reserved
    from m3gn_bench.distributed import torchrun_group
    from m3gn_bench.model import build_model, load_preset
    from m3gn_bench.sources import find_or_generate, given
    from m3gn_bench.tasks import get_task
    from m3gn_bench.training import Progress, require_budget, tensorboard_observer, usable_device
    from m3gn_bench.training import train as train_model

    usable_device(device)
    group = click.get_current_context().with_resource(torchrun_group(device))
    report = Report(as_json, silent=not group.leads)
    spec = get_task(task)
    if dataset is not None:
        spec, tier = given(dataset, task)
    overrides = _parse_settings(settings)
    overrides |= {f"training.{k}": v for k, v in (("minutes", minutes), ("steps", steps)) if v is not None}
    config = load_preset(model, preset, spec, overrides)
    # Whatever can be refused is refused before data are simulated.
    require_budget(config, build_model(config, spec).is_learned)
    group.require_shares(config.training.batch_size)
    if group.leads:
        click.get_current_context().with_resource(reserved(out, "trains", out))
    curves = tensorboard_observer(out) if tensorboard and group.leads else None
    path = dataset
    if path is None:
        with group.first_alone(), report.progress(f"simulating {spec.scene}") as on_progress:
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
            group=group,
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
        key, _, text = setting.partition("=")
        try:
            (values[key.strip()],) = tomllib.loads(f"value = {text}").values()
        except ValueError:
            raise click.BadParameter(
                f"{setting!r} is no KEY=VALUE with a TOML value, e.g. training.learning_rate=1e-3"
            ) from None
    return values


@click.command()
@click.option("--model", required=True, help="Which model.")
@click.option(
    "--task", "task_name", default=None, help="Which task.  [default: all with a shipped checkpoint]"
)
@click.option("--tier", default="quick", show_default=True, help="Which test trajectories.")
@click.option("--preset", default="compact", show_default=True, help="Which shipped checkpoint.")
@click.option("--seed", type=SEED, default=0, show_default=True, help="Which shipped checkpoint.")
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
@click.option(
    "--variant",
    default="",
    help="For --record: what differs from the model's preset, in a word (needed where settings do).",
)
@click.option("--replace", is_flag=True, help="For --record: replace a record of the same name.")
@DATASET
@DEVICE
@THREADS
@WORKERS
@DATA
@JSON
@click.pass_context
def evaluate(
    invoked: click.Context,
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
    variant: str,
    replace: bool,
    dataset: Path | None,
    device: str,
    threads: int,
    workers: int,
    data: Path,
    as_json: bool,
) -> None:
    """Score a model over context sizes, beside the number on the leaderboard.

    Test trajectories are simulated first if they are not there yet. What is recorded of the same model, preset and
    seed is given for exactly these trajectories; with --tier paper they are all that the board averages over.
    """
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.cpu import use_cpu
    from m3gn_bench.data import require_context
    from m3gn_bench.datasets.file import open_file, read_splits
    from m3gn_bench.datasets.schema import as_split
    from m3gn_bench.datasets.writer import require_writable
    from m3gn_bench.errors import CheckpointError, ConfigError
    from m3gn_bench.leaderboard.record import (
        SHIPPED,
        Name,
        Variant,
        checkpoint_folder,
        find_record,
        read_records,
        shipped_models,
        write_record,
    )
    from m3gn_bench.leaderboard.scoring import score
    from m3gn_bench.metrics import confidence_interval
    from m3gn_bench.model import get_model_class, require_preset
    from m3gn_bench.sources import find_or_generate, given
    from m3gn_bench.tasks import TASKS, get_task
    from m3gn_bench.training import usable_device

    report = Report(as_json)
    use_cpu(threads)
    usable_device(device)  # refused before data are simulated
    get_model_class(model)
    require_preset(preset)
    part = as_split(split)
    sizes = None if contexts is None else _parse_contexts(contexts)
    _require_part_of_a_file_name("--track", track, Name, "letters, digits and any of . - _")
    _require_part_of_a_file_name(
        "--variant", variant, Variant, "letters, digits, spaces and any of . + = - _"
    )
    if record_home is not None and (part != "test" or sizes is not None):
        raise ConfigError("--record takes the test split at the task's own context sizes")
    if record_home is not None and dataset is not None:
        raise ConfigError("--record takes the benchmark's own data, so not --dataset")
    if checkpoint is not None:
        described = read_description(checkpoint)
        if described.config.model_name != model:
            raise CheckpointError(f"{checkpoint} holds a {described.config.model_name}, not a {model}")
        if task_name not in (None, described.task):
            raise CheckpointError(f"{checkpoint} was trained on {described.task}, not on {task_name}")
        for name, asked, held in (
            ("preset", preset, described.config.preset),
            ("seed", seed, described.seed),
        ):
            if invoked.get_parameter_source(name) is ParameterSource.COMMANDLINE and asked != held:
                raise CheckpointError(f"{checkpoint} is of {name} {held}, not of {asked}")
        folders = {described.task: checkpoint}
    else:
        names = list(TASKS) if task_name is None else [get_task(task_name).name]
        if dataset is not None and task_name is None:
            with open_file(dataset) as file:
                names = list(read_splits(file))
        folders = {name: checkpoint_folder(name, model, preset, seed) for name in names}
        if task_name is None:
            folders = {name: folder for name, folder in folders.items() if folder.is_dir()}
        missing = [name for name, folder in folders.items() if not folder.is_dir()]
        if missing or not folders:
            there = sorted({name for task in names for name in shipped_models(task)})
            raise CheckpointError(
                f"no checkpoint of {model} (preset {preset}, seed {seed}) ships with the project"
                f"{f' for {missing[0]}' if missing else ''}; train one and pass --checkpoint. "
                f"Of preset {SHIPPED}, seed 0, there are {', '.join(there) or 'none'}"
            )
    if sizes is not None and dataset is None:
        for size in sizes:
            for name in folders:
                require_context(size, get_task(name).frames)

    if record_home is None and (variant or replace):
        raise ConfigError("--variant and --replace say what --record does, which is not given")
    if record_home is not None:
        board = [] if replace else read_records(record_home)
        for folder in folders.values():
            _require_recordable(folder, board, track, variant)
        require_writable(record_home)
    recorded = read_records()
    rows: list[dict[str, Any]] = []
    for name, folder in folders.items():
        task = get_task(name)
        path = dataset
        if path is not None:
            _, tier = given(path, name)
        else:
            with report.progress(f"simulating {task.scene}") as on_progress:
                path = find_or_generate(
                    task,
                    tier,
                    data,
                    splits=(part,),
                    workers=workers,
                    on_progress=on_progress,
                )
        with report.progress(f"evaluating {name}") as on_progress:
            record = score(
                folder,
                path,
                track=track,
                tier=tier,
                split=part,
                contexts=sizes,
                variant=variant,
                ships=record_home is not None and _is_shipped(folder, record_home),
                device=device,
                on_progress=on_progress,
            )
        if record_home is not None:
            write_record(record, record_home)
        # Trajectories of another file may have the names of the board's.
        reference = None if dataset else find_record(recorded, track, name, record.name)
        if reference and reference.dataset_version != record.dataset_version:
            reference = None  # of other trajectories
        rows += [
            {
                "task": name,
                "model": model,
                "preset": record.preset,
                "seed": record.seed,
                "context": r.context,
                "mse": r.mse,
                "mse_free_nodes": r.mse_free_nodes,
                "ci95": confidence_interval(r.trajectory_mse),
                "per_timestep_mse": r.per_timestep_mse,
                "trajectories": len(record.keys),
                "recorded_mse": reference.mse_over(r.context, record.keys)
                if reference and split == "test"
                else None,
            }
            for r in record.results
        ]
    report.finish(
        {
            "model": model,
            "dataset": None if dataset is None else str(dataset),
            "tier": tier,
            "split": split,
            "results": rows,
        },
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


def _require_recordable(folder: Path, board: "Sequence[ResultRecord]", track: str, variant: str) -> None:
    """Raises ConfigError if a record would replace another, or pass for one of the model's preset and is not."""
    from m3gn_bench.checkpoint import is_of_preset, read_description
    from m3gn_bench.errors import ConfigError
    from m3gn_bench.leaderboard.record import find_record, run_name

    found = read_description(folder)
    config = found.config
    name = run_name(config.model_name, config.preset, variant, found.seed)
    if find_record(board, track, found.task, name) is not None:
        raise ConfigError(
            f"there is a record of {found.task}/{name} on track {track!r} already; give --replace to replace it, or "
            "another --track"
        )
    of_preset = is_of_preset(found)  # refuses a preset that there is not, whatever the variant
    if not variant and (found.materials or not of_preset):
        raise ConfigError(
            f"{folder} was trained with other settings than preset {config.preset!r} has, or on some materials only; "
            "name what differs with --variant"
        )


def _require_part_of_a_file_name(option: str, value: str, kind: Any, allowed: str) -> None:
    """Raises ConfigError if a track or a variant has characters that such names do not have."""
    from pydantic import TypeAdapter, ValidationError

    from m3gn_bench.errors import ConfigError

    try:
        TypeAdapter(kind).validate_python(value)
    except ValidationError:
        raise ConfigError(f"{option} {value!r}: {allowed} make file names") from None


def _is_shipped(checkpoint: Path, home: Path) -> bool:
    """Whether a checkpoint lies where those that ship with a leaderboard do."""
    from m3gn_bench.checkpoint import read_description
    from m3gn_bench.leaderboard.record import checkpoint_folder

    found = read_description(checkpoint)
    place = checkpoint_folder(found.task, found.config.model_name, found.config.preset, found.seed, home)
    return checkpoint.resolve() == place.resolve()


def _parse_contexts(text: str) -> list[int]:
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise click.BadParameter(f"--contexts {text!r} is no list of numbers such as 2,5,10") from None


@click.command()
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
@DEVICE
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
    from m3gn_bench.data import load_cases, require_context
    from m3gn_bench.model import load_preset
    from m3gn_bench.profiling import profile_models, ratios
    from m3gn_bench.published import published_parameters
    from m3gn_bench.sources import find_or_generate
    from m3gn_bench.tasks import get_task
    from m3gn_bench.training import usable_device

    report = Report(as_json)
    use_cpu(threads)
    task = get_task(task_name)
    frames = task.context_sizes[0] if context is None else context
    require_context(frames, task.frames)
    for name in models:
        load_preset(name, preset, task)
    where = usable_device(device)
    with report.progress(f"simulating {task.scene}") as on_progress:
        path = find_or_generate(
            task, tier, data, splits=("train", "test"), workers=workers, on_progress=on_progress
        )
    cases = load_cases(path, task, "test", tier)[:trajectories]
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
