"""Pictures of a trajectory with matplotlib, off screen.

Every scene is drawn the same way. Points are projected onto the plane of the picture (orthographically, so
a scale bar holds everywhere), triangles are painted from the back to the front and shaded by a light beside
the camera, and all frames share the limits of the whole motion.
"""

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image

from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import FIXED, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.view import Colour, Look

Array = NDArray[np.float64]
Indices = NDArray[np.int32]

STILL_PANEL, STILL_DPI = 3.0, 150  # longer side of one frame [inch]
MOVIE_PANEL, MOVIE_DPI = 5.0, 100
STILL_SHAPE = 1.7  # width over height that a still comes close to
HEAD, FOOT, BAR, TITLE, TICKS = 0.6, 0.6, 1.0, 0.28, 0.6  # what surrounds the frames [inch]
GAP = 0.1  # between the frames [inch]
SCALE = 1.6  # width of what shows the scale, in the corner below [inch]
MARGIN = 0.05  # around the motion, of its larger extent
NARROWEST = 0.52  # width over height of one frame: its title must fit
LEAST_WIDTH = 6.0  # [inch], for the heading
PALETTE_FRAMES = 8
LEAST_AREA_CHANGE = 1e-3  # on the colour bar; below is the round-off of float32

LIGHT = np.array([-0.45, 0.5, 0.74])  # right, up, towards the camera; of length 1
AMBIENT = 0.6
EDGE = 0.8  # brightness of a triangle's edges, of its face's
FLOOR, FLOOR_LINE, SHADOW = "#eef0f2", "#cfd4d9", "#bfc5cb"
COLLIDER, GRIP = "#8d99a6", "#d62728"
LONG_UNIT = 3  # letters
SYMBOLS = {"youngs_modulus": "E", "poisson_ratio": "ν", "density": "ρ"}  # noqa: RUF001


def surface(mesh: Mesh) -> Indices:
    """Triangles that can be seen: all of them, or the faces that belong to one tetrahedron only, [faces, 3]."""
    if mesh.cell_type == VTK_TRIANGLE:
        return mesh.cells
    faces = mesh.cells[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, first, counts = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    return faces[np.sort(first[counts == 1])]


def outline(faces: Indices) -> Indices:
    """Edges that belong to one triangle only, shape [edges, 2]; empty for a closed surface."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), 1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    return unique[counts == 1]


def rings(edges: Indices) -> list[list[int]]:
    """The closed lines that the edges form, each as a list of nodes; [] where an edge is part of none."""
    neighbours: dict[int, set[int]] = {}
    for a, b in edges.tolist():
        neighbours.setdefault(a, set()).add(b)
        neighbours.setdefault(b, set()).add(a)
    if any(len(others) != 2 for others in neighbours.values()):
        return []
    found = []
    while neighbours:
        ring = [min(neighbours)]
        while further := [node for node in sorted(neighbours.pop(ring[-1])) if node in neighbours]:
            ring.append(further[0])
        found.append(ring)
    return found


def triangle_areas(positions: Array, faces: Indices) -> Array:
    """Areas of triangles in two or three dimensions, shape [..., faces]."""
    corners = positions[..., faces, :]
    a, b = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    gram = (a * a).sum(-1) * (b * b).sum(-1) - (a * b).sum(-1) ** 2
    return 0.5 * np.sqrt(np.maximum(gram, 0))


class Camera:
    """An orthographic projection; in two dimensions the identity."""

    def __init__(self, dimension: int, azimuth: float, elevation: float) -> None:
        a, e = math.radians(azimuth), math.radians(elevation)
        self.flat = dimension == 2
        self.axes = np.array(  # right, up, towards the camera
            [
                [-math.sin(a), math.cos(a), 0],
                [-math.sin(e) * math.cos(a), -math.sin(e) * math.sin(a), math.cos(e)],
                [math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)],
            ]
        )

    def __call__(self, points: Array) -> Array:
        """Coordinates to the right and upwards, shape [..., 2]."""
        return points if self.flat else points @ self.axes[:2].T

    def in_space(self, points: Array) -> Array:
        """Coordinates to the right, upwards and towards the camera, shape [..., 3]."""
        return points @ self.axes.T


@dataclass(frozen=True, eq=False)
class Floor:
    """A square grid in space: its corners [4, 3], its lines [lines, 2, 3] and their distance."""

    corners: Array
    lines: Array
    step: float


class Picture:
    """A trajectory ready to be drawn.

    Args:
        trajectory: what to draw.
        metadata: of its file.
        look: how its scene is looked at.
        colour: what the colours show.
        title: the first line of the heading.
    """

    def __init__(
        self, trajectory: Trajectory, metadata: Metadata, look: Look, colour: Colour, title: str
    ) -> None:
        self.mesh, self.metadata, self.look = trajectory.mesh, metadata, look
        self.positions = trajectory.positions.astype(np.float64)
        self.flat = self.positions.shape[-1] == 2
        self.camera = Camera(self.positions.shape[-1], look.azimuth, look.elevation)
        self.faces = surface(self.mesh)
        self.outline = outline(self.faces)
        self.fixed = np.intersect1d(np.flatnonzero(self.mesh.node_type == FIXED), self.faces)
        collider = trajectory.collider_positions
        self.collider = None if collider is None else collider.astype(np.float64)
        self.collider_edges = trajectory.collider_edges
        self.collider_rings = [] if trajectory.collider_edges is None else rings(trajectory.collider_edges)
        self.values, self.norm, self.colours, self.label = self._colouring(colour)
        self.floor = None if look.floor is None or self.flat else self._floor(look.floor)
        self.lower, self.upper = self._limits()
        self.heading = [title, _description(trajectory, metadata)]

    def still(self, frames: Sequence[int]) -> bytes:
        """A PNG with the frames side by side, in rows."""
        width, height = self._panel(STILL_PANEL)

        def badness(columns: int) -> float:
            rows = math.ceil(len(frames) / columns)
            empty = rows * columns - len(frames)
            return abs(math.log(columns * width / (rows * height) / STILL_SHAPE)) + empty / columns

        columns = min(range(1, len(frames) + 1), key=badness)
        figure, panels = self._figure(len(frames), columns, STILL_PANEL, STILL_DPI)
        for panel, frame in zip(panels, frames, strict=True):
            self._draw(panel, frame)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png")
        return buffer.getvalue()

    def animation(self, frames: Sequence[int], fps: int, on_progress: Callable[[int, int], None]) -> bytes:
        """A GIF of the frames that repeats for ever."""
        figure, (panel,) = self._figure(1, 1, MOVIE_PANEL, MOVIE_DPI)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        empty = canvas.copy_from_bbox(figure.bbox)  # most of the time would go into texts that stay the same

        def image(frame: int) -> Image.Image:
            canvas.restore_region(empty)
            for artist in sorted(self._draw(panel, frame), key=lambda artist: artist.get_zorder()):
                panel.draw_artist(artist)
                artist.remove()
            return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

        # One palette for all: with one for each frame the colours would flicker.
        samples = [np.asarray(image(frame)) for frame in frames[:: math.ceil(len(frames) / PALETTE_FRAMES)]]
        palette = _palette(np.concatenate([sample.reshape(-1, 3) for sample in samples]))

        def images() -> Iterator[Image.Image]:
            for done, frame in enumerate(frames):
                on_progress(done, len(frames))
                yield image(frame).quantize(palette=palette, dither=Image.Dither.NONE)

        every = images()
        buffer = io.BytesIO()
        next(every).save(
            buffer, "GIF", save_all=True, append_images=every, duration=round(1000 / fps), loop=0
        )
        on_progress(len(frames), len(frames))
        return buffer.getvalue()

    # --- what there is to draw ----------------------------------------------------------------------------

    def _colouring(self, colour: Colour) -> tuple[Array, Normalize, Colormap, str]:
        """The number behind each triangle's colour, shape [frames, faces]; its scale, colours and name."""
        unit = self.metadata.length_unit
        moved = self.positions - self.positions[0]
        if colour == "area":
            rest = triangle_areas(self.mesh.rest_positions.astype(np.float64), self.faces)
            values = triangle_areas(self.positions, self.faces) / np.maximum(rest, np.finfo(float).tiny)
            # A few crumpled triangles would leave no colour for the others.
            reach = max(float(np.quantile(np.abs(values - 1), 0.998)), LEAST_AREA_CHANGE)
            return values, Normalize(1 - reach, 1 + reach), colormaps["coolwarm"], "area / area at rest"
        if colour == "height":
            values = moved[..., -1][:, self.faces].mean(-1)
            reach = float(np.abs(values).max()) or 1.0
            label = f"displacement in {'xyz'[moved.shape[-1] - 1]} since frame 0 [{unit}]"
            return values, Normalize(-reach, reach), colormaps["coolwarm"], label
        values = np.linalg.norm(moved, axis=-1)[:, self.faces].mean(-1)
        reach = float(values.max()) or 1.0
        return values, Normalize(0, reach), colormaps["YlGnBu"], f"displacement since frame 0 [{unit}]"

    def _floor(self, height: float) -> Floor:
        """A floor below the whole motion."""
        lower, upper = self.positions.min((0, 1))[:2], self.positions.max((0, 1))[:2]
        step = round_length((float((upper - lower).max()) or 1.0) / 4)
        first, last = np.floor(lower / step) - 1, np.ceil(upper / step) + 1
        x, y = (step * np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        along_y = [[(value, y[0], height), (value, y[-1], height)] for value in x]
        along_x = [[(x[0], value, height), (x[-1], value, height)] for value in y]
        corners = [(x[i], y[j], height) for i, j in ((0, 0), (-1, 0), (-1, -1), (0, -1))]
        return Floor(np.array(corners), np.array(along_y + along_x), step)

    def _limits(self) -> tuple[Array, Array]:
        """Corners of the picture: the whole motion of everything fits, and its shadow."""
        shown = [self.positions] if self.collider is None else [self.positions, self.collider]
        if self.look.floor is not None:
            below = self.positions.copy()
            below[..., -1] = self.look.floor
            shown.append(below)
        points = np.concatenate([self.camera(part).reshape(-1, 2) for part in shown])
        lower, upper = points.min(0), points.max(0)
        margin = MARGIN * (float((upper - lower).max()) or 1.0)
        width, height = upper - lower + 2 * margin
        beside = max(0.0, NARROWEST * height - width) / 2
        return lower - margin - [beside, 0], upper + margin + [beside, 0]

    # --- the figure ---------------------------------------------------------------------------------------

    def _panel(self, longer: float) -> tuple[float, float]:
        """Width and height of one frame [inch]."""
        extent = self.upper - self.lower
        width, height = longer * extent / extent.max()
        return float(width), float(height)

    def _figure(self, count: int, columns: int, longer: float, dpi: int) -> tuple[Figure, list[Axes]]:
        """A figure with a heading, a colour bar, a legend, and axes that hold what no frame changes.

        Everything is placed by hand, because automatic layouts move from frame to frame.
        """
        (width, height), rows = self._panel(longer), math.ceil(count / columns)
        ticks = TICKS if self.flat else GAP
        used = ticks + columns * (width + GAP) + BAR
        total_width = max(used, LEAST_WIDTH)
        left = ticks + (total_width - used) / 2
        frames_height = rows * (height + TITLE)
        total_height = HEAD + frames_height + (TICKS if self.flat else 0) + FOOT
        figure = Figure(figsize=(total_width, total_height), dpi=dpi)

        def place(from_left: float, from_top: float, wide: float, high: float) -> Axes:
            bottom = total_height - from_top - high
            return figure.add_axes(
                (from_left / total_width, bottom / total_height, wide / total_width, high / total_height)
            )

        panels = []
        for number in range(count):
            row, column = divmod(number, columns)
            panel = place(left + column * (width + GAP), HEAD + TITLE + row * (height + TITLE), width, height)
            self._furnish(panel, leftmost=column == 0, lowest=number + columns >= count)
            panels.append(panel)

        bar_height = min(frames_height - TITLE, 3.0)
        bar_top = HEAD + TITLE + (frames_height - TITLE - bar_height) / 2
        bar = place(left + columns * (width + GAP) + 0.05, bar_top, 0.12, bar_height)
        beyond = self.values.min() < self.norm.vmin, self.values.max() > self.norm.vmax
        extend = {(False, False): "neither", (True, False): "min", (False, True): "max"}.get(beyond, "both")
        figure.colorbar(ScalarMappable(self.norm, self.colours), cax=bar, extend=extend)
        bar.tick_params(labelsize=7)
        bar.set_ylabel(self.label, fontsize=8)

        for line, (from_top, size) in zip(self.heading, ((0.1, 11), (0.34, 9)), strict=True):
            figure.text(0.5, 1 - from_top / total_height, line, ha="center", va="top", fontsize=size)
        middle = total_width / 2
        if not self.flat:
            corner = place(0.1, total_height - FOOT, SCALE, FOOT)
            self._draw_scale(corner, unit=longer / float((self.upper - self.lower).max()))
            middle += SCALE / 2
        if handles := self._legend():
            place_of_legend = (middle / total_width, FOOT / 2 / total_height)
            figure.legend(
                handles=handles,
                loc="center",
                bbox_to_anchor=place_of_legend,
                ncols=2 if total_width < 8 and len(handles) > 2 else len(handles),
                fontsize=8,
                frameon=False,
            )
        return figure, panels

    def _furnish(self, panel: Axes, *, leftmost: bool, lowest: bool) -> None:
        """What is the same in every frame: limits, ticks, the floor."""
        panel.set(xlim=(self.lower[0], self.upper[0]), ylim=(self.lower[1], self.upper[1]))
        if self.flat:
            # Numbers are the same everywhere, so they stand at the outer frames only.
            panel.tick_params(labelsize=7, labelleft=leftmost, labelbottom=lowest)
            if leftmost:
                panel.set_ylabel(f"y [{self.metadata.length_unit}]", fontsize=8, labelpad=0)
            if lowest:
                panel.set_xlabel(f"x [{self.metadata.length_unit}]", fontsize=8, labelpad=1)
        else:
            panel.set_axis_off()
        if self.floor:
            ground = PolyCollection([self.camera(self.floor.corners)], facecolor=FLOOR, zorder=0)
            panel.add_collection(ground)
            lines = LineCollection(list(self.camera(self.floor.lines)), color=FLOOR_LINE, lw=0.5, zorder=0)
            panel.add_collection(lines)
        elif self.look.floor is not None:
            panel.axhspan(
                self.lower[1],
                self.look.floor,
                facecolor=FLOOR,
                edgecolor=FLOOR_LINE,
                hatch="////",
                zorder=0,
            )

    def _draw_scale(self, corner: Axes, unit: float) -> None:
        """A scale bar, and which way x, y and z go, in axes of the size [SCALE, FOOT]; a unit is `unit` inch."""
        corner.set(xlim=(0, SCALE), ylim=(0, FOOT))
        corner.set_axis_off()
        origin = np.array([0.18, 0.14])
        for name, tip in zip("xyz", 0.22 * self.camera(np.eye(3)), strict=True):
            arrow = {"arrowstyle": "->", "lw": 0.7, "shrinkA": 0, "shrinkB": 0}
            end = origin + tip
            corner.annotate("", xy=(end[0], end[1]), xytext=(origin[0], origin[1]), arrowprops=arrow)
            end = origin + 1.35 * tip
            corner.text(end[0], end[1], name, ha="center", va="center", fontsize=7)
        length = round_length(1.0 / unit)
        bar = 0.6 + np.array([0, length * unit])
        corner.plot(bar, [0.14, 0.14], color="black", lw=1.5, solid_capstyle="butt")
        text = f"{length:g} {self.metadata.length_unit}"
        corner.text(float(bar.mean()), 0.18, text, ha="center", va="bottom", fontsize=7)

    def _legend(self) -> list[Artist]:
        """What the marks mean, for those that there are."""
        handles: list[Artist] = []
        if self.flat and len(self.outline):
            handles.append(Line2D([], [], color="black", lw=0.8, ls=":", label="outline in frame 0"))
        if len(self.fixed):
            handles.append(Line2D([], [], ls="", marker="o", ms=3, color="black", label="fixed nodes"))
        if self.collider is not None and self.collider_edges is None:
            name = f"{self.look.collider}: start, and way so far"
            handles.append(Line2D([], [], color=GRIP, lw=1.2, marker="o", ms=4, mfc="white", label=name))
        elif self.collider is not None:
            handles.append(Patch(facecolor=COLLIDER, edgecolor="black", lw=0.6, label=self.look.collider))
        if self.look.floor is not None:
            squares = f", squares of {self.floor.step:g} {self.metadata.length_unit}" if self.floor else ""
            handles.append(Patch(facecolor=FLOOR, edgecolor=FLOOR_LINE, label=f"floor{squares}"))
        if self.floor:
            handles.append(Patch(facecolor=SHADOW, label="straight below the object"))
        return handles

    # --- one frame ----------------------------------------------------------------------------------------

    def _draw(self, panel: Axes, frame: int) -> list[Artist]:
        """Put one frame into axes; returns what is new in them."""
        before = set(panel.get_children())
        panel.annotate(
            _time(frame, self.metadata),
            (0.5, 1),
            (0, 4),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="center",
            fontsize=9,
        )
        self._draw_shadow(panel, frame)
        self._draw_surface(panel, frame)
        self._draw_collider(panel, frame)
        return [artist for artist in panel.get_children() if artist not in before]

    def _draw_shadow(self, panel: Axes, frame: int) -> None:
        if self.floor:
            below = self.positions[frame].copy()
            below[:, 2] = self.floor.corners[0, 2]
            shadow = self.camera(below)[self.faces]
            panel.add_collection(
                PolyCollection(list(shadow), facecolor=SHADOW, edgecolor=SHADOW, lw=0.3, zorder=1)
            )

    def _draw_surface(self, panel: Axes, frame: int) -> None:
        points = self.camera(self.positions[frame])
        colours = self.colours(self.norm(self.values[frame]))[:, :3]
        order = np.arange(len(self.faces))
        visible = np.ones(len(points), bool)
        if not self.flat:
            normals, depths = self._normals_and_depths(frame)
            order = np.argsort(depths, kind="stable")
            # Light falls on the side that the camera sees, however the triangle is oriented.
            facing = normals * np.where(normals[:, 2:] < 0, -1, 1)
            colours = colours * (AMBIENT + (1 - AMBIENT) * np.maximum(facing @ LIGHT, 0))[:, None]
            if not len(self.outline):  # a closed surface hides the nodes on its far side
                visible[:] = False
                visible[self.faces[normals[:, 2] > 0]] = True
        triangles = points[self.faces[order]]
        panel.add_collection(
            PolyCollection(
                list(triangles), facecolor=colours[order], edgecolor=EDGE * colours[order], lw=0.4, zorder=2
            )
        )
        if self.flat:
            start = self.camera(self.positions[0])[self.outline]
            panel.add_collection(LineCollection(list(start), color="black", lw=0.7, ls=":", zorder=3))
        fixed = points[self.fixed[visible[self.fixed]]]
        panel.plot(*fixed.T, ls="", marker="o", ms=2, color="black", zorder=3)

    def _normals_and_depths(self, frame: int) -> tuple[Array, Array]:
        """In the camera's axes: unit normals, outwards where the surface is closed, and how near triangles are."""
        corners = self.camera.in_space(self.positions[frame])[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        volume = (normals * (corners[:, 0] - corners.mean((0, 1)))).sum()
        lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
        return (-1 if volume < 0 else 1) * normals / lengths, corners[..., 2].mean(1)

    def _draw_collider(self, panel: Axes, frame: int) -> None:
        if self.collider is None:
            return
        path = self.camera(self.collider)
        if self.collider_rings:
            shapes = [path[frame][ring] for ring in self.collider_rings]
            panel.add_collection(
                PolyCollection(shapes, facecolor=COLLIDER, edgecolor="black", lw=0.6, zorder=4)
            )
        elif self.collider_edges is not None:
            lines = list(path[frame][self.collider_edges])
            panel.add_collection(LineCollection(lines, color=COLLIDER, zorder=4))
        else:
            for way in path[: frame + 1].swapaxes(0, 1):
                panel.plot(*way.T, color=GRIP, lw=1.2, zorder=4)
                panel.plot(*way[0], marker="o", ms=4, mfc="white", mec=GRIP, zorder=4)
                before, now = way[max(0, frame - 1)], way[-1]
                if (now != before).any():
                    head = {"arrowstyle": "-|>", "color": GRIP, "shrinkA": 0, "shrinkB": 0}
                    panel.annotate(
                        "", xy=(now[0], now[1]), xytext=(before[0], before[1]), arrowprops=head, zorder=4
                    )


def _palette(pixels: NDArray[np.uint8]) -> Image.Image:
    """White and 255 colours that stand for those of the pixels, shape [pixels, 3], the rare like the frequent.

    If frequency counted, the background would take most of them and a thin red arrow would turn grey.
    """
    red, green, blue = pixels.astype(np.int32).T
    different = np.unique(red << 16 | green << 8 | blue)  # far faster than unique rows
    channels = np.stack([different >> 16, different >> 8 & 255, different & 255], -1).astype(np.uint8)
    # Pillow looks colours up in steps of four levels, so an entry next to white would take white's place.
    channels = channels[channels.min(1) < 248]
    colours = Image.fromarray(channels[None]).quantize(255, kmeans=1).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *colours])
    return palette


def round_length(length: float) -> float:
    """The largest of 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(digit for digit in (1, 2, 5) if digit * power <= length * (1 + 1e-9))


def _time(frame: int, metadata: Metadata) -> str:
    """Number and time of a frame. A unit of many letters stands in the heading instead."""
    decimals = max(0, math.ceil(-math.log10(metadata.dt) - 1e-9))
    unit = f" {metadata.time_unit}" if len(metadata.time_unit) <= LONG_UNIT else ""
    return f"frame {frame}, t = {frame * metadata.dt:.{decimals}f}{unit}"


def _description(trajectory: Trajectory, metadata: Metadata) -> str:
    """Tags and material in one line, e.g. "object teddy, E = 3.2e+05 Pa, ν = 0.49"."""
    parts = [f"{name} {value}" for name, value in trajectory.tags.items()]
    rank = {name: number for number, name in enumerate(SYMBOLS)}
    for name, value in sorted(trajectory.material.items(), key=lambda item: rank.get(item[0], len(rank))):
        unit = metadata.material_units.get(name, "1")
        parts.append(f"{SYMBOLS.get(name, name)} = {value:.3g}{'' if unit == '1' else f' {unit}'}")
    if len(metadata.time_unit) > LONG_UNIT:
        parts.append(f"t: {metadata.time_unit}")
    return ", ".join(parts).replace("_", " ")
