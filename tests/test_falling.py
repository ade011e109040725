"""Falling teddy and mixed objects: draws, flight, options, and the checks that guard the dataset."""

import pickle
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from m3gn_bench.datasets.file import open_file, read_trajectory
from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.generators.errors import GeneratorError, SolverError
from m3gn_bench.generators.falling import (
    FRAME_TIME,
    GRAVITY,
    HEIGHT,
    POISSON_RATIOS,
    YOUNGS_MODULI,
    FallFidelity,
    FallingTeddy,
    FallParameters,
    MixedObjects,
)
from m3gn_bench.generators.generate import draw, generate
from m3gn_bench.generators.objects import load_object, read_object, write_object
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.generators.solvers.quiet_warp import wp

TEDDY = FallingTeddy()


@pytest.fixture(scope="module")
def fall() -> Trajectory:
    """A soft teddy, quick to compute."""
    parameters = draw(TEDDY, "test", 0, DATASET_SEED)
    return TEDDY.simulate(replace(parameters, youngs_modulus=2e5, poisson_ratio=0.3), "fast")


def test_draws_come_from_the_papers_grids() -> None:
    draws = [draw(MixedObjects(), "train", index, DATASET_SEED) for index in range(60)]
    assert all(d.youngs_modulus in YOUNGS_MODULI and d.poisson_ratio in POISSON_RATIOS for d in draws)
    assert {d.object for d in draws[:6]} == set(MixedObjects.objects)
    assert [d.object for d in draws[:54]] == [d.object for d in draws[6:]]
    quaternions = np.array([d.orientation for d in draws])
    assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1)
    assert len({d.orientation for d in draws}) == 60


def test_it_falls_freely_until_it_touches_the_floor(fall: Trajectory) -> None:
    start = fall.positions[0].astype(np.float64)
    assert start[:, 2].min() == pytest.approx(HEIGHT, abs=1e-7)
    landing = int(np.sqrt(2 * HEIGHT / GRAVITY) / FRAME_TIME)
    times = FRAME_TIME * np.arange(landing + 1)
    expected = start - np.array([0, 0, GRAVITY / 2]) * times[:, None, None] ** 2
    assert np.abs(fall.positions[: landing + 1] - expected).max() < 1e-6
    # One frame later the lowest node has met the floor, the highest has not noticed.
    highest = start[:, 2].argmax()
    fallen = start[highest, 2] - GRAVITY / 2 * (times[-1] + FRAME_TIME) ** 2
    assert fall.positions[landing + 1, highest, 2] == pytest.approx(fallen, abs=1e-4)
    assert fall.positions[landing + 1 :, :, 2].min(1).max() < 0.3


def test_a_trajectory(fall: Trajectory) -> None:
    assert fall.positions.shape == (201, 304, 3)
    assert fall.mesh.cells.shape == (604, 3)
    assert np.array_equal(fall.mesh.rest_positions, fall.positions[0])
    assert fall.tags == {"object": "teddy"}
    assert fall.material == {"youngs_modulus": 2e5, "poisson_ratio": 0.3}
    assert TEDDY.check(fall) == []
    assert 0 < fall.diagnostics["energy_left"] < 0.9  # of the potential energy most is that of its own height
    squashed = np.ptp(fall.positions[:, :, 2], axis=1).min()
    assert squashed < 0.9 * np.ptp(fall.positions[0, :, 2])


def test_the_same_draw_is_the_same_bit_for_bit(fall: Trajectory) -> None:
    parameters = draw(TEDDY, "test", 0, DATASET_SEED)
    again = FallingTeddy().simulate(replace(parameters, youngs_modulus=2e5, poisson_ratio=0.3), "fast")
    assert again.content_hash() == fall.content_hash()


def test_soft_and_stiff_are_told_apart() -> None:
    parameters = draw(TEDDY, "test", 1, DATASET_SEED)
    soft, stiff = (replace(parameters, youngs_modulus=e, poisson_ratio=0.3) for e in (1e5, 1e6))
    one, other = (TEDDY.simulate(p, "fast").positions for p in (soft, stiff))
    assert np.mean((one - other) ** 2) / TEDDY.scale_length**2 > 1e-3


def test_a_motion_that_diverges_is_computed_with_smaller_steps() -> None:
    """Beyond the limit of stability the first attempt fails; what comes of it is the usual motion."""
    parameters = replace(draw(TEDDY, "test", 0, DATASET_SEED), youngs_modulus=1e6, poisson_ratio=0.49)

    class Hasty(FallingTeddy):
        fidelities: ClassVar[dict[str, FallFidelity]] = {
            "default": FallFidelity(parts=1, courant=2.8, vbd_iterations=1, vbd_substeps=1)
        }

    hasty, usual = Hasty().simulate(parameters), TEDDY.simulate(parameters)
    assert hasty.diagnostics["substeps_per_frame"] in (40, 80)  # it began with 20
    assert TEDDY.check(hasty) == []
    assert np.abs(hasty.positions[:40] - usual.positions[:40]).max() < 2e-3


class TogetherOnTheCpu(FallingTeddy):
    """What a GPU is given, with the arithmetic of the CPU; one draw in four diverges at first."""

    together = 3

    def simulate_together(
        self, draws: Sequence[FallParameters], level: FallFidelity, frames: int | None = None
    ) -> list[Trajectory | SolverError]:
        spoilt = draw(self, "test", 1, DATASET_SEED)
        made = super().simulate_together(draws, level, frames)
        return [
            SolverError("frame 9: it diverges") if parameters == spoilt else outcome
            for parameters, outcome in zip(draws, made, strict=True)
        ]


def test_a_dataset_of_many_at_once_is_that_of_one_by_one(tmp_path: Path) -> None:
    done: list[int] = []
    scene = TogetherOnTheCpu()
    report = generate(
        scene, "smoke", tmp_path, splits=["test"], fidelity="fast", on_progress=lambda n, _: done.append(n)
    )
    assert done == [0, 3, 4]
    (rejection,) = report.rejected
    assert (rejection.key, rejection.attempt, rejection.reason) == ("test_00001", 0, "frame 9: it diverges")
    with open_file(report.file) as file:
        for index in range(4):
            parameters = draw(TEDDY, "test", index, DATASET_SEED, attempt=int(index == 1))
            expected = TEDDY.simulate(parameters, "fast")
            assert read_trajectory(file, f"test_{index:05}").content_hash() == expected.content_hash()


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a CUDA device")
def test_without_a_gpu_cuda_is_refused(tmp_path: Path) -> None:
    scene = get_scene("falling_teddy", device="cuda")
    assert scene.variant == {"device": "cuda"}
    with pytest.raises(GeneratorError, match="has no CUDA device that Warp can use; simulate on the cpu"):
        generate(scene, "smoke", tmp_path)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="there is no CUDA device")
def test_a_gpu_simulates_the_same_falls(tmp_path: Path) -> None:
    """Until the first rebound; later, round-off grows with every contact."""
    report = generate(get_scene("falling_teddy", device="cuda"), "smoke", tmp_path, splits=["test"])
    with open_file(report.file) as file:
        found = read_trajectory(file, "test_00000")
    expected = TEDDY.simulate(draw(TEDDY, "test", 0, DATASET_SEED))
    assert np.abs(found.positions[:30] - expected.positions[:30]).max() < 1e-6


def sink(trajectory: Trajectory, depth: float) -> None:
    """The lowest node of a frame, so far below the floor."""
    positions = trajectory.positions[90]
    positions[positions[:, 2].argmin(), 2] = -depth


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (lambda t: t.positions.__setitem__((80, 3, 1), np.nan), "frame 80: positions are not finite"),
        (lambda t: sink(t, 0.01), "frame 90: a node is 0.01 m below the floor"),
        (
            lambda t: t.positions.__iadd__(np.float32([0, 0, 0.3])),
            r"frame 0: its lowest point is 0.32 m above",
        ),
        (lambda t: t.positions[2].__iadd__(np.float32([0, 0, 2e-3])), "frame 2: it does not fall freely"),
        (lambda t: t.positions[60:].__iadd__(np.float32([1, 0, 0])), "frame 60: a node jumps by 1"),
        (lambda t: sink(t, 1e-5), "frame 90: a node is 1e-05 m below the floor"),
        (lambda t: t.diagnostics.update(energy_growth=0.02), "energy grows by 2.00%"),
        (lambda t: t.diagnostics.update(inverted_tetrahedra_at_end=3), "3 tetrahedra are inverted"),
        (lambda t: t.diagnostics.update(max_speed=100.0), "100.0 m/s"),
    ],
)
def test_faults_are_found(fall: Trajectory, fault: object, reason: str) -> None:
    spoilt = replace(fall, positions=fall.positions.copy(), diagnostics=dict(fall.diagnostics))
    fault(spoilt)  # type: ignore[operator]
    (problem,) = TEDDY.check(spoilt)
    assert re.search(reason, problem)


def test_a_users_own_object(tmp_path: Path) -> None:
    """A scene with another object says so in its variant, and takes it to the workers as it is."""
    path = tmp_path / "worm.npz"
    write_object(replace(load_object("gummy_worm_2"), name="worm"), path)
    scene = get_scene("falling_teddy", mesh=read_object(path))
    (name,) = scene.variant.values()
    assert name.startswith("worm-")
    path.unlink()
    sent = pickle.loads(pickle.dumps(scene))
    assert sent.variant == scene.variant
    report = generate(sent, "smoke", tmp_path, splits=["test"], fidelity="fast")
    assert report.file.name == f"falling_teddy-smoke-{name}-test-fast.h5"
    assert report.trajectories == 4


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"solver": "magic"}, "unknown solver 'magic'; known: explicit, newton-vbd"),
        ({"device": "tpu"}, "unknown device 'tpu'; known: cpu, cuda"),
        ({"device": "cuda", "solver": "newton-vbd"}, "on cuda only the solver explicit"),
    ],
)
def test_unknown_options(options: dict[str, str], reason: str) -> None:
    with pytest.raises(GeneratorError, match=reason):
        get_scene("mixed_objects", **options)
