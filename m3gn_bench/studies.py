"""Studies of many cells, each measured once and kept at once: interrupted, a study goes on where it stopped."""

import io
import json
import shutil
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from m3gn_bench.checkpoint import read_description
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import ConfigError
from m3gn_bench.provenance import changes, commit
from m3gn_bench.version import __version__

OnProgress = Callable[[int, int], None]
RunJobs = Callable[..., Generator[tuple[str, "Result"]]]


@dataclass(frozen=True, eq=False)
class Result:
    """What a cell's measurement found.

    Attributes:
        values: whatever JSON can hold.
        arrays: and what it cannot.
    """

    values: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class Cell:
    """One measurement of a study, with a name that is unique in it.

    Where no time is taken, several are measured at once, in processes of their own: then pickle must be able to
    send `measure`.
    """

    name: str
    measure: Callable[[], Result]
    timed: bool = True


class Study:
    """A folder of results, for as long as a study is not finished.

    Args:
        folder: where results are kept.
        settings: what results depend on; those of other settings, or by other code, are dropped.

    Attributes:
        results: those there are of the cells that were asked for, by their names.

    Raises:
        ConfigError: the folder cannot be written.
    """

    def __init__(self, folder: Path, settings: dict[str, Any]) -> None:
        self.folder = folder
        self.results: dict[str, Result] = {}
        made_by = {"version": __version__, "commit": commit(), "changes": changes()}
        head = json.dumps({"settings": settings, **made_by}, sort_keys=True).encode()
        written = folder / "settings.json"
        try:
            if folder.is_dir() and not (written.is_file() and written.read_bytes() == head):
                shutil.rmtree(folder)
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes_atomically(written, head)
        except OSError as error:
            raise ConfigError(f"cannot write to {folder}: {error.strerror or error}") from error

    def measure(
        self, cells: Sequence[Cell], on_progress: OnProgress, run_jobs: RunJobs | None = None
    ) -> dict[str, Result]:
        """The results of all cells by their names; those that an interrupted run has left are not made again.

        Args:
            cells: of the study.
            on_progress: called with the numbers of cells done and in total.
            run_jobs: runs cells without a time in several processes (`generators.workers`); None: here.
        """
        paths = {cell.name: self.folder / f"{number:03}.npz" for number, cell in enumerate(cells)}
        kept = {name: _read(path) for name, path in paths.items()}
        results = self.results = {
            name: found for name, found in kept.items() if found is not None and found.values["key"] == name
        }

        def keep(name: str, made: Result) -> None:
            results[name] = Result({**made.values, "key": name}, made.arrays)
            buffer = io.BytesIO()
            np.savez(buffer, values=np.array(json.dumps(results[name].values)), **made.arrays)  # type: ignore[arg-type]
            write_bytes_atomically(paths[name], buffer.getvalue())
            on_progress(len(results), len(cells))

        on_progress(len(results), len(cells))
        todo = [cell for cell in cells if cell.name not in results]
        alone = [cell for cell in todo if cell.timed or run_jobs is None]
        for cell in alone:
            keep(cell.name, cell.measure())
        if run_jobs is not None:
            with closing(run_jobs(_measured, [cell for cell in todo if not cell.timed])) as finished:
                for name, made in finished:
                    keep(name, made)
        return {cell.name: results[cell.name] for cell in cells}

    def finish(self) -> None:
        """Delete the folder: what it held is kept elsewhere, and the next study begins anew."""
        (
            self.folder / "settings.json"
        ).unlink()  # without it a folder that is half deleted counts for nothing
        shutil.rmtree(self.folder)


@dataclass(frozen=True)
class Shipped:
    """A trained model that takes part in a study.

    Attributes:
        name, preset: which one.
        folder: of its checkpoint.
        training_seconds: CPU seconds of its training; None: nobody knows.
    """

    name: str
    preset: str
    folder: Path
    training_seconds: float | None = None

    @property
    def key(self) -> str:
        """Tells the same folder with other weights apart."""
        return f"{self.folder} {read_description(self.folder).weights_sha256[:8]}"


def distance(one: np.ndarray, other: np.ndarray) -> float:
    """Root mean square distance of nodes, of positions [..., nodes, dim]."""
    squared = (one.astype(np.float64) - other.astype(np.float64)) ** 2
    return float(np.sqrt(squared.sum(-1).mean()))


def _measured(cell: Cell) -> tuple[str, Result]:
    return cell.name, cell.measure()


def _read(path: Path) -> Result | None:
    if not path.is_file():
        return None
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    return Result(json.loads(str(arrays.pop("values"))), arrays)
