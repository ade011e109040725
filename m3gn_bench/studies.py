"""Studies of many cells, each measured once and kept at once: interrupted, a study goes on where it stopped."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import ConfigError
from m3gn_bench.version import __version__


@dataclass(frozen=True)
class Cell:
    """One measurement of a study.

    Attributes:
        name: unique in the study.
        measure: makes the result, which JSON must be able to hold.
    """

    name: str
    measure: Callable[[], dict[str, Any]]


def measure_cells(
    cells: Sequence[Cell],
    state: Path,
    *,
    settings: dict[str, Any],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:
    """The results of all cells, in order; those that an interrupted run has left in `state` are not made again.

    Args:
        cells: of the study.
        state: file of results so far, one JSON object per line. The caller deletes it once the study is kept.
        settings: what the results depend on; a state with other settings, or of another version, is dropped.
        on_progress: called with the numbers of cells done and in total.

    Raises:
        ConfigError: the state cannot be written.
    """
    head = {"settings": settings, "version": __version__}
    done = _read(state, head)
    try:
        state.parent.mkdir(parents=True, exist_ok=True)
        lines = "".join(json.dumps(line) + "\n" for line in (head, *done.values()))
        write_bytes_atomically(state, lines.encode())
        with state.open("a") as file:
            for number, cell in enumerate(cells):
                on_progress(number, len(cells))
                if cell.name not in done:
                    done[cell.name] = {"cell": cell.name, **cell.measure()}
                    file.write(json.dumps(done[cell.name]) + "\n")
                    file.flush()
    except OSError as error:
        raise ConfigError(f"cannot write to {state}: {error.strerror or error}") from error
    on_progress(len(cells), len(cells))
    return [done[cell.name] for cell in cells]


def _read(state: Path, head: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Whole lines of a state with the same head, by the cell's name."""
    if not state.is_file():
        return {}
    found = []
    for line in state.read_text().splitlines():
        try:
            found.append(json.loads(line))
        except json.JSONDecodeError:  # the line that a kill has cut
            break
    if not found or found[0] != json.loads(json.dumps(head)):
        return {}
    return {result["cell"]: result for result in found[1:]}
