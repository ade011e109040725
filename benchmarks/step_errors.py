"""Where a step-wise model's error comes from: its single steps, or what it makes of its own steps.

Each step of a rollout starts from positions and last movements. Here either can be the true ones, so that a step meets
only the other as the model left it:

- single steps: both are true, and errors of steps add up to a path;
- true movements: positions are the model's own;
- true positions: movements are the model's own last steps;
- rollout: both are its own, which is how it predicts.

A model without history sees no movements: the first two and the last two are the same.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import torch
from inputs import parse_for_validation
from torch import Tensor

from m3gn_bench.baselines.mgn import MeshGraphNet, State
from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.data import Case

WAYS = {
    "single steps": (True, True),
    "true movements": (False, True),
    "true positions": (True, False),
    "rollout": (False, False),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoints", nargs="+", type=Path, help="folders of MeshGraphNets without material")
    parser.add_argument("--task", default="deformable_block")
    options, task, cases = parse_for_validation(parser)

    context = task.middle_context
    rows = []
    for folder in options.checkpoints:
        model, description = load_checkpoint(folder, task)
        if not isinstance(model, MeshGraphNet) or model.uses_material:
            parser.error(f"{folder} has {description.config.model_name}: take MeshGraphNets without material")
        with torch.inference_mode():
            errors = {way: mean_error(model, cases, context, *true) for way, true in WAYS.items()}
        rows.append({"task": task.name, "context": context, "model": description.config.model_name} | errors)
    if options.json:
        print(json.dumps(rows))
        return
    print(f"{'task':<20}{'context':>8}  {'model':<20}" + "".join(f"{way:>16}" for way in WAYS))
    for row in rows:
        numbers = "".join(f"{1e6 * row[way]:>16.3g}" for way in WAYS)
        print(f"{row['task']:<20}{row['context']:>8}  {row['model']:<20}{numbers}")


def mean_error(
    model: MeshGraphNet, cases: Sequence[Case], context: int, true_positions: bool, true_movements: bool
) -> float:
    """Mean squared error of paths, scaled units."""
    errors = [
        (path(model, case, context, true_positions, true_movements) - case.future(context)).square().mean()
        for case in cases
    ]
    return float(torch.stack(errors).mean())


def path(model: MeshGraphNet, case: Case, context: int, true_positions: bool, true_movements: bool) -> Tensor:
    """The anchor and all steps after it added up, shape [horizon, nodes, dim].

    Args:
        model: predicts the steps.
        case: the trajectory.
        context: frames that are given; the last is the anchor.
        true_positions: steps start from where nodes are, not from where the model's steps took them.
        true_movements: steps are told how nodes moved, not how the model moved them.
    """
    positions, collider, body = case.positions, case.collider_path, case.body
    steps: list[Tensor] = []
    own = positions[context - 1]

    def movement(now: int) -> Tensor:
        """Of the frame before `now` to `now`; none is known before the first."""
        if now < 1:
            return torch.zeros_like(own)
        if now < context or true_movements:
            return positions[now] - positions[now - 1]
        return steps[now - context]

    paths = []
    for now in range(context - 1, case.frames - 1):
        state = State(
            (positions[now] if true_positions else own)[None],
            (movement(now)[None], movement(now - 1)[None]),
            collider[now][None],
            ((collider[now + 1] - collider[now])[None], (collider[now] - collider[now - 1])[None]),
        )
        scaled = model.simulator(body, state, model.velocity_scale)[0]
        steps.append(torch.where(body.fixed[:, None], 0.0, scaled * model.velocity_scale))
        own = own + steps[-1]
        paths.append(own)
    return torch.stack(paths)


if __name__ == "__main__":
    main()
