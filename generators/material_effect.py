"""How much there is to infer: the same draw simulated with the softest and with the stiffest material."""

import numpy as np
from threadpoolctl import threadpool_limits

from m3gn_bench.datasets.schema import DATASET_SEED
from m3gn_bench.generators.generate import draw
from m3gn_bench.generators.scene import Scene


def material_effect(scene: Scene, draws: int = 6) -> float:
    """Mean squared difference of the positions, scaled units, over all frames and nodes of a few test draws.

    Raises:
        SolverError: one of the extremes cannot be simulated.
    """
    differences = []
    with threadpool_limits(1):
        for index in range(draws):
            extremes = scene.extreme_materials(draw(scene, "test", index, DATASET_SEED))
            soft, stiff = (scene.simulate(parameters, "default").positions for parameters in extremes)
            differences.append(np.mean((soft.astype(np.float64) - stiff) ** 2) / scene.scale_length**2)
    return float(np.mean(differences))
