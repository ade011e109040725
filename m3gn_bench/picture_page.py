"""A page of panels: a heading above them, a colour bar beside them, a legend below them; all lengths in inches.

Everything is placed by hand, because automatic layouts move from frame to frame.
"""

import math
from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from m3gn_bench.picture_colours import Colouring

HEAD, FOOT, BAR, TICKS = 0.6, 0.6, 1.0, 0.6  # what surrounds the panels
LINE = 0.16  # of a panel's title
ABOVE = 0.12  # a panel's title
GAP = 0.1  # between panels
SCALE = 1.6  # width of the corner below, for what shows the scale
LEAST_WIDTH = 6.0  # for the heading


class Page:
    """A figure with panels in rows, numbered from left to right and from top to bottom.

    Args:
        count, columns: number of panels, and of those in a row.
        width, height: of a panel.
        lines: of each panel's title.
        ticks: whether panels have numbers to the left and below.
        dpi: pixels per inch.
    """

    def __init__(
        self, count: int, columns: int, width: float, height: float, *, lines: int, ticks: bool, dpi: int
    ) -> None:
        title = ABOVE + lines * LINE
        rows = math.ceil(count / columns)
        beside = TICKS if ticks else GAP
        used = beside + columns * (width + GAP) + BAR
        self.width = max(used, LEAST_WIDTH)
        self.height = HEAD + rows * (height + title) + (TICKS if ticks else 0) + FOOT
        self.figure = Figure(figsize=(self.width, self.height), dpi=dpi)
        left, top = beside + (self.width - used) / 2, HEAD + title
        self._right = left + columns * (width + GAP)
        self._middle = top + (rows * (height + title) - title) / 2
        self._bar = min(rows * (height + title) - title, 3.0)
        self.panels = [
            self._place(left + column * (width + GAP), top + row * (height + title), width, height)
            for row, column in (divmod(number, columns) for number in range(count))
        ]

    def _place(self, left: float, top: float, width: float, height: float) -> Axes:
        bottom = self.height - top - height
        return self.figure.add_axes(
            (left / self.width, bottom / self.height, width / self.width, height / self.height)
        )

    def heading(self, title: str, below: str) -> None:
        """Two lines at the top."""
        for text, from_top, size in ((title, 0.1, 11), (below, 0.34, 9)):
            self.figure.text(0.5, 1 - from_top / self.height, text, ha="center", va="top", fontsize=size)

    def colour_bar(self, colouring: Colouring) -> None:
        """The scale of the colours, to the right."""
        bar = self._place(self._right + 0.05, self._middle - self._bar / 2, 0.12, self._bar)
        names = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
        shown = ScalarMappable(colouring.norm, colouring.colours)
        self.figure.colorbar(shown, cax=bar, extend=names[colouring.beyond])
        bar.tick_params(labelsize=7)
        bar.set_ylabel(colouring.label, fontsize=8)

    def corner(self) -> Axes:
        """Axes of the size [SCALE, FOOT] at the lower left, in inches."""
        corner = self._place(0.1, self.height - FOOT, SCALE, FOOT)
        corner.set(xlim=(0, SCALE), ylim=(0, FOOT))
        corner.set_axis_off()
        return corner

    def legend(self, handles: Sequence[Artist], *, beside_corner: bool) -> None:
        """What the marks mean, in the middle below."""
        if not handles:
            return
        middle = (self.width + (SCALE if beside_corner else 0)) / 2
        self.figure.legend(
            handles=handles,
            loc="center",
            bbox_to_anchor=(middle / self.width, FOOT / 2 / self.height),
            ncols=2 if self.width < 8 and len(handles) > 2 else len(handles),
            fontsize=8,
            frameon=False,
        )


def columns_for(count: int, width: float, height: float, shape: float) -> int:
    """How many of `count` panels of a size go into a row, so that the page comes close to a shape.

    Args:
        count: number of panels.
        width, height: of each.
        shape: width over height of all together.
    """

    def badness(columns: int) -> float:
        rows = math.ceil(count / columns)
        empty = rows * columns - count
        return abs(math.log(columns * width / (rows * height) / shape)) + empty / columns

    return min(range(1, count + 1), key=badness)
