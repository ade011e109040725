"""The layout of a dataset file (HDF5), and the record of where its numbers come from.

    /                                   root attributes: format, and every field of `Metadata`
    /meshes/<hash>/                     rest_positions, cells, cell_type, node_type; each mesh once
    /trajectories/<key>/                attributes: content_hash
        positions                       [frames, nodes, dim] float32, one gzip + shuffle chunk
        mesh                            hard link to /meshes/<hash>
        material                        group; attributes are the parameters
        loads/<name>                    arrays, may be absent
        collider_positions              [frames, collider_nodes, dim] float32, may be absent
        collider_edges                  [edges, 2] int32, may be absent
        tags                            group; attributes are words, e.g. object = "teddy"; may be absent
        diagnostics                     group; attributes are what the solver reports
    /splits/<task>/<train|validation|test>   keys of the trajectories, in order

A key is <split>_<index>, e.g. test_00012. The file's content hash covers the trajectories' content hashes,
so it does not depend on compression, on the HDF5 library or on the order of writing. It does not cover root
attributes and splits. All strings are of fixed length: HDF5 guards those with checksums, and others not.
`docs/format.md` says of every scene which fields it has, their shapes, units and meaning.
"""

import json
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from m3gn_bench.datasets.errors import DatasetError, unknown_name

FORMAT = "m3gn-bench dataset"
SCHEMA_VERSION = 1
DATASET_SEED = 2025  # the leaderboard's
LARGEST_SEED = 2**63 - 1  # that an attribute of HDF5 holds
NO_SEED = -1  # of data that were not drawn here
IMPORTED = "imported"  # in a variant: the layout that the data of others had

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
Fidelity = Literal["fast", "default", "reference"]
Tier = Literal["smoke", "quick", "paper"]
TIERS: tuple[Tier, ...] = get_args(Tier)
SMALL_TIERS: dict[str, dict[Split, int]] = {
    "smoke": {"train": 8, "validation": 4, "test": 4},
    "quick": {"train": 64, "validation": 16, "test": 16},
}


class Record(BaseModel):
    """Base of all records: unknown fields are errors, and records do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Rejection(Record):
    """A draw that was not kept."""

    key: str
    attempt: int
    reason: str


class Metadata(Record):
    """Root attributes of a dataset file.

    Units are named, e.g. length_unit "mm". Models see (positions - scale_centre) / scale_length, which makes
    coordinates of the order of one; each card states the largest.
    """

    schema_version: int = SCHEMA_VERSION
    scene: str
    dataset_version: str
    tier: Tier
    paper_sizes: dict[Split, int]
    generator_version: str
    simulator_versions: dict[str, str]
    fidelity: Fidelity
    variant: dict[str, str] = {}  # how the scene differs from the benchmark's own, e.g. another solver
    seed: int
    dt: float = Field(gt=0, allow_inf_nan=False)
    time_unit: str
    length_unit: str
    material_units: dict[str, str]
    load_units: dict[str, str]
    frames: int = Field(ge=2)
    scale_centre: tuple[float, ...]
    scale_length: float = Field(gt=0, allow_inf_nan=False)
    licence: str = "CC-BY-4.0"
    machine: str = ""  # on which it was generated; explains the times among the diagnostics
    content_hash: str = ""
    rejections: tuple[Rejection, ...] = ()

    @property
    def dimension(self) -> int:
        """Number of space dimensions."""
        return len(self.scale_centre)

    @property
    def transitions(self) -> int:
        """Number of steps between frames: one less than frames."""
        return self.frames - 1

    @property
    def is_benchmark(self) -> bool:
        """Whether everybody is meant to have this dataset: the scene's own options, fidelity and seed."""
        return (self.fidelity, self.variant, self.seed) == ("default", {}, DATASET_SEED)

    @property
    def is_imported(self) -> bool:
        """Whether others made the data (see `imports`)."""
        return IMPORTED in self.variant

    def to_attributes(self) -> dict[str, Any]:
        """HDF5 attributes: numbers as they are, strings as bytes (of fixed length), everything else as JSON."""
        dumped = self.model_dump(mode="json")
        plain = {k: v if isinstance(v, str | int | float) else json.dumps(v) for k, v in dumped.items()}
        return {k: fixed_length(v) for k, v in {"format": FORMAT, **plain}.items()}

    @classmethod
    def from_attributes(cls, attributes: dict[str, Any]) -> "Metadata":
        """The inverse of `to_attributes`; raises ValueError (pydantic's is one) on anything unexpected."""
        values: dict[str, Any] = {}
        for name, value in attributes.items():
            if name == "format":
                continue
            value = as_text(value)
            field = cls.model_fields.get(name)
            if isinstance(value, str) and field and get_origin(field.annotation) in (dict, tuple):
                value = json.loads(value)
            values[name] = value.item() if hasattr(value, "item") else value
        return cls.model_validate(values)


def fixed_length(value: Any) -> Any:
    """A string as h5py stores it with fixed length; anything else as it is."""
    return np.bytes_(value.encode()) if isinstance(value, str) else value


def as_text(value: Any) -> Any:
    """The inverse of `fixed_length`."""
    return value.decode() if isinstance(value, bytes) else value


def tier_sizes(tier: str, paper_sizes: dict[Split, int]) -> dict[Split, int]:
    """Trajectories per split of a tier. Raises DatasetError for an unknown tier, listing the known ones."""
    if tier == "paper":
        return paper_sizes
    if tier not in SMALL_TIERS:
        raise DatasetError(unknown_name("tier", tier, list(TIERS)))
    return SMALL_TIERS[tier]


def as_split(name: str) -> Split:
    """The split of that name. Raises DatasetError listing the splits if there is none."""
    for split in SPLITS:
        if split == name:
            return split
    raise DatasetError(unknown_name("split", name, list(SPLITS)))


def trajectory_key(split: str, index: int) -> str:
    """The name of trajectory `index` of a split inside a dataset file."""
    return f"{split}_{index:05d}"


def parse_key(key: str) -> tuple[Split, int]:
    """The inverse of `trajectory_key`. Raises DatasetError for anything else."""
    split, _, index = key.rpartition("_")
    if not index.isdecimal():
        raise DatasetError(f"{key!r} is no trajectory's name, such as test_00012")
    return as_split(split), int(index)


def in_tier(key: str, sizes: dict[Split, int]) -> bool:
    """Whether the trajectory belongs to a tier of the given sizes (tiers are prefixes of one another)."""
    split, index = parse_key(key)
    return index < sizes[split]
