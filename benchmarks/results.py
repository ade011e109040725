"""Results of long benchmarks, one JSON line per run: nothing is measured twice, and nothing is lost."""

import json
import multiprocessing
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

Record = dict[str, Any]


def read_results(path: Path) -> list[Record]:
    """All recorded runs."""
    text = path.read_text() if path.is_file() else ""
    return [json.loads(line) for line in text.splitlines()]


def run_missing(path: Path, plan: Iterable[Record], run: Callable[..., Record], **settings: Any) -> None:
    """Run what the file does not hold yet, and append each result as it ends.

    Args:
        path: the file; several processes may append to it, each with a plan of its own.
        plan: what names each run, as keyword arguments.
        run: called with those and `settings`, in a process of its own: nothing that it changes in the code
            survives, and memory starts afresh. Its result is recorded beside the name.
        settings: further keyword arguments, which name nothing.
    """
    for name in plan:
        if any(name.items() <= recorded.items() for recorded in read_results(path)):
            continue
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            result = pool.apply(run, kwds=name | settings)
        with path.open("a") as file:
            file.write(json.dumps(name | result) + "\n")
