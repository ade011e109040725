"""The command that hands trajectories to other tools; part of the command line (see `cli`)."""

from collections.abc import Callable
from pathlib import Path

import click

from m3gn_bench.console import JSON, Report

ENDINGS = {"vtkhdf": ".vtkhdf", "xdmf": ".xdmf", "npz": ".npz", "pyg": ".pt"}  # formats of one trajectory
FOLDER = "huggingface"  # the format of a whole dataset


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--format", "name", required=True, metavar="FORMAT", help="vtkhdf, xdmf, npz, pyg or huggingface."
)
@click.option("--split", default=None, help="train, validation or test.  [default: test]")
@click.option("--index", type=int, default=None, help="Which trajectory of the split.  [default: 0]")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path),
    default=None,
    help="File to write; a folder for huggingface.  [default: beside FILE, named after it]",
)
@JSON
def export(
    file: Path, name: str, split: str | None, index: int | None, output: Path | None, as_json: bool
) -> None:
    """Write a trajectory of a dataset FILE, or all of them, in the format of another tool.

    \b
    vtkhdf       for ParaView and VTK, in time. Points into FILE without a copy:
                 move both together. A collider gets a second file.
    xdmf         the same for older readers, as XML; with the collider.
    npz          plain numpy arrays
    pyg          a graph of PyTorch Geometric     (extra `pyg`)
    huggingface  all trajectories as Parquet with a dataset card, for
                 datasets.load_dataset            (extra `hub`)

    docs/export.md has the names of the arrays.
    """
    from m3gn_bench.datasets.errors import unknown_name
    from m3gn_bench.datasets.exports.huggingface import export_huggingface
    from m3gn_bench.datasets.file import find_key, open_file
    from m3gn_bench.errors import ConfigError

    report = Report(as_json)
    if name == FOLDER:
        if split is not None or index is not None:
            raise ConfigError("huggingface takes all trajectories: leave out --split and --index")
        folder = output or file.with_name(f"{file.stem}-{FOLDER}")
        with report.progress(f"writing {folder.name}") as on_progress:
            count = export_huggingface(file, folder, on_progress=on_progress)
        report.finish(
            {"format": name, "files": [str(folder)], "trajectories": count},
            f"{folder}: {count} trajectories",
        )
        return
    if name not in ENDINGS:
        raise ConfigError(unknown_name("format", name, [*ENDINGS, FOLDER]))
    if output is not None and output.suffix != ENDINGS[name]:
        raise ConfigError(f"{output} must end in {ENDINGS[name]}, by which readers of {name} know it")
    with open_file(file) as opened:
        key = find_key(opened, split or "test", index or 0)
    written = _exporter(name)(file, key, output or file.with_name(f"{file.stem}-{key}{ENDINGS[name]}"))
    report.finish(
        {"format": name, "files": [str(path) for path in written], "trajectory": key},
        "\n".join(f"{path}: {key}, {path.stat().st_size / 1e3:.1f} kB" for path in written),
    )


def _exporter(name: str) -> Callable[[Path, str, Path], list[Path]]:
    """What writes a trajectory, given the dataset file, the trajectory's key and the file to write."""
    if name == "vtkhdf":
        from m3gn_bench.datasets.exports.vtkhdf import export_vtkhdf

        return export_vtkhdf
    if name == "xdmf":
        from m3gn_bench.datasets.exports.xdmf import export_xdmf

        return export_xdmf
    if name == "npz":
        from m3gn_bench.datasets.exports.npz import export_npz

        return export_npz
    from m3gn_bench.pyg import export_pyg

    return export_pyg
