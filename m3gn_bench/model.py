"""What a model is, which models there are, and the presets that fix their size and training."""

import hashlib
import json
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor, nn

from m3gn_bench.data import Body, Case, Context
from m3gn_bench.datasets.errors import first_problem, unknown_name
from m3gn_bench.datasets.plugins import load, plugins, usable
from m3gn_bench.errors import ConfigError
from m3gn_bench.tasks import Task


class ModelConfig(BaseModel):
    """Base of all configurations: an unknown key is an error, and nothing changes after the start."""

    model_config = ConfigDict(extra="forbid", frozen=True)


C = TypeVar("C", bound=ModelConfig)


class TrainingConfig(ModelConfig):
    """How to train; the same loop serves every model.

    The budget is either `minutes` or `steps`. On a CPU minutes are CPU time of the training steps (validation
    and loading are not counted), so that "10 minutes on one core" means the same on a busy machine.
    """

    minutes: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    steps: int | None = Field(default=None, gt=0)
    batch_size: int = Field(default=1, ge=1)  # trajectories per step
    learning_rate: float = Field(default=5e-4, gt=0)
    warmup_steps: int = Field(default=100, ge=0)
    cosine_decay: bool = True  # to zero at the end of the budget; constant otherwise
    weight_decay: float = Field(default=0.0, ge=0)
    gradient_clip: float | None = Field(default=None, gt=0)  # on the global norm
    precision: Literal["float32", "bfloat16"] = (
        "float32"  # of matrix products in training; weights are float32
    )
    validations: int = Field(default=10, ge=1)  # over the whole budget; the best one is kept
    validation_trajectories: int = Field(default=18, ge=1)


class Model(nn.Module):
    """Base of all models, learned or not.

    A subclass defines `Config` (its hyper-parameters), `predict`, and either `training_loss` (learned models)
    or `prepare` alone (models that only need statistics of the training data, or nothing).

    Attributes:
        velocity_scale, displacement_scale: standard deviations over the training data of free nodes'
            movement in one step, and since the first frame; they make inputs and outputs of order one.
    """

    Config: ClassVar[type[ModelConfig]] = ModelConfig
    preset_file: ClassVar[str | None] = None  # in the folder `presets` beside the module that names it
    variant: ClassVar[dict[str, Any]] = {}  # hyper-parameters that make the model what its name says

    velocity_scale: Tensor
    displacement_scale: Tensor

    def __init__(self, task: Task, config: ModelConfig) -> None:
        super().__init__()
        self.task = task
        self.config = config
        self.register_buffer("velocity_scale", torch.ones(()))
        self.register_buffer("displacement_scale", torch.ones(()))

    @property
    def is_learned(self) -> bool:
        """Whether there are weights to train."""
        return any(parameter.requires_grad for parameter in self.parameters())

    def parameter_count(self) -> int:
        """Number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters() if parameter.requires_grad)

    def prepare(self, cases: Sequence[Case]) -> None:
        """Take statistics from the training data, before the first step. Raises ConfigError if nothing moves."""
        steps = [np.diff(c.positions[:, ~c.body.fixed].numpy(), axis=0).ravel() for c in cases]
        moved = [(c.positions - c.positions[0])[1:, ~c.body.fixed].numpy().ravel() for c in cases]
        velocity = np.concatenate(steps).std(dtype=np.float64)
        displacement = np.concatenate(moved).std(dtype=np.float64)
        if self.is_learned and not velocity > 0:  # also where no node is free
            raise ConfigError("no free node of the training trajectories moves: there is nothing to learn")
        self.velocity_scale.fill_(float(velocity))
        self.displacement_scale.fill_(float(displacement))

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """The loss of one step on a batch of trajectories: a mean over its free nodes.

        All randomness comes from `rng`; numbers for every body or node are drawn with the methods of `case.body`, or
        several processes could not share a batch.
        """
        raise NotImplementedError(f"{type(self).__name__} is not trained")

    def predict(self, context: Context) -> Tensor:
        """Positions in the frames after the anchor, shape [horizon, nodes, dim]."""
        raise NotImplementedError


class TrajectoryModel(Model):
    """A model that predicts whole trajectories at once, trained on whole trajectories.

    A subclass defines `generate`.
    """

    def generate(self, context: Context, rng: np.random.Generator | None) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]; `rng` is None when predicting."""
        raise NotImplementedError

    def predict(self, context: Context) -> Tensor:
        """Positions after the anchor, shape [horizon, nodes, dim]."""
        return self.generate(context, None)

    def training_loss(self, case: Case, rng: np.random.Generator) -> Tensor:
        """Mean squared error of free nodes after a random anchor, relative to the data's variance."""
        lower, upper = self.task.training_context
        context = case.context(int(rng.integers(lower, upper + 1)))
        return self.mean_square(self.generate(context, rng) - case.future(context.size), case.body)

    def mean_square(self, error: Tensor, body: Body) -> Tensor:
        """Of an error [..., nodes, dim], over free nodes, relative to the data's variance."""
        # Zeros for the others: gathering the free ones takes longer than all else here.
        squares = torch.where(body.fixed[:, None], 0.0, (error / self.displacement_scale).square())
        return squares.mean() * (body.nodes / body.free_nodes)


def hold_fixed(context: Context, positions: Tensor) -> Tensor:
    """Predicted positions [..., nodes, dim] with the nodes of prescribed position at their place."""
    return torch.where(context.body.fixed[:, None], context.positions[-1], positions)


def model_names() -> list[str]:
    """All registered models, ours and other packages'."""
    return sorted(plugins("model"))


def usable_models() -> dict[str, type[Model]]:
    """The classes of all registered models, without those of packages that cannot be imported."""
    return dict(usable("model", get_model_class))


@cache
def get_model_class(name: str) -> type[Model]:
    """The class of a registered model.

    Raises:
        ConfigError: there is none (lists all).
        PluginError: its package cannot be imported (names the package).
    """
    if name not in plugins("model"):
        raise ConfigError(unknown_name("model", name, model_names()))
    found: type[Model] = load("model", name)
    return found


class RunConfig(BaseModel):
    """Everything that determines a training run, besides the data and the seed."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    model_name: str
    preset: str
    model: ModelConfig
    training: TrainingConfig

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "model_name": self.model_name,
            "preset": self.preset,
            "model": self.model.model_dump(mode="json"),
            "training": self.training.model_dump(mode="json"),
        }

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> "RunConfig":
        """The inverse of `to_json`."""
        model = get_model_class(record["model_name"]).Config.model_validate(record["model"])
        training = TrainingConfig.model_validate(record["training"])
        return cls(model_name=record["model_name"], preset=record["preset"], model=model, training=training)

    def hash(self) -> str:
        """SHA-256 of the configuration, without the budget (records name that separately)."""
        record = self.to_json()
        for budget in ("minutes", "steps"):
            del record["training"][budget]
        return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


PRESETS = ("smoke", "compact", "paper")


def require_preset(preset: str) -> None:
    """Raises ConfigError if there is no preset of that name."""
    if preset not in PRESETS:
        raise ConfigError(unknown_name("preset", preset, list(PRESETS)))


def load_preset(
    model_name: str, preset: str, task: Task, overrides: dict[str, Any] | None = None
) -> RunConfig:
    """The configuration of a model's preset for a task.

    A preset file is TOML: tables [PRESET.model] and [PRESET.training], and for single tasks
    [PRESET.task.TASK.model] and [PRESET.task.TASK.training]. A subclass shares its parent's file unless it
    names its own. Later values win: the preset's, the task's, the model's `variant`, the overrides.

    Args:
        model_name: a registered model.
        preset: "smoke", "compact" or "paper".
        task: the task, for its own entries.
        overrides: values by dotted key, e.g. {"training.learning_rate": 1e-3}.

    Raises:
        ConfigError: unknown preset or key (the message lists the known ones), or a value out of range.
    """
    require_preset(preset)
    model_class = get_model_class(model_name)
    values: dict[str, dict[str, Any]] = {"model": {}, "training": {}}
    if model_class.preset_file is not None:
        owner = next(parent for parent in model_class.__mro__ if "preset_file" in vars(parent))
        package = owner.__module__.rpartition(".")[0]
        text = (resources.files(package) / "presets" / model_class.preset_file).read_text()
        tables = tomllib.loads(text).get(preset)
        if tables is None:
            raise ConfigError(f"{model_class.preset_file} of model {model_name} has no preset {preset!r}")
        for layer in (tables, tables.get("task", {}).get(task.name, {})):
            for section in values:
                values[section] |= layer.get(section, {})
    values["model"] |= model_class.variant
    known = [f"model.{key}" for key in model_class.Config.model_fields]
    known += [f"training.{key}" for key in TrainingConfig.model_fields]
    for key, value in (overrides or {}).items():
        if key not in known:
            raise ConfigError(unknown_name("configuration key", key, known))
        section, _, name = key.partition(".")
        values[section][name] = value
    return RunConfig(
        model_name=model_name,
        preset=preset,
        model=_validated(model_class.Config, "model", values["model"]),
        training=_validated(TrainingConfig, "training", values["training"]),
    )


def _validated(kind: type[C], section: str, values: dict[str, Any]) -> C:
    try:
        return kind.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"configuration key {first_problem(error, section)}") from error


def build_model(config: RunConfig, task: Task, seed: int = 0) -> Model:
    """A freshly initialised model; the seed fixes its weights."""
    torch.manual_seed(seed)
    return get_model_class(config.model_name)(task, config.model)
