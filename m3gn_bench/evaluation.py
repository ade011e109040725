"""Score a model: predict from contexts of several sizes and measure the error of every trajectory."""

from collections.abc import Callable, Sequence

import torch

from m3gn_bench.data import Case, join
from m3gn_bench.metrics import TrajectoryErrors, concatenate, trajectory_errors
from m3gn_bench.model import Model

# Trajectories predicted together. More than a few leave a CPU's cache, and take longer each; a GPU waits for the CPU
# to start its work, whatever there is to do.
BATCH, BATCH_ON_ACCELERATOR = 4, 20


def evaluate_model(
    model: Model,
    cases: Sequence[Case],
    context_sizes: Sequence[int],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[int, TrajectoryErrors]:
    """Errors of every trajectory at every context size.

    Args:
        model: any model, on the cases' device.
        cases: the trajectories, in the order in which errors are returned.
        context_sizes: numbers of context frames.
        on_progress: called with (done, total) after every batch.

    Raises:
        ConfigError: a context size that the trajectories do not allow.
        DatasetError: trajectories that this model cannot predict, such as those of other meshes than it remembers.
    """
    was_training = model.training
    model.eval()
    on_cpu = cases[0].positions.device.type == "cpu"
    batch_size = BATCH if on_cpu else BATCH_ON_ACCELERATOR
    starts = range(0, len(cases), batch_size)
    results: dict[int, TrajectoryErrors] = {}
    done, total = 0, len(starts) * len(context_sizes)
    with torch.no_grad():  # what cases remember from here must not stop a training that comes later
        for size in context_sizes:
            parts = []
            for start in starts:
                batch = join(cases[start : start + batch_size])
                predicted = model.predict(batch.context(size))
                parts.append(trajectory_errors(batch.body, predicted, batch.future(size)))
                done += 1
                on_progress(done, total)
            results[size] = concatenate(parts)
    model.train(was_training)
    return results
