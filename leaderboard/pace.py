"""How many steps of training each model makes per minute on one reference machine.

Machines differ by a factor of two, and by another one from model to model. So plans give every model the steps that it
makes in the same time on one core of one machine, which any other machine can repeat to the last digit.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from m3gn_bench.checkpoint import Checkpoint, is_of_preset
from m3gn_bench.datasets.schema import Record
from m3gn_bench.errors import ConfigError

PLANS = Path(__file__).parent / "plans"
PACE = PLANS / "pace.jsonl"  # of the models of this package


class Measured(Record):
    """The pace of models with a preset on a task; one line of a file."""

    preset: str
    task: str
    steps_per_minute: dict[str, Annotated[float, Field(gt=0, allow_inf_nan=False)]]  # of CPU time, by model
    machine: str
    commit: str | None


@dataclass(frozen=True)
class Pace:
    """All that was measured on one machine.

    Attributes:
        path: of the file.
        steps_per_minute: by preset, task and model.
    """

    path: Path
    steps_per_minute: Mapping[tuple[str, str, str], float]

    def steps(self, preset: str, task: str, model: str, minutes: float) -> int:
        """The steps of so many minutes of one core. Raises ConfigError where nobody measured."""
        return round(minutes * self.per_minute(preset, task, model))

    def per_minute(self, preset: str, task: str, model: str) -> float:
        """Steps of one minute of one core. Raises ConfigError where nobody measured."""
        try:
            return self.steps_per_minute[preset, task, model]
        except KeyError:
            raise ConfigError(
                f"{self.path} has no pace of {model} with preset {preset!r} on {task}; measure it with "
                "benchmarks/pace.py, or leave out `pace` for minutes of the machine that trains"
            ) from None


def read_pace(path: Path) -> Pace:
    """Read a file that benchmarks/pace.py wrote.

    Raises:
        ConfigError: there is none, it is damaged, or of several machines.
    """
    try:
        lines = [Measured.model_validate(json.loads(line)) for line in path.read_text().splitlines()]
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read the pace of models in {path}: {error}") from error
    machines = {line.machine for line in lines}
    if len(machines) != 1:
        raise ConfigError(f"{path} must be of one machine, and is of {', '.join(sorted(machines)) or 'none'}")
    paces = {
        (line.preset, line.task, model): pace
        for line in lines
        for model, pace in line.steps_per_minute.items()
    }
    return Pace(path, paces)


def training_seconds(description: Checkpoint) -> float | None:
    """CPU seconds of training, the same wherever a preset was trained: its steps at the pace of the reference machine.

    Where no pace was measured, or settings are not the preset's, as long as it took on a CPU; None for other devices.
    """
    named = description.config
    try:
        if is_of_preset(description):
            pace = read_pace(PACE).per_minute(named.preset, description.task, named.model_name)
            return 60 * description.steps / pace
    except ConfigError:  # no such preset, or no pace
        pass
    return 60 * description.minutes if description.device == "cpu" else None
