"""Pictures of a trajectory with matplotlib, off screen.

Every scene is drawn the same way. Points are projected onto the plane of the picture (orthographically, so
a scale bar holds everywhere), triangles are painted from the back to the front and shaded by a light beside
the camera, and all panels share the limits of the whole motion. What models predict is drawn in panels of its
own, beside the truth.
"""

import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import FIXED, Trajectory
from m3gn_bench.movie import Pixels, gif, mp4
from m3gn_bench.picture_colours import colouring
from m3gn_bench.picture_geometry import (
    Array,
    Camera,
    outline,
    rings,
    round_length,
    silhouette,
    surface,
    wireframe,
)
from m3gn_bench.picture_page import LINE, Page, columns_for
from m3gn_bench.view import Colour, Look

STILL_PANEL, STILL_DPI = 3.0, 150  # longer side of one panel [inch]
MOVIE_PANEL, MOVIE_DPI = 5.0, 100
COMPARED_PANEL = 3.6  # in a movie with several
COMPARED_COLUMNS = 4  # at most, in a movie
STILL_SHAPE = 1.7  # width over height that a still comes close to
MARGIN = 0.05  # around the motion, of its larger extent
NARROWEST = 0.52  # width over height of one panel: its title must fit
BEYOND = 0.25  # how far a prediction may widen the picture, of the truth's larger extent
PALETTE_FRAMES = 8
TITLE_SIZE = 9.0  # of a panel's title [pt], unless the panel is too narrow for it
LETTER = {"normal": 0.55, "bold": 0.68}  # width of a letter over its size

LIGHT = np.array([-0.45, 0.5, 0.74])  # right, up, towards the camera; of length 1
AMBIENT = 0.6
EDGE = 0.8  # brightness of a triangle's edges, of its face's
FLOOR, FLOOR_LINE, SHADOW = "#eef0f2", "#cfd4d9", "#bfc5cb"
COLLIDER, GRIP = "#8d99a6", "#d62728"
TRUTH = "#1f3a93"
LONG_UNIT = 3  # letters
SYMBOLS = {"youngs_modulus": "E", "poisson_ratio": "ν", "density": "ρ"}  # noqa: RUF001


@dataclass(frozen=True, eq=False)
class Floor:
    """A square grid in space: its corners [4, 3], its lines [lines, 2, 3] and their distance."""

    corners: Array
    lines: Array
    step: float


class Picture:
    """A trajectory ready to be drawn, alone or with predictions of it.

    Args:
        trajectory: what to draw.
        metadata: of its file.
        look: how its scene is looked at.
        colour: what the colours show.
        title: the first line of the heading.
        predictions: what models make of the trajectory, by the title of their panels; in the file's unit of
            length, each of shape [frames, nodes, dim].
        context: the number of frames that the models were given.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        metadata: Metadata,
        look: Look,
        colour: Colour,
        title: str,
        *,
        predictions: Mapping[str, Array] | None = None,
        context: int = 0,
    ) -> None:
        self.mesh, self.metadata, self.look = trajectory.mesh, metadata, look
        self.context = context
        self.names = ["truth", *(predictions or {})]
        # The truth, then the predictions: [motions, frames, nodes, dim].
        self.motions = np.stack([trajectory.positions, *(predictions or {}).values()]).astype(np.float64)
        self.flat = self.motions.shape[-1] == 2
        self.camera = Camera(self.motions.shape[-1], look.azimuth, look.elevation)
        self.faces = surface(self.mesh)
        self.edges, self.outline = wireframe(self.faces), outline(self.faces)
        self.fixed = np.intersect1d(np.flatnonzero(self.mesh.node_type == FIXED), self.faces)
        collider = trajectory.collider_positions
        self.collider = None if collider is None else collider.astype(np.float64)
        self.collider_edges = trajectory.collider_edges
        self.collider_rings = [] if trajectory.collider_edges is None else rings(trajectory.collider_edges)
        self.colouring = colouring(colour, self.motions, self.mesh, self.faces, metadata.length_unit)
        self.floor = None if look.floor is None or self.flat else self._floor(look.floor)
        self.lower, self.upper = self._limits()
        self.heading = (title, _description(trajectory, metadata, context))

    @property
    def compares(self) -> bool:
        """Whether there is more than the truth."""
        return len(self.names) > 1

    def still(self, frames: Sequence[int]) -> bytes:
        """A PNG: frames side by side, in rows; with predictions a row for each frame, a column for each model."""
        count = len(frames) * len(self.names)
        columns = len(self.names)
        if not self.compares:
            columns = columns_for(count, *self._panel(STILL_PANEL), STILL_SHAPE)
        page = self._page(count, columns, STILL_PANEL, STILL_DPI)
        shown = [(motion, frame) for frame in frames for motion in range(len(self.names))]
        for panel, (motion, frame) in zip(page.panels, shown, strict=True):
            self._draw(panel, motion, frame)
        buffer = io.BytesIO()
        page.figure.savefig(buffer, format="png")
        return buffer.getvalue()

    def gif(self, frames: Sequence[int], fps: int, on_progress: Callable[[int, int], None]) -> bytes:
        """A GIF of the frames that repeats for ever."""
        pixels = self._animated()
        samples = [pixels(frame) for frame in frames[:: math.ceil(len(frames) / PALETTE_FRAMES)]]
        return gif(_counted(pixels, frames, on_progress), samples, fps)

    def mp4(self, frames: Sequence[int], fps: int, on_progress: Callable[[int, int], None]) -> bytes:
        """An MP4 of the frames. Raises ConfigError where ffmpeg is missing, or fails."""
        return mp4(_counted(self._animated(), frames, on_progress), fps)

    def _animated(self) -> Callable[[int], Pixels]:
        """Draws a frame of all motions, pixels of shape [rows, columns, 3]."""
        count = len(self.names)
        rows = math.ceil(count / COMPARED_COLUMNS)
        longer = COMPARED_PANEL if self.compares else MOVIE_PANEL
        page = self._page(count, math.ceil(count / rows), longer, MOVIE_DPI)
        canvas = FigureCanvasAgg(page.figure)
        canvas.draw()
        empty = canvas.copy_from_bbox(
            page.figure.bbox
        )  # most of the time would go into texts that stay the same

        def pixels(frame: int) -> Pixels:
            canvas.restore_region(empty)
            for motion, panel in enumerate(page.panels):
                for artist in sorted(
                    self._draw(panel, motion, frame), key=lambda artist: artist.get_zorder()
                ):
                    panel.draw_artist(artist)
                    artist.remove()
            return np.array(canvas.buffer_rgba())[..., :3]

        return pixels

    # --- what there is to draw ----------------------------------------------------------------------------

    def _floor(self, height: float) -> Floor:
        """A floor below the whole motion."""
        lower, upper = self.motions[0].min((0, 1))[:2], self.motions[0].max((0, 1))[:2]
        step = round_length((float((upper - lower).max()) or 1.0) / 4)
        first, last = np.floor(lower / step) - 1, np.ceil(upper / step) + 1
        x, y = (step * np.arange(a, b + 1) for a, b in zip(first, last, strict=True))
        along_y = [[(value, y[0], height), (value, y[-1], height)] for value in x]
        along_x = [[(x[0], value, height), (x[-1], value, height)] for value in y]
        corners = [(x[i], y[j], height) for i, j in ((0, 0), (-1, 0), (-1, -1), (0, -1))]
        return Floor(np.array(corners), np.array(along_y + along_x), step)

    def _limits(self) -> tuple[Array, Array]:
        """Corners of a panel: the true motion of everything fits, its shadow, and predictions nearby."""
        shown = [self.motions[0]] if self.collider is None else [self.motions[0], self.collider]
        if self.look.floor is not None:
            below = self.motions[0].copy()
            below[..., -1] = self.look.floor
            shown.append(below)
        points = np.concatenate([self.camera(part).reshape(-1, 2) for part in shown])
        lower, upper = points.min(0), points.max(0)
        # A prediction that leaves the scene must not make everything else tiny.
        reach = BEYOND * float((upper - lower).max())
        predicted = self.camera(self.motions).reshape(-1, 2)
        lower = np.clip(predicted.min(0), lower - reach, lower)
        upper = np.clip(predicted.max(0), upper, upper + reach)
        margin = MARGIN * (float((upper - lower).max()) or 1.0)
        width, height = upper - lower + 2 * margin
        beside = max(0.0, NARROWEST * height - width) / 2
        return lower - margin - [beside, 0], upper + margin + [beside, 0]

    # --- the page -----------------------------------------------------------------------------------------

    def _panel(self, longer: float) -> tuple[float, float]:
        """Width and height of one panel [inch]."""
        extent = self.upper - self.lower
        width, height = longer * extent / extent.max()
        return float(width), float(height)

    def _page(self, count: int, columns: int, longer: float, dpi: int) -> Page:
        """A page with everything that no frame changes."""
        page = Page(count, columns, *self._panel(longer), lines=1 + self.compares, ticks=self.flat, dpi=dpi)
        for number, panel in enumerate(page.panels):
            self._furnish(panel, leftmost=number % columns == 0, lowest=number + columns >= count)
        page.heading(*self.heading)
        page.colour_bar(self.colouring)
        if not self.flat:
            self._draw_scale(page.corner(), unit=longer / float((self.upper - self.lower).max()))
        page.legend(self._legend(), beside_corner=not self.flat)
        return page

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
        if self.compares:
            handles.append(Line2D([], [], color=TRUTH, lw=0.8, label="the truth"))
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

    # --- one panel ----------------------------------------------------------------------------------------

    def _draw(self, panel: Axes, motion: int, frame: int) -> list[Artist]:
        """Put one frame of a motion into axes; returns what is new in them."""
        before = set(panel.get_children())
        self._draw_title(panel, motion, frame)
        self._draw_shadow(panel, motion, frame)
        self._draw_surface(panel, motion, frame)
        if motion and frame >= self.context:
            self._draw_truth(panel, frame)
        self._draw_collider(panel, frame)
        return [artist for artist in panel.get_children() if artist not in before]

    def title(self, motion: int, frame: int) -> list[str]:
        """The lines above a panel: frame and time, or whose prediction it is and how far from the truth."""
        time = _time(frame, self.metadata)
        if not self.compares:
            return [time]
        if motion == 0:
            return [self.names[0], time]
        if frame < self.context:
            return [self.names[motion], "context"]
        distances = np.linalg.norm(self.motions[motion, frame] - self.motions[0, frame], axis=-1)
        number = f"{distances.mean():#.3g}".rstrip(".")
        return [self.names[motion], f"mean distance {number} {self.metadata.length_unit}"]

    def _draw_title(self, panel: Axes, motion: int, frame: int) -> None:
        width = 72 * panel.bbox.width / panel.figure.dpi  # points
        for number, line in enumerate(reversed(self.title(motion, frame))):
            weight = "bold" if number else "normal"
            panel.annotate(
                line,
                (0.5, 1),
                (0, 4 + 72 * LINE * number),
                xycoords="axes fraction",
                textcoords="offset points",
                ha="center",
                fontsize=min(TITLE_SIZE, width / (LETTER[weight] * len(line))),
                fontweight=weight,
            )

    def _draw_shadow(self, panel: Axes, motion: int, frame: int) -> None:
        if self.floor:
            below = self.motions[motion, frame].copy()
            below[:, 2] = self.floor.corners[0, 2]
            shadow = self.camera(below)[self.faces]
            panel.add_collection(
                PolyCollection(list(shadow), facecolor=SHADOW, edgecolor=SHADOW, lw=0.3, zorder=1)
            )

    def _draw_surface(self, panel: Axes, motion: int, frame: int) -> None:
        positions = self.motions[motion, frame]
        points = self.camera(positions)
        colours = self.colouring(motion, frame)
        order = np.arange(len(self.faces))
        visible = np.ones(len(points), bool)
        if not self.flat:
            normals, depths = self.camera.normals_and_depths(positions, self.faces)
            order = np.argsort(depths, kind="stable")
            # Light falls on the side that the camera sees, however the triangle is oriented.
            facing = normals * np.where(normals[:, 2:] < 0, -1, 1)
            colours = colours * (AMBIENT + (1 - AMBIENT) * np.clip(facing @ LIGHT, 0, 1))[:, None]
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
            start = self.camera(self.motions[0, 0])[self.outline]
            panel.add_collection(LineCollection(list(start), color="black", lw=0.7, ls=":", zorder=3))
        fixed = points[self.fixed[visible[self.fixed]]]
        panel.plot(*fixed.T, ls="", marker="o", ms=2, color="black", zorder=3)

    def _draw_truth(self, panel: Axes, frame: int) -> None:
        """Where the body really is, as lines over a prediction."""
        positions, width = self.motions[0, frame], 0.8
        if self.flat:
            edges = self.outline
        elif len(self.outline):
            edges, width = self.edges, 0.25  # the border of a sheet in space says little of its shape
        else:
            normals, _ = self.camera.normals_and_depths(positions, self.faces)
            edges = silhouette(self.faces, normals[:, 2] > 0)
        lines = self.camera(positions)[edges]
        panel.add_collection(LineCollection(list(lines), color=TRUTH, lw=width, zorder=3))

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


def _time(frame: int, metadata: Metadata) -> str:
    """Number and time of a frame. A unit of many letters stands in the heading instead."""
    decimals = max(0, math.ceil(-math.log10(metadata.dt) - 1e-9))
    unit = f" {metadata.time_unit}" if len(metadata.time_unit) <= LONG_UNIT else ""
    return f"frame {frame}, t = {frame * metadata.dt:.{decimals}f}{unit}"


def _description(trajectory: Trajectory, metadata: Metadata, context: int) -> str:
    """Tags, material and context in one line, e.g. "object teddy, E = 3.2e+05 Pa, ν = 0.49"."""
    parts = [f"{name} {value}" for name, value in trajectory.tags.items()]
    rank = {name: number for number, name in enumerate(SYMBOLS)}
    for name, value in sorted(trajectory.material.items(), key=lambda item: rank.get(item[0], len(rank))):
        unit = metadata.material_units.get(name, "1")
        parts.append(f"{SYMBOLS.get(name, name)} = {value:.3g}{'' if unit == '1' else f' {unit}'}")
    if len(metadata.time_unit) > LONG_UNIT:
        parts.append(f"t: {metadata.time_unit}")
    if context:
        parts.append(f"models see frames 0 to {context - 1}")
    return ", ".join(parts).replace("_", " ")


def _counted(
    pixels: Callable[[int], Pixels], frames: Sequence[int], on_progress: Callable[[int, int], None]
) -> Iterator[Pixels]:
    """Draw frames one by one, and tell how many are done."""
    for done, frame in enumerate(frames, 1):
        yield pixels(frame)
        on_progress(done, len(frames))
