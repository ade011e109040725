"""Several processes, started by torchrun, train one model: each takes a part of every batch.

What they compute is defined by what one process computes with the same settings, and equals it up to rounding,
whatever their number:

- `training.batch_size` is that of the whole batch. All processes draw the same batch with the same random
  generator, and each takes its share of it.
- What a model draws for a batch as a whole (the number of context frames, the pairs among them) all draw alike.
  What it draws for every body or node (noise, moments) all draw for the whole batch, and each keeps its share:
  see `Body.drawn_per_node`.
- A loss is a mean over free nodes, so gradients are averaged with the weights of shares' free nodes.
- The first process decides what must be decided once: how much of the budget is spent, how large the error of
  validation is. It alone writes.
"""

import importlib
import os
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

from m3gn_bench.data import Case, Share, join
from m3gn_bench.errors import ConfigError, TrainingError

# Others wait while the first one simulates data or validates. If one fails, torchrun ends all of them.
PATIENCE = timedelta(days=7)


@dataclass(frozen=True)
class Group:
    """The processes that train a model together, as one of them sees them; by default it is alone.

    Attributes:
        rank: of this process, from 0.
        size: number of processes.
        device: of this process; None where it is for the user to say.
    """

    rank: int = 0
    size: int = 1
    device: torch.device | None = None

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.rank == 0

    def require_shares(self, trajectories: int) -> None:
        """Raises ConfigError if a batch of so many trajectories has no share for every process."""
        if trajectories < self.size:
            raise ConfigError(
                f"a batch of {trajectories} trajectories is too small for {self.size} processes; start fewer, or have "
                f"{self.size} or more in the training split and in training.batch_size"
            )

    def share(self, batch: Sequence[Case]) -> tuple[Case, float]:
        """The part of a batch that this process has, and that part's weight in the mean over free nodes.

        Raises:
            ConfigError: there are more processes than trajectories.
        """
        if self.size == 1:
            return join(batch), 1.0
        self.require_shares(len(batch))
        start, stop = (len(batch) * rank // self.size for rank in (self.rank, self.rank + 1))
        bodies = [case.body for case in batch]
        share = Share(
            node_counts=tuple(count for body in bodies for count in body.node_counts),
            collider_counts=tuple(count for body in bodies for count in body.collider_counts),
            first=sum(len(body.node_counts) for body in bodies[:start]),
        )
        own = join(batch[start:stop])
        free = [body.free_nodes for body in bodies]
        return replace(own, body=replace(own.body, share=share)), sum(free[start:stop]) / sum(free)

    def add_up_gradient(self, weights: nn.Parameter) -> None:
        """Replace a gradient by the sum over all processes."""
        if self.size > 1:
            dist.all_reduce(weights.grad)

    def total(self, value: float) -> float:
        """The sum of a number over all processes."""
        if self.size == 1:
            return value
        values = torch.tensor([value], dtype=torch.float64, device=self.device)
        dist.all_reduce(values)
        return float(values)

    def first(self, value: float) -> float:
        """The number that the first process has."""
        if self.size == 1:
            return value
        values = torch.tensor([value], dtype=torch.float64, device=self.device)
        dist.broadcast(values, src=0)
        return float(values)

    @contextmanager
    def first_alone(self) -> Iterator[None]:
        """The first process does what is in here, and the others do it after that."""
        if not self.leads:
            self.first(0)
        yield
        if self.leads:
            self.first(0)

    def require_same(self, rng: np.random.Generator) -> None:
        """Raises TrainingError unless the generator is in the same state in all processes."""
        state = zlib.crc32(repr(rng.bit_generator.state).encode())
        if self.total(state) != state * self.size:
            raise TrainingError(
                "processes no longer draw the same random numbers: either they do not see the same folder of the run, "
                "or the model draws for nodes by itself instead of with Body.drawn_per_node (see docs/scale.md)"
            )


ALONE = Group()


@contextmanager
def torchrun_group(device: str) -> Iterator[Group]:
    """The group of processes that torchrun started, connected; without torchrun, this process alone.

    Args:
        device: "cpu" (by gloo), or "cuda" (by NCCL), of which every process takes another one.

    Raises:
        ConfigError: another device, or the processes do not find each other.
    """
    rank, size = (int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1)))
    if size == 1:
        yield ALONE
        return
    # Functions in there have the group that exists when they are loaded as a default argument. Optimisers load them,
    # and then ours would outlive its end, and its threads the interpreter.
    importlib.import_module("torch.distributed.nn.functional")
    if device not in ("cpu", "cuda"):
        raise ConfigError(f"several processes share the work on --device cpu or cuda, not {device}")
    own = torch.device("cpu") if device == "cpu" else torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    try:
        if own.type == "cuda":
            torch.cuda.set_device(own)
        dist.init_process_group("gloo" if own.type == "cpu" else "nccl", timeout=PATIENCE)
    except (ValueError, RuntimeError) as error:
        raise ConfigError(
            f"the processes cannot connect, or have not a device each; start them with torchrun ({error})"
        ) from error
    try:
        yield Group(rank, size, own)
    finally:
        dist.destroy_process_group()
