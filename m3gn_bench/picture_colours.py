"""What the colours of a picture mean: the numbers behind them, and their scale."""

from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, Normalize

from m3gn_bench.datasets.trajectory import Mesh
from m3gn_bench.picture_geometry import Array, Indices, triangle_areas
from m3gn_bench.view import Colour

LEAST_AREA_CHANGE = 1e-3  # on the colour bar; below is the round-off of float32


@dataclass(frozen=True, eq=False)
class Colouring:
    """Numbers and their colours.

    Attributes:
        values: the number behind each triangle's colour, shape [motions, frames, faces].
        norm, colours: from numbers to colours, the same in all panels.
        label: what the numbers are, with their unit.
    """

    values: Array
    norm: Normalize
    colours: Colormap
    label: str

    @property
    def beyond(self) -> tuple[bool, bool]:
        """Whether there are numbers below and above the scale."""
        return bool(self.values.min() < self.norm.vmin), bool(self.values.max() > self.norm.vmax)

    def __call__(self, motion: int, frame: int) -> Array:
        """Red, green and blue of every triangle, shape [faces, 3]."""
        return self.colours(self.norm(self.values[motion, frame]))[:, :3]


def colouring(colour: Colour, motions: Array, mesh: Mesh, faces: Indices, unit: str) -> Colouring:
    """The colours of one or several motions of a mesh.

    The scale is that of the truth, or of how far the others are from it, so a prediction that leaves the
    scene does not take all colours.

    Args:
        colour: what they show.
        motions: the truth, then predictions, shape [motions, frames, nodes, dim].
        mesh, faces: what moves, and the triangles of it that are coloured, shape [faces, 3].
        unit: of length.
    """
    moved = motions - motions[:, :1]
    match colour:
        case "area":
            rest = triangle_areas(mesh.rest_positions.astype(np.float64), faces)
            values = triangle_areas(motions, faces) / np.maximum(rest, np.finfo(float).tiny)
            # A few crumpled triangles would leave no colour for the others.
            reach = max(float(np.quantile(np.abs(values[0] - 1), 0.998)), LEAST_AREA_CHANGE)
            return Colouring(
                values, Normalize(1 - reach, 1 + reach), colormaps["coolwarm"], "area / area at rest"
            )
        case "height":
            values = moved[..., -1][..., faces].mean(-1)
            reach = float(np.abs(values[0]).max()) or 1.0
            label = f"displacement in {'xyz'[moved.shape[-1] - 1]} since frame 0 [{unit}]"
            return Colouring(values, Normalize(-reach, reach), colormaps["coolwarm"], label)
        case "displacement":
            values = np.linalg.norm(moved, axis=-1)[..., faces].mean(-1)
            reach = float(values[0].max()) or 1.0
            label = f"displacement since frame 0 [{unit}]"
            return Colouring(values, Normalize(0, reach), colormaps["YlGnBu"], label)
        case "distance":
            values = np.linalg.norm(motions - motions[0], axis=-1)[..., faces].mean(-1)
            size = float(np.ptp(motions[0], axis=(0, 1)).max())
            reach = min(float(values.max()), size) or 1.0
            label = f"distance from the truth [{unit}]"
            return Colouring(values, Normalize(0, reach), colormaps["YlOrRd"], label)
