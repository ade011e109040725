"""What predictions of falling bodies get wrong: where the body is, how it is turned, or what shape it has.

An error is the sum of three parts: of the nodes' mean (level and upright); of the turn that brings the prediction
closest to the truth about that mean; and what is left, the shape. The last row is no model: the same body simulated
again, turned by a tenth of a degree before it is dropped. If that changes little, where a body goes can be predicted.
"""

import argparse
import json
from dataclasses import replace

import numpy as np
import torch
from inputs import parse_for_validation
from scipy.spatial.transform import Rotation

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.schema import DATASET_SEED, parse_key
from m3gn_bench.generators.falling import FallParameters
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.leaderboard.record import checkpoint_folder
from m3gn_bench.tasks import Task

TURN = np.radians(0.1)
PARTS = ("level", "upright", "turn", "shape")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="falling_teddy")
    parser.add_argument(
        "--models", default="m3gn,mgn,mango,egno,stand_still", help="that ship with the project"
    )
    options, task, cases = parse_for_validation(parser)

    context = task.middle_context
    rows = []
    for name in options.models.split(","):
        model, _ = load_checkpoint(checkpoint_folder(task.name, name, "compact"), task)
        with torch.inference_mode():
            parts = [
                rigid_parts(
                    model.predict(case.context(context)).double().numpy(), case.future(context).numpy()
                )
                for case in cases
            ]
        rows.append({"task": task.name, "context": context, "model": name} | mean_of(parts))
    parts = [rigid_parts(turned(task, case)[context:], case.future(context).numpy()) for case in cases]
    rows.append({"task": task.name, "context": context, "model": "turned by 0.1 degrees"} | mean_of(parts))
    if options.json:
        print(json.dumps(rows))
        return
    for row in rows:
        shares = ", ".join(f"{part} {row[part] * 1e3:.3g}" for part in PARTS)
        print(
            f"{row['task']}, context {row['context']}, {row['model']}: {row['mse'] * 1e3:.3g} x 1e-3 = {shares}"
        )


def turned(task: Task, case: Case) -> np.ndarray:
    """The trajectory if the body were turned a little about a level axis at the start, shape [frames, nodes, 3]."""
    (key,) = case.keys
    scene = get_scene(task.scene)
    parameters = draw(scene, *parse_key(key), DATASET_SEED)
    assert isinstance(parameters, FallParameters)
    orientation = Rotation.from_rotvec([TURN, 0, 0]) * Rotation.from_quat(parameters.orientation)
    drop = replace(parameters, orientation=tuple(orientation.as_quat()))
    return case_from(task, scene, scene.simulate(drop, "default"), key).positions.numpy()


def mean_of(parts: list[dict[str, float]]) -> dict[str, float]:
    """Means over trajectories, and their sum."""
    means = {part: float(np.mean([one[part] for one in parts])) for part in PARTS}
    return means | {"mse": sum(means.values())}


def rigid_parts(predicted: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """The parts of the mean squared error per coordinate; gravity is along the last one.

    Args:
        predicted, truth: positions, shape [frames, nodes, 3].
    """
    offset = (predicted - truth).mean(1)
    centred, wanted = (positions - positions.mean(1, keepdims=True) for positions in (predicted, truth))
    aligned = [Rotation.align_vectors(q, p)[0].apply(p) for p, q in zip(centred, wanted, strict=True)]
    shape = np.square(np.array(aligned) - wanted).mean()
    return {
        "level": float(np.square(offset[:, :2]).mean() * 2 / 3),
        "upright": float(np.square(offset[:, 2]).mean() / 3),
        "turn": float(np.square(centred - wanted).mean() - shape),
        "shape": float(shape),
    }


if __name__ == "__main__":
    main()
