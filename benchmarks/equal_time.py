"""Models after the same training time on one core: errors on the test split, over several seeds.

Every model's compact preset is trained on paper-tier data. Intervals are percentile bootstraps over seeds and
trajectories; models are compared on the same trajectories. Tables are made from a file of results, see `results.py`.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from results import Record, read_results, run_missing
from rich.console import Console

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.console import table
from m3gn_bench.data import load_cases
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.metrics import bootstrap_means
from m3gn_bench.model import load_preset
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import get_task
from m3gn_bench.training import train


def run(task: str, model: str, minutes: float, seed: int, data: Path) -> Record:
    """Train one model and score it on all test trajectories."""
    trained_on = get_task(task)
    path = find_or_generate(trained_on, "paper", data)
    train_cases, validation_cases, test_cases = (
        load_cases(path, trained_on, split, "paper") for split in ("train", "validation", "test")
    )
    config = load_preset(model, "compact", trained_on, {"training.minutes": minutes})
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        done = train(config, trained_on, train_cases, validation_cases, out, seed=seed, dataset_hash="")
        trained, _ = load_checkpoint(out)
    errors = evaluate_model(trained, test_cases, trained_on.context_sizes)
    return {
        "steps": done.steps,
        "validation_mse": done.validation_error,
        "test_mse": {size: error.mse.tolist() for size, error in errors.items()},
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="deformable_block")
    parser.add_argument("--models", default="m3gn,mgn_mp,mgn", help="the first is compared with the others")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--results", type=Path, default=Path("equal_time.jsonl"))
    options = parser.parse_args()

    models = options.models.split(",")
    plan = [
        {"task": options.task, "model": model, "minutes": options.minutes, "seed": seed}
        for seed in range(options.seeds)
        for model in models
    ]
    run_missing(options.results, plan, run, data=options.data)

    recorded = [r for r in read_results(options.results) if any(name.items() <= r.items() for name in plan)]
    rows: list[list[object]] = [[model] for model in models]
    for size in get_task(options.task).context_sizes:
        errors = [
            1e6 * np.array([r["test_mse"][str(size)] for r in recorded if r["model"] == model])
            for model in models
        ]
        means = bootstrap_means(errors)
        for row, error, mean in zip(rows, errors, means, strict=True):
            low, high = np.percentile(mean, [2.5, 97.5])
            worse = np.percentile(mean - means[0], [2.5, 97.5])
            row += [f"{error.mean():.3g} [{low:.3g}, {high:.3g}]", f"{worse[0]:.3g} .. {worse[1]:.3g}"]
    steps = [[r["steps"] for r in recorded if r["model"] == model] for model in models]
    columns = [
        column
        for size in get_task(options.task).context_sizes
        for column in (f"context {size}", f"above {models[0]}")
    ]
    Console().print(
        table(
            f"{options.task}, {options.minutes:g} minutes on one core, {options.seeds} seeds: test MSE x 1e6",
            ["model", "steps", *columns],
            [[row[0], f"{np.mean(s):.0f}", *row[1:]] for row, s in zip(rows, steps, strict=True)],
        )
    )


if __name__ == "__main__":
    main()
