"""Steps of training per minute of one core, for every run of some plans: `leaderboard/plans/pace.jsonl`.

    OMP_NUM_THREADS=1 python benchmarks/pace.py leaderboard/plans/compact.toml --data data

Two of these at a time, each with a part of the runs (`--part 1/2`, `--part 2/2`), share a machine as a campaign does.
"""

import argparse
import time
import tomllib
from pathlib import Path

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
WARM_STEPS = 5
SECONDS = 15.0  # of CPU time


def measure(preset: str, task: str, model: str, data: Path) -> Record:
    """The pace of one model, in a process of its own."""
    use_cpu(1)
    what = get_task(task)
    config = load_preset(model, preset, what, {"training.minutes": 1.0})
    cases = load_cases(find_or_generate(what, "paper", data), what, "train", "paper")
    built = build_model(config, what)
    built.prepare(cases)
    run = Run(config, built, 0, Path(), {})
    for _ in range(WARM_STEPS):
        run.step(cases)
    steps, start = 0, time.process_time()
    while time.process_time() - start < SECONDS:
        run.step(cases)
        steps += 1
    pace = 60 * steps / (time.process_time() - start)
    return {"steps_per_minute": round(pace, 1), "machine": machine(), "commit": commit()}


def main() -> None:
    """Measure what the file does not have yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("plans", nargs="+", type=Path)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--part", default="1/1", help="which of how many, e.g. 1/2")
    parser.add_argument("--output", type=Path, default=PACE)
    arguments = parser.parse_args()
    part, parts = map(int, arguments.part.split("/"))
    names = [
        {"preset": grid.preset, "task": task, "model": model}
        for path in arguments.plans
        for grid in Plan.model_validate(tomllib.loads(path.read_text())).runs
        if grid.minutes is not None
        for task in grid.tasks
        for model in grid.models
    ]
    run_missing(arguments.output, names[part - 1 :: parts], measure, data=arguments.data)


if __name__ == "__main__":
    main()
