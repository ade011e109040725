"""Draw a trajectory of a dataset file: a still with several frames, or an animation. No display is needed."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory, stored_hashes
from m3gn_bench.datasets.schema import as_split, parse_key, trajectory_key
from m3gn_bench.datasets.trajectory import CELL_CORNERS, Trajectory
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import ConfigError

# What the colours can show: how far a node is from where it was in frame 0, how much of that is upwards, or
# how many times its area at rest a triangle covers.
Colour = Literal["displacement", "height", "area"]
COLOURS: tuple[Colour, ...] = get_args(Colour)
STILL_FRAMES = 6
MAX_FPS = 50  # a GIF counts in hundredths of a second, and viewers slow down anything below two of them


@dataclass(frozen=True)
class Look:
    """How a scene is looked at: what its files do not say.

    Attributes:
        azimuth, elevation: where the camera is, seen from a three-dimensional scene [degrees].
        floor: height of the floor in the scene's unit of length, or None where there is none.
        colour: what the colours show unless the user says otherwise.
        collider: its name.
    """

    azimuth: float = -60.0
    elevation: float = 20.0
    floor: float | None = None
    colour: Colour = "displacement"
    collider: str = "collider"


_FALLING = Look(elevation=14.0, floor=0.0, colour="area")
LOOKS = {
    "sheet_deformation": Look(azimuth=-55.0, elevation=32.0, colour="height"),
    "deformable_block": Look(floor=-100.0, collider="rigid circle"),
    "tissue_manipulation": Look(azimuth=-65.0, elevation=14.0, collider="gripper"),
    "falling_teddy": _FALLING,
    "mixed_objects": _FALLING,
}


@dataclass(frozen=True)
class Viewed:
    """What was drawn: the trajectory's key and the frames."""

    trajectory: str
    frames: list[int]


def view(
    file: Path,
    out: Path,
    *,
    split: str = "test",
    index: int = 0,
    frames: str | None = None,
    fps: int = 20,
    colour: str | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Viewed:
    """Draw frames of one trajectory of a dataset file.

    Args:
        file: the dataset file.
        out: the picture; a .png shows the frames side by side, a .gif one after the other.
        split, index: which trajectory.
        frames: a number of evenly spaced frames, or a list such as "0,10,20"; None for 6 of them in a .png
            and all in a .gif.
        fps: frames per second of a .gif.
        colour: one of `COLOURS`, or None for the scene's own.
        on_progress: called with the number of frames done and of all.

    Raises:
        DatasetError: the file is unusable, or has no such trajectory; or `out` cannot be written.
        ConfigError: the ending of `out`, frames, fps or colour make no sense, or matplotlib is missing.
    """
    kind = out.suffix.lower()
    if kind not in (".png", ".gif"):
        raise ConfigError(f"{out} must end in .png (a still) or in .gif (an animation)")
    if not 1 <= fps <= MAX_FPS:
        raise ConfigError(f"{fps} frames per second are out of range: 1 to {MAX_FPS}")
    if colour is not None and colour not in COLOURS:
        raise ConfigError(unknown_name("colour", colour, list(COLOURS)))
    try:
        from m3gn_bench.picture import Picture
    except ImportError as error:
        raise ConfigError(
            f"pictures need matplotlib and pillow ({error}); pip install 'm3gn-bench[plot]'"
        ) from error

    with open_file(file) as opened:
        metadata = read_metadata(opened)
        key = _find(file, list(stored_hashes(opened)), split, index)
        trajectory = read_trajectory(opened, key)
    _require_drawable(trajectory, f"{file}: trajectory {key}")
    count = len(trajectory.positions)
    chosen = select_frames(frames, count, STILL_FRAMES if kind == ".png" else count)
    look = LOOKS.get(metadata.scene, Look())
    picture = Picture(
        trajectory, metadata, look, colour or look.colour, f"{metadata.scene}, {split} trajectory {index}"
    )
    content = picture.still(chosen) if kind == ".png" else picture.animation(chosen, fps, on_progress)
    write_bytes_atomically(out, content)
    return Viewed(trajectory=key, frames=chosen)


def _find(file: Path, keys: list[str], split: str, index: int) -> str:
    """The key of a trajectory. Raises DatasetError with what there is instead."""
    wanted = as_split(split)
    count = sum(parse_key(key)[0] == wanted for key in keys)
    if not count:
        present = sorted({parse_key(key)[0] for key in keys})
        raise DatasetError(f"{file} has no {split} trajectories; it has {' and '.join(present) or 'none'}")
    key = trajectory_key(split, index)
    if key not in keys:
        raise DatasetError(
            f"index {index} is out of range: {file} has {count} {split} trajectories, 0 to {count - 1}"
        )
    return key


def _require_drawable(trajectory: Trajectory, where: str) -> None:
    """Raise DatasetError for what cannot be drawn: the hash only says that it is what was written."""
    positions, mesh, collider = trajectory.positions, trajectory.mesh, trajectory.collider_positions
    edges = trajectory.collider_edges
    drawable = (
        positions.ndim == 3
        and positions.shape[-1] in (2, 3)
        and mesh.rest_positions.shape == positions.shape[1:]
        and mesh.node_type.shape == positions.shape[1:2]
        and CELL_CORNERS.get(mesh.cell_type) == mesh.cells.shape[-1]
        and _refer(mesh.cells, positions.shape[1])
        and np.isfinite(positions).all()
        and np.isfinite(mesh.rest_positions).all()
    )
    if drawable and collider is not None:
        drawable = (
            collider.ndim == 3
            and (len(collider), collider.shape[-1]) == (len(positions), positions.shape[-1])
            and np.isfinite(collider).all()
            and (edges is None or (edges.ndim == 2 and _refer(edges, collider.shape[1])))
        )
    if not drawable:
        raise DatasetError(f"{where} cannot be drawn; 'm3gn-bench validate' tells what is wrong with it")


def _refer(indices: np.ndarray, nodes: int) -> bool:
    """Whether there are indices, all of them of existing nodes."""
    return bool(indices.size and indices.min() >= 0 and indices.max() < nodes)


def select_frames(text: str | None, count: int, default: int) -> list[int]:
    """The frames out of `count` that `text` asks for: a number of evenly spaced ones, or a list of them.

    Args:
        text: "6" is six frames from the first to the last, "0,10,20" these three and "7," just this one;
            None is `default` evenly spaced ones, or all if there are fewer.

    Raises:
        ConfigError: neither a number nor a list, or out of range.
    """
    if text is None:
        return _evenly(min(default, count), count)
    try:
        numbers = [int(part) for part in text.removesuffix(",").split(",")]
    except ValueError:
        raise ConfigError(
            f"frames {text!r} is neither a number of frames such as 6 nor a list such as 0,10,20"
        ) from None
    if "," not in text:
        if not 1 <= numbers[0] <= count:
            raise ConfigError(f"{numbers[0]} frames are out of range: the trajectory has {count}")
        return _evenly(numbers[0], count)
    for frame in numbers:
        if not 0 <= frame < count:
            raise ConfigError(f"frame {frame} is out of range: the trajectory has frames 0 to {count - 1}")
    return numbers


def _evenly(wanted: int, count: int) -> list[int]:
    """Evenly spaced frames, from the first to the last."""
    return [int(frame) for frame in np.linspace(0, count - 1, wanted).round()]
