"""What each device of training brings, in steps per second and in error after the same time on one core.

M3GN's compact preset is trained as it is, and with one thing changed at a time. The table is made from a file of
results, see `results.py`.
"""

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from results import Record, read_results, run_missing
from rich.console import Console
from usual_m3gn import PlainM3GN

from m3gn_bench import checkpoint, training
from m3gn_bench.console import table
from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import Body, load_cases
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.m3gn import M3GN
from m3gn_bench.model import Model, RunConfig, build_model, load_preset
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import Task, get_task

Exchange = Callable[[], AbstractContextManager[Any]]


@contextmanager
def usual_layers() -> Iterator[None]:
    """Concatenate, per-edge linear layer, scatter."""

    def build(config: RunConfig, task: Task, seed: int = 0) -> Model:
        model = build_model(config, task, seed)
        assert isinstance(model, M3GN)
        return PlainM3GN(model)

    with patch.object(training, "build_model", build), patch.object(checkpoint, "build_model", build):
        yield


def rebuilt_static_parts() -> AbstractContextManager[Any]:
    """Rest vectors of the mesh computed whenever they are needed."""
    return patch.object(Body, "rest_vectors", property(Body.rest_vectors.func))


def no_scaling() -> AbstractContextManager[Any]:
    """Loss, movements and what is predicted in scaled coordinates, not in units of the data's spread."""
    return patch.object(Model, "prepare", lambda self, cases: None)


def memory_given_back() -> AbstractContextManager[Any]:
    """The C library's defaults: large blocks go back to the system as soon as they are free."""
    return patch.object(training, "use_cpu", torch.set_num_threads)


# name in the table, what is overridden, what is exchanged in the code
VARIANTS: dict[str, tuple[dict[str, Any], Exchange | None]] = {
    "as it is": ({}, None),  # one or two context pairs, one trajectory per step
    "usual edge layer": ({}, usual_layers),
    "all context pairs": ({"model.max_training_context_pairs": None}, None),
    "one context pair": ({"model.max_training_context_pairs": 1}, None),
    "four trajectories per step": ({"training.batch_size": 4}, None),
    "four and all pairs": ({"training.batch_size": 4, "model.max_training_context_pairs": None}, None),
    "eight trajectories per step": ({"training.batch_size": 8}, None),
    "eight and all pairs": ({"training.batch_size": 8, "model.max_training_context_pairs": None}, None),
    "sixteen trajectories per step": ({"training.batch_size": 16}, None),
    "sixteen and all pairs": ({"training.batch_size": 16, "model.max_training_context_pairs": None}, None),
    "four and one pair": ({"training.batch_size": 4, "model.max_training_context_pairs": 1}, None),
    "bfloat16 products": ({"training.precision": "bfloat16"}, None),
    "constant learning rate": ({"training.cosine_decay": False}, None),
    "no scaling by the data's spread": ({}, no_scaling),
    "static parts rebuilt": ({}, rebuilt_static_parts),
    "memory given back": ({}, memory_given_back),
}


def rates(task_name: str, variants: list[str], steps: int, data: Path) -> list[tuple[str, float]]:
    """Steps per second of variants that take turns, so that whatever else the machine does meets all of them.

    In a turn all have the same random numbers: trajectories and context of a step are the same.
    """
    use_cpu(1)
    task = get_task(task_name)
    cases = load_cases(find_or_generate(task, "paper", data), task, "validation", "paper")
    runs, seconds = {}, dict.fromkeys(variants, 0.0)
    for name in variants:
        overrides, exchange = VARIANTS[name]
        config = load_preset("m3gn", "compact", task, {"training.steps": steps} | overrides)
        with (exchange or nullcontext)():
            model = training.build_model(config, task, 0)
            model.prepare(cases)
            runs[name] = training.Run(config, model, 0, Path(), {})
            runs[name].step(cases)
    for turn in range(steps):
        for name, variant in runs.items():
            variant.rng = np.random.default_rng(turn)
            with (VARIANTS[name][1] or nullcontext)():
                start = time.process_time()
                variant.step(cases)
                seconds[name] += time.process_time() - start
    return [(name, steps / seconds[name]) for name in variants]


def run(task: str, variant: str, minutes: float, seed: int, data: Path) -> Record:
    """Train one variant and score it on all validation trajectories."""
    trained_on = get_task(task)
    overrides, exchange = VARIANTS[variant]
    path = find_or_generate(trained_on, "paper", data)
    train_cases, validation_cases = (
        load_cases(path, trained_on, split, "paper") for split in ("train", "validation")
    )
    settings = {"training.minutes": minutes, "training.validations": 4}
    config = load_preset("m3gn", "compact", trained_on, settings | overrides)
    with (exchange or nullcontext)(), tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        done = training.train(
            config, trained_on, train_cases, validation_cases, out, seed=seed, dataset_hash=""
        )
        model, _ = checkpoint.load_checkpoint(out)
        errors = evaluate_model(model, validation_cases, trained_on.context_sizes)
    return {
        "steps": done.steps,
        "steps_per_second": done.steps / (60 * done.minutes),
        "validation_mse": {size: float(error.mse.mean()) for size, error in errors.items()},
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", default="sheet_deformation,deformable_block,falling_teddy")
    parser.add_argument("--variants", default=",".join(VARIANTS))
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument(
        "--turns",
        type=int,
        default=None,
        help="only measure speed, in so many steps of each variant in turns",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--results", type=Path, default=Path("training_efficiency.jsonl"))
    options = parser.parse_args()

    tasks, variants = options.tasks.split(","), options.variants.split(",")
    if unknown := set(variants) - set(VARIANTS):
        parser.error(f"unknown variants {sorted(unknown)}; known: {', '.join(VARIANTS)}")
    if options.turns is not None:
        for task in tasks:
            rows = [[name, f"{r:.2f}"] for name, r in rates(task, variants, options.turns, options.data)]
            Console().print(table(f"{task}, one core", ["variant", "steps/s"], rows))
        return
    plan = [
        {"task": task, "variant": variant, "minutes": options.minutes, "seed": options.seed}
        for task in tasks
        for variant in variants
    ]
    run_missing(options.results, plan, run, data=options.data)
    for task in tasks:
        sizes = get_task(task).context_sizes
        Console().print(
            table(
                f"{task}, {options.minutes:g} minutes on one core",
                ["variant", "seed", "steps/s", *(f"1e6 MSE at {size}" for size in sizes), "mean"],
                [
                    [r["variant"], r["seed"], f"{r['steps_per_second']:.1f}"]
                    + [f"{1e6 * mse:.3g}" for mse in r["validation_mse"].values()]
                    + [f"{1e6 * sum(r['validation_mse'].values()) / len(sizes):.3g}"]
                    for r in read_results(options.results)
                    if (r["task"], r["minutes"]) == (task, options.minutes)
                ],
            )
        )


if __name__ == "__main__":
    main()
