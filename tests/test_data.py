"""What models are told of real trajectories, from the numbers in the files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from m3gn_bench.data import case_from, load_cases
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.trajectory import FIXED
from m3gn_bench.generators.deformable_block import BlockParameters, DeformableBlock
from m3gn_bench.tasks import get_task


def test_a_sheets_force_clamps_and_material(smoke_file: Path) -> None:
    cases = load_cases(smoke_file, get_task("sheet_deformation"), "train", "smoke")
    stored = TrajectoryDataset(smoke_file, "sheet_deformation", "train", "smoke")
    moduli = set()
    for case, trajectory in zip(cases, stored, strict=True):
        force, clamped = case.body.static_features.numpy().T
        assert force == pytest.approx(trajectory.loads["nodal_forces"][:, 2] / 200)
        assert trajectory.positions[-1, :, 2] @ force > 0  # it moves where it is pushed
        assert (clamped == (trajectory.mesh.node_type == FIXED)).all()
        assert (case.body.fixed.numpy() == (clamped == 1)).all()
        modulus = trajectory.material["youngs_modulus"]
        assert case.body.material.item() == pytest.approx(np.log10(modulus) - 2)  # 10 to 1000 MPa
        moduli.add(modulus)
    assert len(moduli) > 2


def test_a_block_is_told_as_it_is_first_seen() -> None:
    """Its shape at rest, before the hidden first material was pressed, would give that material away."""
    scene = DeformableBlock()
    parameters = BlockParameters(widths=(220.0, 180.0), poisson_ratios=(0.0, 0.49), radius=35.0, start=25.0)
    trajectory = scene.simulate(parameters, "fast")
    case = case_from(get_task("deformable_block"), scene, trajectory, "test_00000")
    body = case.body

    def scaled(positions: np.ndarray) -> torch.Tensor:
        return torch.from_numpy((positions - np.array(scene.scale_centre)) / scene.scale_length).float()

    assert torch.equal(body.rest_positions, scaled(trajectory.positions[0]))
    assert (body.rest_positions - scaled(trajectory.mesh.rest_positions)).abs().max() > 0.01
    assert body.material.tolist() == [[pytest.approx(1)]]  # the second ratio, of -0.9 to 0.49
    assert trajectory.collider_positions is not None
    assert trajectory.collider_edges is not None
    assert torch.equal(case.collider_path, scaled(trajectory.collider_positions))
    told = {frozenset(pair) for pair in body.collider_edges.T.tolist()}
    assert told == {frozenset(pair) for pair in trajectory.collider_edges.tolist()}
    edges = {(i, j) for cell in trajectory.mesh.cells.tolist() for i in cell for j in cell if i != j}
    assert set(map(tuple, body.edges.T.tolist())) == edges
    assert body.edges.shape[1] == len(edges)


MIDDLES = {
    "sheet_deformation": {"youngs_modulus": (10.0, 100.0, 1000.0)},  # even in the logarithm
    "deformable_block": {"poisson_ratio": (-0.9, -0.205, 0.49)},
    "tissue_manipulation": {"poisson_ratio": (-0.9, -0.205, 0.49)},
    "falling_teddy": {"youngs_modulus": (1e5, 5.5e5, 1e6), "poisson_ratio": (0.0, 0.2495, 0.499)},
}


@pytest.mark.parametrize("name", MIDDLES)
def test_materials_are_told_as_numbers_from_minus_one_to_one(name: str) -> None:
    told = {feature.name: feature for feature in get_task(name).material}
    assert told.keys() == MIDDLES[name].keys()
    for parameter, values in MIDDLES[name].items():
        assert [told[parameter](value) for value in values] == pytest.approx([-1, 0, 1], abs=1e-12)
