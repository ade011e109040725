"""Deformable Block: a rigid circle is pressed into an elastic block whose material changes on the way.

A trapezoidal block stands on its clamped base. A rigid, frictionless circle moves down at constant
speed. For eleven frames the block has one Poisson's ratio; then it gets another, and from there 39 frames are
recorded: the first of them shows a state with a history, and what must be inferred is the second ratio. The
scene's energies are those of a two-dimensional solid at finite strain, of its contact with the circle, and of
inertia, which is there to make the sudden change of material a short transient instead of a
jump. Source: paper, sections 5 and C; sizes, ratios and numbers follow the description of the original data.
"""

from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from skfem import ElementQuad1, ElementQuad2, ElementQuadS2, ElementTriP1, MeshQuad, MeshTri

from m3gn_bench.datasets.errors import unknown_name
from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.generators.errors import GeneratorError, problem
from m3gn_bench.generators.scene import Leveled, SimulatedWithScikitFem, SingleTask
from m3gn_bench.generators.solvers.contact import BoundaryPoints, Disc, PenaltyContact
from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array

HEIGHT = 200.0  # [mm]
BASE = -100.0  # [mm], where the base is
TRAPEZOIDS = (  # (bottom, top) widths [mm]
    (200.0, 200.0),
    (220.0, 180.0),
    (240.0, 160.0),
    (220.0, 200.0),
    (200.0, 160.0),
    (180.0, 140.0),
    (180.0, 200.0),
    (160.0, 200.0),
    (200.0, 180.0),
)
NODES_PER_SIDE = 9  # recorded
YOUNGS_MODULUS = 5000.0  # [Pa]
POISSON_RATIOS = (-0.9, 0.0, 0.49)
DENSITY = 50e-6  # [Pa s^2 / mm^2], 50 kg/m^3: a soft foam
DAMPING = 300.0  # [1/s], mass-proportional
FRAME = 0.01  # [s]
SPEED = 150.0  # [mm/s] of the circle, downwards
HIDDEN_FRAMES = 11  # with the first ratio, not recorded
RECORDED_FRAMES = 39
RADIUS = (15.0, 37.5, 60.0)  # [mm], minimum, mode and maximum of a triangular distribution
START_RANGE = 0.7  # of half the top's width
COLLIDER_NODES = 57
PENALTY_RATIO = 10.0  # of Young's modulus [1/mm]: a pressure E/20 sinks in by 5 µm
FACET_ORDER = 5  # three Gauss points per facet
SAMPLING_ORDER = 31  # sixteen points per facet, to see what happens between those three
CELL_ORDER = 3  # 2 x 2 Gauss points per cell

MAX_PENETRATION = 0.1  # of the radius
MAX_FORCE_DROP = 0.5  # of the largest contact force so far
MAX_STEP = 4.0  # of a node, in steps of the circle
TRANSIENT = 2  # transitions in which the block finds its new equilibrium after the change of material
MAX_TRANSIENT_STEP = 0.1 * HEIGHT  # [mm], of a node in those
REMEDY = "press less deep, more slowly, with a larger circle or further from the block's corners"

Plane = Literal["stress", "strain"]


@dataclass(frozen=True)
class BlockParameters:
    """One draw.

    Attributes:
        widths: of the base and of the top [mm].
        poisson_ratios: before and after the change of material.
        radius: of the circle [mm].
        start: x of the circle's centre [mm].
        youngs_modulus: [Pa]; the scene has one only.
        speed: of the circle [mm/s]; the scene has one only.
    """

    widths: tuple[float, float]
    poisson_ratios: tuple[float, float]
    radius: float
    start: float
    youngs_modulus: float = YOUNGS_MODULUS
    speed: float = SPEED


# Mesh, element and integration order of the cells. "serendipity", with 2 x 2 Gauss points, neither locks nor
# hourglasses; the others are there to be compared.
ELEMENTS: dict[str, tuple[Any, Any, int]] = {
    "serendipity": (MeshQuad, ElementQuadS2(), CELL_ORDER),
    "biquadratic": (MeshQuad, ElementQuad2(), 5),
    "bilinear": (MeshQuad, ElementQuad1(), CELL_ORDER),
    "linear triangles": (MeshTri, ElementTriP1(), 1),
}


@dataclass(frozen=True)
class BlockFidelity:
    """Discretisation: cells per side (a multiple of eight), time steps in each hidden frame, in the frames
    that follow the change of material, and in all others, Newton's tolerance relative to the reaction, and the
    element, one of `ELEMENTS`."""

    cells: int
    hidden_steps: int
    transient_steps: tuple[int, ...]
    steps: int
    tolerance: float
    element: str = "serendipity"


@dataclass(frozen=True)
class DeformableBlock(Leveled, SingleTask, SimulatedWithScikitFem):
    """The scene. Positions in mm, Young's modulus in Pa, time in s.

    Attributes:
        plane: "stress" (a thin plate, the benchmark's) or "strain" (a slice of a long bar).
    """

    plane: Plane = "stress"

    name: ClassVar[str] = "deformable_block"
    dataset_version: ClassVar[str] = "3.0"
    tasks: ClassVar[tuple[str, ...]] = ("deformable_block",)
    paper_sizes: ClassVar[dict[Split, int]] = {"train": 675, "validation": 135, "test": 135}
    frames: ClassVar[int] = RECORDED_FRAMES
    dt: ClassVar[float] = FRAME
    time_unit: ClassVar[str] = "s"
    length_unit: ClassVar[str] = "mm"
    material_units: ClassVar[dict[str, str]] = {"poisson_ratio": "1"}
    load_units: ClassVar[dict[str, str]] = {"first_poisson_ratio": "1", "radius": "mm", "start": "mm"}
    scale_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0)
    scale_length: ClassVar[float] = 100.0
    fidelities: ClassVar[dict[str, BlockFidelity]] = {
        "fast": BlockFidelity(8, 1, (4, 2, 2), 1, 1e-2),
        "default": BlockFidelity(8, 1, (16, 8, 8, 4, 4, 4, 2, 2, 2, 2), 1, 1e-2),
        "reference": BlockFidelity(16, 2, (32, 16, 16, 8, 8, 8, 4, 4, 4, 4), 2, 1e-7),
    }

    def __post_init__(self) -> None:
        if self.plane not in get_args(Plane):
            raise GeneratorError(unknown_name("plane", self.plane, list(get_args(Plane))))

    @property
    def variant(self) -> dict[str, str]:
        """Options that differ from the benchmark's."""
        return {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}

    def sample(self, rng: np.random.Generator, index: int) -> BlockParameters:
        """Trapezoid and second ratio cycle with the index, through all 27 pairs; the rest is random."""
        widths = TRAPEZOIDS[index % len(TRAPEZOIDS)]
        # Shifted by one in every round of trapezoids: short prefixes hold all ratios, 27 draws hold all pairs.
        second = POISSON_RATIOS[(index + index // len(TRAPEZOIDS)) % len(POISSON_RATIOS)]
        first = float(rng.choice([ratio for ratio in POISSON_RATIOS if ratio != second]))
        reach = START_RANGE * widths[1] / 2
        return BlockParameters(
            widths=widths,
            poisson_ratios=(first, second),
            radius=float(rng.triangular(*RADIUS)),
            start=float(rng.uniform(-reach, reach)),
        )

    def simulate_with(
        self, parameters: BlockParameters, level: BlockFidelity, frames: int | None = None
    ) -> Trajectory:
        """Simulate eleven hidden frames, of which the state after the last is recorded, and those that follow.

        Raises:
            SolverError: a time step has no solution.
        """
        frames = self.frames if frames is None else frames
        block = make_block(parameters.widths, level.cells, level.element)
        dynamics, disc = self.prepare(parameters, block.body, block.contact_points, level.tolerance)
        first, second = parameters.poisson_ratios
        states = np.empty((frames, block.body.solid.dofs))
        forces = np.empty(frames)
        for k in range(1, HIDDEN_FRAMES + 1):
            label = f"frame {k - HIDDEN_FRAMES} (frame 0 is the first recorded)"
            dynamics.advance(FRAME * k, level.hidden_steps, label)
        states[0], forces[0] = dynamics.displacement, dynamics.contact_forces[0, 1]
        dynamics.potential.law = self.law(parameters.youngs_modulus, second)
        dynamics.restart()
        for k in range(1, frames):
            steps = level.transient_steps[k - 1] if k <= len(level.transient_steps) else level.steps
            dynamics.advance(FRAME * (HIDDEN_FRAMES + k), steps, f"frame {k} of {frames - 1}")
            states[k], forces[k] = dynamics.displacement, dynamics.contact_forces[0, 1]

        displacements = states.reshape(frames, -1, 2)[:, block.recorded]
        positions = block.mesh.rest_positions.astype(np.float64) + displacements
        around = np.arange(COLLIDER_NODES)
        angles = -np.pi / 2 + 2 * np.pi * around / COLLIDER_NODES
        ring = parameters.radius * np.column_stack([np.cos(angles), np.sin(angles)])
        centres = np.array([disc.centre(FRAME * (HIDDEN_FRAMES + k)) for k in range(frames)])
        depth = [
            disc.depth(points.reshape(-1, 2), FRAME * (HIDDEN_FRAMES + k)).max()
            for k, points in enumerate(block.surface_points.positions(states))
        ]
        drop, drop_frame = max_force_drop(forces)
        return Trajectory(
            positions=positions.astype(np.float32),
            mesh=block.mesh,
            material={"poisson_ratio": second},
            loads={
                "first_poisson_ratio": np.array([first], dtype=np.float32),
                "radius": np.array([parameters.radius], dtype=np.float32),
                "start": np.array(disc.start, dtype=np.float32),
            },
            collider_positions=(centres[:, None] + ring).astype(np.float32),
            collider_edges=np.column_stack([around, (around + 1) % COLLIDER_NODES]).astype(np.int32),
            diagnostics={
                **asdict(dynamics.newton.statistics),
                "min_jacobian": dynamics.min_jacobian,
                "max_penetration": float(max(depth)),
                "max_penetration_frame": int(np.argmax(depth)),
                "max_contact_force": float(forces.max()),
                "max_force_drop": drop,
                "max_force_drop_frame": drop_frame,
            },
        )

    def law(self, youngs_modulus: float, poisson_ratio: float) -> NeoHookean:
        """The material in the scene's plane state."""
        return NeoHookean.from_youngs_modulus(
            youngs_modulus, poisson_ratio, "plane stress" if self.plane == "stress" else "plane strain"
        )

    def prepare(
        self,
        parameters: BlockParameters,
        body: ConstrainedSolid,
        contact_points: BoundaryPoints,
        tolerance: float,
    ) -> tuple[ImplicitDynamics, Disc]:
        """A block at rest, of the first material, just touched by the circle; and the circle."""
        disc = Disc(
            radius=parameters.radius,
            start=(parameters.start, BASE + HEIGHT + parameters.radius),
            velocity=(0.0, -parameters.speed),
        )
        contact = PenaltyContact(
            contact_points,
            penalty=PENALTY_RATIO * parameters.youngs_modulus,
            obstacles=[disc],
        )
        potential = IncrementalPotential(
            body,
            self.law(parameters.youngs_modulus, parameters.poisson_ratios[0]),
            contact=contact,
            force_floor=1e-6 * parameters.youngs_modulus * HEIGHT,
        )
        newton = ModifiedNewton(potential, tolerance=tolerance)
        return ImplicitDynamics(potential, newton, density=DENSITY, damping=DAMPING), disc

    def check(self, trajectory: Trajectory) -> list[str]:
        """Finite, clamped, no triangle turned over, no punch-through, little penetration, no jump."""
        positions = trajectory.positions.astype(np.float64)
        assert trajectory.collider_positions is not None
        collider = trajectory.collider_positions.astype(np.float64)
        finite = np.isfinite(positions).all((1, 2)) & np.isfinite(collider).all((1, 2))
        if not finite.all():
            return [problem(int(finite.argmin()), "positions are not finite", REMEDY)]
        problems = []
        fixed = trajectory.mesh.node_type == FIXED
        moved = np.abs(positions[:, fixed] - trajectory.mesh.rest_positions[fixed]).max((1, 2))
        if moved.any():
            problems.append(
                problem(int(moved.argmax()), f"a clamped node moves by {moved.max():.2g} mm", "clamp it")
            )
        corners = positions[:, trajectory.mesh.cells]
        a, b = corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0]
        areas = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).min(1) / 2
        if areas.min() <= 0:
            frame = int(np.flatnonzero(areas <= 0)[0])
            problems.append(
                problem(frame, f"a triangle turns over, its area is {areas[frame]:.2g} mm²", REMEDY)
            )
        radius = float(trajectory.loads["radius"][0])
        found = trajectory.diagnostics
        depth = found["max_penetration"]
        if depth > MAX_PENETRATION * radius:
            problems.append(
                problem(
                    int(found["max_penetration_frame"]),
                    f"the circle of radius {radius:.1f} mm sinks in by {depth:.2f} mm",
                    REMEDY,
                )
            )
        drop = found["max_force_drop"]
        if drop == 1:
            what = "the contact force is 0: the circle punches through, has slipped off, or is not there yet"
            problems.append(
                problem(
                    int(found["max_force_drop_frame"]),
                    what,
                    "let it press on the top of the block, with a larger radius",
                )
            )
        elif drop > MAX_FORCE_DROP:
            problems.append(
                problem(
                    int(found["max_force_drop_frame"]),
                    f"the contact force has fallen by {drop:.0%}: the circle punches through or slips off",
                    REMEDY,
                )
            )
        inside = radius - np.linalg.norm(positions - collider.mean(1, keepdims=True), axis=-1).min(1)
        if inside.max() > MAX_PENETRATION * radius:
            what = f"a recorded node is {inside.max():.2f} mm inside the circle of radius {radius:.1f} mm"
            problems.append(problem(int(inside.argmax()), what, REMEDY))
        travel = np.linalg.norm(np.diff(collider, axis=0), axis=-1).max(-1)
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(-1)
        allowed = np.where(np.arange(len(steps)) < TRANSIENT, MAX_TRANSIENT_STEP, MAX_STEP * travel)
        jumps = np.flatnonzero(steps > allowed)
        if jumps.size:
            problems.append(problem(int(jumps[0]) + 1, f"a node jumps by {steps[jumps[0]]:.2f} mm", REMEDY))
        return problems

    def extreme_materials(self, parameters: BlockParameters) -> tuple[BlockParameters, BlockParameters]:
        """The same indentation, with the smallest and with the largest second ratio, from the same first."""
        smallest, middle, largest = POISSON_RATIOS
        return (
            replace(parameters, poisson_ratios=(middle, smallest)),
            replace(parameters, poisson_ratios=(middle, largest)),
        )


def max_force_drop(forces: Array) -> tuple[float, int]:
    """How far the contact force [frames] falls below its largest value so far, relative to that, and in which frame.

    It may fall once, at the change of material, to that of the new one. After that the circle goes ever
    deeper and the force grows; where it collapses the circle has punched through or slipped off. Without
    contact in some frame the drop is 1.
    """
    if forces.min() <= 0:
        return 1.0, int(forces.argmin())
    settled = forces[TRANSIENT:]
    if not settled.size:
        return 0.0, 0
    drops = 1 - settled / np.maximum.accumulate(settled)
    return float(drops.max()), TRANSIENT + int(drops.argmax())


@dataclass(frozen=True, eq=False)
class Block:
    """A clamped trapezoid at rest, ready for many simulations.

    Attributes:
        body: the solid, and its clamped base.
        contact_points: on the top and the sides, which may touch the circle.
        surface_points: the same boundary, sampled more densely than contact looks at it.
        recorded: nodes of the solid on the recorded lattice, row by row from the base, shape [81].
        mesh: the recorded mesh.
    """

    body: ConstrainedSolid
    contact_points: BoundaryPoints
    surface_points: BoundaryPoints
    recorded: NDArray[np.int64]
    mesh: Mesh


@lru_cache(maxsize=2 * len(TRAPEZOIDS))
def make_block(widths: tuple[float, float], cells: int, element: str = "serendipity") -> Block:
    """The trapezoid with these widths of base and top, with so many cells (a multiple of eight) per side."""
    mesh_class, shape_functions, integration_order = ELEMENTS[element]
    grid = np.linspace(0, 1, cells + 1)
    square = mesh_class.init_tensor(grid, grid)
    mesh = mesh_class(_trapezoid(widths, square.p.T).T, square.t)
    solid = Solid(mesh, shape_functions, integration_order=integration_order)
    base = np.flatnonzero(solid.nodes[:, 1] < BASE + 1e-9 * HEIGHT)
    facets = mesh.boundary_facets()
    heights = mesh.p[1, mesh.facets[:, facets]].mean(0)
    surface = facets[heights > BASE + 1e-9 * HEIGHT]

    n = NODES_PER_SIDE
    ticks = np.linspace(0, 1, n)
    lattice = np.array([(x, y) for y in ticks for x in ticks])
    rest = _trapezoid(widths, lattice)
    distance = np.linalg.norm(solid.nodes - rest[:, None], axis=-1)
    triangles = []
    for row in range(n - 1):
        for column in range(n - 1):
            a = row * n + column
            triangles += [(a, a + 1, a + n + 1), (a, a + n + 1, a + n)]
    return Block(
        body=ConstrainedSolid(solid, solid.dofs_of(base)),
        contact_points=BoundaryPoints(solid, surface, FACET_ORDER),
        surface_points=BoundaryPoints(solid, surface, SAMPLING_ORDER),
        recorded=distance.argmin(1),
        mesh=Mesh(
            rest_positions=rest.astype(np.float32),
            cells=np.array(triangles, dtype=np.int32),
            cell_type=VTK_TRIANGLE,
            node_type=np.where(lattice[:, 1] == 0, FIXED, FREE).astype(np.uint8),
        ),
    )


def _trapezoid(widths: tuple[float, float], square: Array) -> Array:
    """Map points [points, 2] of the unit square to the block."""
    x, y = square.T
    base, top = widths
    return np.column_stack([(x - 0.5) * (base + (top - base) * y), BASE + HEIGHT * y])
