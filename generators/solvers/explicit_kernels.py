# mypy: ignore-errors
"""What a tetrahedron and a node do in a step of `explicit`; written in the part of Python that Warp compiles."""

from m3gn_bench.generators.solvers.quiet_warp import wp

wp.set_module_options({"enable_backward": False})


@wp.func
def _deformation_gradient(
    x: wp.array(dtype=wp.vec3d), corners: wp.vec4i, inverse_edges: wp.mat33d
) -> wp.mat33d:
    origin = x[corners[0]]
    return (
        wp.matrix_from_cols(x[corners[1]] - origin, x[corners[2]] - origin, x[corners[3]] - origin)
        * inverse_edges
    )


@wp.kernel
def cell_volumes(
    x: wp.array(dtype=wp.vec3d),
    tetrahedra: wp.array(dtype=wp.vec4i),
    rest: wp.array(dtype=wp.mat33d),
    volumes: wp.array(dtype=wp.float64),
    current: wp.array(dtype=wp.float64),
):
    cell = wp.tid()
    current[cell] = wp.determinant(_deformation_gradient(x, tetrahedra[cell], rest[cell])) * volumes[cell]


@wp.kernel
def nodal_pressures(
    current: wp.array(dtype=wp.float64),
    start: wp.array(dtype=wp.int32),
    incident: wp.array(dtype=wp.int32),
    nodal_volumes: wp.array(dtype=wp.float64),
    lam: wp.float64,
    pressures: wp.array(dtype=wp.float64),
):
    node = wp.tid()
    volume = wp.float64(0.0)
    for entry in range(start[node], start[node + 1]):
        volume += current[incident[entry] // 4]
    ratio = wp.float64(0.25) * volume / nodal_volumes[node]
    pressures[node] = lam * (ratio - wp.float64(1.0))


@wp.func
def _stress(
    F: wp.mat33d, rate: wp.mat33d, pressure: wp.float64, mu: wp.float64, viscosity: wp.float64
) -> wp.mat33d:
    """First Piola-Kirchhoff stress where the deformation gradient changes at that rate."""
    zero = wp.float64(0.0)
    f1 = wp.vec3d(F[0, 0], F[1, 0], F[2, 0])
    f2 = wp.vec3d(F[0, 1], F[1, 1], F[2, 1])
    f3 = wp.vec3d(F[0, 2], F[1, 2], F[2, 2])
    c1 = wp.cross(f2, f3)
    dilatation = wp.dot(f1, c1) - wp.float64(1.0)
    cofactor = wp.matrix_from_cols(c1, wp.cross(f3, f1), wp.cross(f1, f2))
    second = wp.mat33d(mu, zero, zero, zero, mu, zero, zero, zero, mu)
    if viscosity > zero:
        strain_rate = wp.transpose(F) * rate
        # S = 2 eta dE/dt, dE/dt = sym(F^T dF/dt)
        second += (strain_rate + wp.transpose(strain_rate)) * viscosity
    return F * second + cofactor * (mu * dilatation - mu + pressure)


@wp.kernel
def corner_forces(
    x: wp.array(dtype=wp.vec3d),
    v: wp.array(dtype=wp.vec3d),
    tetrahedra: wp.array(dtype=wp.vec4i),
    rest: wp.array(dtype=wp.mat33d),
    volumes: wp.array(dtype=wp.float64),
    pressures: wp.array(dtype=wp.float64),
    mu: wp.float64,
    lam: wp.float64,
    viscosity: wp.float64,
    nodal_pressure: wp.bool,
    forces: wp.array(dtype=wp.vec3d),
):
    cell = wp.tid()
    corners = tetrahedra[cell]
    inverse_edges = rest[cell]
    F = _deformation_gradient(x, corners, inverse_edges)
    if nodal_pressure:
        pressure = wp.float64(0.25) * (
            pressures[corners[0]] + pressures[corners[1]] + pressures[corners[2]] + pressures[corners[3]]
        )
    else:
        pressure = lam * (wp.determinant(F) - wp.float64(1.0))
    rate = wp.mat33d()
    if viscosity > wp.float64(0.0):
        rate = _deformation_gradient(v, corners, inverse_edges)
    H = _stress(F, rate, pressure, mu, viscosity) * wp.transpose(inverse_edges * volumes[cell])
    a = wp.vec3d(H[0, 0], H[1, 0], H[2, 0])
    b = wp.vec3d(H[0, 1], H[1, 1], H[2, 1])
    c = wp.vec3d(H[0, 2], H[1, 2], H[2, 2])
    forces[4 * cell] = a + b + c
    forces[4 * cell + 1] = -a
    forces[4 * cell + 2] = -b
    forces[4 * cell + 3] = -c


@wp.func
def _quadratic_gradient(
    x: wp.array(dtype=wp.vec3d),
    nodes: wp.array2d(dtype=wp.int32),
    gradients: wp.array2d(dtype=wp.vec3d),
    cell: int,
    point: int,
    inverse_edges: wp.mat33d,
) -> wp.mat33d:
    """Of a field x with respect to the place at rest, at a Gauss point."""
    reference = wp.mat33d()
    for k in range(10):
        reference += wp.outer(x[nodes[cell, k]], gradients[point, k])
    return reference * inverse_edges


@wp.kernel
def quadratic_forces(
    x: wp.array(dtype=wp.vec3d),
    v: wp.array(dtype=wp.vec3d),
    nodes: wp.array2d(dtype=wp.int32),
    gradients: wp.array2d(dtype=wp.vec3d),
    rest: wp.array(dtype=wp.mat33d),
    volumes: wp.array(dtype=wp.float64),
    mu: wp.float64,
    lam: wp.float64,
    viscosity: wp.float64,
    forces: wp.array(dtype=wp.vec3d),
):
    cell = wp.tid()
    inverse_edges = rest[cell]
    share = wp.float64(0.25)  # of each Gauss point
    ratio = wp.float64(0.0)
    for point in range(4):
        ratio += share * wp.determinant(_quadratic_gradient(x, nodes, gradients, cell, point, inverse_edges))
    pressure = lam * (ratio - wp.float64(1.0))
    for k in range(10):
        forces[10 * cell + k] = wp.vec3d()
    for point in range(4):
        F = _quadratic_gradient(x, nodes, gradients, cell, point, inverse_edges)
        rate = wp.mat33d()
        if viscosity > wp.float64(0.0):
            rate = _quadratic_gradient(v, nodes, gradients, cell, point, inverse_edges)
        H = _stress(F, rate, pressure, mu, viscosity) * wp.transpose(inverse_edges * (share * volumes[cell]))
        for k in range(10):
            forces[10 * cell + k] = forces[10 * cell + k] - H * gradients[point, k]


@wp.kernel
def move(
    forces: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.int32),
    incident: wp.array(dtype=wp.int32),
    inverse_masses: wp.array(dtype=wp.float64),
    gravity: wp.float64,
    friction: wp.float64,
    floor: wp.bool,
    substep: wp.float64,
    x: wp.array(dtype=wp.vec3d),
    v: wp.array(dtype=wp.vec3d),
):
    node = wp.tid()
    inverse_mass = inverse_masses[node]
    if inverse_mass == wp.float64(0.0):
        return
    force = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for entry in range(start[node], start[node + 1]):
        force += forces[incident[entry]]
    u = v[node] + force * (substep * inverse_mass)
    u = wp.vec3d(u[0], u[1], u[2] - gravity * substep)
    arrival = -x[node][2] / substep  # the velocity with which the node just reaches the floor
    y = x[node] + u * substep
    if floor and u[2] < arrival:
        impulse = arrival - u[2]
        sliding = wp.sqrt(u[0] * u[0] + u[1] * u[1])
        kept = wp.float64(0.0)
        if sliding > friction * impulse:
            kept = wp.float64(1.0) - friction * impulse / sliding
        u = wp.vec3d(u[0] * kept, u[1] * kept, arrival)
        y = x[node] + u * substep
        y = wp.vec3d(y[0], y[1], wp.float64(0.0))  # so that not even round-off passes the floor
    v[node] = u
    x[node] = y
