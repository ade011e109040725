# mypy: ignore-errors
"""What `vbd` adds to a step of Newton's; written in the part of Python that Warp compiles."""

from m3gn_bench.generators.solvers.quiet_warp import wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def set_velocities(
    displacements: wp.array(dtype=wp.vec3), substep: wp.float32, velocities: wp.array(dtype=wp.vec3)
):
    node = wp.tid()
    velocities[node] = displacements[node] / substep
