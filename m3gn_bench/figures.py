"""Figures as files: matplotlib is optional, and the same figure gives the same bytes."""

from pathlib import Path
from typing import TYPE_CHECKING

from m3gn_bench.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(figure: "Figure", path: Path) -> None:
    """Write a figure in the format of the path's suffix; the same figure gives the same bytes.

    Raises:
        ConfigError: see `require_drawable`.
    """
    import matplotlib

    from m3gn_bench.datasets.writer import atomic_path

    kind = require_drawable(path)
    with matplotlib.rc_context({"svg.hashsalt": "m3gn-bench"}), atomic_path(path) as temporary:
        figure.savefig(temporary, format=kind, metadata={"Date": None} if kind == "svg" else None)


def require_drawable(path: Path) -> str:
    """The format of a figure of that name. Raises ConfigError if a library is missing or does not know it."""
    try:
        import adjustText  # noqa: F401
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(
            f"figures need matplotlib and adjustText ({error}); pip install 'm3gn-bench[plot]'"
        ) from error
    known = Figure().canvas.get_supported_filetypes()
    kind = path.suffix.removeprefix(".").lower()
    if kind not in known:
        raise ConfigError(f"{path}: unknown picture format {kind!r}; known: {', '.join(sorted(known))}")
    return kind
