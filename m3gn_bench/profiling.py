"""What a prediction costs: time, memory, and floating-point operations, of several models side by side.

The quantities of the paper's table "Runtime, memory, and parameter comparison" (appendix):

- Time runs from trajectories in memory to predicted positions, and is given per trajectory. Predictions of all
  models take turns, so that whatever else the machine does meets all of them; given is the median over
  repetitions. Encoding the context is what runs inside a `ContextEncoder`, simulation is everything else.
- Memory is the largest size of all tensors that are alive at once during a prediction, weights included: the
  same quantity on a CPU and on CUDA. Neither the interpreter nor input trajectories count.
- Operations are those of matrix products and convolutions, two for each multiplication and addition. Their
  ratio bounds what a model can gain in time where arithmetic takes all of it.

Weights are untrained. Time hardly depends on them: only contact edges do, where a model's own predictions go back in.
"""

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from m3gn_bench.data import Case, join
from m3gn_bench.m3gn import ContextEncoder
from m3gn_bench.model import Model, build_model, load_preset
from m3gn_bench.tasks import Task

Shape = Sequence[int]

YARDSTICK = "m3gn"  # every model's time is compared with this one's
BATCHES = (1, 4, 16, 32)
REPETITIONS = 5
SEARCH_SECONDS = 2.0  # of runs at one batch size when looking for the best one


def _operations_of_product(total: Shape, left: Shape, right: Shape, **_: object) -> int:
    return 2 * left[0] * left[1] * right[1]


# The counter knows products, but not this one, which adds to a tensor in place (see `message_passing`).
IN_PLACE: dict[Any, Any] = {torch.ops.aten.addmm_: _operations_of_product}


@dataclass(frozen=True)
class Time:
    """Seconds per trajectory when so many are predicted together.

    Attributes:
        batch: trajectories predicted together.
        encoding, simulation, total: medians over repetitions (which need not add up).
        fastest, slowest: total of the fastest and of the slowest repetition.
    """

    batch: int
    encoding: float
    simulation: float
    total: float
    fastest: float
    slowest: float


@dataclass(frozen=True)
class Profile:
    """What predictions of a model cost.

    Attributes:
        model: its name.
        parameters: number of trainable parameters.
        operations: floating-point operations per trajectory.
        peak_memory: bytes, when predicting one trajectory.
        single: time when trajectories are predicted one after the other (the paper's way).
        batched: time with the batch size that takes least.
        batches: seconds per trajectory at each batch size tried, in search of the best.
    """

    model: str
    parameters: int
    operations: float
    peak_memory: int
    single: Time
    batched: Time
    batches: dict[int, float]


def profile_models(
    names: Sequence[str],
    task: Task,
    preset: str,
    cases: Sequence[Case],
    context: int,
    *,
    training_cases: Callable[[], Sequence[Case]],
    batches: Sequence[int] = BATCHES,
    repetitions: int = REPETITIONS,
    device: torch.device | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Profile]:
    """Profile models in one run, the yardstick always among them and first.

    Args:
        names: registered models.
        task: what they predict.
        preset: their size.
        cases: trajectories to predict; larger batches than there are trajectories repeat them.
        context: number of context frames.
        training_cases: asked for training trajectories where a model without weights consists of them.
        batches: batch sizes to choose from, in ascending order; the first is the one of `Profile.single`.
        repetitions: timed repetitions, after the search for the best batch size has warmed up.
        device: where to predict; None: the CPU.
        on_progress: called with (done, total).

    Raises:
        ConfigError: unknown model or preset, or a context size that the trajectories do not allow.
    """
    where = device or torch.device("cpu")
    loaded, cases = cases, [case.to(where) for case in cases]
    ordered = dict.fromkeys([YARDSTICK, *names])
    timed: dict[str, TimedModel] = {}
    for name in ordered:
        built = build_model(load_preset(name, preset, task), task)
        built.prepare(loaded if built.is_learned else training_cases())
        timed[name] = TimedModel(built.to(where).eval(), context)
    done, total = 0, 2 * len(timed) + repetitions
    costs, searched, chosen = {}, {}, {}
    for name, model in timed.items():
        costs[name] = model.operations(cases), model.peak_memory(cases[0])  # these warm up, too
        on_progress(done := done + 1, total)
        searched[name] = fastest_batch(model, cases, batches)
        chosen[name] = min(searched[name], key=searched[name].__getitem__)
        on_progress(done := done + 1, total)
    runs: dict[str, dict[int, list[Run]]] = {name: {} for name in timed}
    for _ in range(repetitions):
        for name, model in timed.items():
            for batch in {batches[0], chosen[name]}:
                runs[name].setdefault(batch, []).append(model.run(cases, batch))
        on_progress(done := done + 1, total)
    return [
        Profile(
            model=name,
            parameters=model.model.parameter_count(),
            operations=costs[name][0],
            peak_memory=costs[name][1],
            single=_summary(batches[0], runs[name][batches[0]]),
            batched=_summary(chosen[name], runs[name][chosen[name]]),
            batches=searched[name],
        )
        for name, model in timed.items()
    ]


@dataclass(frozen=True)
class Ratios:
    """A model's time, predicting one by one and in batches, and its operations, over the yardstick's."""

    single: float
    batched: float
    operations: float


def ratios(profiles: Sequence[Profile]) -> list[Ratios]:
    """Every model compared with the yardstick, which is the first."""
    first = profiles[0]
    return [
        Ratios(
            p.single.total / first.single.total,
            p.batched.total / first.batched.total,
            p.operations / first.operations,
        )
        for p in profiles
    ]


@dataclass(frozen=True)
class Run:
    """Seconds per trajectory: of context encoding, altogether, and of all the process's threads together."""

    encoding: float
    total: float
    cpu: float


class TimedModel:
    """A model with a watch on its context encoder, if it has one."""

    def __init__(self, model: Model, context: int) -> None:
        self.model = model
        self.context = context
        self.encoding = 0.0
        self.device = model.velocity_scale.device
        for module in model.modules():
            if isinstance(module, ContextEncoder):
                module.register_forward_pre_hook(self._start)
                module.register_forward_hook(self._stop)

    def run(self, cases: Sequence[Case], batch: int) -> Run:
        """Predict every trajectory once, or so many of them again that they fill one batch."""
        trajectories = [cases[i % len(cases)] for i in range(max(len(cases), batch))]
        self.encoding = 0.0
        start, cpu_start = self._now(), time.process_time()
        for first in range(0, len(trajectories), batch):
            self.predict(join(trajectories[first : first + batch]))
        seconds, cpu_seconds = self._now() - start, time.process_time() - cpu_start
        return Run(*(value / len(trajectories) for value in (self.encoding, seconds, cpu_seconds)))

    def predict(self, case: Case) -> None:
        """A prediction whose result is not needed."""
        with torch.inference_mode():
            self.model.predict(case.context(self.context))

    def operations(self, cases: Sequence[Case]) -> float:
        """Floating-point operations per trajectory."""
        with FlopCounterMode(display=False, custom_mapping=IN_PLACE) as counter:
            for case in cases:
                self.predict(case)
        return counter.get_total_flops() / len(cases)

    def peak_memory(self, case: Case) -> int:
        """Largest size of weights and of tensors made during one prediction [bytes]."""
        held = sum(tensor.nbytes for tensor in (*self.model.parameters(), *self.model.buffers()))
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            before = torch.cuda.memory_allocated(self.device)
            self.predict(case)
            return held + torch.cuda.max_memory_allocated(self.device) - before
        os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # or it writes to standard error that it starts
        with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as recorded:
            self.predict(case)
        events = recorded.profiler.kineto_results.events()
        changes = sorted((e.start_ns(), e.nbytes()) for e in events if e.name() == "[memory]")
        return held + max(accumulate(size for _, size in changes), default=0)

    def _start(self, *_: Any) -> None:
        self.encoding -= self._now()

    def _stop(self, *_: Any) -> None:
        self.encoding += self._now()

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def fastest_batch(
    model: TimedModel, cases: Sequence[Case], batches: Sequence[int] = BATCHES
) -> dict[int, float]:
    """Seconds per trajectory at growing batch sizes, until it becomes worse; short runs are repeated."""
    found: dict[int, float] = {}
    for batch in batches:
        start = time.perf_counter()
        seconds = [model.run(cases, batch).total]
        while len(seconds) < 3 and time.perf_counter() - start < SEARCH_SECONDS:
            seconds.append(model.run(cases, batch).total)
        found[batch] = min(seconds)
        if found[batch] > 1.1 * min(found.values()):
            break
    return found


def _summary(batch: int, runs: Sequence[Run]) -> Time:
    totals = [run.total for run in runs]
    return Time(
        batch=batch,
        encoding=statistics.median(run.encoding for run in runs),
        simulation=statistics.median(run.total - run.encoding for run in runs),
        total=statistics.median(totals),
        fastest=min(totals),
        slowest=max(totals),
    )
