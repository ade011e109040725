"""How long a training step of M3GN takes, against the same network written the usual way.

Both take whole steps (loss on all context pairs, backward, optimiser) on the same trajectory, in turns: whatever
else the machine does meets both. Compared are medians.
"""

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from usual_m3gn import PlainM3GN

from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import Case, load_cases
from m3gn_bench.m3gn import M3GN
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import Task, get_task

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}


def loss(model: M3GN, case: Case, context: int) -> Tensor:
    """Mean squared error of free nodes after the anchor, relative to the data's variance; all pairs are read."""
    error = model.generate(case.context(context), None) - case.future(context)
    return (error[:, ~case.body.fixed] / model.displacement_scale).square().mean()


def pair_of_models(task: Task, preset: str, cases: list[Case]) -> tuple[M3GN, PlainM3GN]:
    """M3GN and the yardstick with the same weights."""
    fast = build_model(load_preset("m3gn", preset, task), task)
    assert isinstance(fast, M3GN)
    fast.prepare(cases)
    return fast, PlainM3GN(fast)


def optimiser_step(model: M3GN, optimizer: torch.optim.Optimizer, case: Case, context: int) -> None:
    """One step of training."""
    optimizer.zero_grad(set_to_none=True)
    loss(model, case, context).backward()
    optimizer.step()


def time_steps(
    models: dict[str, nn.Module], case: Case, context: int, repetitions: int
) -> dict[str, dict[str, list[float]]]:
    """Seconds of each step of each model, by clock; two more steps of each come first and do not count."""
    optimizers = {
        name: torch.optim.AdamW(model.parameters(), lr=1e-5, fused=True) for name, model in models.items()
    }
    seconds: dict[str, dict[str, list[float]]] = {name: {clock: [] for clock in CLOCKS} for name in models}
    for repetition in range(-2, repetitions):
        for name, model in models.items():
            start = {clock: read() for clock, read in CLOCKS.items()}
            optimiser_step(model, optimizers[name], case, context)  # type: ignore[arg-type]
            if repetition >= 0:
                for clock, read in CLOCKS.items():
                    seconds[name][clock].append(read() - start[clock])
    return seconds


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="deformable_block")
    parser.add_argument("--context", type=int, default=9, help="context frames")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--tier", default="smoke")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    use_cpu(options.threads)

    task = get_task(options.task)
    cases = load_cases(
        find_or_generate(task, options.tier, options.data, splits=("train",)), task, "train", options.tier
    )
    fast, plain = pair_of_models(task, options.preset, cases)
    case = cases[0]
    seconds = time_steps({"ours": fast, "usual": plain}, case, options.context, options.repetitions)
    medians = {
        name: {clock: statistics.median(values) for clock, values in clocks.items()}
        for name, clocks in seconds.items()
    }
    ratios = {clock: medians["usual"][clock] / medians["ours"][clock] for clock in CLOCKS}
    record = {
        "task": task.name,
        "context": options.context,
        "preset": options.preset,
        "threads": options.threads,
        "processor": platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "seconds": seconds,
        "medians": medians,
        "ratios": ratios,
    }
    if options.json:
        print(json.dumps(record, indent=2))
        return
    print(f"{task.name}, context {options.context}, preset {options.preset}, {options.threads} thread(s)")
    for name, clocks in seconds.items():
        for clock, values in clocks.items():
            print(
                f"{name:6} {clock:4} median {1e3 * medians[name][clock]:8.1f} ms   "
                f"range {1e3 * min(values):.1f} .. {1e3 * max(values):.1f}"
            )
    print(f"ratio (usual / ours): {ratios['cpu']:.2f} in CPU time, {ratios['wall']:.2f} in wall time")


if __name__ == "__main__":
    main()
