"""What shipped checkpoints predict, small enough for a browser: one script per trajectory."""

import base64
import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import Trajectory
from m3gn_bench.leaderboard.check import TOLERANCES
from m3gn_bench.leaderboard.record import ResultRecord, checkpoint_folder
from m3gn_bench.leaderboard.site.board import digits
from m3gn_bench.leaderboard.summary import middle
from m3gn_bench.model import Model
from m3gn_bench.tasks import Task
from m3gn_bench.view import LOOKS, Look

FRAMES = 60  # at most so many of a trajectory's frames are kept, evenly spaced
LARGEST = 32767  # of 16 bits
ROOM = 1.5  # positions are kept up to this many times the truth's largest coordinate
COLOURED = 98.0  # percentile of distances that gets the last colour


@dataclass(frozen=True, eq=False)
class Runnable:
    """A record, the model of its checkpoint, and what that is called on the page."""

    label: str
    record: ResultRecord
    model: Model


@dataclass(frozen=True)
class Script:
    """One trajectory with all predictions.

    Attributes:
        name: of the trajectory on the site, also of its file (without suffix).
        label: what the page calls it.
        content: JavaScript that hands it to the page.
    """

    name: str
    label: str
    content: bytes


@dataclass(frozen=True)
class Rollouts:
    """All that the page shows of a task.

    Attributes:
        task: which one.
        models: what the page calls them, by the records' names.
        scripts: one per trajectory.
        notes: what a reader should know, e.g. errors that differ from the records.
    """

    task: Task
    models: dict[str, str]
    scripts: tuple[Script, ...]
    notes: tuple[str, ...] = ()


def runnable(
    records: Sequence[ResultRecord], task: Task, version: str, home: Path
) -> tuple[list[Runnable], list[str]]:
    """The learned models of a task whose checkpoints ship, and why others are left out.

    Args:
        records: of any task.
        task: which one.
        version: of the dataset at hand.
        home: the leaderboard's folder.
    """
    found, left_out = [], []
    ships = [r for r in records if r.ships and r.task == task.name and r.checkpoint.steps > 0]
    models = Counter(record.model for record in ships)
    for record in ships:
        folder = checkpoint_folder(task.name, record.model, record.preset, record.seed, home)
        where = f"{task.name}/{record.name}"
        if record.dataset_version != version:
            left_out.append(
                f"{where} was scored on dataset version {record.dataset_version}, and {version} is at hand"
            )
            continue
        try:
            model, description = load_checkpoint(folder)
        except BenchError as error:  # no reason to have no site
            left_out.append(f"{where}: {error}")
            continue
        if description != record.checkpoint:
            left_out.append(f"{where}: the checkpoint in {folder} is not the one that was recorded")
            continue
        label = record.model if models[record.model] == 1 else record.name
        found.append(Runnable(label, record, model))
    return found, left_out


def roll_out(
    models: Sequence[Runnable],
    task: Task,
    dataset: Path,
    tier: str,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Rollouts:
    """Let all models predict the trajectories that are easiest, in the middle and hardest for M3GN.

    Args:
        models: at least one; where M3GN is not among them, the first takes its place.
        task: what to predict.
        dataset, tier: where the test trajectories are.
        on_progress: called with (done, total) after every prediction.

    Raises:
        DatasetError: the dataset is damaged.
    """
    source = TrajectoryDataset(dataset, task.name, "test", tier)
    judge = next((model for model in models if model.record.model == "m3gn"), models[0])
    chosen = choose(judge.record, source.keys, middle(task.context_sizes))
    total = len(chosen) * len(models) * len(task.context_sizes)
    scripts: list[Script] = []
    notes: list[str] = []
    done = 0
    for key, word in chosen.items():
        trajectory = source[source.keys.index(key)]
        case = case_from(task, source.metadata, trajectory, key)
        content = _scene(case, trajectory, source.metadata)
        for one in models:
            for context in task.context_sizes:
                content["predictions"].append(_prediction(content, case, one, context, notes))
                done += 1
                on_progress(done, total)
        name = f"{task.name}-{key}"
        label = f"{key}, {word} for {judge.label}: {_described(trajectory, source.metadata)}"
        script = f"rollouts[{json.dumps(name)}] = {json.dumps(content, separators=(',', ':'))};\n"
        scripts.append(Script(name, label, script.encode()))
    return Rollouts(task, {model.record.name: model.label for model in models}, tuple(scripts), tuple(notes))


def choose(record: ResultRecord, keys: Sequence[str], context: int) -> dict[str, str]:
    """The trajectories of lowest, median and highest recorded error, each with that in words; fewer if there are."""
    result = record.result(context)
    assert result is not None, f"{record.name} has no result at context {context}"
    errors = dict(zip(record.keys, result.trajectory_mse, strict=True))
    ordered = sorted((key for key in keys if key in errors), key=lambda key: errors[key])
    words = {0: "easiest", len(ordered) // 2: "typical", len(ordered) - 1: "hardest"}
    return {ordered[place]: word for place, word in words.items() if ordered}


def kept_frames(frames: int) -> range:
    """Evenly spaced frames, the first among them."""
    return range(0, frames, math.ceil(frames / FRAMES))


def pack(values: np.ndarray, step: float) -> str:
    """Numbers as base64 of little-endian int16, in units of `step`; too large ones become the largest."""
    whole = np.clip(np.rint(values / step), -LARGEST, LARGEST)
    return base64.b64encode(whole.astype("<i2").tobytes()).decode()


def _scene(case: Case, trajectory: Trajectory, metadata: Metadata) -> dict[str, Any]:
    """Everything but the predictions, for `static/rollouts.js`; positions in scaled units, always three coordinates."""
    from m3gn_bench.picture_geometry import surface

    frames = kept_frames(case.frames)
    truth, path = _in_space(case.positions[frames]), _in_space(case.collider_path[frames])
    step = ROOM * float(max(np.abs(truth).max(), np.abs(path).max(initial=0))) / LARGEST
    faces = surface(trajectory.mesh)
    look = LOOKS.get(metadata.scene, Look())
    floor = None
    if look.floor is not None:
        floor = (look.floor - metadata.scale_centre[-1]) / metadata.scale_length
    edges = trajectory.collider_edges
    return {
        "flat": metadata.dimension == 2,
        "frames": list(frames),
        "count": case.frames,
        "nodes": truth.shape[1],
        "step": step,
        "unit": metadata.length_unit,
        "length": metadata.scale_length,
        "look": [look.azimuth, look.elevation],
        "floor": floor,
        "faces": _indices(faces),
        "closed": is_closed(faces),
        "truth": pack(truth, step),
        "collider": {
            "name": look.collider,
            "nodes": path.shape[1],
            "edges": _indices(np.empty((0, 2)) if edges is None else edges),
            "positions": pack(path, step),
        },
        "predictions": [],
    }


def _prediction(
    scene: dict[str, Any], case: Case, one: Runnable, context: int, notes: list[str]
) -> dict[str, Any]:
    with torch.inference_mode():
        predicted = one.model.predict(case.context(context))
    future = case.future(context)
    kept = [frame - context for frame in scene["frames"] if frame >= context]
    distances = (predicted - future).norm(dim=-1).numpy()[kept]
    result = one.record.result(context)
    recorded = one.record.mse_over(context, case.keys)
    found = float((predicted - future).double().square().mean())
    if recorded is not None and abs(found - recorded) > TOLERANCES["shipped checkpoint"] * recorded:
        notes.append(
            f"{one.label} at context {context} has an error of {found:.4g} on {case.keys[0]} here, "
            f"and {recorded:.4g} on record"
        )
    positions = _in_space(predicted[kept])
    return {
        "model": one.label,
        "context": context,
        "positions": pack(positions, scene["step"]),
        "cut": bool(np.abs(positions).max() > LARGEST * scene["step"]),
        "largest": float(np.percentile(distances, COLOURED)),
        "mse": recorded,
        "mean_mse": None if result is None else result.mse,
    }


def is_closed(faces: np.ndarray) -> bool:
    """Whether triangles [faces, 3] bound a body, all with the same side outwards: then one side is never seen."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = {(int(a), int(b)) for a, b in edges}
    return len(directed) == len(edges) and all((b, a) in directed for a, b in directed)


def _in_space(positions: torch.Tensor) -> np.ndarray:
    """The same with three coordinates, the last of which is zero for scenes in a plane."""
    values = positions.numpy()
    return np.concatenate([values, np.zeros((*values.shape[:2], 3 - values.shape[2]), values.dtype)], axis=2)


def _indices(values: np.ndarray) -> str:
    return base64.b64encode(np.asarray(values, "<u2").tobytes()).decode()


def _described(trajectory: Trajectory, metadata: Metadata) -> str:
    from m3gn_bench.picture import SYMBOLS

    parts = list(trajectory.tags.values())
    for name, value in trajectory.material.items():
        unit = metadata.material_units.get(name, "1")
        parts.append(f"{SYMBOLS.get(name, name)} = {digits(value)}{'' if unit == '1' else f' {unit}'}")
    return ", ".join(parts)
