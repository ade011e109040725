"""The command that takes in published data of others; part of the command line (see `cli`)."""

from pathlib import Path

import click

from m3gn_bench.console import DATA, JSON, Report


@click.command("import")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--layout", required=True, help="Whose files they are: ggns, mango or deepmind.")
@click.option("--task", required=True, help="As what to use them.")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    default=None,
    help="The dataset file to make.  [default: LAYOUT_TASK.h5 in the folder of --data]",
)
@click.option(
    "--skip", type=click.IntRange(min=0), default=0, show_default=True, help="Leave out so many frames first."
)
@click.option(
    "--every", type=click.IntRange(min=1), default=1, show_default=True, help="Of the others, keep every nth."
)
@click.option("--frames", type=click.IntRange(min=2), default=None, help="Keep at most so many.")
@click.option(
    "--limit", type=click.IntRange(min=1), default=None, help="At most so many trajectories of each split."
)
@DATA
@JSON
def import_command(
    paths: tuple[Path, ...],
    layout: str,
    task: str,
    output: Path | None,
    skip: int,
    every: int,
    frames: int | None,
    limit: int | None,
    data: Path,
    as_json: bool,
) -> None:
    """Make a dataset file of published data of others, for `train --dataset` and `evaluate --dataset`."""
    from m3gn_bench.data import case_from
    from m3gn_bench.datasets.errors import DatasetError
    from m3gn_bench.datasets.imports.convert import Frames, import_dataset, open_source
    from m3gn_bench.datasets.schema import Metadata
    from m3gn_bench.datasets.trajectory import Trajectory
    from m3gn_bench.tasks import get_task, task_of_data
    from m3gn_bench.version import __version__

    report = Report(as_json)
    own = get_task(task)
    source = open_source(layout, paths, task)

    def check(metadata: Metadata, key: str, trajectory: Trajectory) -> None:
        told = task_of_data(task, metadata)
        for feature in told.material:
            value = trajectory.material[feature.name]
            if feature.logarithmic and value <= 0:
                raise DatasetError(f"{feature.name} is {value:g}, of which models are told the logarithm")
        case_from(told, metadata, trajectory, key)

    with report.progress(f"importing {layout}") as on_progress:
        made = import_dataset(
            source,
            layout,
            task,
            output or data / f"{layout}_{task}.h5",
            version=__version__,
            frames=Frames(skip, every, frames),
            limit=limit,
            check=check,
            on_progress=on_progress,
        )
    metadata = made.metadata
    record: dict[str, object] = {
        "file": str(made.file),
        "content_hash": metadata.content_hash,
        "layout": layout,
        "task": task,
        "trajectories": metadata.paper_sizes,
        "frames": metadata.frames,
        "benchmark_frames": own.frames,
        "material": sorted(metadata.material_units),
        "megabytes": made.file.stat().st_size / 1e6,
    }
    missing = [feature.name for feature in own.material if feature.name not in metadata.material_units]
    report.finish(
        record,
        f"file           {made.file} ({made.file.stat().st_size / 1e6:.1f} MB)",
        f"content hash   {metadata.content_hash}",
        "trajectories   " + ", ".join(f"{number} {split}" for split, number in metadata.paper_sizes.items()),
        f"frames         {metadata.frames}; the benchmark's own data have {own.frames}",
        *([f"not told       {', '.join(missing)}"] if missing else []),
    )
