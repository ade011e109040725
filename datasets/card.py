"""Fill the numbers of a dataset's card from the dataset file, so that none is typed by hand.

A card is Markdown written by people, with one block between two markers that belongs to this module.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.file import (
    damage_as_dataset_error,
    open_file,
    read_metadata,
    read_trajectory,
    tier_hashes,
)
from m3gn_bench.datasets.schema import SPLITS

CARDS = Path(__file__).parent / "cards"
BEGIN = "<!-- numbers: written by `m3gn-bench card`, do not edit -->"
END = "<!-- end of numbers -->"


class Moments:
    """Mean and variance of vectors that come in batches, without holding them."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = np.zeros(())
        self.variance = np.zeros(())

    def add(self, batch: np.ndarray) -> None:
        """Take in vectors [..., dim] (Chan, Golub and LeVeque's update)."""
        vectors = batch.reshape(-1, batch.shape[-1]).astype(np.float64)
        mean, variance = vectors.mean(0), vectors.var(0)
        total = self.count + len(vectors)
        share = len(vectors) / total
        self.variance = (1 - share) * self.variance + share * variance
        self.variance = self.variance + share * (1 - share) * (mean - self.mean) ** 2
        self.mean = (1 - share) * self.mean + share * mean
        self.count = total


def numbers(path: Path, further: Sequence[tuple[str, str]] = ()) -> str:
    """The generated block for a dataset file, without its markers; `further` rows stand near the end."""
    with open_file(path) as file:
        metadata = read_metadata(file)
        with damage_as_dataset_error(str(path)):
            keys = list(file["trajectories"])
            splits = {
                task: "/".join(str(len(group[split])) for split in SPLITS if split in group)
                for task, group in file["splits"].items()
            }
        hashes = tier_hashes(file)
        diagnostics: dict[str, list[float]] = {}
        steps = Moments()
        reach = 0.0
        sizes: dict[str, tuple[int, int]] = {}
        for key in keys:
            trajectory = read_trajectory(file, key)
            for name, value in trajectory.diagnostics.items():
                diagnostics.setdefault(name, []).append(value)
            steps.add(np.diff(trajectory.positions / metadata.scale_length, axis=0))
            scaled = (trajectory.positions - np.array(metadata.scale_centre)) / metadata.scale_length
            reach = max(reach, float(np.abs(scaled).max()))
            mesh = trajectory.mesh
            sizes[trajectory.tags.get("object", "")] = (len(mesh.rest_positions), len(mesh.cells))
    rows = [
        ("trajectories", f"{len(keys)}, tier `{metadata.tier}`, dataset version {metadata.dataset_version}"),
        *((f"train/validation/test of `{task}`", sizes) for task, sizes in splits.items()),
        ("frames, transitions", f"{metadata.frames}, {metadata.transitions}"),
        *(
            (f"nodes, cells{f' of `{name}`' if len(sizes) > 1 else ''}", f"{nodes}, {cells}")
            for name, (nodes, cells) in sizes.items()
        ),
        ("time step", f"{metadata.dt:g} ({metadata.time_unit})"),
        (
            "lengths",
            f"{metadata.length_unit}; models see (x - {metadata.scale_centre}) / {metadata.scale_length:g}",
        ),
        (
            "movement per step, scaled",
            f"mean {_vector(steps.mean)}, std {_vector(steps.variance**0.5)}",
        ),
        ("largest coordinate of a node, scaled", f"{reach:.3g}"),
        ("rejected draws", "; ".join(f"{r.key}: {r.reason}" for r in metadata.rejections) or "0"),
        ("CPU time per trajectory", _range(diagnostics.pop("cpu_seconds"), " s")),
        *(
            (name.replace("_", " "), _range(values, ""))
            for name, values in diagnostics.items()
            if not name.endswith("_frame")  # says where, in an error; its mean says nothing
        ),
        *further,
        ("file size", f"{path.stat().st_size / 1e6:.1f} MB"),
        ("machine", metadata.machine),
        ("versions", ", ".join(f"{k} {v}" for k, v in metadata.simulator_versions.items())),
        ("generator, seed", f"m3gn-bench {metadata.generator_version}, {metadata.seed}"),
        *((f"content hash, {tier}", f"`{digest}`") for tier, digest in hashes.items()),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)])


def fill(card: str, block: str, begin: str = BEGIN, end: str = END) -> str:
    """The card with the block between two markers replaced. Raises DatasetError if it has no such block."""
    before, opened, rest = card.partition(begin)
    _, closed, after = rest.partition(end)
    if not opened or not closed:
        raise DatasetError(f"the card has no block between {begin!r} and {end!r}")
    return f"{before}{begin}\n{block}\n{end}{after}"


def _range(values: list[float], unit: str) -> str:
    return f"mean {np.mean(values):.3g}, min {min(values):.3g}, max {max(values):.3g}{unit}"


def _vector(values: np.ndarray) -> str:
    return "[" + ", ".join(f"{value:.2g}" for value in values) + "]"
