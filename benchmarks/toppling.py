"""How well it can be predicted where a dropped body goes, by a regression that knows how it was turned.

A body that falls from rest does the same again, turned about the vertical, if it is turned about the vertical. So its
level path, seen in its own axes, is a function of where "up" is in these axes, and of the material: four numbers.
Kernel ridge regression on the training split says how much of the path they explain. It is no model of the benchmark,
whose models are not told how a body was turned; it shows that the data suffice.
"""

import argparse
import json
from collections.abc import Sequence
from itertools import product

import numpy as np
from inputs import add_dataset_options
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from m3gn_bench.cpu import use_cpu
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.sources import find_or_generate
from m3gn_bench.tasks import Task, get_task

MATERIAL_WEIGHT = 0.1  # material parameters, in [-1, 1], matter less than where "up" is
WIDTHS, RIDGES = (0.2, 0.3, 0.5), (1e-2, 1e-1)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="falling_teddy", help="of a single object")
    add_dataset_options(parser)
    options = parser.parse_args()
    use_cpu(1)

    task = get_task(options.task)
    context = task.middle_context
    path = find_or_generate(task, options.tier, options.data, splits=("train", "validation"))
    (inputs, paths), (asked, wanted) = (
        level_paths(task, TrajectoryDataset(path, task.name, split, options.tier), context)
        for split in ("train", "validation")
    )
    still = float(np.square(wanted).sum(-1).mean() / 3)
    rows = [
        {
            "task": task.name,
            "context": context,
            "width": width,
            "ridge": ridge,
            "level": float(
                np.square(regression(inputs, paths, asked, width, ridge) - wanted).sum(-1).mean() / 3
            ),
            "standing still": still,
        }
        for width, ridge in product(WIDTHS, RIDGES)
    ]
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        print(
            f"{row['task']}, context {row['context']}, width {row['width']}, ridge {row['ridge']}: level part of the "
            f"MSE {row['level'] * 1e3:.3g} x 1e-3, standing still {still * 1e3:.3g} x 1e-3"
        )


def level_paths(
    task: Task, trajectories: TrajectoryDataset | Sequence[Trajectory], context: int
) -> tuple[np.ndarray, np.ndarray]:
    """Of every trajectory "up" and the material, and the scaled level path after the anchor; in own axes.

    Returns:
        Shapes [trajectories, 3 + materials] and [trajectories, frames - context, 3].
    """
    inputs, paths = [], []
    scale = get_scene(task.scene).scale_length
    for number in range(len(trajectories)):
        trajectory = trajectories[number]
        to_own_axes = Rotation.from_quat(trajectory.loads["orientation"]).inv()
        material = [feature(trajectory.material[feature.name]) for feature in task.material]
        inputs.append(np.append(to_own_axes.apply([0, 0, 1]), MATERIAL_WEIGHT * np.array(material)))
        middle = trajectory.positions.mean(1, dtype=np.float64) / scale
        path = middle[context:] - middle[context - 1]
        path[:, 2] = 0
        paths.append(to_own_axes.apply(path))
    return np.array(inputs), np.array(paths)


def regression(
    inputs: np.ndarray, outputs: np.ndarray, asked: np.ndarray, width: float, ridge: float
) -> np.ndarray:
    """Kernel ridge regression with a Gaussian kernel, shape [asked, ...]."""

    def kernel(others: np.ndarray) -> np.ndarray:
        return np.exp(-cdist(others, inputs, "sqeuclidean") / (2 * width**2))

    factor = cho_factor(kernel(inputs) + ridge * np.eye(len(inputs)))
    weights = cho_solve(factor, outputs.reshape(len(outputs), -1))
    return (kernel(asked) @ weights).reshape(len(asked), *outputs.shape[1:])


if __name__ == "__main__":
    main()
