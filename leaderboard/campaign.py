"""A plan of training runs, carried out: train, score, put on record, and never do anything twice.

A plan is a TOML file. Its head names the board and the data; every table `[[runs]]` is a grid of runs:

    track = "compact"
    tier = "paper"              # default
    split = "test"              # default; "validation" for trials of hyper-parameters
    pace = "pace.jsonl"         # a file beside the plan: minutes are those of its machine, as steps (`pace`)
    pace_of = { mgn_no_history = "mgn" }  # models that take another's steps, because their network is the same

    [[runs]]
    tasks = ["deformable_block"]
    models = ["m3gn", "mgn"]
    seeds = [0, 1, 2]
    shipped_seeds = [0]         # whose checkpoints are kept beside the records
    preset = "compact"          # default
    minutes = 10                # of one core for training; or steps = 1000; neither for models that do not learn
    variant = "large rate"      # what is different here; needed with settings or materials
    settings = { "training.learning_rate" = 4e-3 }
    materials = { youngs_modulus = [10, 1000] }  # only trajectories of these, in all splits
"""

import hashlib
import json
import tomllib
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from m3gn_bench.checkpoint import copy_checkpoint
from m3gn_bench.data import Materials, load_cases
from m3gn_bench.datasets.errors import BenchError, first_problem
from m3gn_bench.datasets.file import content_hash, open_file
from m3gn_bench.datasets.schema import LARGEST_SEED, TIERS, Record, Split
from m3gn_bench.errors import ConfigError
from m3gn_bench.leaderboard.pace import Pace, read_pace
from m3gn_bench.leaderboard.record import (
    Name,
    ResultRecord,
    Variant,
    checkpoint_folder,
    find_record,
    run_name,
    write_record,
)
from m3gn_bench.leaderboard.scoring import score
from m3gn_bench.model import RunConfig, build_model, load_preset
from m3gn_bench.tasks import get_task
from m3gn_bench.training import require_budget, train
from m3gn_bench.version import __version__

State = Literal["done", "outdated", "to do"]


class Grid(Record):
    """All combinations of some tasks, models and seeds."""

    tasks: tuple[str, ...] = Field(min_length=1)
    models: tuple[str, ...] = Field(min_length=1)
    seeds: tuple[Annotated[int, Field(ge=0, le=LARGEST_SEED)], ...] = Field(default=(0,), min_length=1)
    shipped_seeds: tuple[int, ...] = ()
    preset: str = "compact"
    minutes: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    steps: int | None = Field(default=None, gt=0)
    variant: Variant = ""
    settings: dict[str, Any] = Field(default={})
    materials: Materials = Field(default={})

    @model_validator(mode="after")
    def _ships_what_it_makes(self) -> Self:
        missing = sorted({*self.shipped_seeds} - {*self.seeds})
        if missing:
            raise ValueError(f"shipped_seeds: {missing[0]} is none of seeds")
        return self


class Plan(Record):
    """What a campaign's file says."""

    track: Name
    tier: str = "paper"
    split: Split = "test"
    pace: str | None = None
    pace_of: dict[str, str] = Field(default={})
    runs: tuple[Grid, ...] = Field(min_length=1)


@dataclass(frozen=True)
class PlannedRun:
    """One run of a plan: what it is called, what is trained on what, and whether its checkpoint ships."""

    track: str
    task: str
    seed: int
    variant: str
    config: RunConfig
    materials: Materials
    tier: str
    split: Split
    ships: bool

    @property
    def name(self) -> str:
        """Unique within its track and task."""
        return run_name(self.config.model_name, self.config.preset, self.variant, self.seed)

    def state(self, records: Sequence[ResultRecord], dataset_version: str) -> State:
        """Whether there is a record of this very run on data of that version."""
        found = find_record(records, self.track, self.task, self.name)
        if found is None:
            return "to do"
        same = (
            found.checkpoint.config.model_dump() == self.config.to_json()
            and found.dataset_version == dataset_version
            and (found.tier, found.split, found.materials, found.ships)
            == (self.tier, self.split, self.materials, self.ships)
        )
        return "done" if same else "outdated"


def read_plan(path: Path) -> list[PlannedRun]:
    """The runs of a plan: all models and tasks with the first seed come before any with the second.

    Raises:
        ConfigError: the file is no plan, names something unknown, or plans a run twice.
    """
    try:
        plan = Plan.model_validate(tomllib.loads(path.read_text()))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"cannot read {path}: {error}") from error
    except ValidationError as error:
        raise ConfigError(f"{path}: {first_problem(error)}") from error
    if plan.tier not in TIERS:
        raise ConfigError(f"{path}: tier: unknown {plan.tier!r}; known: {', '.join(TIERS)}")
    pace = None if plan.pace is None else read_pace(path.parent / plan.pace)
    runs = []
    for number, grid in enumerate(plan.runs, 1):
        try:
            runs += [
                _planned(plan, pace, grid, task, model, seed)
                for seed in grid.seeds
                for task in grid.tasks
                for model in grid.models
            ]
        except ConfigError as error:
            raise ConfigError(f"{path}: runs, table {number}: {error}") from error
    names = [(run.task, run.name) for run in runs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ConfigError(f"{path} plans {twice[0]}/{twice[1]} twice; name one of them by a variant")
    return sorted(runs, key=lambda run: run.seed)


def _planned(plan: Plan, pace: Pace | None, grid: Grid, task_name: str, model: str, seed: int) -> PlannedRun:
    task = get_task(task_name)
    budget: dict[str, float | None] = {"training.minutes": grid.minutes, "training.steps": grid.steps}
    if pace is not None and grid.minutes is not None and grid.steps is None:
        budget = {
            "training.steps": pace.steps(grid.preset, task_name, plan.pace_of.get(model, model), grid.minutes)
        }
    settings = grid.settings | {key: value for key, value in budget.items() if value is not None}
    config = load_preset(model, grid.preset, task, settings)
    require_budget(config, build_model(config, task).is_learned)
    usual = load_preset(model, grid.preset, task)
    if not grid.variant and (grid.materials or config.hash() != usual.hash()):
        raise ConfigError(
            f"{model} is not that of preset {grid.preset!r} on all data; name what differs by a variant"
        )
    if grid.shipped_seeds and grid.variant:
        raise ConfigError(
            "checkpoints of a variant cannot ship: their folders are named by model, preset and seed"
        )
    return PlannedRun(
        track=plan.track,
        task=task_name,
        seed=seed,
        variant=grid.variant,
        config=config,
        materials=grid.materials,
        tier=plan.tier,
        split=plan.split,
        ships=seed in grid.shipped_seeds,
    )


def require_own_folders(planned: Sequence[PlannedRun], records: Sequence[ResultRecord]) -> None:
    """Raises ConfigError if a checkpoint would replace one of another track: folders do not tell tracks apart."""
    for run in planned:
        named = run.task, run.config.model_name, run.config.preset, run.seed
        for record in records if run.ships else ():
            taken = record.task, record.model, record.preset, record.seed
            if record.ships and record.track != run.track and taken == named:
                raise ConfigError(
                    f"{run.task}/{run.name}: its checkpoint would replace that of track {record.track!r}; leave its "
                    "seed out of shipped_seeds"
                )


@dataclass(frozen=True)
class Job:
    """What a process needs to carry out a run.

    Attributes:
        run: which one.
        dataset: file with all splits of the run's tier.
        runs: folder of unfinished and finished training runs.
        device: of torch, that trains and predicts.
    """

    run: PlannedRun
    dataset: Path
    runs: Path
    device: str = "cpu"


@dataclass(frozen=True)
class Outcome:
    """What came of a run: its record, or why there is none."""

    run: PlannedRun
    folder: Path
    record: ResultRecord | None
    error: str | None

    def keep(self, home: Path) -> None:
        """Write the record to its place in the leaderboard's folder, and the checkpoint if it ships."""
        if self.record is None:
            return
        if self.run.ships:
            config = self.run.config
            shipped = checkpoint_folder(self.run.task, config.model_name, config.preset, self.run.seed, home)
            copy_checkpoint(self.folder, shipped)
        write_record(self.record, home)


def carry_out(job: Job) -> Outcome:
    """Train (or go on) and score; errors of the run are returned, for others can go on."""
    run = job.run
    task = get_task(run.task)
    folder = job.runs / run.track / run.task
    try:
        with open_file(job.dataset) as file:
            dataset_hash = content_hash(file, run.tier, ("train", "validation"))
        training, validation = (
            load_cases(job.dataset, task, split, run.tier, run.materials) for split in ("train", "validation")
        )
        # An older run of that name, with anything else than these, is no obstacle.
        own = [run.config.to_json(), run.materials, dataset_hash, job.device, __version__]
        folder /= f"{run.name}-{hashlib.sha256(json.dumps(own, sort_keys=True).encode()).hexdigest()[:8]}"
        train(
            run.config,
            task,
            training,
            validation,
            folder,
            seed=run.seed,
            dataset_hash=dataset_hash,
            materials=run.materials,
            device=job.device,
        )
        record = score(
            folder,
            job.dataset,
            track=run.track,
            tier=run.tier,
            split=run.split,
            variant=run.variant,
            ships=run.ships,
            device=job.device,
        )
    except BenchError as error:
        return Outcome(run, folder, None, str(error))
    except Exception as error:  # a defect that this run shows need not be in the way of others
        return Outcome(run, folder, None, "".join(traceback.format_exception(error)))
    return Outcome(run, folder, record, None)
