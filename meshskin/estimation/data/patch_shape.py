"""The curvature of the body over a contact patch, in place of that at the contact point.

A patch presses on all of the surface under it: beside a fillet, between the flat faces of a coarse
mesh and along its long thin faces the curvature at one point is not the patch's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ...core.se3 import orthonormal_basis
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ...scene.belief import Belief

MAX_HOLLOWS = 0.5
"""Largest part of the contacts in hollows tighter than the indenter, as at the creases of a mesh:
more are a body that the indenter does not fit."""
HOLLOW = 0.9
"""Curvature, relative to the indenter's, that hollows tighter than it are believed to have."""
RIM = 2.0
"""Radius, in that of the typical patch, at which the body is compared with quadrics: a layer's
patches and those of a softer skin than believed are that wide."""
SPOKES = 6
"""Points on each of the two rings over a patch: with its middle 13 heights for the 6 terms of a
quadric."""


def _rings() -> Array:
    """Points (1 + 2 SPOKES, 2) on rings of half the radius of a patch, and of the radius."""
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    turned = angle + np.pi / SPOKES
    inner = 0.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    outer = np.column_stack([np.cos(turned), np.sin(turned)])
    return np.concatenate([np.zeros((1, 2)), inner, outer])


PLACES = _rings()
"""Places (k, 2) of the heights over a patch, relative to its radius."""
QUADRIC = np.linalg.pinv(
    np.column_stack(
        [
            np.ones(len(PLACES)),
            PLACES,
            PLACES[:, 0] ** 2 / 2,
            PLACES[:, 0] * PLACES[:, 1],
            PLACES[:, 1] ** 2 / 2,
        ]
    )
)
"""Matrix (6, k) from the heights at PLACES to the terms of the quadric nearest to them."""
OVER_PATCH = np.concatenate(
    [
        1.3 * np.sqrt((ring + 0.5) / 6) * np.column_stack([np.cos(angle), np.sin(angle)])
        for ring in range(6)
        for angle in [2 * np.pi * (np.arange(12) + ring % 2 / 2) / 12]
    ]
)
"""Places (72, 2) of equal areas over a patch and beyond its rim, relative to its radius."""
SPRINGS = 2**0.5
"""Radius of the patch of a foundation of springs, in that of Hertz' of the same depth."""
WIDEST = 0.7
"""Radius of such a patch, in that of the indenter, at most."""
EDGE = 0.05
"""Unevenness from which contacts are over an edge. Smooth bodies have less where their curvature
jumps (0.044 where the caps of bodies/capsule.toml begin) or changes (0.002 on its torus); and the
contact models themselves hold to some percent of the peak (layered.py)."""
SMOOTH = 2e-3
"""Unevenness up to which a body counts as smooth: that of bodies/torus.toml; a sphere has 4e-5, as
heights grow with the fourth power, too. It differs little from contact to contact there, so that
readings could not tell errors by it from noise."""
EDGE_ERROR = 1 / 3
"""Rms error of a contact model's readings in contacts over an edge, relative to the unevenness:
0.26 to 0.33 for thin layers on link meshes, 0.19 for the prism of test_edges.py (residuals, which
taxels follow), 0.16 to 0.25 in simulated recordings."""
ALIKE = 0.3
"""Distance, in contact radii, within which contacts over an edge share the error of the model: with
it stated errors of 600 and 2,000 contacts on the prism of test_edges.py are 0.78 to 1.8 times the
true ones by joint estimate, trilateration and pose graph, with 0.25 0.69 to 1.7, with 1/3 0.81 to
2.1, and with none 0.38 to 0.99 (recordings 1 to 3 there, elliptic and layered)."""
MAX_EDGES = 0.9
"""Largest part of the contacts over edges: residuals of the others, some ten of a usual recording
at least, tell of noise and model."""
GRAZING = 1e-6
"""Sine of the elevation over the surface within which the normal there does not tell the side of a
point in a tangent plane: far above rounding."""
LIFT = 1e-3
"""Elevation of such a point, in distances to the surface, at which the normal tells its side."""


def unevenness(belief: Belief, hit: Closest, radius: Array | float) -> Array:
    """Heights (m,), rms, by which the body departs from the quadrics of the contacts `hit` at RIM
    of patches of `radius` (m,), m, relative to the depth of a ball's impression there.

    Where the body has an edge within a patch no quadric describes it: pressures there differ from
    those of any contact model by about this part of the peak, which is what a thin layer's do. A
    surface that is SMOOTH has 0.
    """
    if not hasattr(belief.body, "surface") or not len(hit.point):
        return np.zeros(len(hit.point))
    size = np.broadcast_to(RIM * np.asarray(radius), len(hit.point))
    rim = PLACES[1 + SPOKES :] * size[:, None, None]
    across = np.cross(hit.normal, hit.direction)
    basis = np.stack([hit.direction, across, hit.normal], axis=2)
    quadric = 0.5 * np.einsum("mc,mpc->mp", hit.curvature, rim**2)
    apart = _heights(belief.body, hit, basis, rim) - quadric
    found = np.sqrt(np.mean(apart**2, axis=1)) * belief.indenter.radius / size**2
    return np.where(found > SMOOTH, found, 0.0)


def patch_shifts(belief: Belief, hit: Closest, radius: Array) -> Array:
    """Displacements (m, 3), m, of the centres of pressure along the surface from the contact points
    `hit`: those of a foundation of springs under the indenter's ball, in patches SPRINGS times as
    wide as `radius` (m,), m; 0 where the body is smooth.
    """
    out, ball = np.zeros((len(hit.point), 3)), belief.indenter.radius
    rows = np.flatnonzero(unevenness(belief, hit, radius))
    if not len(rows):
        return out
    hit, size = hit.take(rows), np.minimum(SPRINGS * radius[rows], WIDEST * ball)
    basis = np.stack([hit.direction, np.cross(hit.normal, hit.direction), hit.normal], axis=2)
    places = size[:, None, None] * OVER_PATCH
    depth = size**2 / 2 * (1 / ball + hit.curvature.mean(axis=1))
    under = ball - np.sqrt(ball**2 - np.sum(places**2, axis=2)) - depth[:, None]
    local = np.concatenate([places, under[:, :, None]], axis=2) @ np.swapaxes(basis, 1, 2)
    face = np.repeat(hit.face, len(OVER_PATCH))
    skin = belief.body.closest((hit.point[:, None] + local).reshape(-1, 3), face)
    pressure = np.maximum(-skin.distance, 0.0).reshape(len(rows), -1)
    apart = skin.point.reshape(local.shape) - hit.point[:, None]
    total = np.maximum(pressure.sum(axis=1, keepdims=True), 1e-300)
    middle = np.einsum("mp,mpc->mc", pressure, apart) / total
    out[rows] = middle - np.sum(middle * hit.normal, axis=1, keepdims=True) * hit.normal
    return out


def over_edges(belief: Belief, hit: Closest, force: Array, learned: float | None = None) -> Array:
    """Parts (m,) of the peak pressures by which those of the contacts `hit` differ from a contact
    model's, rms: 0 but where they are over an edge of the body.

    force (m,), N: of each contact. learned: the edge error of a learned response, in place of the
    model's.
    """
    if learned is not None:
        radius = plane_radius(belief, belief.force_reference or 1.0)
        return learned * unevenness(belief, over_patches(belief, hit, force), radius)
    found = unevenness(belief, hit, plane_radius(belief, force))
    return np.where(found > EDGE, EDGE_ERROR * found, 0.0)


def alike_contacts(points: Array, uneven: np.ndarray, radius: Array) -> Array:
    """Numbers (m,) of the contacts at `points` (m, 3), m, that share the error of each, itself
    among them: those within ALIKE of its radius (m,), m; 1 where it is not over an edge.

    uneven (m,) bool: which are. The error of a contact model over an edge is a function of the
    place, so that n contacts close together have one error e, of a variance v, and not n. The sum
    of their readings then varies by n e, with a variance of n^2 v: as that of independent errors
    does, each of variance n v. With these an estimate has the standard deviation of one contact
    there, however many there are.
    """
    count, rows = np.ones(len(points)), np.flatnonzero(uneven)
    if len(rows):
        tree = cKDTree(points[rows])
        count[rows] = tree.query_ball_point(points[rows], ALIKE * radius[rows], return_length=True)
    return count


def over_patches(belief: Belief, hit: Closest, force: Array) -> Closest:
    """The contacts `hit` (m) with the principal curvatures of the body over their patches, as large
    as those of the typical one of the forces (n,), N, and with none that the indenter does not fit.
    """
    if not len(hit.point) or not np.any(force > 0):
        return hit
    shaped = _curved(belief.body, hit, typical_radius(belief, force))
    return without_hollows(shaped, belief.indenter.radius)


def plane_radius(belief: Belief, force: Array | float) -> Array:
    """Radii (m,), m, of Hertz' patches on a plane under forces (m,), N."""
    load = force * belief.indenter.radius
    return np.asarray((0.75 * load / belief.material.effective_modulus) ** (1 / 3))


def typical_radius(belief: Belief, force: Array) -> float:
    """Radius, m, of Hertz' patch on a plane under the median of the positive forces (n,), N."""
    return float(plane_radius(belief, float(np.median(force[force > 0]))))


def _heights(body: Body, hit: Closest, basis: Array, places: Array) -> Array:
    """Heights (m, p), m, of places (p, 2) or (m, p, 2), m, in the tangent planes of the points
    `hit` above the surface; basis (m, 3, 3): tangents and normal as columns."""
    at = hit.point[:, None] + places @ np.swapaxes(basis[:, :, :2], 1, 2)
    at = at.reshape(-1, 3)
    face = np.repeat(hit.face, places.shape[-2])
    above = body.surface.nearest(at, face)
    apart, up = np.abs(above.distance), np.einsum("ij,ij->i", at - above.point, above.normal)
    # at an edge or a crease of the body, the normal may be that of the face of the contact itself
    level = np.flatnonzero((np.abs(up) < GRAZING * apart) & (apart > GRAZING * np.max(places)))
    if len(level):
        lift = LIFT * apart[level, None] * np.repeat(hit.normal, places.shape[-2], axis=0)[level]
        lifted = body.surface.nearest(at[level] + lift, face[level])
        up[level] = np.einsum("ij,ij->i", at[level] + lift - lifted.point, lifted.normal)
    return np.where(up < -GRAZING * apart, -apart, apart).reshape(len(basis), -1)


def _curved(body: Body, hit: Closest, size: float) -> Closest:
    """The points `hit` with the curvatures and directions of quadrics through the surface within
    `size`, m, of them."""
    basis = orthonormal_basis(hit.normal)
    terms = _heights(body, hit, basis, size * PLACES) @ QUADRIC.T / size**2
    second = np.stack([terms[:, [3, 4]], terms[:, [4, 5]]], axis=1)
    value, vector = np.linalg.eigh(second)
    along = np.einsum("mck,mk->mc", basis[:, :, :2], vector[:, :, 1])
    return replace(hit, curvature=np.ascontiguousarray(value[:, ::-1]), direction=along)


def without_hollows(hit: Closest, radius: float) -> Closest:
    """Where contacts, but not most of them, are in hollows too tight for an indenter of the radius,
    m, those with curvatures that it fits: creases of a coarse mesh have such, and no patch."""
    tight = in_hollows(hit, radius)
    return fitting(hit, radius) if tight.any() and np.mean(tight) <= MAX_HOLLOWS else hit


def in_hollows(hit: Closest, radius: float) -> np.ndarray:
    """Whether contacts (m,) are in hollows too tight for an indenter of the radius, m; `fitting`
    does not change it."""
    return np.asarray((hit.curvature <= -HOLLOW / radius).any(axis=1))


def fitting(hit: Closest, radius: float) -> Closest:
    """The contacts with curvatures that an indenter of the radius, m, fits."""
    return replace(hit, curvature=np.maximum(hit.curvature, -HOLLOW / radius))
