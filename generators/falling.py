"""Falling Teddy Bear and Mixed Objects Falling: soft bodies of unknown stiffness dropped on a rigid floor.

A solid of 0.5 m and of random orientation falls from rest, its lowest point 20 mm above the floor; it hits,
deforms, rebounds, topples, and comes to rest. Needed for that are finite-strain elasticity, inertia, gravity,
the floor with Coulomb friction, and a little viscosity. Young's modulus and Poisson's ratio vary, and in Mixed
Objects the object. Source: paper, sections 5 and C; the original's step, height, density, size, friction and
objects are not published, so these are ours.
"""

import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FREE, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.generators.errors import (
    GeneratorError,
    ParameterError,
    SolverError,
    problem,
    require_installed,
)
from m3gn_bench.generators.objects import SoftBody, load_object
from m3gn_bench.generators.scene import Leveled, SingleTask
from m3gn_bench.generators.solvers.tetrahedra import Element, Motion, TetrahedralSolid

if TYPE_CHECKING:  # it loads Warp
    from m3gn_bench.generators.solvers.captured import CapturedSolid

SIZE = 0.5  # [m], an object's largest extent in its own axes
DENSITY = 1000.0  # [kg/m^3]
VISCOSITY = 100.0  # [Pa s]
FRICTION = 0.5
GRAVITY = 9.81  # [m/s^2]
DOWN = np.array([0.0, 0.0, -GRAVITY])
HEIGHT = (
    0.02  # [m], of the lowest point above the floor: the impact comes early enough to be in every context
)
TRANSITIONS = 200
FRAME_TIME = 0.01  # [s]
YOUNGS_MODULI = np.linspace(1e5, 1e6, 1000)  # [Pa]
POISSON_RATIOS = np.linspace(0.0, 0.499, 100)
MAX_ENERGY_GROWTH = 1e-2  # within a frame, of the energy at the start
REMEDY = "use a stiffer material, drop it from less high, or use more substeps"
FLAT = 1e-12  # volume of a cell over the cube of its size
MAX_HALVINGS = 3  # of the step, where a motion diverges
MAX_FLIGHT_ERROR = 1e-6  # [m]
MAX_PENETRATION = 5e-4  # [m]; the explicit solver has none, vertex block descent has springs
MAX_STEP_RATIO = 1.5  # of a frame at the largest speed, which is known in frames only; stored data reach 1.2
MAX_SPEED_RATIO = 10.0  # of a fall from the highest node; ears and tips whip at up to 4

TOGETHER = 64  # trajectories at once on a GPU, which a single body does not keep busy

Solver = Literal["explicit", "newton-vbd"]
Device = Literal["cpu", "cuda"]


@dataclass(frozen=True)
class FallParameters:
    """One draw: which object, its orientation (unit quaternion x, y, z, w), E [Pa], nu and the height [m]."""

    object: str
    orientation: tuple[float, float, float, float]
    youngs_modulus: float
    poisson_ratio: float
    height: float = HEIGHT


@dataclass(frozen=True)
class FallFidelity:
    """Discretisation.

    Attributes:
        parts: into how many parts each edge of the object's mesh is cut.
        courant: the explicit solver's step in units of its limit of stability at rest.
        vbd_iterations: sweeps of vertex block descent per substep.
        vbd_substeps: its substeps per frame.
        element: of the explicit solver, see `solvers.tetrahedra`; vertex block descent has linear tetrahedra.
    """

    parts: int
    courant: float
    vbd_iterations: int
    vbd_substeps: int
    element: Element = "nodal pressure"


@dataclass(frozen=True)
class _FallingObjects(Leveled, SingleTask):
    """What the two scenes share. Positions in m; the floor is z = 0.

    Attributes:
        solver: "explicit", or "newton-vbd" to compare with.
        device: "cpu", or "cuda" for many trajectories at once. A GPU rounds differently, so its dataset is another one.
    """

    solver: Solver = "explicit"
    device: Device = "cpu"

    name: ClassVar[str]
    tasks: ClassVar[tuple[str, ...]]
    paper_sizes: ClassVar[dict[Split, int]]
    dataset_version: ClassVar[str] = "3.0"
    frames: ClassVar[int] = TRANSITIONS + 1
    dt: ClassVar[float] = FRAME_TIME
    time_unit: ClassVar[str] = "s"
    length_unit: ClassVar[str] = "m"
    material_units: ClassVar[dict[str, str]] = {"youngs_modulus": "Pa", "poisson_ratio": "1"}
    load_units: ClassVar[dict[str, str]] = {"orientation": "quaternion x, y, z, w", "height": "m"}
    scale_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.5)
    scale_length: ClassVar[float] = 0.5
    fidelities: ClassVar[dict[str, FallFidelity]] = {
        # Of the explicit solver nothing faster is sound: longer steps gain energy now and then, linear tetrahedra lock.
        "fast": FallFidelity(parts=1, courant=0.85, vbd_iterations=2, vbd_substeps=40),
        "default": FallFidelity(parts=1, courant=0.85, vbd_iterations=2, vbd_substeps=160),
        "reference": FallFidelity(
            parts=1, courant=0.85, vbd_iterations=5, vbd_substeps=160, element="quadratic"
        ),
    }

    def __post_init__(self) -> None:
        if self.solver not in get_args(Solver):
            raise GeneratorError(unknown_name("solver", self.solver, list(get_args(Solver))))
        if self.device not in get_args(Device):
            raise GeneratorError(unknown_name("device", self.device, list(get_args(Device))))
        if self.device == "cuda" and self.solver != "explicit":
            raise GeneratorError(
                f"on cuda only the solver explicit moves many bodies at once, not {self.solver}"
            )
        if self.solver == "newton-vbd":
            require_installed("newton", "the solver newton-vbd", "newton")

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects that fall."""
        raise NotImplementedError

    @property
    def variant(self) -> dict[str, str]:
        """The solver, where it is not the explicit one, and the device, where it is not the CPU."""
        options: dict[str, str] = {"solver": self.solver, "device": self.device}
        usual = {"solver": "explicit", "device": "cpu"}
        return {name: value for name, value in options.items() if value != usual[name]}

    @property
    def together(self) -> int:
        """How many trajectories to simulate at once."""
        return 1 if self.device == "cpu" else TOGETHER

    def sample(self, rng: np.random.Generator, index: int) -> FallParameters:
        """Orientation uniform over all rotations, E and nu from the paper's grids, objects in turn."""
        orientation = Rotation.random(rng=rng).as_quat()
        return FallParameters(
            object=self.objects[index % len(self.objects)],
            orientation=tuple(orientation.tolist()),
            youngs_modulus=float(rng.choice(YOUNGS_MODULI)),
            poisson_ratio=float(rng.choice(POISSON_RATIOS)),
        )

    def body(self, name: str) -> SoftBody:
        """The object of that name, its largest extent 1."""
        return load_object(name)

    def simulate_with(
        self, parameters: FallParameters, level: FallFidelity, frames: int | None = None
    ) -> Trajectory:
        """States at 0, 0.01, 0.02, ... s, 201 of them if not told otherwise.

        Raises:
            SolverError: positions are not finite even with steps of an eighth.
            ParameterError: a parameter is out of its physical range, or the floor is not reached in so many frames.
            GeneratorError: there is no such device.
        """
        (outcome,) = self.simulate_together([parameters], level, frames)
        if isinstance(outcome, SolverError):
            raise outcome
        return outcome

    def simulate_together(
        self, draws: Sequence[FallParameters], level: FallFidelity, frames: int | None = None
    ) -> list[Trajectory | SolverError]:
        """The same for several drops from one height: of each its trajectory, or the SolverError."""
        frames = self.frames if frames is None else frames
        height, *others = {parameters.height for parameters in draws}
        if others:
            raise ParameterError("bodies that are simulated together must fall from one height")
        if not height >= 0:
            raise ParameterError(f"height must not be negative, as {height} m is")
        # Until it touches the floor the body is free of stress, and its motion known.
        flight = flight_frames(height)
        if frames <= flight:
            raise ParameterError(f"frames must be more than the {flight} of the free fall, not {frames}")
        bodies = [self.body(parameters.object) for parameters in draws]
        prepared = [self._solid(b, p, level) for b, p in zip(bodies, draws, strict=True)]
        solids, substeps = zip(*prepared, strict=True)
        landed = land(solids, height, frames, substeps)
        return [
            outcome
            if isinstance(outcome, SolverError)
            else self._trajectory(body, parameters, solid, *outcome)
            for body, parameters, solid, outcome in zip(bodies, draws, solids, landed, strict=True)
        ]

    def _trajectory(
        self,
        body: SoftBody,
        parameters: FallParameters,
        solid: TetrahedralSolid,
        motion: Motion,
        substeps: int,
    ) -> Trajectory:
        recorded, start = body.surface_nodes, solid.vertices[: body.surface_nodes]
        times = _flight_times(parameters.height)
        flight = start + DOWN / 2 * times[:, None, None] ** 2
        positions = np.concatenate([flight, motion.positions[1:, :recorded]])

        energies, ratios = solid.monitor(motion)
        total = energies.sum(1)
        growth, speeds = np.diff(total), np.linalg.norm(motion.velocities, axis=-1).max(1)
        inverted = (ratios <= 0).sum(1)
        return Trajectory(
            positions=positions.astype(np.float32),
            mesh=Mesh(
                rest_positions=start.astype(np.float32),
                cells=body.surface.astype(np.int32),
                cell_type=VTK_TRIANGLE,
                node_type=np.full(recorded, FREE, dtype=np.uint8),
            ),
            material={
                "youngs_modulus": parameters.youngs_modulus,
                "poisson_ratio": parameters.poisson_ratio,
            },
            loads={
                "orientation": np.array(parameters.orientation, dtype=np.float32),
                "height": np.array(parameters.height, dtype=np.float32),
            },
            tags={"object": parameters.object},
            diagnostics={
                "tetrahedra": solid.cells,
                "substeps_per_frame": substeps,
                "min_volume_ratio": float(ratios.min()),
                "inverted_tetrahedra": int(inverted.max()),
                "inverted_tetrahedra_at_end": int(inverted[-1]),
                "self_penetrating_nodes_at_end": int(
                    self_penetrating(motion.positions[-1], solid, recorded).sum()
                ),
                "energy_growth": float(growth.max() / total[0]),
                "energy_growth_frame": len(times) + int(growth.argmax()),
                "energy_left": float(total[-1] / total[0]),
                "max_speed": float(speeds.max()),
                "max_speed_frame": len(times) - 1 + int(speeds.argmax()),
            },
        )

    def check(self, trajectory: Trajectory) -> list[str]:
        """Finite, falling freely at first, above the floor, no energy from nowhere, nothing left inverted.

        And that what is recorded moves as fast as what was simulated.
        """
        positions = trajectory.positions.astype(np.float64)
        finite = np.isfinite(positions).all((1, 2))
        if not finite.all():
            return [problem(int(finite.argmin()), "positions are not finite", "use more substeps")]
        problems = []
        height = float(trajectory.loads["height"])
        times = _flight_times(height)
        flight = positions[0] - np.array([0.0, 0.0, GRAVITY / 2]) * times[:, None, None] ** 2
        astray = np.abs(positions[: len(times)] - flight).max((1, 2))
        if not astray.max() < MAX_FLIGHT_ERROR:
            what = f"it does not fall freely before it touches the floor, but is {astray.max():.2g} m off"
            problems.append(
                problem(int(astray.argmax()), what, "start it at rest, its lowest point at the height")
            )
        lowest = positions[:, :, 2].min(1)
        if not abs(lowest[0] - height) < MAX_FLIGHT_ERROR:
            what = f"its lowest point is {lowest[0]:.3g} m above the floor, not {height:g} m"
            problems.append(problem(0, what, "start it at the height"))
        if lowest.min() < (0.0 if self.solver == "explicit" else -MAX_PENETRATION):
            what = f"a node is {-lowest.min():.2g} m below the floor"
            problems.append(problem(int(lowest.argmin()), what, "use more substeps"))
        found = trajectory.diagnostics
        if not found["energy_growth"] <= MAX_ENERGY_GROWTH:
            what = f"the energy grows by {found['energy_growth']:.2%} within a frame"
            problems.append(problem(int(found["energy_growth_frame"]), what, "use more substeps"))
        if found["inverted_tetrahedra_at_end"]:
            what = f"{found['inverted_tetrahedra_at_end']:.0f} tetrahedra are inverted at the end"
            problems.append(problem(len(positions) - 1, what, REMEDY))
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(-1)
        fastest = MAX_STEP_RATIO * found["max_speed"] * FRAME_TIME
        if not steps.max() <= fastest:
            what = f"a node jumps by {steps.max():.2g} m, farther than the fastest one can move ({fastest:.2g} m)"
            problems.append(problem(int(steps.argmax()) + 1, what, REMEDY))
        limit = MAX_SPEED_RATIO * np.sqrt(2 * GRAVITY * positions[0, :, 2].max())
        if not found["max_speed"] <= limit:
            what = f"a node moves at {found['max_speed']:.1f} m/s, faster than any fall explains ({limit:.1f} m/s)"
            problems.append(problem(int(found["max_speed_frame"]), what, REMEDY))
        return problems

    def extreme_materials(self, parameters: FallParameters) -> tuple[FallParameters, FallParameters]:
        """The same drop of the softest, most compressible and of the stiffest, least compressible material."""
        soft, stiff = (
            replace(
                parameters,
                youngs_modulus=float(YOUNGS_MODULI[end]),
                poisson_ratio=float(POISSON_RATIOS[end]),
            )
            for end in (0, -1)
        )
        return soft, stiff

    def simulator_versions(self) -> dict[str, str]:
        """Versions of the solver's library, scipy and numpy."""
        libraries = ("warp-lang", "scipy", "numpy")
        return {
            name: version(name)
            for name in (libraries if self.solver == "explicit" else ("newton", *libraries))
        }

    def _solid(
        self, body: SoftBody, parameters: FallParameters, level: FallFidelity
    ) -> "tuple[CapturedSolid, int]":
        """The body where it starts, ready to be moved by the chosen solver, and that solver's substeps per frame."""
        body = body.divided(level.parts)
        start = Rotation.from_quat(parameters.orientation).apply(SIZE * body.vertices)
        start[:, 2] += parameters.height - start[:, 2].min()
        scene: dict[str, Any] = {
            "density": DENSITY,
            "youngs_modulus": parameters.youngs_modulus,
            "poisson_ratio": parameters.poisson_ratio,
            "viscosity": VISCOSITY,
            "friction": FRICTION,
            "gravity": GRAVITY,
        }
        # Imported here: each solver loads a library of its own.
        if self.solver == "newton-vbd":
            from m3gn_bench.generators.solvers.vbd import VertexBlockDescent

            descending = VertexBlockDescent(start, body.tetrahedra, iterations=level.vbd_iterations, **scene)
            return descending, level.vbd_substeps
        from m3gn_bench.generators.solvers.explicit import ExplicitSolid
        from m3gn_bench.generators.solvers.quiet_warp import wp

        if self.device == "cuda" and not wp.is_cuda_available():
            raise GeneratorError(
                f"{platform.node()} has no CUDA device that Warp can use; simulate on the cpu"
            )
        solid = ExplicitSolid(start, body.tetrahedra, element=level.element, device=self.device, **scene)
        return solid, solid.substeps(FRAME_TIME, level.courant)


@dataclass(frozen=True)
class FallingTeddy(_FallingObjects):
    """One object, the teddy, or the user's own.

    Attributes:
        mesh: drop this body instead (see `read_object`).
    """

    mesh: SoftBody | None = None

    name: ClassVar[str] = "falling_teddy"
    tasks: ClassVar[tuple[str, ...]] = ("falling_teddy",)
    paper_sizes: ClassVar[dict[Split, int]] = {"train": 700, "validation": 150, "test": 150}

    @property
    def objects(self) -> tuple[str, ...]:
        """The teddy's name, or that of the user's object."""
        return ("teddy",) if self.mesh is None else (self.mesh.name,)

    @property
    def variant(self) -> dict[str, str]:
        """The solver and the object, where they are not the benchmark's."""
        own = {} if self.mesh is None else {"mesh": f"{self.mesh.name}-{self.mesh.content_hash()[:8]}"}
        return super().variant | own

    def body(self, name: str) -> SoftBody:
        """The teddy, or the user's object."""
        return super().body(name) if self.mesh is None else self.mesh


@dataclass(frozen=True)
class MixedObjects(_FallingObjects):
    """Six objects in turn."""

    name: ClassVar[str] = "mixed_objects"
    tasks: ClassVar[tuple[str, ...]] = ("mixed_objects",)
    paper_sizes: ClassVar[dict[Split, int]] = {"train": 1800, "validation": 360, "test": 360}
    objects: ClassVar[tuple[str, ...]] = (
        "teddy",
        "bunny",
        "gummy_bear",
        "gummy_worm_1",
        "gummy_worm_2",
        "traffic_cone",
    )


def self_penetrating(positions: np.ndarray, solid: TetrahedralSolid, recorded: int) -> np.ndarray:
    """Which of the recorded nodes lie inside a tetrahedron that is not their own, shape [recorded]."""
    corners = positions[solid.tetrahedra]
    edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    # A cell with four nodes on the floor is flat, and nothing is inside it.
    solids = np.flatnonzero(np.abs(np.linalg.det(edges)) > FLAT * np.linalg.norm(edges, axis=(1, 2)) ** 3)
    penetrating = np.zeros(recorded, dtype=bool)
    for cells in np.array_split(solids, len(solids) // 500 + 1):  # bounds the memory of a refined body
        offsets = positions[None, :recorded] - corners[cells, :1]  # cell, node, axis
        weights = np.linalg.solve(edges[cells], offsets.transpose(0, 2, 1))  # cell, axis, node
        inside = (weights > 0).all(1) & (weights.sum(1) < 1)
        for own in solid.tetrahedra[cells].T:
            mine = np.flatnonzero(own < recorded)
            inside[mine, own[mine]] = False
        penetrating |= inside.any(0)
    return penetrating


def land(
    solids: "Sequence[CapturedSolid]", height: float, frames: int, substeps: Sequence[int]
) -> list[tuple[Motion, int] | SolverError]:
    """Move bodies from the last frame of their free fall on, with smaller steps for those whose motion diverges.

    Args:
        solids: of one solver, at rest in the pose from which they fall.
        height: of their lowest points then [m].
        frames: until this one; frame 0 is the start of the fall.
        substeps: of each per frame, to begin with.

    Returns:
        Of each body the motion from the last frame of the fall on, and the substeps that it took; or the error,
        where positions are not finite even with steps of an eighth.
    """
    # Imported here: it loads Warp.
    from m3gn_bench.generators.solvers.captured import Course, Start

    first = flight_frames(height) - 1
    time = FRAME_TIME * first
    course = Course(frames - 1 - first, FRAME_TIME, first)
    landed: dict[int, tuple[Motion, int] | SolverError] = {}
    left = dict(enumerate(substeps))
    for _ in range(MAX_HALVINGS + 1):
        moved = [solids[k] for k in left]
        starts = [
            Start(
                solid.vertices + DOWN / 2 * time**2,
                np.tile(DOWN * time, (solid.nodes, 1)),
                steps,
            )
            for solid, steps in zip(moved, left.values(), strict=True)
        ]
        outcomes = type(solids[0]).run_together(moved, starts, course)
        for (k, steps), outcome in zip(left.items(), outcomes, strict=True):
            landed[k] = outcome if isinstance(outcome, SolverError) else (outcome, steps)
        # The step is stable at rest; a cell that is squashed flat may ask for a smaller one.
        left = {k: 2 * steps for k, steps in left.items() if isinstance(landed[k], SolverError)}
        if not left:
            break
    return [landed[k] for k in range(len(solids))]


def flight_frames(height: float) -> int:
    """Number of frames in which a body dropped from that height [m] has not touched the floor yet."""
    return 1 + int(np.sqrt(2 * height / GRAVITY) / FRAME_TIME)


def _flight_times(height: float) -> np.ndarray:
    """Times [s] of those frames."""
    return FRAME_TIME * np.arange(flight_frames(height))
