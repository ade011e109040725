"""Six soft toys as signed distance fields: smooth unions of ellipsoids, capsules and a rounded box.

A field maps points of shape [..., 3] to values of shape [...], negative inside; its zero level is the surface.
z points up, the toys look towards -y, and a toy is about 1 high or long. Features stay thicker than about 0.1,
because 304 surface nodes cannot carry finer ones. The primitives and the polynomial smooth minimum are the
customary ones of constructive solid geometry (e.g. Quilez, "Distance functions"); the toys are our own.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Field = Callable[[Array], Array]


def ellipsoid(points: Array, centre: ArrayLike, radii: ArrayLike) -> Array:
    """First-order distance to an axis-aligned ellipsoid: exact at the surface, which is all that is used."""
    scaled = (points - np.asarray(centre)) / np.asarray(radii)
    norm = np.linalg.norm(scaled, axis=-1)
    gradient = np.linalg.norm(scaled / np.asarray(radii), axis=-1)
    return norm * (norm - 1) / np.maximum(gradient, 1e-9)


def capsule(points: Array, start: ArrayLike, end: ArrayLike, radius: float, end_radius: float) -> Array:
    """Distance to a segment less a radius that varies linearly along it."""
    axis = np.asarray(end, float) - np.asarray(start, float)
    offset = points - np.asarray(start)
    along = np.clip(offset @ axis / (axis @ axis), 0, 1)
    distance = np.linalg.norm(offset - along[..., None] * axis, axis=-1)
    return distance - (radius + (end_radius - radius) * along)


def rounded_box(points: Array, centre: ArrayLike, half_sides: ArrayLike, rounding: float) -> Array:
    """Distance to a box whose edges are rounded; `half_sides` include the rounding."""
    outside = np.abs(points - np.asarray(centre)) - (np.asarray(half_sides) - rounding)
    return np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(-1), 0) - rounding


def smooth_union(fields: list[Array], blend: float) -> Array:
    """Union with fillets of about the size `blend`: the polynomial smooth minimum, taken in turn."""
    union, *others = fields
    for other in others:
        weight = np.clip(0.5 + 0.5 * (other - union) / blend, 0, 1)
        union = other * (1 - weight) + union * weight - blend * weight * (1 - weight)
    return union


def teddy(points: Array) -> Array:
    """A sitting teddy: round ears and belly, a muzzle, arms held out, legs stretched forward."""
    parts = [
        ellipsoid(points, (0, 0, 0.34), (0.26, 0.23, 0.30)),  # body
        ellipsoid(points, (0, -0.02, 0.76), (0.24, 0.21, 0.20)),  # head
        ellipsoid(points, (0, -0.23, 0.70), (0.115, 0.11, 0.09)),  # muzzle
    ]
    for side in (-1, 1):
        parts += [
            ellipsoid(points, (side * 0.235, 0, 0.965), (0.125, 0.075, 0.125)),  # ear
            capsule(points, (side * 0.20, -0.04, 0.54), (side * 0.38, -0.16, 0.40), 0.085, 0.095),  # arm
            capsule(points, (side * 0.13, -0.05, 0.13), (side * 0.24, -0.36, 0.12), 0.11, 0.115),  # leg
            ellipsoid(points, (side * 0.25, -0.40, 0.15), (0.115, 0.085, 0.14)),  # foot
        ]
    return smooth_union(parts, 0.025)


def bunny(points: Array) -> Array:
    """A sitting bunny: long upright ears, a pear-shaped body, haunches, forepaws and a ball of a tail."""
    parts = [
        ellipsoid(points, (0, 0.06, 0.23), (0.20, 0.25, 0.23)),  # rump
        ellipsoid(points, (0, -0.06, 0.30), (0.15, 0.15, 0.27)),  # chest
        ellipsoid(points, (0, -0.13, 0.60), (0.15, 0.17, 0.14)),  # head
        ellipsoid(points, (0, -0.27, 0.57), (0.075, 0.06, 0.06)),  # snout
        ellipsoid(points, (0, 0.34, 0.17), (0.10, 0.10, 0.10)),  # tail
    ]
    for side in (-1, 1):
        parts += [
            capsule(points, (side * 0.06, -0.08, 0.70), (side * 0.14, -0.01, 0.98), 0.055, 0.08),  # ear
            ellipsoid(points, (side * 0.17, 0.04, 0.17), (0.09, 0.17, 0.16)),  # haunch
            capsule(
                points, (side * 0.17, 0.02, 0.065), (side * 0.205, -0.09, 0.065), 0.065, 0.065
            ),  # hind foot
            capsule(points, (side * 0.065, -0.14, 0.32), (side * 0.06, -0.20, 0.065), 0.06, 0.065),  # forepaw
        ]
    return smooth_union(parts, 0.035)


def gummy_bear(points: Array) -> Array:
    """A standing gummy bear: stout, small round ears, a blunt snout, stubs of arms and legs held forward."""
    parts = [
        ellipsoid(points, (0, 0, 0.38), (0.24, 0.19, 0.32)),  # body
        ellipsoid(points, (0, -0.02, 0.77), (0.19, 0.17, 0.17)),  # head
        ellipsoid(points, (0, -0.19, 0.73), (0.10, 0.10, 0.08)),  # snout
    ]
    for side in (-1, 1):
        parts += [
            ellipsoid(points, (side * 0.175, -0.01, 0.935), (0.105, 0.08, 0.105)),  # ear
            capsule(points, (side * 0.18, -0.06, 0.54), (side * 0.17, -0.22, 0.47), 0.085, 0.085),  # arm
            capsule(points, (side * 0.13, -0.02, 0.14), (side * 0.14, -0.19, 0.10), 0.125, 0.11),  # leg
        ]
    return smooth_union(parts, 0.04)


def _worm(points: Array, curve: Array, ridges: int) -> Array:
    """A tube around a curve [stations, 3] whose radius swells `ridges` times and tapers towards both ends."""
    arc = np.linspace(0, 1, len(curve))
    taper = 0.8 + 0.2 * np.clip(np.minimum(arc, 1 - arc) / 0.08, 0, 1)
    radii = 0.09 * taper * (1 - 0.24 * np.cos(2 * np.pi * ridges * arc))
    tube = [
        capsule(points, start, end, radius, end_radius)
        for start, end, radius, end_radius in zip(curve, curve[1:], radii, radii[1:], strict=False)
    ]
    return np.min(tube, axis=0)


def gummy_worm_1(points: Array) -> Array:
    """A ridged worm lying in the shape of an S."""
    arc = np.linspace(-1, 1, 81)
    curve = np.c_[0.42 * arc, 0.15 * np.sin(np.pi * arc), np.full_like(arc, 0.5)]
    return _worm(points, curve, ridges=6)


def gummy_worm_2(points: Array) -> Array:
    """A ridged worm bent to a C, one end lifted above the other."""
    angle = np.linspace(-0.68, 0.68, 81) * np.pi
    curve = np.c_[0.34 * np.sin(angle), 0.34 * np.cos(angle), 0.5 + 0.10 * angle / np.pi]
    return _worm(points, curve, ridges=7)


def traffic_cone(points: Array) -> Array:
    """A traffic cone: a round, blunt cone on a square plate with rounded corners."""
    plate = rounded_box(points, (0, 0, 0.06), (0.32, 0.32, 0.06), 0.02)
    cone = capsule(points, (0, 0, 0.05), (0, 0, 0.92), 0.225, 0.075)
    return np.maximum(
        smooth_union([plate, cone], 0.03), -points[..., 2]
    )  # the capsule's lower end is cut off


SHAPES: dict[str, Field] = {
    "teddy": teddy,
    "bunny": bunny,
    "gummy_bear": gummy_bear,
    "gummy_worm_1": gummy_worm_1,
    "gummy_worm_2": gummy_worm_2,
    "traffic_cone": traffic_cone,
}
