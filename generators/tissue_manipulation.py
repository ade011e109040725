"""Tissue Manipulation: a soft wall that stands on a held foot is pulled by a gripper near its top.

A curved slab of tissue is held up to a height of 25 mm. A rigid gripper has grasped a small patch of its top,
through the whole thickness, and moves at constant speed in the plane of the wall, away from the foot. Three
materials occur, each a Poisson's ratio with a Young's modulus of its own. The only energy is that of a
three-dimensional solid at finite strain: inertia would change the path by less than the mesh does (see the
card), so every frame is an equilibrium; there is no contact and no gravity. Source: paper,
sections 5 and C; materials, numbers of nodes and time step follow the description of the original data, while
the slab's shape is our own.

Units are mm and Pa, so forces are in uN.
"""

from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.linalg import LinAlgError
from scipy.sparse import csr_matrix
from skfem import Basis, ElementHex1, ElementHexS2, MeshHex, MeshHex2

from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.generators.errors import problem
from m3gn_bench.generators.scene import Leveled, SimulatedWithScikitFem, SingleTask
from m3gn_bench.generators.solvers.dynamics import ConstrainedSolid, ImplicitDynamics, IncrementalPotential
from m3gn_bench.generators.solvers.finite_strain import NeoHookean, Solid
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.sparse import Array

HEIGHT = 105.0  # [mm]
THICKNESS = 10.0  # [mm], from y = -5 to y = 5
FIXED_HEIGHT = 25.0  # [mm], everything up to there is held
OUTLINE = np.array(  # height, left edge, right edge [mm]; monotone cubics in between
    [
        (0.0, -28.0, 22.0),
        (25.0, -28.0, 22.0),
        (45.0, -25.0, 23.5),
        (55.0, -19.5, 24.5),
        (75.0, -12.5, 22.0),
        (85.0, -11.5, 19.0),
        (105.0, -12.0, 10.0),
    ]
)
LATTICE = (6, 3, 4, 14)  # recorded cells along x, along y, and along z below and above FIXED_HEIGHT

MATERIALS = ((-0.9, 10e3), (0.0, 80e3), (0.49, 30e3))  # Poisson's ratio, Young's modulus [Pa]

PATCHES = 19  # evenly spaced along the top
PATCH_WIDTH = 1 / 6  # of the slab's
PATCH_CENTRES = (1 / 6, 5 / 6)  # across the slab, of the first and the last
PATCH_HEIGHT = 10.0  # [mm]
SPEED = 25.0  # [mm/s] of the gripper
FRAME = 0.01  # [s]
TRANSITIONS = 100
CELL_ORDER = 5  # 3 x 3 x 3 Gauss points: with fewer, serendipity hexahedra hourglass at nu = 0.49

MIN_JACOBIAN = 0.1  # beyond this cells are close to inversion
MIN_CELL_AREA = 0.1  # of a recorded triangle's area at rest
RENEWAL_INTERVAL = 5  # frames after which the solver starts afresh
STABILITY_INTERVAL = 20  # frames after which stability is tested
MAX_STEP = 4.0  # of the gripper's
MAX_ASYMMETRY = 1e-3  # [mm], between both faces of the wall
REMEDY = "pull away from the foot instead of pushing, or less far"
GRIPPER_TOLERANCE = 1e-4  # [mm], above the round-off of float32 positions


@dataclass(frozen=True)
class TissueParameters:
    """One draw.

    Attributes:
        poisson_ratio: of the tissue.
        youngs_modulus: of the tissue [Pa].
        patch: which place is grasped, 0 (near the left end of the top) to 18 (near the right one).
        angle: of the pull in the plane of the wall [degrees]; 0 is to the right, 90 upwards.
        speed: of the gripper [mm/s]; the scene has one only.
    """

    poisson_ratio: float
    youngs_modulus: float
    patch: int
    angle: float
    speed: float = SPEED

    @property
    def direction(self) -> Array:
        """Unit vector of the pull, shape [3]."""
        angle = np.radians(self.angle)
        return np.array([np.cos(angle), 0.0, np.sin(angle)])


# Integrated with full 3 x 3 x 3 Gauss points. Trilinear hexahedra are there to be compared: they lock.
ELEMENTS = {"serendipity": ElementHexS2(), "trilinear": ElementHex1()}


@dataclass(frozen=True)
class TissueFidelity:
    """Discretisation: cells along x (a multiple of six), along y and above the held foot along z (a multiple
    of eight), steps per frame, Newton's tolerance relative to the reaction, and the element, one of `ELEMENTS`."""

    cells: tuple[int, int, int]
    steps: int
    tolerance: float
    element: str = "serendipity"


@dataclass(frozen=True)
class TissueManipulation(Leveled, SingleTask, SimulatedWithScikitFem):
    """The scene. Positions in mm, Young's modulus in Pa, time in s."""

    name: ClassVar[str] = "tissue_manipulation"
    dataset_version: ClassVar[str] = "2.0"
    tasks: ClassVar[tuple[str, ...]] = ("tissue_manipulation",)
    paper_sizes: ClassVar[dict[Split, int]] = {"train": 600, "validation": 120, "test": 120}
    frames: ClassVar[int] = TRANSITIONS + 1
    dt: ClassVar[float] = FRAME
    time_unit: ClassVar[str] = "s"
    length_unit: ClassVar[str] = "mm"
    material_units: ClassVar[dict[str, str]] = {"youngs_modulus": "Pa", "poisson_ratio": "1"}
    load_units: ClassVar[dict[str, str]] = {"patch": "1", "direction": "1"}
    scale_centre: ClassVar[tuple[float, ...]] = (0.0, 0.0, 66.0)
    scale_length: ClassVar[float] = 66.0
    variant: ClassVar[dict[str, str]] = {}
    fidelities: ClassVar[dict[str, TissueFidelity]] = {
        "fast": TissueFidelity((6, 1, 8), 1, 1e-3),
        "default": TissueFidelity((6, 1, 16), 1, 1e-5),
        "reference": TissueFidelity((12, 2, 32), 2, 1e-7),
    }

    def sample(self, rng: np.random.Generator, index: int) -> TissueParameters:
        """Patch and angle uniform, the angle so that the gripper does not push; materials cycle."""
        poisson_ratio, youngs_modulus = MATERIALS[index % len(MATERIALS)]
        return TissueParameters(
            poisson_ratio=poisson_ratio,
            youngs_modulus=youngs_modulus,
            patch=int(rng.integers(PATCHES)),
            angle=float(rng.uniform(0, 180)),
        )

    def simulate_with(
        self, parameters: TissueParameters, level: TissueFidelity, frames: int | None = None
    ) -> Trajectory:
        """Equilibria while the gripper pulls, 100 frames long if not told otherwise.

        Raises:
            SolverError: a step has no solution.
        """
        frames = self.frames if frames is None else frames
        slab = make_slab(parameters.patch, level.cells, level.element)
        law = NeoHookean.from_youngs_modulus(parameters.youngs_modulus, parameters.poisson_ratio, "3d")
        velocity = parameters.speed * parameters.direction
        potential = IncrementalPotential(
            slab.body, law, force_floor=1e-9 * parameters.youngs_modulus * THICKNESS**2
        )
        newton = ModifiedNewton(potential, tolerance=level.tolerance)
        dynamics = ImplicitDynamics(
            potential,
            newton,
            density=0.0,
            prescribed=lambda time: slab.prescribed(time * velocity),
        )
        displacements = np.zeros((frames, len(surface().mesh.rest_positions), 3))
        forces = np.zeros((frames, 3))
        unstable_frames: list[int] = []
        for frame in range(1, frames):
            dynamics.advance(frame * FRAME, level.steps, f"frame {frame} of {frames - 1}")
            displacements[frame] = slab.interpolation @ dynamics.displacement.reshape(-1, 3)
            forces[frame] = slab.gripper_force(potential.reaction)
            if frame % RENEWAL_INTERVAL == 0:
                # A wall under tension gets stiffer against bending out of its plane. Once that stiffness has
                # doubled, Newton's iterations with an old factorisation would amplify round-off there.
                newton.forget()
            if frame % STABILITY_INTERVAL == 0 and not slab.is_stable(law, dynamics.displacement):
                unstable_frames.append(frame)

        path = FRAME * np.arange(frames)[:, None] * velocity
        return Trajectory(
            positions=(surface().rest_positions + displacements).astype(np.float32),
            mesh=surface().mesh,
            material={
                "youngs_modulus": parameters.youngs_modulus,
                "poisson_ratio": parameters.poisson_ratio,
            },
            loads={
                "patch": np.array([parameters.patch], dtype=np.float32),
                "direction": parameters.direction.astype(np.float32),
            },
            collider_positions=(grasp_point(parameters.patch) + path)[:, None].astype(np.float32),
            diagnostics={
                **asdict(newton.statistics),
                "min_jacobian": dynamics.min_jacobian,
                "max_gripper_force_newton": 1e-6 * float(np.linalg.norm(forces, axis=1).max()),
                "max_asymmetry_mm": float(asymmetry(displacements).max()),
                "unstable_frames": len(unstable_frames),
                "first_unstable_frame": unstable_frames[0] if unstable_frames else 0,
            },
        )

    def check(self, trajectory: Trajectory) -> list[str]:
        """Finite, foot held, gripper followed, no cell crushed or turned over, no jump, no buckling."""
        positions = trajectory.positions.astype(np.float64)
        gripper = trajectory.collider_positions
        assert gripper is not None
        finite = np.isfinite(positions).all((1, 2)) & np.isfinite(gripper).all((1, 2))
        if not finite.all():
            return [problem(int(finite.argmin()), "positions are not finite", REMEDY)]
        problems = []
        mesh = trajectory.mesh
        displacements = positions - mesh.rest_positions
        path = gripper[:, 0].astype(np.float64) - gripper[0, 0]
        moved = np.abs(displacements[:, mesh.node_type == FIXED]).max((1, 2))
        if moved.any():
            problems.append(
                problem(int(moved.argmax()), f"a fixed node moves by {moved.max():.2g} mm", "hold it")
            )
        grasped = surface().grasped(int(trajectory.loads["patch"][0]))
        slip = np.abs(displacements[:, grasped] - path[:, None]).max((1, 2))
        if slip.max() > GRIPPER_TOLERANCE:
            what = f"a grasped node strays from the gripper by {slip.max():.2g} mm"
            problems.append(problem(int(slip.argmax()), what, "move it with the gripper"))
        normals = _area_vectors(positions, mesh.cells)
        areas = np.linalg.norm(normals, axis=-1)
        shares = (areas / areas[0]).min(1)
        crushed = np.flatnonzero(shares < MIN_CELL_AREA)
        if crushed.size:
            what = f"a cell is crushed to {shares[crushed[0]]:.2f} of its area"
            problems.append(problem(int(crushed[0]), what, REMEDY))
        turns = np.einsum("fci,fci->fc", normals[1:], normals[:-1]) / (areas[1:] * areas[:-1] + 1e-300)
        flipped = np.flatnonzero((turns <= 0).any(1))
        if flipped.size:
            angle = np.degrees(np.arccos(np.clip(turns[flipped[0]].min(), -1, 1)))
            problems.append(
                problem(int(flipped[0]) + 1, f"a cell turns over, by {angle:.0f} degrees in a frame", REMEDY)
            )
        found = trajectory.diagnostics
        if found["min_jacobian"] < MIN_JACOBIAN:
            what = f"the tissue is compressed to {found['min_jacobian']:.3f} of its volume"
            problems.append(problem(len(positions) - 1, what, REMEDY))
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(-1)
        allowed = MAX_STEP * np.linalg.norm(np.diff(path, axis=0), axis=-1).max() + GRIPPER_TOLERANCE
        jumps = np.flatnonzero(steps > allowed)
        if jumps.size:
            problems.append(problem(int(jumps[0]) + 1, f"a node jumps by {steps[jumps[0]]:.2f} mm", REMEDY))
        if found["unstable_frames"]:
            what = "the equilibrium is unstable (its stiffness is not positive definite): the wall may buckle"
            problems.append(problem(int(found["first_unstable_frame"]), what, REMEDY))
        out_of_plane = asymmetry(displacements)
        if out_of_plane.max() > MAX_ASYMMETRY:
            what = f"the wall buckles out of its plane, by {out_of_plane.max():.2g} mm"
            problems.append(problem(int(out_of_plane.argmax()), what, REMEDY))
        return problems

    def extreme_materials(self, parameters: TissueParameters) -> tuple[TissueParameters, TissueParameters]:
        """The same pull of the softest and of the stiffest of the materials."""
        soft, stiff = (
            replace(parameters, poisson_ratio=ratio, youngs_modulus=modulus)
            for ratio, modulus in (MATERIALS[0], MATERIALS[1])
        )
        return soft, stiff


@dataclass(frozen=True, eq=False)
class Surface:
    """The recorded surface at rest.

    Attributes:
        coordinates: of the vertices, shape [361, 3]: place across the outline (0 left, 1 right), y and z [mm].
        rest_positions: [mm], shape [361, 3], float64.
        mirrored: the vertex at the same place of the opposite face, shape [361].
        mesh: as recorded.
    """

    coordinates: Array
    rest_positions: Array
    mirrored: NDArray[np.int64]
    mesh: Mesh

    def grasped(self, patch: int) -> NDArray[np.bool_]:
        """Which vertices the gripper holds, shape [361]."""
        return in_patch(self.coordinates, patch)


@lru_cache
def surface() -> Surface:
    """The boundary of a lattice of 6 x 3 x 18 cells, one edge of its underside collapsed: 361 vertices."""
    nx, ny, below, above = LATTICE
    lines = (
        np.linspace(0, 1, nx + 1),
        np.linspace(-THICKNESS / 2, THICKNESS / 2, ny + 1),
        np.append(np.linspace(0, FIXED_HEIGHT, below + 1)[:-1], np.linspace(FIXED_HEIGHT, HEIGHT, above + 1)),
    )
    triangles, (lost, kept) = _lattice_boundary(nx, ny, below + above)
    triangles[triangles == lost] = kept
    corners = np.sort(triangles, axis=1)
    triangles = triangles[(np.diff(corners, axis=1) > 0).all(1)]
    vertices, cells = np.unique(triangles, return_inverse=True)

    z, y, x = np.unravel_index(vertices, (below + above + 1, ny + 1, nx + 1))
    coordinates = np.column_stack([lines[0][x], lines[1][y], lines[2][z]])
    coordinates[vertices == kept, 1] = 0.0  # amid the two vertices that have become one
    offset = coordinates[:, None] - coordinates * (1, -1, 1)
    rest = to_physical(coordinates)
    mesh = Mesh(
        rest_positions=rest.astype(np.float32),
        cells=cells.reshape(-1, 3).astype(np.int32),
        cell_type=VTK_TRIANGLE,
        node_type=np.where(coordinates[:, 2] <= FIXED_HEIGHT, FIXED, FREE).astype(np.uint8),
    )
    return Surface(coordinates, rest, (offset**2).sum(-1).argmin(1), mesh)


def _lattice_boundary(nx: int, ny: int, nz: int) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Two triangles per square of a lattice's boundary, outwards, and an edge amid the underside.

    Vertices of the lattice are numbered along x, then y, then z.
    """
    number = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nz + 1, ny + 1, nx + 1).transpose(2, 1, 0)
    triangles = []
    for axis in range(3):
        sides = np.moveaxis(number, (axis, (axis + 1) % 3, (axis + 2) % 3), (0, 1, 2))
        for side, outwards in ((sides[0], -1), (sides[-1], 1)):
            a, b, c, d = side[:-1, :-1], side[1:, :-1], side[1:, 1:], side[:-1, 1:]
            for triangle in ((a, b, c), (a, c, d)):
                triangles.append(np.stack(triangle, -1).reshape(-1, 3)[:, ::outwards])
    middle = number[nx // 2, :, 0]
    return np.concatenate(triangles), (int(middle[ny // 2 + 1]), int(middle[ny // 2]))


def to_physical(coordinates: Array) -> Array:
    """Places in the slab [mm] from those across the outline, y and z; shape [points, 3]."""
    across, y, z = coordinates.T
    left, right = PchipInterpolator(OUTLINE[:, 0], OUTLINE[:, 1:])(z).T
    return np.column_stack([left + across * (right - left), y, z])


def patch_start(patch: int) -> float:
    """Place of a patch's left end across the outline, from 0 to 1."""
    first, last = PATCH_CENTRES
    return first + (last - first) * patch / (PATCHES - 1) - PATCH_WIDTH / 2


def in_patch(coordinates: Array, patch: int) -> NDArray[np.bool_]:
    """Which points (place across the outline, y and z; shape [points, 3]) the gripper holds, shape [points]."""
    start, close = patch_start(patch), 1e-9
    across, _, z = coordinates.T
    held = (across > start - close) & (across < start + PATCH_WIDTH + close)
    return np.asarray(held & (z > HEIGHT - PATCH_HEIGHT - close * HEIGHT))


def grasp_point(patch: int) -> Array:
    """Centre of a patch at rest, where the gripper is recorded [mm], shape [3]."""
    centre = (patch_start(patch) + PATCH_WIDTH / 2, 0.0, HEIGHT - PATCH_HEIGHT / 2)
    return to_physical(np.array([centre]))[0]


@dataclass(frozen=True, eq=False)
class Slab:
    """The part of the tissue above its held foot, grasped at one patch, ready for many simulations.

    Attributes:
        body: the solid; its lowest nodes and those of the patch are prescribed.
        gripped: which of the prescribed degrees of freedom belong to the patch, shape [constrained].
        interpolation: nodal values of the solid to the recorded vertices (0 for those of the foot), shape
            [361, nodes].
    """

    body: ConstrainedSolid
    gripped: NDArray[np.bool_]
    interpolation: csr_matrix

    def prescribed(self, displacement: Array) -> Array:
        """Displacements of the prescribed degrees of freedom when the gripper has moved by that much."""
        return np.where(self.gripped, displacement[self.body.constrained % 3], 0.0)

    def gripper_force(self, reaction: Array) -> Array:
        """Force of the gripper on the tissue, shape [3], from the reaction, shape [constrained]."""
        return (reaction * self.gripped) @ (self.body.constrained[:, None] % 3 == np.arange(3))

    def is_stable(self, law: NeoHookean, u: Array) -> bool:
        """Whether the state u [dofs], held where it is prescribed, is a minimum of the stored energy alone.

        Newton's method may stay on the symmetric path beyond the point where it is no minimum any more; real
        tissue would not.
        """
        solid, assembler = self.body.solid, self.body.assembler
        stiffness = assembler.matrix(solid.element_stiffness(solid.response(u, law)))
        try:
            assembler.factorise(stiffness)
        except LinAlgError:
            return False
        return True


@lru_cache(maxsize=PATCHES)
def make_slab(patch: int, cells: tuple[int, int, int], element: str = "serendipity") -> Slab:
    """The slab with so many cells along x, y and z, whose lines run along the patch's edges."""
    nx, ny, nz = cells
    straight = MeshHex.init_tensor(
        _columns(patch, nx // 6),
        np.linspace(-THICKNESS / 2, THICKNESS / 2, ny + 1),
        np.linspace(FIXED_HEIGHT, HEIGHT, nz + 1),
    )
    shape_functions = ELEMENTS[element]
    straight_basis = Basis(straight, shape_functions, intorder=1)
    curved = MeshHex2.from_mesh(straight)
    curved = MeshHex2(np.ascontiguousarray(to_physical(curved.doflocs.T).T), curved.t)
    solid = Solid(curved, shape_functions, integration_order=CELL_ORDER)

    coordinates = straight_basis.doflocs.T
    held = in_patch(coordinates, patch)
    foot = coordinates[:, 2] < FIXED_HEIGHT + 1e-9 * HEIGHT
    body = ConstrainedSolid(solid, solid.dofs_of(np.flatnonzero(held | foot)))
    recorded = surface().coordinates
    above = np.flatnonzero(recorded[:, 2] > FIXED_HEIGHT)
    values = straight_basis.probes(recorded[above].T).tocoo()
    return Slab(
        body=body,
        gripped=held[body.constrained // 3],
        interpolation=csr_matrix(
            (values.data, (above[values.row], values.col)), (len(recorded), len(coordinates))
        ),
    )


def _columns(patch: int, parts: int) -> Array:
    """Lines between six columns of cells across the outline, one of them the patch's, each split in parts."""
    start = patch_start(patch)
    end = start + PATCH_WIDTH
    left = int(np.clip(round(6 * start), 1, 4))
    lines = np.concatenate([np.linspace(0, start, left + 1)[:-1], [start], np.linspace(end, 1, 6 - left)])
    return np.interp(np.arange(6 * parts + 1) / parts, np.arange(7), lines)


def asymmetry(displacements: Array) -> Array:
    """Largest deviation [mm] from symmetry in the wall's middle plane in each frame, shape [frames].

    Args:
        displacements: of the recorded vertices [mm], shape [frames, 361, 3].
    """
    mirrored = displacements[:, surface().mirrored] * (1, -1, 1)
    deviations: Array = np.linalg.norm(displacements - mirrored, axis=-1).max(-1)
    return deviations


def _area_vectors(positions: Array, cells: NDArray[np.int32]) -> Array:
    """Normals of the triangles times twice their areas, shape [frames, triangles, 3]."""
    corners = positions[:, cells]
    return np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
