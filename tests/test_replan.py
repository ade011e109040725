"""Re-planning: its limit is M3GN, seams are smooth, and each segment sees what it may see."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_cases import KINDS, make_case

from m3gn_bench.m3gn import M3GN
from m3gn_bench.m3gn_replan import M3GNReplan
from m3gn_bench.model import build_model, load_preset
from m3gn_bench.tasks import get_task


def make_model(kind: str, **settings: object) -> M3GNReplan:
    task = get_task(kind)
    overrides = {f"model.{key}": value for key, value in settings.items()}
    model = build_model(load_preset("m3gn_replan", "smoke", task, overrides), task, seed=1)
    assert isinstance(model, M3GNReplan)
    model.prepare([make_case(kind, 0), make_case(kind, 1)])
    return model.eval()


@pytest.mark.parametrize("kind", KINDS)
def test_one_long_segment_is_m3gn(kind: str) -> None:
    task, case = get_task(kind), make_case(kind, 2)
    replanned = make_model(kind, segment=task.frames - 1)
    whole = build_model(load_preset("m3gn", "smoke", task), task)
    assert isinstance(whole, M3GN)
    whole.load_state_dict(replanned.state_dict())
    with torch.inference_mode():
        context = case.context(12)
        assert torch.equal(replanned.predict(context), whole.predict(context))


def test_segments_start_where_the_last_one_ended_and_as_fast() -> None:
    """Without weights a primitive only fades out: position and velocity at every seam follow by hand."""
    case, segment, size = make_case("falling_teddy", 2), 20, 15
    model = make_model("falling_teddy", segment=segment)
    with torch.no_grad():
        model.simulator.network.readout.weight.zero_()
        model.simulator.network.readout.bias[1:].zero_()
        path = torch.cat([case.positions[:size], model.predict(case.context(size))]).double()
    tau, a = model.config.initial_tau, model.config.alpha / 2
    for start in range(size - 1, case.frames - 1, segment):
        velocity = (path[start] - path[start - 1]) * segment
        steps = min(segment, case.frames - 1 - start)
        s = torch.arange(1, steps + 1, dtype=torch.float64)[:, None, None] / (segment * tau)
        expected = path[start] + tau * velocity * s * torch.exp(-a * s)
        assert (path[start + 1 : start + steps + 1] - expected).abs().max() < 1e-5


def test_a_segment_knows_the_collider_until_its_own_end() -> None:
    case, segment, size = make_case("deformable_block", 2), 10, 5
    model = make_model("deformable_block", segment=segment)
    latent = torch.zeros(case.body.nodes + case.body.collider_nodes, model.config.latent_size)
    end = size - 1 + segment
    path = case.collider_path.clone()
    path[end + 1 :] += 0.1
    with torch.inference_mode():
        context = replace(case, collider_path=path).context(size)
        predicted, changed = (model._segments(c, latent, c.horizon) for c in (case.context(size), context))
    assert torch.equal(predicted[:segment], changed[:segment])
    assert not torch.equal(predicted[segment:], changed[segment:])


def test_training_reaches_every_segment() -> None:
    """All starts occur, each compared with the true frames: a perfect simulator has no loss anywhere."""
    case, model = make_case("deformable_block", 2), make_model("deformable_block", training_segments=1)
    starts = set()

    def truth(context: object, latent: object, v: object, d: object, segment: int) -> torch.Tensor:
        size = len(context.positions)  # type: ignore[attr-defined]
        assert torch.equal(context.positions, case.positions[:size])  # type: ignore[attr-defined]
        starts.add(size)
        return case.positions[size : size + segment]

    model.simulator.forward = truth  # type: ignore[method-assign, assignment]
    rng = np.random.default_rng(0)
    assert all(model.training_loss(case, rng) == 0 for _ in range(200))
    lower, upper = model.task.training_context
    assert min(starts) == lower
    assert max(starts) > case.frames - model.config.segment
    assert len(starts) > upper
