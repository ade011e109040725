"""What trained models make of one trajectory of a dataset file, in the file's own unit of length."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from m3gn_bench.checkpoint import load_checkpoint, read_description
from m3gn_bench.data import Scaling, case_from
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.errors import CheckpointError
from m3gn_bench.tasks import Task


def predict(
    checkpoints: Mapping[str, Path],
    task: Task,
    context: int,
    trajectory: Trajectory,
    key: str,
    scaling: Scaling,
) -> dict[str, NDArray[np.float64]]:
    """Positions that each model predicts; those of the context are the trajectory's own.

    Args:
        checkpoints: folders of trained models, by any name.
        task: what they were trained on.
        context: the number of frames that they are given.
        trajectory, key: what to predict, and its name in the dataset.
        scaling: its file's metadata.

    Returns:
        For every name an array of shape [frames, nodes, dim], in the trajectory's unit of length.

    Raises:
        ConfigError: the trajectory does not allow this context.
        DatasetError: the trajectory does not fit the task.
        CheckpointError: a checkpoint is unusable, or of another task.
        BenchError: a prediction diverges.
    """
    case = case_from(task, scaling, trajectory, key)
    seen = case.context(context)
    given = trajectory.positions[:context].astype(np.float64)
    predicted = {}
    for name, folder in checkpoints.items():
        trained_on = read_description(folder).task
        if trained_on != task.name:
            raise CheckpointError(f"{folder} was trained on {trained_on}, not on {task.name}")
        model, _ = load_checkpoint(folder, task)
        with torch.inference_mode():
            scaled = model.predict(seen).double().numpy()
        finite = np.isfinite(scaled).all((1, 2))
        if not finite.all():
            raise BenchError(
                f"{name} diverges: its prediction is not finite from frame {context + int(finite.argmin())} on"
            )
        after = scaled * scaling.scale_length + np.array(scaling.scale_centre)
        predicted[name] = np.concatenate([given, after])
    return predicted
