"""Sheet Deformation: a clamped elastic sheet under two growing forces.

A square sheet, clamped along its border, carries two transverse forces whose magnitude grows linearly from
zero. The path is quasi-static: no inertia, no viscosity, no contact, no gravity. What is left is the energy
of a geometrically nonlinear Kirchhoff-Love plate; slopes reach 0.5, so small-slope theories do not do.
The load's place and sign and Young's modulus vary. Source: paper, sections 5 and C; the sheet's size,
thickness, Poisson's ratio and load history follow the description of the original Abaqus data.
"""

from dataclasses import asdict, dataclass, replace
from typing import ClassVar

import numpy as np

from m3gn_bench.datasets.schema import Split
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.generators.errors import problem
from m3gn_bench.generators.scene import Leveled, SimulatedWithScikitFem
from m3gn_bench.generators.solvers.newton import ModifiedNewton
from m3gn_bench.generators.solvers.plate import ClampedPlate
from m3gn_bench.generators.solvers.quasistatic import load_path

SIDE = 140.0  # [mm]
THICKNESS = 2.0  # [mm]
POISSON_RATIO = 0.3
NODES_PER_SIDE = 15  # recorded; 10 mm apart
BORDER_LAYER = (
    3.0  # [mm], a further line of nodes; at E = 10 MPa the sheet bends within about 2 mm of its clamp
)
FORCE = 200.0  # [N], each of the two
LOAD_RADIUS = 10.0  # [mm]
LOAD_MARGIN = 20.0  # [mm], forces keep this distance from the border
INCREMENTS = 50
YOUNGS_MODULI = (10.0, 30.0, 60.0, 100.0, 180.0, 320.0, 500.0, 750.0, 1000.0)  # [MPa]
IN_DISTRIBUTION = (60.0, 500.0)  # [MPa], the training range of the out-of-distribution task

# A St. Venant-Kirchhoff bar loses stability in compression at the stretch 1/sqrt(3). Two opposite forces side
# by side on the softest sheet reach a strain of -0.16 and, in tension, where the law is stable, of 0.5.
MIN_PRINCIPAL_STRAIN = -1 / 3
REMEDY = "use a smaller force, a stiffer sheet, or keep forces further from the border and from each other"
SNAP_MARGIN = 1e-3  # [mm], below which a step is round-off of float32 positions


@dataclass(frozen=True)
class SheetParameters:
    """One draw: E [MPa], centres of the forces [mm] and their signed magnitudes [N]."""

    youngs_modulus: float
    centres: tuple[tuple[float, float], tuple[float, float]]
    forces: tuple[float, float]


@dataclass(frozen=True)
class SheetFidelity:
    """Discretisation: parts into which each element of the scene's mesh is split along either direction,
    Newton's tolerance relative to the load, and whether there is a line of nodes close to the border."""

    refinement: int
    tolerance: float
    border_layer: bool = True


@dataclass(frozen=True)
class SheetDeformation(Leveled, SimulatedWithScikitFem):
    """The scene. Positions in mm, moduli in MPa, forces in N; a frame is 1/50 of the load."""

    name: ClassVar[str] = "sheet_deformation"
    dataset_version: ClassVar[str] = "2.0"
    tasks: ClassVar[tuple[str, ...]] = ("sheet_deformation", "sheet_deformation_ood")
    paper_sizes: ClassVar[dict[Split, int]] = {"train": 630, "validation": 135, "test": 135}
    frames: ClassVar[int] = INCREMENTS + 1
    dt: ClassVar[float] = 1 / INCREMENTS
    time_unit: ClassVar[str] = "fraction of the full load"
    length_unit: ClassVar[str] = "mm"
    material_units: ClassVar[dict[str, str]] = {"youngs_modulus": "MPa"}
    load_units: ClassVar[dict[str, str]] = {"nodal_forces": "N", "centres": "mm", "forces": "N"}
    scale_centre: ClassVar[tuple[float, ...]] = (SIDE / 2, SIDE / 2, 0.0)
    scale_length: ClassVar[float] = SIDE / 2
    variant: ClassVar[dict[str, str]] = {}
    fidelities: ClassVar[dict[str, SheetFidelity]] = {
        "fast": SheetFidelity(refinement=1, tolerance=1e-3, border_layer=False),
        "default": SheetFidelity(refinement=1, tolerance=1e-4),
        "reference": SheetFidelity(refinement=2, tolerance=1e-8),
    }

    def sample(self, rng: np.random.Generator, index: int) -> SheetParameters:
        """Centres uniform over the sheet without its margin, signs fair, E cycling with the index."""
        centres = rng.uniform(LOAD_MARGIN, SIDE - LOAD_MARGIN, (2, 2)).tolist()
        signs = rng.choice([-1.0, 1.0], 2)
        return SheetParameters(
            youngs_modulus=YOUNGS_MODULI[index % len(YOUNGS_MODULI)],
            centres=(tuple(centres[0]), tuple(centres[1])),
            forces=(float(signs[0]) * FORCE, float(signs[1]) * FORCE),
        )

    def simulate_with(
        self, parameters: SheetParameters, level: SheetFidelity, frames: int | None = None
    ) -> Trajectory:
        """Equilibria at 0, 1/50, 2/50, ... of the load, 51 of them if not told otherwise.

        Raises:
            SolverError: the equilibrium path is lost.
        """
        increments = (self.frames if frames is None else frames) - 1
        plate = self.plate(parameters.youngs_modulus, level.refinement, level.border_layer)
        load = self._load(plate, parameters)
        newton = ModifiedNewton(plate, tolerance=level.tolerance)
        applied = load[plate.assembler.free] * (increments / INCREMENTS)
        states = load_path(newton, applied, increments)

        recorded, mesh = self._recorded(plate)
        positions = plate.nodes[recorded] + plate.displacements(states)[:, recorded]
        # Models see the load's work-conjugate share on the recorded nodes, whatever mesh was computed on.
        if level.refinement == 1 and level.border_layer:
            nodal_forces = plate.nodal_values(load)[recorded]
        else:
            coarse = self.plate(parameters.youngs_modulus, 1)
            nodal_forces = coarse.nodal_values(self._load(coarse, parameters))[self._recorded(coarse)[0]]
        strains = plate.principal_membrane_strains(states[-1])
        return Trajectory(
            positions=positions.astype(np.float32),
            mesh=mesh,
            material={"youngs_modulus": parameters.youngs_modulus},
            loads={
                "nodal_forces": nodal_forces.astype(np.float32),
                "centres": np.array(parameters.centres, dtype=np.float32),
                "forces": np.array(parameters.forces, dtype=np.float32),
            },
            diagnostics={
                **asdict(newton.statistics),
                "min_principal_strain": float(strains.min()),
                "max_principal_strain": float(strains.max()),
            },
        )

    def check(self, trajectory: Trajectory) -> list[str]:
        """Finite, clamped, no cell folded over, no snap, material stable."""
        positions = trajectory.positions.astype(np.float64)
        finite = np.isfinite(positions).all((1, 2))
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
        normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
        upwards = normals[..., 2].min(1)
        if upwards.min() <= 0:
            frame = int(np.flatnonzero(upwards <= 0)[0])
            problems.append(
                problem(frame, f"a cell folds over (its projected area is {upwards[frame]:.2g} mm²)", REMEDY)
            )
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1).max(-1)
        # The sheet stiffens as it deflects, so every increment moves it less than the one before.
        snaps = np.flatnonzero(steps[1:] > 1.5 * steps[:-1] + SNAP_MARGIN)
        if snaps.size:
            before, after = steps[snaps[0]], steps[snaps[0] + 1]
            problems.append(
                problem(
                    int(snaps[0]) + 2,
                    f"the sheet snaps: a node moves by {after:.2g} mm after {before:.2g} mm in the frame before",
                    REMEDY,
                )
            )
        strain = trajectory.diagnostics["min_principal_strain"]
        if strain < MIN_PRINCIPAL_STRAIN:
            problems.append(
                problem(
                    len(positions) - 1,
                    f"compressive membrane strain {strain:.3f}, beyond the material law's stability at "
                    f"{MIN_PRINCIPAL_STRAIN:.3f}",
                    REMEDY,
                )
            )
        return problems

    def extreme_materials(self, parameters: SheetParameters) -> tuple[SheetParameters, SheetParameters]:
        """The same forces on the softest and on the stiffest sheet."""
        return (
            replace(parameters, youngs_modulus=YOUNGS_MODULI[0]),
            replace(parameters, youngs_modulus=YOUNGS_MODULI[-1]),
        )

    def tasks_of(self, split: Split, material: dict[str, float]) -> list[str]:
        """All take part in the main task; the other one trains inside E's range and tests outside it."""
        lower, upper = IN_DISTRIBUTION
        inside = lower <= material["youngs_modulus"] <= upper
        return list(self.tasks) if inside == (split != "test") else [self.name]

    def task_size(self, task: str, split: Split, trajectories: int) -> int:
        """E cycles with the index, so this needs no simulation."""
        moduli = [YOUNGS_MODULI[i % len(YOUNGS_MODULI)] for i in range(trajectories)]
        return sum(task in self.tasks_of(split, {"youngs_modulus": modulus}) for modulus in moduli)

    def plate(self, youngs_modulus: float, refinement: int, border_layer: bool = True) -> ClampedPlate:
        """The sheet's plate, each element split into `refinement` parts along either direction."""
        ticks = np.linspace(0, SIDE, NODES_PER_SIDE)
        if border_layer:
            ticks = np.union1d(ticks, [BORDER_LAYER, SIDE - BORDER_LAYER])
        parts = np.arange(refinement) / refinement
        fine = (ticks[:-1, None] + np.diff(ticks)[:, None] * parts).ravel()
        return ClampedPlate(
            ticks=np.append(fine, SIDE),
            thickness=THICKNESS,
            youngs_modulus=youngs_modulus,
            poisson_ratio=POISSON_RATIO,
        )

    def _load(self, plate: ClampedPlate, parameters: SheetParameters) -> np.ndarray:
        """Both forces at full magnitude, over all degrees of freedom of the plate."""
        load = np.zeros(plate.dofs)
        for centre, force in zip(parameters.centres, parameters.forces, strict=True):
            load += plate.disc_load(centre, LOAD_RADIUS, (0.0, 0.0, force))
        return load

    def _recorded(self, plate: ClampedPlate) -> tuple[np.ndarray, Mesh]:
        """Indices of the recorded nodes in the plate (row by row in y), and the recorded mesh."""
        ticks = np.linspace(0, SIDE, NODES_PER_SIDE)
        rest = np.array([(x, y, 0.0) for y in ticks for x in ticks])
        nearest = np.linalg.norm(plate.nodes[None, :, :2] - rest[:, None, :2], axis=-1)
        recorded = nearest.argmin(1)
        cells = []
        for row in range(NODES_PER_SIDE - 1):
            for column in range(NODES_PER_SIDE - 1):
                a = row * NODES_PER_SIDE + column
                b, c, d = a + 1, a + NODES_PER_SIDE + 1, a + NODES_PER_SIDE
                cells += [(a, b, c), (a, c, d)]
        mesh = Mesh(
            rest_positions=rest.astype(np.float32),
            cells=np.array(cells, dtype=np.int32),
            cell_type=VTK_TRIANGLE,
            node_type=np.where(plate.border[recorded], FIXED, FREE).astype(np.uint8),
        )
        return recorded, mesh
