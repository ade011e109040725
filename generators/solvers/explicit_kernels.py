# mypy: ignore-errors
"""What a tetrahedron and a node do in a step of `explicit`; written in the part of Python that Warp compiles.

Cells and nodes may be those of several solids, so what differs between solids is an array.
"""

from m3gn_bench.generators.solvers import tetrahedra as mesh
from m3gn_bench.generators.solvers.quiet_warp import wp

NEAR, FAR = wp.constant(wp.float64(mesh.NEAR)), wp.constant(wp.float64(mesh.FAR))

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
    lam: wp.array(dtype=wp.float64),
    pressures: wp.array(dtype=wp.float64),
):
    node = wp.tid()
    volume = wp.float64(0.0)
    for entry in range(start[node], start[node + 1]):
        volume += current[incident[entry] // 4]
    ratio = wp.float64(0.25) * volume / nodal_volumes[node]
    pressures[node] = lam[node] * (ratio - wp.float64(1.0))


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
    mu: wp.array(dtype=wp.float64),
    lam: wp.array(dtype=wp.float64),
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
        pressure = lam[cell] * (wp.determinant(F) - wp.float64(1.0))
    rate = wp.mat33d()
    if viscosity > wp.float64(0.0):
        rate = _deformation_gradient(v, corners, inverse_edges)
    H = _stress(F, rate, pressure, mu[cell], viscosity) * wp.transpose(inverse_edges * volumes[cell])
    a = wp.vec3d(H[0, 0], H[1, 0], H[2, 0])
    b = wp.vec3d(H[0, 1], H[1, 1], H[2, 1])
    c = wp.vec3d(H[0, 2], H[1, 2], H[2, 2])
    forces[4 * cell] = a + b + c
    forces[4 * cell + 1] = -a
    forces[4 * cell + 2] = -b
    forces[4 * cell + 3] = -c


@wp.func
def _corner_gradients(x: wp.array(dtype=wp.vec3d), nodes: wp.array2d(dtype=wp.int32), cell: int):
    """Of a quadratic field with respect to the unit tetrahedron, at its four corners.

    The field's derivative towards corner j is 4 (its node between here and j - its node between here and 0) less
    the difference of the two corners, where the node between a corner and itself is the corner.
    """
    x0, x1, x2, x3 = x[nodes[cell, 0]], x[nodes[cell, 1]], x[nodes[cell, 2]], x[nodes[cell, 3]]
    x01, x02, x03 = x[nodes[cell, 4]], x[nodes[cell, 5]], x[nodes[cell, 6]]
    x12, x13, x23 = x[nodes[cell, 7]], x[nodes[cell, 8]], x[nodes[cell, 9]]
    four = wp.float64(4.0)
    linear = wp.matrix_from_cols(x1 - x0, x2 - x0, x3 - x0)
    return (
        four * wp.matrix_from_cols(x01 - x0, x02 - x0, x03 - x0) - linear,
        four * wp.matrix_from_cols(x1 - x01, x12 - x01, x13 - x01) - linear,
        four * wp.matrix_from_cols(x12 - x02, x2 - x02, x23 - x02) - linear,
        four * wp.matrix_from_cols(x13 - x03, x23 - x03, x3 - x03) - linear,
    )


@wp.func
def _at_gauss_points(a: wp.mat33d, b: wp.mat33d, c: wp.mat33d, d: wp.mat33d):
    """What has these values at corners and is linear between them, at Gauss points; also the transpose of that."""
    rest = FAR * (a + b + c + d)
    own = NEAR - FAR
    return rest + own * a, rest + own * b, rest + own * c, rest + own * d


@wp.func
def _by_slopes(A: wp.mat33d):
    """The matrix times the gradients of the four barycentric coordinates."""
    first = wp.vec3d(A[0, 0], A[1, 0], A[2, 0])
    second = wp.vec3d(A[0, 1], A[1, 1], A[2, 1])
    third = wp.vec3d(A[0, 2], A[1, 2], A[2, 2])
    return -(first + second + third), first, second, third


@wp.kernel
def quadratic_forces(
    x: wp.array(dtype=wp.vec3d),
    v: wp.array(dtype=wp.vec3d),
    nodes: wp.array2d(dtype=wp.int32),
    rest: wp.array(dtype=wp.mat33d),
    volumes: wp.array(dtype=wp.float64),
    mu: wp.array(dtype=wp.float64),
    lam: wp.array(dtype=wp.float64),
    viscosity: wp.float64,
    forces: wp.array(dtype=wp.vec3d),
):
    cell = wp.tid()
    inverse_edges = rest[cell]
    share = wp.float64(0.25)  # of each Gauss point
    r0, r1, r2, r3 = _corner_gradients(x, nodes, cell)
    g0, g1, g2, g3 = _at_gauss_points(r0, r1, r2, r3)
    F0, F1, F2, F3 = g0 * inverse_edges, g1 * inverse_edges, g2 * inverse_edges, g3 * inverse_edges
    ratio = share * (wp.determinant(F0) + wp.determinant(F1) + wp.determinant(F2) + wp.determinant(F3))
    pressure = lam[cell] * (ratio - wp.float64(1.0))
    w0, w1, w2, w3 = wp.mat33d(), wp.mat33d(), wp.mat33d(), wp.mat33d()
    if viscosity > wp.float64(0.0):
        s0, s1, s2, s3 = _corner_gradients(v, nodes, cell)
        u0, u1, u2, u3 = _at_gauss_points(s0, s1, s2, s3)
        w0, w1, w2, w3 = u0 * inverse_edges, u1 * inverse_edges, u2 * inverse_edges, u3 * inverse_edges
    back = wp.transpose(inverse_edges * (share * volumes[cell]))
    H0 = _stress(F0, w0, pressure, mu[cell], viscosity) * back
    H1 = _stress(F1, w1, pressure, mu[cell], viscosity) * back
    H2 = _stress(F2, w2, pressure, mu[cell], viscosity) * back
    H3 = _stress(F3, w3, pressure, mu[cell], viscosity) * back
    # Shape functions of barycentric coordinates l, m: l (2 l - 1) of a corner, 4 l m of an edge.
    K0, K1, K2, K3 = _at_gauss_points(H0, H1, H2, H3)
    t0, t1, t2, t3 = _by_slopes(H0 + H1 + H2 + H3)
    a0, a1, a2, a3 = _by_slopes(K0)
    b0, b1, b2, b3 = _by_slopes(K1)
    c0, c1, c2, c3 = _by_slopes(K2)
    d0, d1, d2, d3 = _by_slopes(K3)
    four = wp.float64(4.0)
    first = 10 * cell
    forces[first] = t0 - four * a0
    forces[first + 1] = t1 - four * b1
    forces[first + 2] = t2 - four * c2
    forces[first + 3] = t3 - four * d3
    forces[first + 4] = -four * (a1 + b0)
    forces[first + 5] = -four * (a2 + c0)
    forces[first + 6] = -four * (a3 + d0)
    forces[first + 7] = -four * (b2 + c1)
    forces[first + 8] = -four * (b3 + d1)
    forces[first + 9] = -four * (c3 + d2)


@wp.kernel
def move(
    forces: wp.array(dtype=wp.vec3d),
    start: wp.array(dtype=wp.int32),
    incident: wp.array(dtype=wp.int32),
    inverse_masses: wp.array(dtype=wp.float64),
    gravity: wp.float64,
    friction: wp.float64,
    floor: wp.bool,
    substeps: wp.array(dtype=wp.float64),
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
    substep = substeps[node]
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
