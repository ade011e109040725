"""MaNGO and EGNO: size, transforms over time, symmetries, horizon. What holds for every model is in test_models."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from model_cases import KINDS, build, make_case, predict, training_cases, transform
from scipy.spatial.transform import Rotation

from m3gn_bench.baselines import egno, mango
from m3gn_bench.baselines.egno import EGNO, SpectralConvolution
from m3gn_bench.baselines.mango import KERNEL, TemporalConvolution
from m3gn_bench.baselines.spacetime import TIME_FEATURES, time_embedding
from m3gn_bench.data import Context
from m3gn_bench.errors import ConfigError
from m3gn_bench.model import Model, build_model, load_preset
from m3gn_bench.published import PARAMETERS
from m3gn_bench.tasks import get_task

OPERATORS = ("mango", "egno")
WITH_COLLIDER = ("deformable_block", "tissue_manipulation")
every_operator = pytest.mark.parametrize("name", OPERATORS)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def lively(name: str, kind: str, **settings: object) -> Model:
    """A model whose every weight matters: fresh ones nearly stand still."""
    task = get_task(kind)
    overrides = {f"model.{key}": value for key, value in settings.items()}
    model = build_model(load_preset(name, "smoke", task, overrides), task, seed=1)
    model.prepare(training_cases(kind))
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=generator)
    return model.eval()


@pytest.mark.parametrize("task", PARAMETERS)
def test_equivariant_egno_has_as_many_parameters(task: str) -> None:
    """As the paper counts, and as the invariant one has."""
    with torch.device("meta"):
        config = load_preset("egno", "paper", get_task(task), {"model.invariant": False})
        assert build_model(config, get_task(task)).parameter_count() == PARAMETERS[task]["egno"]


def test_temporal_convolution_is_the_sum_over_seven_frames() -> None:
    torch.manual_seed(0)
    layer = TemporalConvolution(5)
    features = torch.randn(3, 11, 5)
    weight, bias = (p.detach().double().numpy() for p in (layer.conv.weight, layer.conv.bias))
    expected = np.zeros((3, 11, 5))
    for time in range(11):
        for tap in range(KERNEL):
            read = time + tap - KERNEL // 2
            if 0 <= read < 11:
                expected[:, time] += features[:, read].double().numpy() @ weight[:, :, tap].T
    expected += bias
    expected = np.where(expected > 0, expected, 0.01 * expected)
    assert np.abs(layer(features).detach().numpy() - expected).max() < 1e-5


@pytest.mark.parametrize(("times", "modes"), [(9, 1), (9, 2), (10, 2), (10, 5), (11, 6)])
def test_spectral_convolution_is_the_one_of_numpys_transform(times: int, modes: int) -> None:
    torch.manual_seed(0)
    layer = SpectralConvolution(4, times, modes, 1.0)
    features = torch.randn(3, times, 4)
    weight = layer.weight.detach().double().numpy()
    spectrum = np.fft.rfft(features.double().numpy(), axis=1)
    kept = np.zeros_like(spectrum)
    for mode in range(modes):
        kept[:, mode] = spectrum[:, mode] @ (weight[mode, 0] + 1j * weight[mode, 1])
    expected = np.fft.irfft(kept, n=times, axis=1)
    assert np.abs(layer(features).detach().numpy() - expected).max() < 1e-5


def test_more_modes_than_there_are_frequencies_are_refused() -> None:
    with pytest.raises(ConfigError, match="no more than 5 modes"):
        SpectralConvolution(4, 9, 6, 1.0)


def test_time_embedding_tells_the_frame_and_its_distance_from_the_anchor() -> None:
    found = time_embedding(torch.arange(4, 60), 10)
    assert found.shape == (56, TIME_FEATURES)
    for row, frame in ((0, 4), (6, 10), (50, 54)):
        waves = [10_000.0 ** (-i / 8) for i in range(8)]
        angles = [n * np.array(waves) for n in (frame, frame - 10)]
        expected = np.concatenate([part(angle) for angle in angles for part in (np.sin, np.cos)])
        assert np.abs(found[row].numpy() - expected).max() < 1e-5


@pytest.mark.parametrize("kind", KINDS)
@every_operator
def test_predicts_from_two_frames_in_every_task(name: str, kind: str) -> None:
    """Also where the task's own contexts are larger."""
    case, model = make_case(kind, 3), lively(name, kind)
    path = predict(model, case, 2)
    assert path.shape == case.future(2).shape
    assert torch.isfinite(path).all()


@pytest.mark.parametrize("name", OPERATORS)
def test_any_number_of_edges_at_a_time_gives_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = "deformable_block"
    case, model = make_case(kind, 3), lively(name, kind)
    found = []
    for number in (1, 7, 10_000):
        for module in (mango, egno):
            monkeypatch.setattr(module, "edges_at_a_time", lambda *_, number=number: number)
        found.append(predict(model, case, 30))
    assert (found[0] - found[2]).abs().max() < 1e-5
    assert (found[1] - found[2]).abs().max() < 1e-5


@pytest.mark.parametrize("kind", WITH_COLLIDER)
@every_operator
def test_the_colliders_way_to_its_end_matters(name: str, kind: str) -> None:
    """Its true path is read, not only where it ends."""
    case, model = make_case(kind, 3), lively(name, kind)
    size = case.frames - 8
    path = case.collider_path.clone()
    path[size + 2 : size + 5] += 0.05
    other = predict(model, replace(case, collider_path=path), size)
    assert (other - predict(model, case, size)).abs().max() > 1e-5


def orthogonal(dimension: int, sign: int) -> torch.Tensor:
    """A rotation by no special angle, with a reflection where the sign is negative."""
    matrix = Rotation.from_rotvec([0.4, -0.9, 0.7]).as_matrix()
    if dimension == 2:
        matrix = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    matrix[:, 0] *= sign
    return torch.tensor(matrix, dtype=torch.float32)


def turned_error(kind: str, sign: int, **settings: object) -> tuple[float, float]:
    """How far the prediction for the turned scene is from the turned prediction; and how far things move."""
    case, model = make_case(kind, 3), lively("egno", kind, **settings)
    size, dimension = case.frames - 8, case.positions.shape[-1]
    matrix, shift = orthogonal(dimension, sign), torch.full((dimension,), 0.3)
    expected = predict(model, case, size)
    found = predict(model, transform(case, matrix, shift), size)
    moved = (expected - case.positions[size - 1]).abs().max()
    return float((found - expected @ matrix.T - shift).abs().max()), float(moved)


@pytest.mark.parametrize("kind", WITH_COLLIDER)
@pytest.mark.parametrize("sign", [1, -1])
def test_egno_turns_with_the_scene(kind: str, sign: int) -> None:
    error, moved = turned_error(kind, sign)
    assert error < 1e-5
    assert moved > 0.05


def test_egno_turns_about_the_axis_of_the_sheets_load() -> None:
    """The load's component is a scalar; a rotation in the sheet's plane leaves it as it is."""
    case, model = make_case("sheet_deformation", 3), lively("egno", "sheet_deformation")
    matrix = torch.tensor(Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), dtype=torch.float32)
    found = predict(model, transform(case, matrix, torch.zeros(3)), 40)
    assert (found - predict(model, case, 40) @ matrix.T).abs().max() < 1e-5


@pytest.mark.parametrize("kind", WITH_COLLIDER)
def test_egno_does_not_turn_if_vectors_are_read_as_scalars(kind: str) -> None:
    error, _ = turned_error(kind, 1, invariant=False)
    assert error > 1e-4


def test_what_neighbours_move_a_node_by_is_limited() -> None:
    """One far node alone threw out its neighbours by hundreds of standard deviations, layer by layer."""
    kind = "falling_teddy"
    case, model = make_case(kind, 3), build("egno", kind, training_cases(kind))
    assert isinstance(model, EGNO)
    found = []
    for scalar in (1e4, 1e6):
        with torch.no_grad():
            for layer in model.layers:
                layer.vector_scalar[-1].bias.fill_(scalar)
            context = case.context(10)
            moved = (model.predict(context) - context.positions[-1]) / model.displacement_scale
        found.append(moved.abs().max().item())
    assert found[0] > egno.FAR  # the limit was reached
    assert found[1] < 2.5 * egno.FAR * len(model.layers)  # the last layer's limit, and what convolutions add


def test_egnos_horizon_is_fixed_and_its_tail_is_cut() -> None:
    """Later anchors see the same transform over time; beyond the end the collider is taken to rest."""
    kind = "tissue_manipulation"
    case, model = make_case(kind, 3), lively("egno", kind)
    assert isinstance(model, EGNO)
    horizon = case.frames - 2
    assert all(len(layer.convolution.synthesis) == horizon for layer in model.layers)
    size = 60
    path = torch.cat([case.collider_path, case.collider_path[-1:].expand(horizon, -1, -1)])[: size + horizon]
    with torch.inference_mode():
        full = model.predict(Context(case.body, case.positions[:size], horizon, path, case.keys))
    assert len(full) == horizon
    assert torch.equal(predict(model, case, size), full[: case.frames - size])
    path = torch.cat([path, path[-1:]])
    with pytest.raises(ConfigError, match=f"predicts {horizon} frames after the anchor, not {horizon + 1}"):
        model.predict(Context(case.body, case.positions[:size], horizon + 1, path, case.keys))


@every_operator
def test_learns_and_in_bfloat16_too(name: str) -> None:
    """A few steps on one trajectory take most of the error away; both precisions begin at the same loss."""
    kind = "sheet_deformation"
    model = build(name, kind, training_cases(kind)).train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    case = make_case(kind, 0)

    def loss(bfloat16: bool) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            return model.training_loss(case, np.random.default_rng(0))

    with torch.no_grad():
        first = loss(bfloat16=False).item()
        assert loss(bfloat16=True).item() == pytest.approx(first, rel=2e-2)
    for step in range(30):
        optimizer.zero_grad()
        loss(bfloat16=step < 2).backward()
        optimizer.step()
    assert loss(bfloat16=False).item() < 0.5 * first
