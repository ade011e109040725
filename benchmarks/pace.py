"""Steps of training per minute of one core, for every run of some plans: `leaderboard/plans/pace.jsonl`.

    OMP_NUM_THREADS=1 python benchmarks/pace.py leaderboard/plans/compact.toml --data data

All models of a task take short turns, and medians over turns count, so that what else the machine does meets all of
them alike. Any `--tier` will do: more trajectories are not larger ones. Two of these at a time, each with a part of the
tasks (`--part 1/2`, `--part 2/2`), share a machine as a campaign does.
"""

import argparse
import time
import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from results import Record, run_missing

from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import load_cases
from m3gn_bench.generators.generate import machine
from m3gn_bench.leaderboard.campaign import Plan
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.provenance import commit
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import get_task
from m3gn_bench.training import Run

PACE = Path(__file__).parents[1] / "leaderboard" / "plans" / "pace.jsonl"
TURNS = 5
SECONDS, STEPS = 3.0, 3  # of a turn, at least; CPU time
Models = Mapping[tuple[str, str], list[str]]  # by preset and task


def measure(preset: str, task: str, models: Models, tier: str, data: Path) -> Record:
    """The pace of all models of a task, in a process of its own."""
    use_cpu(1)
    what = get_task(task)
    cases = load_cases(find_or_generate(what, tier, data), what, "train", tier)
    runs = {}
    for name in models[preset, task]:
        config = load_preset(name, preset, what, {"training.minutes": 1.0})
        model = build_model(config, what)
        model.prepare(cases)
        runs[name] = Run(config, model, 0, Path(), {})
        runs[name].step(cases)  # what is done but once
    turns: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(TURNS):
        for name, run in runs.items():
            steps, start, spent = 0, time.process_time(), 0.0
            while spent < SECONDS or steps < STEPS:
                run.step(cases)
                steps += 1
                spent = time.process_time() - start
            turns[name].append(60 * steps / spent)
    return {
        "steps_per_minute": {name: round(float(np.median(found)), 1) for name, found in turns.items()},
        "machine": machine(),
        "commit": commit(),
    }


def main() -> None:
    """Measure the tasks that the file does not have yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plans", nargs="+", type=Path)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--tier", default="paper")
    parser.add_argument("--part", default="1/1", help="which of how many, e.g. 1/2")
    parser.add_argument("--output", type=Path, default=PACE)
    arguments = parser.parse_args()
    part, parts = map(int, arguments.part.split("/"))
    models: dict[tuple[str, str], list[str]] = {}
    for path in arguments.plans:
        plan = Plan.model_validate(tomllib.loads(path.read_text()))
        for grid in plan.runs:
            for task in grid.tasks if grid.minutes is not None else ():
                known = models.setdefault((grid.preset, task), [])
                known += [model for model in grid.models if model not in known and model not in plan.pace_of]
    names = [{"preset": preset, "task": task} for preset, task in models]
    settings = {"models": models, "tier": arguments.tier, "data": arguments.data}
    run_missing(arguments.output, names[part - 1 :: parts], measure, **settings)


if __name__ == "__main__":
    main()
