"""MeshGraphNets: the noise of training, and the label that belongs to it."""

import numpy as np
import pytest
import torch
from model_cases import make_case

from m3gn_bench.baselines.mgn import MeshGraphNet, State
from m3gn_bench.data import Body
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.tasks import get_task


def test_noise_has_its_size_and_leaves_the_true_next_position_the_target() -> None:
    """A simulator that knows the next positions has no loss, however wrong the present ones are that it is shown."""
    noise, scale = 1e-2, torch.tensor(0.05)
    task, case = get_task("deformable_block"), make_case("deformable_block", 1, size=12)
    model = build_model(load_preset("mgn", "smoke", task, {"model.noise": noise}), task)
    assert isinstance(model, MeshGraphNet)
    shown = []

    def truth(body: Body, state: State, velocity_scale: torch.Tensor, extra: object) -> torch.Tensor:
        shown.append(state)
        return (case.positions[2:] - state.position) / velocity_scale

    model.simulator.forward = truth  # type: ignore[method-assign, assignment]
    moments = torch.arange(1, case.frames - 1)[:, None]
    assert (
        model.simulator.loss(case, moments, scale, np.random.default_rng(0)) < 1e-9
    )  # 0.04 without correction

    (state,) = shown
    movements = case.positions.diff(dim=0)
    errors = (
        state.movements[0] - movements[:-1],
        (state.movements[1] - torch.cat([torch.zeros_like(movements[:1]), movements[:-2]])),
    )
    fixed = case.body.fixed
    for error, expected in zip(errors, (noise, noise / 2**0.5), strict=True):
        assert float(error[:, ~fixed].std()) == pytest.approx(expected, rel=0.03)
        assert error[:, fixed].abs().max() < 1e-6
    assert torch.equal(state.position[:, fixed], case.positions[1:-1, fixed])
