"""The training loop: one for all models, resumable to the same state.

The whole state (weights, optimiser, best weights so far, random generator, counters) is one safetensors
file in the output folder, replaced atomically. A run that is killed and started again goes on from it; with
a budget in steps it ends, on a CPU, with exactly the weights of a run that was never killed. Finished runs leave a
checkpoint (see `checkpoint`) and no state. Several processes may share the work (see `distributed`).
"""

import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from m3gn_bench.checkpoint import (
    DESCRIPTION,
    Checkpoint,
    read_description,
    save_checkpoint,
)
from m3gn_bench.cpu import use_cpu
from m3gn_bench.data import Case, Materials
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.distributed import ALONE, Group
from m3gn_bench.errors import CheckpointError, ConfigError, TrainingError
from m3gn_bench.evaluation import evaluate_model
from m3gn_bench.model import Model, RunConfig, build_model
from m3gn_bench.provenance import commit
from m3gn_bench.tasks import Task
from m3gn_bench.version import __version__

STATE = "state.safetensors"
SAVE_INTERVAL = 30.0  # seconds of wall time between saved states


@dataclass
class Progress:
    """Where a run stands; part of the saved state, and what observers are shown."""

    step: int = 0
    minutes: float = 0.0
    loss: float = math.nan  # exponential average
    best_error: float = math.inf
    best_step: int = 0
    validations: int = 0
    fraction: float = 0.0  # of the budget


Observer = Callable[[Progress], None]


def train(
    config: RunConfig,
    task: Task,
    training_cases: Sequence[Case],
    validation_cases: Sequence[Case],
    out: Path,
    *,
    seed: int,
    dataset_hash: str,
    materials: Materials | None = None,
    device: str = "cpu",
    threads: int = 1,
    group: Group = ALONE,
    observe: Observer = lambda progress: None,
) -> Checkpoint:
    """Train a model to the end of its budget and write its checkpoint.

    Args:
        config: model, preset and budget (`training.minutes` or `training.steps`).
        task: what to train on.
        training_cases, validation_cases: trajectories; validation picks the weights that are kept.
        out: folder of the run: the state while it lasts, the checkpoint at its end.
        seed: of weights and sampling.
        dataset_hash: content hash of the data, for the record.
        materials: of which alone the cases are, for the record.
        device: torch device.
        threads: CPU threads of torch.
        group: the processes that train together; all of them call this, and the first one writes.
        observe: called after every step, in the first process.

    Raises:
        ConfigError: no budget, or both kinds; more processes than trajectories in a batch.
        CheckpointError: the folder holds a different run.
        TrainingError: the loss is no longer finite, or the processes fall apart.
    """
    commit()  # asked now: the checkout may change while this trains
    use_cpu(threads)
    where = usable_device(device) if group.device is None else group.device
    model = build_model(config, task, seed)
    model.prepare(training_cases)
    model.to(where)
    describe: dict[str, Any] = {
        "task": task.name,
        "seed": seed,
        "config": config.to_json(),
        "config_hash": config.hash(),
        "dataset_hash": dataset_hash,
        "device": device,
        "threads": threads,
        "package_version": __version__,
    }
    # Said only where it is so: states from before it could be said are those of the usual run.
    if group.size > 1:
        describe["processes"] = group.size
    if materials:
        describe["materials"] = materials
    if group.first((out / DESCRIPTION).is_file()):
        found = read_description(out).model_dump()
        expected = {"processes": 1, "materials": {}, **describe}
        if any(found[name] != value for name, value in expected.items()):
            raise CheckpointError(
                f"{out} holds another finished run ({found['task']}, seed {found['seed']}, or other data, settings or "
                "version); use another folder"
            )
        return read_description(out)
    if not model.is_learned:
        checkpoint = Checkpoint(
            **describe, steps=0, best_step=0, minutes=0.0, validation_error=None, commit=commit()
        )
        return _finish(out, model.state_dict(), checkpoint, group)
    require_budget(config, model.is_learned)

    run = Run(config, model, seed, out, describe, group)
    run.resume()
    group.require_same(run.rng)
    cases = [case.to(where) for case in training_cases]
    held_out = [case.to(where) for case in validation_cases[: config.training.validation_trajectories]]
    clock = time.process_time if where.type == "cpu" else time.perf_counter
    saved = time.perf_counter()
    while run.progress.fraction < 1:
        start = clock()
        run.step(cases)
        run.account(group.first((clock() - start) / 60))
        if run.validation_due():
            run.validate(held_out, task)
        if not group.leads:
            continue
        if time.perf_counter() - saved > SAVE_INTERVAL and run.progress.fraction < 1:
            run.save()
            saved = time.perf_counter()
        observe(run.progress)
    return _finish(out, run.best_weights, run.description(), group)


def _finish(out: Path, weights: dict[str, Tensor], description: Checkpoint, group: Group) -> Checkpoint:
    """The first process writes the checkpoint; returns what it says."""
    if not group.leads:
        return description
    save_checkpoint(out, weights, description)
    (out / STATE).unlink(missing_ok=True)
    return read_description(out)


def require_budget(config: RunConfig, is_learned: bool) -> None:
    """Raises ConfigError unless a model that learns has exactly one kind of budget."""
    if is_learned and (config.training.minutes is None) == (config.training.steps is None):
        raise ConfigError("give a budget: either training.minutes or training.steps")


def usable_device(device: str) -> torch.device:
    """The device. Raises ConfigError if torch cannot use it here."""
    try:
        torch.zeros(1, device=device).item()  # "meta" has tensors, but no numbers
    except (RuntimeError, AssertionError) as error:  # torch asserts where it was built without the device
        raise ConfigError(f"device {device!r} cannot be used: {error}") from error
    return torch.device(device)


def as_one(parameters: Iterable[nn.Parameter]) -> nn.Parameter:
    """One parameter that shares its memory, and its gradient's, with all of these.

    Optimiser and gradient norm then take a few operations, not hundreds, which are a tenth of a small model's step.
    """
    parts = list(parameters)
    sizes = [part.numel() for part in parts]
    whole = nn.Parameter(torch.cat([part.detach().flatten() for part in parts]))
    whole.grad = torch.zeros_like(whole)
    for part, value, gradient in zip(
        parts, whole.detach().split(sizes), whole.grad.split(sizes), strict=True
    ):
        part.data, part.grad = value.view_as(part), gradient.view_as(part)
    return whole


class Run:
    """The state of one run and its single steps."""

    def __init__(
        self,
        config: RunConfig,
        model: Model,
        seed: int,
        out: Path,
        identity: dict[str, Any],
        group: Group = ALONE,
    ) -> None:
        self.group = group
        self.training = config.training
        self.model = model
        self.out = out
        self.identity = identity
        self.progress = Progress()
        self.rng = np.random.default_rng(seed)
        self.weights = as_one(weight for weight in model.parameters() if weight.requires_grad)
        self.optimizer = torch.optim.AdamW(
            [self.weights],
            lr=self.training.learning_rate,
            weight_decay=self.training.weight_decay,
            fused=True,
        )
        self.best_weights = {name: value.clone() for name, value in model.state_dict().items()}

    def step(self, cases: Sequence[Case]) -> None:
        """One optimiser step on a random batch, of which this process has its share."""
        chosen = self.rng.choice(len(cases), min(self.training.batch_size, len(cases)), replace=False)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate()
        self.optimizer.zero_grad(set_to_none=False)
        batch, part = self.group.share([cases[i] for i in chosen])
        with torch.autocast(
            batch.positions.device.type, torch.bfloat16, enabled=self.training.precision == "bfloat16"
        ):
            loss = part * self.model.training_loss(batch, self.rng)
        loss.backward()
        self.group.add_up_gradient(self.weights)
        if self.training.gradient_clip is not None:
            nn.utils.clip_grad_norm_(self.weights, self.training.gradient_clip)
        self.optimizer.step()
        value = self.group.total(loss.item())
        if not math.isfinite(value):
            raise TrainingError(
                f"the loss is {value} at step {self.progress.step}; lower training.learning_rate"
            )
        previous = self.progress.loss
        self.progress.loss = value if math.isnan(previous) else 0.99 * previous + 0.01 * value

    def learning_rate(self) -> float:
        """Linear warm-up, then a cosine to zero at the end of the budget."""
        warmup = min(1.0, (self.progress.step + 1) / max(1, self.training.warmup_steps))
        decay = 0.5 * (1 + math.cos(math.pi * self.progress.fraction)) if self.training.cosine_decay else 1.0
        return self.training.learning_rate * warmup * decay

    def account(self, minutes: float) -> None:
        """Count a step and its time against the budget."""
        progress = self.progress
        progress.step += 1
        progress.minutes += minutes
        spent = (
            progress.minutes / self.training.minutes
            if self.training.minutes is not None
            else progress.step / (self.training.steps or 1)
        )
        progress.fraction = min(1.0, spent)

    def validation_due(self) -> bool:
        """Validations are spread evenly over the budget; the last one is at its end."""
        return self.progress.fraction * self.training.validations >= self.progress.validations + 1

    def validate(self, cases: Sequence[Case], task: Task) -> None:
        """Mean full-rollout MSE over context sizes; keep the weights if it is the lowest so far."""
        self.group.require_same(self.rng)
        error = math.nan
        if self.group.leads:
            errors = evaluate_model(self.model, cases, task.context_sizes)
            error = float(np.mean([e.mse.mean() for e in errors.values()]))
        error = self.group.first(error)
        self.progress.validations += 1
        if error < self.progress.best_error:
            self.progress.best_error, self.progress.best_step = error, self.progress.step
            self.best_weights = {name: value.clone() for name, value in self.model.state_dict().items()}

    def description(self) -> Checkpoint:
        """What the checkpoint will say of this run."""
        progress = self.progress
        if not math.isfinite(progress.best_error):
            raise TrainingError("no validation gave a finite error; lower training.learning_rate")
        return Checkpoint(
            **self.identity,
            steps=progress.step,
            best_step=progress.best_step,
            minutes=progress.minutes,
            validation_error=progress.best_error,
            commit=commit(),
        )

    def save(self) -> None:
        """Write the whole state as one file."""
        tensors: dict[str, Tensor] = {f"model/{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"best/{k}": v for k, v in self.best_weights.items()}
        for index, moments in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer/{index}/{name}": value for name, value in moments.items()}
        metadata = {
            "identity": json.dumps(self.identity),
            "progress": json.dumps(self.progress.__dict__),
            "rng": json.dumps(self.rng.bit_generator.state),
        }
        content = save({name: value.contiguous() for name, value in tensors.items()}, metadata)
        write_bytes_atomically(self.out / STATE, content)

    def resume(self) -> None:
        """Go on from the folder's state, if there is one.

        Raises:
            CheckpointError: the state is damaged or belongs to another run.
        """
        path = self.out / STATE
        if not path.is_file():
            return
        try:
            with safe_open(path, framework="pt") as file:
                metadata = file.metadata() or {}
                parsed = {name: json.loads(metadata[name]) for name in ("identity", "progress", "rng")}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except (SafetensorError, OSError, KeyError, json.JSONDecodeError) as error:
            raise CheckpointError(f"{path} is damaged ({error}); delete it to start again") from error
        if parsed["identity"] != json.loads(json.dumps(self.identity)):
            before = parsed["identity"].get("package_version")
            other = "with other settings" if before == __version__ else f"of version {before}"
            raise CheckpointError(f"{path} belongs to a run {other}; delete it or use another folder")
        self.progress = Progress(**parsed["progress"])
        self.rng.bit_generator.state = parsed["rng"]

        def part(prefix: str) -> dict[str, Tensor]:
            start = len(prefix) + 1
            return {name[start:]: value for name, value in tensors.items() if name.startswith(f"{prefix}/")}

        self.model.load_state_dict(part("model"))
        self.best_weights = part("best")
        moments: dict[int, dict[str, Tensor]] = {}
        for name, value in part("optimizer").items():
            index, _, moment = name.partition("/")
            moments.setdefault(int(index), {})[moment] = value
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": moments, "param_groups": groups})


def tensorboard_observer(folder: Path) -> Observer:
    """Write loss and validation error for TensorBoard every hundred steps.

    Raises:
        ConfigError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise ConfigError("TensorBoard is not installed; pip install 'm3gn-bench[tensorboard]'") from error
    writer = SummaryWriter(folder)

    def observe(progress: Progress) -> None:
        if progress.step % 100 == 0:
            writer.add_scalar("loss", progress.loss, progress.step)
            if math.isfinite(progress.best_error):
                writer.add_scalar("best validation error", progress.best_error, progress.step)

    return observe
