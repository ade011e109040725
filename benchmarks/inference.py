"""How long predictions of M3GN take, against MGN's rollout, over a whole test split.

Both predict every trajectory once, each with the batch size that takes it least time per trajectory, and they take
turns: whatever else the machine does meets both. Weights are untrained. The ratio of operations is what the ratio
of times would be if arithmetic took all of it, at the same rate.
"""

import argparse
import json
import math
import statistics
from pathlib import Path
from typing import Any

import torch
from inputs import add_dataset_options

from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import load_cases
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.profiling import TimedModel, fastest_batch
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import get_task

BATCHES = (1, 2, 4, 8, 16, 32)
SEARCHED = 8  # trajectories on which batch sizes are compared


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="tissue_manipulation")
    parser.add_argument(
        "--models", nargs=2, default=["m3gn", "mgn"], help="the second is compared with the first"
    )
    parser.add_argument(
        "--context", type=int, default=None, help="context frames (default: the task's fewest)"
    )
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--trajectories", type=int, default=None, help="default: all of the test split")
    parser.add_argument("--state", type=Path, default=None, help="a file to go on from after an interruption")
    add_dataset_options(parser)
    options = parser.parse_args()
    use_cpu(options.threads)

    task = get_task(options.task)
    path = find_or_generate(task, options.tier, options.data, splits=("test",))
    cases = load_cases(path, task, "test", options.tier)[: options.trajectories]
    context = options.context or task.context_sizes[0]
    timed = {}
    for name in options.models:
        model = build_model(load_preset(name, options.preset, task), task)
        model.prepare(cases)
        timed[name] = TimedModel(model.eval(), context)

    settings = {
        "task": task.name,
        "models": options.models,
        "context": context,
        "preset": options.preset,
        "threads": options.threads,
        "trajectories": len(cases),
        "torch": torch.__version__,
    }
    record: dict[str, Any] = {
        "settings": settings,
        "seconds": {name: [] for name in timed},
        "cpu_seconds": {name: [] for name in timed},
    }
    if options.state is not None and options.state.is_file():
        record = json.loads(options.state.read_text())
        if record["settings"] != settings:
            parser.error(f"{options.state} was made with other settings: {record['settings']}")

    def keep() -> None:
        if options.state is not None:
            write_bytes_atomically(options.state, json.dumps(record, indent=2).encode())

    if "batches" not in record:
        record["operations"] = {name: model.operations(cases[:SEARCHED]) for name, model in timed.items()}
        record["searched"] = {
            name: fastest_batch(model, cases[:SEARCHED], BATCHES) for name, model in timed.items()
        }
        record["batches"] = {
            name: min(found, key=found.__getitem__) for name, found in record["searched"].items()
        }
        keep()
    batches = record["batches"]
    for name, model in timed.items():  # the first run is a slow one, also after an interruption
        model.run(cases[: batches[name]], batches[name])
    turn = math.lcm(*batches.values())  # trajectories of one turn
    for first in range(turn * len(record["seconds"][options.models[0]]), len(cases), turn):
        part = cases[first : first + turn]
        for name, model in timed.items():
            run = model.run(part, min(batches[name], len(part)))
            record["seconds"][name].append(run.total)
            record["cpu_seconds"][name].append(run.cpu)
        keep()

    fast, slow = options.models
    weights = [min(turn, len(cases) - first) for first in range(0, len(cases), turn)]

    def mean(values: list[float]) -> float:
        return sum(value * weight for value, weight in zip(values, weights, strict=True)) / len(cases)

    means, cpu_means = (
        {name: mean(values) for name, values in record[clock].items()} for clock in ("seconds", "cpu_seconds")
    )
    by_turn = [b / a for a, b in zip(record["seconds"][fast], record["seconds"][slow], strict=True)]
    record |= {
        "seconds_per_trajectory": means,
        "cpu_seconds_per_trajectory": cpu_means,
        "ratio": means[slow] / means[fast],
        "ratio_in_cpu_time": cpu_means[slow] / cpu_means[fast],
        "ratio_median_of_turns": statistics.median(by_turn),
        "operations_ratio": record["operations"][slow] / record["operations"][fast],
    }
    if options.json:
        print(json.dumps(record, indent=2))
        return
    print(", ".join(f"{key} {value}" for key, value in settings.items()))
    for name in options.models:
        print(
            f"{name:6} {means[name]:8.4f} s ({cpu_means[name]:.4f} s of CPU) per trajectory at batch "
            f"{batches[name]:2}, "
            f"{record['operations'][name] / 1e9:8.2f} Gflop"
        )
    print(
        f"{slow} / {fast}: {record['ratio']:.2f} in time ({min(by_turn):.2f} .. {max(by_turn):.2f} over "
        f"{len(by_turn)} turns), {record['ratio_in_cpu_time']:.2f} in CPU time, "
        f"{record['operations_ratio']:.2f} in operations"
    )


if __name__ == "__main__":
    main()
