"""Draw a trajectory of a dataset file, alone or beside what models predict: a still with several frames, or an
animation. No display is needed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from m3gn_bench.datasets.errors import DatasetError, unknown_name
from m3gn_bench.datasets.file import find_key, open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.trajectory import CELL_CORNERS, Trajectory
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.errors import ConfigError
from m3gn_bench.tasks import task_of_data

# What the colours can show: how far a node is from where it was in frame 0, how much of that is upwards,
# how many times its area at rest a triangle covers, or how far a prediction is from the truth.
Colour = Literal["displacement", "height", "area", "distance"]
COLOURS: tuple[Colour, ...] = get_args(Colour)
KINDS = {".png": "a still", ".gif": "an animation", ".mp4": "an animation"}
STILL_FRAMES, COMPARED_FRAMES = 6, 4  # in a .png, unless the user says otherwise
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
class Comparison:
    """Models to draw beside the truth.

    Attributes:
        task: what they were trained on.
        checkpoints: their folders, by the title of their panels.
        context: the number of frames that they are given; None for the middle one of the task's sizes.
    """

    task: str
    checkpoints: Mapping[str, Path]
    context: int | None = None


@dataclass(frozen=True)
class Viewed:
    """What was drawn.

    Attributes:
        trajectory: its key.
        frames: the frames.
        panels: the truth and models; of each frame one panel each.
        context: the number of frames that the models were given, if there are models.
    """

    trajectory: str
    frames: list[int]
    panels: list[str]
    context: int | None


def view(
    file: Path,
    out: Path,
    *,
    split: str = "test",
    index: int = 0,
    frames: str | None = None,
    fps: int = 20,
    colour: str | None = None,
    comparison: Comparison | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Viewed:
    """Draw frames of one trajectory of a dataset file.

    Args:
        file: the dataset file.
        out: the picture; a .png shows the frames side by side, a .gif or .mp4 one after the other.
        split, index: which trajectory; where there are models, of their task's split.
        frames: a number of evenly spaced frames, or a list such as "0,10,20"; None for 6 of them in a .png
            (4 where there are models) and all in an animation.
        fps: frames per second of an animation.
        colour: one of `COLOURS`, or None for the scene's own, or the distance where there are models.
        comparison: models whose predictions are drawn beside the truth, if any.
        on_progress: called with the number of frames done and of all.

    Raises:
        DatasetError: the file is unusable, or has no such trajectory; or `out` cannot be written.
        ConfigError: the ending of `out`, frames, fps, colour, task or context make no sense, or matplotlib
            or, for an .mp4, ffmpeg is missing.
        CheckpointError: a model's checkpoint is unusable, or of another task.
        BenchError: a prediction diverges.
    """
    kind = out.suffix.lower()
    if kind not in KINDS:
        endings = [f"{ending} ({what})" for ending, what in KINDS.items()]
        raise ConfigError(f"{out} must end in {', '.join(endings[:-1])} or {endings[-1]}")
    if not 1 <= fps <= MAX_FPS:
        raise ConfigError(f"{fps} frames per second are out of range: 1 to {MAX_FPS}")
    if colour is not None and colour not in COLOURS:
        raise ConfigError(unknown_name("colour", colour, list(COLOURS)))
    if colour == "distance" and comparison is None:
        raise ConfigError("colour 'distance' is that of models from the truth: name a model or a checkpoint")
    try:
        from m3gn_bench.movie import require_mp4
        from m3gn_bench.picture import Picture
    except ImportError as error:
        raise ConfigError(
            f"pictures need matplotlib and pillow ({error}); pip install 'm3gn-bench[plot]'"
        ) from error

    if kind == ".mp4":
        require_mp4()

    with open_file(file) as opened:
        metadata = read_metadata(opened)
        key = find_key(opened, split, index, comparison.task if comparison else None)
        trajectory = read_trajectory(opened, key)
    _require_drawable(trajectory, f"{file}: trajectory {key}")
    count = len(trajectory.positions)
    few = COMPARED_FRAMES if comparison else STILL_FRAMES
    chosen = select_frames(frames, count, few if kind == ".png" else count)
    look = LOOKS.get(metadata.scene, Look())
    context, predictions = None, {}
    if comparison is not None:
        from m3gn_bench.predictions import predict  # needs torch

        task = task_of_data(comparison.task, metadata)
        context = task.middle_context if comparison.context is None else comparison.context
        predictions = predict(comparison.checkpoints, task, context, trajectory, key, metadata)
    picture = Picture(
        trajectory,
        metadata,
        look,
        colour or ("distance" if predictions else look.colour),
        f"{comparison.task if comparison else metadata.scene}, {split} trajectory {index}",
        predictions=predictions,
        context=context or 0,
    )
    match kind:
        case ".png":
            content = picture.still(chosen)
        case ".gif":
            content = picture.gif(chosen, fps, on_progress)
        case _:
            content = picture.mp4(chosen, fps, on_progress)
    write_bytes_atomically(out, content)
    return Viewed(trajectory=key, frames=chosen, panels=picture.names, context=context)


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
