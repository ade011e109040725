"""A pendulum of point masses and springs in two dimensions, whose stiffness is to be inferred."""

from dataclasses import dataclass
from importlib.metadata import version
from typing import ClassVar

import numpy as np
from scipy.integrate import solve_ivp

from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.generators.errors import SolverError, problem
from m3gn_bench.generators.scene import Leveled, SingleTask
from m3gn_bench.tasks import MaterialFeature, Task

NAME = "spring_pendulum"
NODES, PITCH = 9, 0.05  # masses hang in a zigzag, so far apart [m] in both directions; the first one is held
MASS, GRAVITY, DAMPING = 0.05, 9.81, 0.2  # [kg], [m/s^2], [N s/m] along every spring
STIFFNESS, ANGLE = (50.0, 500.0), 1.0  # [N/m]; largest angle from the vertical [rad] at which all is let go
# A spring ties every mass to the next and to the next but one: the edges of these triangles.
TRIANGLES = np.array([(i, i + 1, i + 2) if i % 2 else (i, i + 2, i + 1) for i in range(NODES - 2)], np.int32)
SPRINGS = [(i, j) for i in range(NODES) for j in (i + 1, i + 2) if j < NODES]
SPAN = np.array([np.eye(NODES)[j] - np.eye(NODES)[i] for i, j in SPRINGS])  # from positions to springs
Draw = tuple[float, float]  # stiffness of all springs [N/m], angle from the vertical at the start [rad]


@dataclass(frozen=True)
class SpringPendulum(Leveled, SingleTask):
    """The scene. Its levels are relative tolerances of the solver."""

    name, dataset_version, tasks = NAME, "1.0", (NAME,)
    paper_sizes: ClassVar = {"train": 200, "validation": 50, "test": 50}
    frames, dt, time_unit, length_unit = 41, 0.04, "s", "m"
    material_units: ClassVar = {"stiffness": "N/m"}
    load_units: ClassVar = {"angle": "rad"}
    scale_centre, scale_length = (0.0, -0.3), 0.4
    fidelities: ClassVar = {"fast": 1e-4, "default": 1e-6, "reference": 1e-10}
    variant: ClassVar = {}  # there are no options

    def sample(self, rng: np.random.Generator, index: int) -> Draw:
        return float(np.exp(rng.uniform(*np.log(STIFFNESS)))), float(rng.uniform(-ANGLE, ANGLE))

    def simulate_with(self, parameters: Draw, level: float, frames: int | None = None) -> Trajectory:
        (stiffness, angle), place = parameters, np.arange(NODES)
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        rest = PITCH * np.stack([place % 2, -place], axis=-1) @ turn
        lengths = np.linalg.norm(SPAN @ rest, axis=-1)

        def rates(time: float, state: np.ndarray) -> np.ndarray:
            x, v = state[:-1].reshape(2, NODES, 2)
            length = np.linalg.norm(SPAN @ x, axis=-1)
            along = SPAN @ x / length[:, None]
            speed = (SPAN @ v * along).sum(-1)
            tension = stiffness * (length - lengths) + DAMPING * speed
            acceleration = -SPAN.T @ (tension[:, None] * along) / MASS - [0, GRAVITY]
            acceleration[0] = 0
            return np.concatenate([v.ravel(), acceleration.ravel(), [DAMPING * (speed**2).sum()]])

        times = self.dt * np.arange(self.frames if frames is None else frames)
        start = np.concatenate([rest.ravel(), np.zeros(2 * NODES + 1)])  # positions, velocities, heat
        found = solve_ivp(rates, times[[0, -1]], start, "DOP853", times, rtol=level, atol=1e-2 * level)
        if not found.success:
            raise SolverError(problem(found.y.shape[1], found.message, "take softer springs"))
        x, v = found.y[:-1].reshape(2, NODES, 2, -1).transpose(0, 3, 1, 2)
        stretch = np.linalg.norm(SPAN @ x, axis=-1) - lengths
        energy = MASS * (v**2 / 2 + [0, GRAVITY] * x).sum((1, 2)) + stiffness / 2 * (stretch**2).sum(-1)
        drift = np.ptp(energy + found.y[-1])  # with the heat of the dampers, it is conserved
        node_type = np.where(place == 0, FIXED, FREE).astype(np.uint8)
        return Trajectory(
            positions=x.astype(np.float32),
            mesh=Mesh(rest.astype(np.float32), TRIANGLES, VTK_TRIANGLE, node_type),
            material={"stiffness": stiffness},
            loads={"angle": np.array([angle], np.float32)},
            diagnostics={"energy_drift": float(drift)},  # [J]
        )

    def check(self, trajectory: Trajectory) -> list[str]:
        drift, last = trajectory.diagnostics["energy_drift"], len(trajectory.positions) - 1
        return (
            [] if drift < 1e-4 else [problem(last, f"energy drifts by {drift:.1e} J", "lower the tolerance")]
        )

    def extreme_materials(self, parameters: Draw) -> tuple[Draw, Draw]:
        return (STIFFNESS[0], parameters[1]), (STIFFNESS[1], parameters[1])

    def simulator_versions(self) -> dict[str, str]:
        return {name: version(name) for name in ("scipy", "numpy")}


TASK = Task(
    name=NAME,
    title="Spring Pendulum",
    scene=NAME,
    dimension=2,
    frames=SpringPendulum.frames,
    material=(MaterialFeature("stiffness", *STIFFNESS, logarithmic=True),),
    context_sizes=(2, 5, 10),
    training_context=(2, 15),
)
