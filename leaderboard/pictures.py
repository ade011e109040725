"""Pictures of what the shipped models do: final frames over the truth, and what M3GN tells materials apart by."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.data import Case, case_from
from m3gn_bench.datasets.reader import TrajectoryDataset
from m3gn_bench.errors import ConfigError
from m3gn_bench.leaderboard.record import ResultRecord, checkpoint_folder
from m3gn_bench.m3gn import M3GN
from m3gn_bench.picture_geometry import surface, wireframe
from m3gn_bench.tasks import Task

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

PERPLEXITY = 20.0  # of t-SNE, where there are trajectories enough


def draw_overlays(
    records: Sequence[ResultRecord], task: Task, dataset: "Path", tier: str, home: "Path"
) -> "Figure":
    """Predicted final frames (faces) and true ones (lines) of the trajectory whose error is M3GN's median.

    Args:
        records: whose checkpoints to run, on this task; M3GN's is among them.
        task: what to predict.
        dataset, tier: where the test trajectories are.
        home: the leaderboard's folder, with the checkpoints.

    Raises:
        CheckpointError: a checkpoint that is missing or damaged.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    context = task.middle_context
    judge = next(record for record in records if record.model == "m3gn")
    result = judge.result(context)
    assert result is not None
    source = TrajectoryDataset(dataset, task.name, "test", tier)
    errors = dict(zip(judge.keys, result.trajectory_mse, strict=True))
    ranked = sorted(set(source.keys) & errors.keys(), key=lambda key: errors[key])
    if not ranked:
        raise ConfigError(
            f"{dataset} holds none of the trajectories that {judge.task}/{judge.name} was scored on"
        )
    key = ranked[len(ranked) // 2]
    trajectory = source[source.keys.index(key)]
    case = case_from(task, source.metadata, trajectory, key)
    triangles = surface(trajectory.mesh)
    edges = wireframe(triangles)

    truth = case.positions[-1].numpy()
    predictions = {}
    for record in records:
        folder = checkpoint_folder(task.name, record.model, record.preset, record.seed, home)
        model, _ = load_checkpoint(folder)
        with torch.inference_mode():
            predictions[record.model] = model.predict(case.context(context))[-1].numpy()
    distances = {name: np.linalg.norm(found - truth, axis=1) for name, found in predictions.items()}
    colours = ScalarMappable(Normalize(0, max(float(d.max()) for d in distances.values())), "viridis")

    columns = min(len(predictions), 3)
    rows = -(-len(predictions) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.4 * rows), layout="constrained")
    figure.suptitle(f"{task.title}, {key}\nlast frame after {context} context frames")
    panels: list[Any] = []
    for place, (name, predicted) in enumerate(predictions.items(), 1):
        faces = colours.to_rgba(distances[name][triangles].mean(1))
        if task.dimension == 3:
            axes: Any = figure.add_subplot(rows, columns, place, projection="3d")
            axes.add_collection3d(Poly3DCollection(predicted[triangles], facecolors=faces))
            axes.add_collection3d(Line3DCollection(truth[edges], colors="0.2", linewidths=0.4))
            axes.auto_scale_xyz(*np.concatenate([truth, predicted]).T)
        else:
            axes = figure.add_subplot(rows, columns, place)
            axes.add_collection(PolyCollection(list(predicted[triangles]), facecolors=faces))
            axes.add_collection(LineCollection(list(truth[edges]), colors="0.2", linewidths=0.4))
            axes.autoscale()
        axes.set(title=name, aspect="equal")
        axes.set_axis_off()
        panels.append(axes)
    figure.colorbar(colours, ax=panels, label="distance from the truth, scaled", shrink=0.7)
    return figure


def draw_latents(model: M3GN, cases: Sequence[Case], context: int) -> "Figure":
    """t-SNE of every test trajectory's task description (mean over nodes), coloured by its material.

    What t-SNE shows of neighbourhoods is measured in the descriptions themselves (`agreement_of_neighbours`).

    Raises:
        ConfigError: scikit-learn is missing.
    """
    try:
        from sklearn.manifold import TSNE
    except ImportError as error:
        raise ConfigError("t-SNE needs scikit-learn; pip install 'm3gn-bench[plot]'") from error
    from matplotlib.figure import Figure

    with torch.inference_mode():
        latents = [
            model.encoder(case.context(context), model.velocity_scale, None)[: case.body.nodes].mean(0)
            for case in cases
        ]
    descriptions = torch.stack(latents).numpy()
    perplexity = min(PERPLEXITY, (len(cases) - 1) / 3)
    places = TSNE(perplexity=perplexity, random_state=0).fit_transform(descriptions)
    materials = torch.cat([case.body.material for case in cases]).numpy()
    names = [feature.name for feature in model.task.material]
    figure = Figure(figsize=(4.5 * len(names), 4), layout="constrained")
    figure.suptitle(f"{model.task.title}\ntask descriptions after {context} frames")
    for number, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), number + 1)
        shown = axes.scatter(places[:, 0], places[:, 1], c=materials[:, number], cmap="viridis", s=14)
        figure.colorbar(shown, label=f"{name}, scaled")
        agreement = round(agreement_of_neighbours(descriptions, materials[:, number]), 2) + 0  # no -0.00
        axes.set(xticks=[], yticks=[])
        axes.set_xlabel(f"rank correlation with the nearest\nneighbour's {name}: {agreement:.2f}")
    return figure


def agreement_of_neighbours(points: np.ndarray, values: np.ndarray) -> float:
    """Spearman's correlation of values [n] with those of the nearest other points [n, dim]: 1 where alike are close."""
    _, nearest = cKDTree(points).query(points, k=2)
    return float(spearmanr(values, values[nearest[:, 1]]).statistic)
