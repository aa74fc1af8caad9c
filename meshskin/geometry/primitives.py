"""The primitives, centred at the origin: their exact surfaces, and triangle meshes of them.

A surface has `closest(points)` like a body; `face` is -1 and `uv` zero. Curvatures from do Carmo,
"Differential Geometry of Curves and Surfaces", chapter 3. Its `mesh(faces)` of about so many
triangles is vertices (n, 3), m, on the surface, and faces (m, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array, Index
from ..core.errors import MeshError
from ..core.se3 import orthonormal_basis, perpendicular
from .surface.closest_point import Closest

MIN_TANGENT = 1e-9
"""norm of a tangent below which it is rounding, and any other is taken"""
ICOSAHEDRON = 0.5257311121191336, 0.85065080835204
"""The coordinates of the vertices of the unit icosahedron other than zero."""
ICOSAHEDRON_FACES = (
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11),
    (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
    (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
    (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
)  # fmt: skip
"""The vertices of its faces: vertices are four on each coordinate plane, xy, yz and zx."""


def _points(points: ArrayLike) -> Array:
    return np.asarray(points, dtype=float).reshape(-1, 3)


def _unit(vectors: Array, fallback: tuple[float, float, float]) -> tuple[Array, Array]:
    """Unit vectors (n, 3) and norms (n,); the fallback for zero vectors."""
    length = np.linalg.norm(vectors, axis=1)
    safe = np.where(length > 0, length, 1.0)[:, None]
    return np.where(length[:, None] > 0, vectors / safe, fallback), length


def _answer(
    foot: Array, distance: Array, normal: Array, k1: ArrayLike, k2: ArrayLike, first: Array
) -> Closest:
    """The result for curvatures k1 >= k2 (n,); `first` (n, 3): tangents along k1, or zero."""
    n = len(foot)
    curvature = np.stack([np.broadcast_to(k1, n), np.broadcast_to(k2, n)], axis=1)
    nowhere = np.linalg.norm(first, axis=1, keepdims=True) < MIN_TANGENT
    direction, _ = _unit(np.where(nowhere, perpendicular(normal), first), (1.0, 0.0, 0.0))
    return Closest(foot, distance, normal, curvature, direction, np.full(n, -1), np.zeros((n, 2)))


def _round(normal: Array) -> Array:
    """Tangents (n, 3) around the z axis; zero on it."""
    return np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)


def _steepest(normal: Array, radii: Array) -> Array:
    """Tangents (n, 3) along the first principal curvature of an ellipsoid.

    Up to its length the shape operator is diag(1/r^2), restricted to the tangent plane.
    """
    t1, t2, _ = np.moveaxis(orthonormal_basis(normal, perpendicular(normal)), 2, 0)
    a, b, c = (np.sum(s * t / radii**2, axis=1) for s, t in ((t1, t1), (t1, t2), (t2, t2)))
    angle = 0.5 * np.arctan2(2.0 * b, a - c)[:, None]
    return np.asarray(np.cos(angle) * t1 + np.sin(angle) * t2)


@dataclass(frozen=True)
class Sphere:
    """Sphere of a radius in m."""

    radius: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; the centre goes to the pole +z."""
        normal, length = _unit(_points(points), (0.0, 0.0, 1.0))
        k = 1.0 / self.radius
        return _answer(
            self.radius * normal, length - self.radius, normal, k, k, perpendicular(normal)
        )

    def mesh(self, faces: int) -> tuple[Array, Index]:
        """An icosphere."""
        vertices, triangles = sphere_mesh(faces)
        return self.radius * vertices, triangles


@dataclass(frozen=True)
class Capsule:
    """Cylinder of a radius along z, `length` long, closed by half spheres (m)."""

    radius: float
    length: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; on the seams the curvature is the half sphere's."""
        p = _points(points)
        half = 0.5 * self.length
        axis = np.zeros_like(p)
        axis[:, 2] = np.clip(p[:, 2], -half, half)
        normal, gap = _unit(p - axis, (1.0, 0.0, 0.0))
        k = 1.0 / self.radius
        second = np.where(np.abs(p[:, 2]) < half, 0.0, k)
        return _answer(
            axis + self.radius * normal, gap - self.radius, normal, k, second, _round(normal)
        )

    def mesh(self, faces: int) -> tuple[Array, Index, Index]:
        """Rows of triangles on the cylinder, half octahedra at its ends.

        Third, the seams (k, 2) of cylinder and half spheres: edges, by their vertices.
        """
        radius, length = self.radius, self.length
        area_sphere, area_side = 4.0 * np.pi * radius**2, 2.0 * np.pi * radius * length
        n = max(2, round(float(np.sqrt(faces / 8.0 * area_sphere / (area_sphere + area_side)))))
        step = 2.0 * np.pi * radius / (4 * n)
        rows = max(1, round(length / (step * np.sqrt(3.0) / 2.0))) if length > 0 else 0
        latitudes = np.linspace(0.5 * np.pi, 0.0, n + 1), np.linspace(0.0, -0.5 * np.pi, n + 1)[1:]
        upper, lower = ((radius * np.sin(a), radius * np.cos(a)) for a in latitudes)
        rings = _capped(length, rows, upper, lower, [max(1, 4 * k) for k in range(n + 1)])
        starts = np.cumsum([0, *map(len, rings)])
        around = np.arange(4 * n)
        seam = np.column_stack([around, (around + 1) % (4 * n)])
        return *_stitch(rings), np.concatenate([seam + starts[n], seam + starts[n + rows]])


@dataclass(frozen=True)
class Cylinder:
    """Cylinder of a radius along z, `length` long, closed by flat caps (m)."""

    radius: float
    length: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m.

        On a rim the normal points from the foot to the point, and the curvature is the side's.
        Points on the axis, nearer to the side than to a cap, go to +x.
        """
        p = _points(points)
        half = 0.5 * self.length
        radial, reach = _unit(p * [1.0, 1.0, 0.0], (1.0, 0.0, 0.0))
        up = np.where(p[:, 2:] < 0.0, -1.0, 1.0) * [0.0, 0.0, 1.0]
        side, cap = reach - self.radius, np.abs(p[:, 2]) - half
        rim = (side > 0.0) & (cap > 0.0)
        flat = (cap >= side) & ~rim
        foot = radial * np.where(flat, reach, self.radius)[:, None]
        foot[:, 2] = np.where(rim | flat, half * up[:, 2], p[:, 2])
        corner, gap = _unit(p - foot, (1.0, 0.0, 0.0))
        normal = np.where(rim[:, None], corner, np.where(flat[:, None], up, radial))
        distance = np.where(rim, gap, np.maximum(side, cap))
        side = np.where(flat, 0.0, 1.0 / self.radius)
        return _answer(foot, distance, normal, side, 0.0, _round(normal))

    def mesh(self, faces: int) -> tuple[Array, Index]:
        """Rows of triangles on the side, rings on the caps."""
        radius, length = self.radius, self.length
        area = 2.0 * np.pi * radius * (radius + length)
        step = float(np.sqrt(area / (faces * np.sqrt(3.0) / 4.0)))
        n = max(2, round(2.0 * np.pi * radius / (6.0 * step)))
        rows = max(1, round(length / (2.0 * np.pi * radius / (6 * n) * np.sqrt(3.0) / 2.0)))
        cap = np.array([radius * k / n for k in range(n + 1)])
        counts = [1, *(6 * k for k in range(1, n + 1))]
        flat = np.zeros(n + 1)
        return _stitch(_capped(length, rows, (flat, cap), (flat[1:], cap[n - 1 :: -1]), counts))


@dataclass(frozen=True)
class Torus:
    """Torus about z: a circle of radius `minor` carried round a circle of radius `major` (m)."""

    major: float
    minor: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; points on the axis go to +x."""
        p = _points(points)
        flat = p * [1.0, 1.0, 0.0]
        radial, _ = _unit(flat, (1.0, 0.0, 0.0))
        normal, gap = _unit(p - self.major * radial, (0.0, 0.0, 1.0))
        outward = np.sum(normal * radial, axis=1)
        foot = self.major * radial + self.minor * normal
        around = outward / (self.major + self.minor * outward)
        meridian = np.cross(_round(radial), normal)
        return _answer(foot, gap - self.minor, normal, 1.0 / self.minor, around, meridian)

    def mesh(self, faces: int) -> tuple[Array, Index]:
        """A regular grid. Raises MeshError for a torus that intersects itself."""
        major, minor = self.major, self.minor
        if not major > minor:
            raise MeshError("the torus intersects itself", value=f"{major} m", limit=f"> {minor} m")
        around = max(6, round(float(np.sqrt(faces * major / (2.0 * minor)))))
        across = max(6, round(faces / (2.0 * around)))
        i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
        a, b = 2.0 * np.pi * i / around, 2.0 * np.pi * (j + 0.5 * (i % 2)) / across
        if around % 2:
            b = 2.0 * np.pi * j / across
        radial = major + minor * np.cos(b)
        vertices = np.stack([radial * np.cos(a), radial * np.sin(a), minor * np.sin(b)], axis=-1)
        here, there, k = i * across, (i + 1) % around * across, (j + 1) % across
        node, up, east, east_up = here + j, here + k, there + j, there + k
        odd = (i % 2 == 1) & (around % 2 == 0)  # cut along the other diagonal
        first = np.stack([node, east, np.where(odd, east_up, up)], axis=-1)
        second = np.stack([np.where(odd, node, east), east_up, up], axis=-1)
        return vertices.reshape(-1, 3), np.stack([first, second]).reshape(-1, 3)


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid of three semi-axes along x, y, z (m)."""

    radii: tuple[float, float, float]

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m, by bisection and Newton on the multiplier.

        Source: Eberly, "Distance from a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid".
        """
        p = _points(points)
        r = np.asarray(self.radii, dtype=float)
        y = np.maximum(np.abs(p), 1e-12 * r.min())  # off the symmetry planes: one root, no cases
        low = np.max(r * y - r**2, axis=1)  # f(low) >= 0 >= f(high) for the falling f below
        high = np.linalg.norm(r * y, axis=1) - np.min(r) ** 2
        t = 0.5 * (low + high)
        for _ in range(200):
            q = r * y / (t[:, None] + r**2)
            f = np.sum(q**2, axis=1) - 1.0
            low, high = np.where(f > 0, t, low), np.where(f > 0, high, t)
            newton = t + 0.5 * f / np.sum(q**2 / (t[:, None] + r**2), axis=1)
            after = np.where((newton > low) & (newton < high), newton, 0.5 * (low + high))
            if np.all(np.abs(after - t) <= 1e-16 * r.max() ** 2):
                break
            t = after
        foot = np.copysign(r**2 * y / (t[:, None] + r**2), p)
        foot /= np.sqrt(np.sum((foot / r) ** 2, axis=1))[:, None]
        normal, steep = _unit(foot / r**2, (0.0, 0.0, 1.0))
        distance = np.copysign(np.linalg.norm(p - foot, axis=1), np.sum((p / r) ** 2, axis=1) - 1.0)
        gauss = 1.0 / (np.prod(r) ** 2 * steep**4)
        mean = (np.sum(r**2) - np.sum(foot**2, axis=1)) / (2.0 * np.prod(r) ** 2 * steep**3)
        spread = np.sqrt(np.maximum(mean**2 - gauss, 0.0))
        first = _steepest(normal, r)
        return _answer(foot, distance, normal, mean + spread, mean - spread, first)

    def mesh(self, faces: int) -> tuple[Array, Index]:
        """The image of an icosphere.

        Scaling the sphere by the radii leaves large angles between faces at sharp ends, the inverse
        of the Gauss map large faces on flat sides; halfway between, both vary by the square root of
        the ratio of the radii.
        """
        radii, (directions, triangles) = np.array(self.radii), sphere_mesh(faces)
        scaled = np.sqrt(radii) * directions
        return radii * scaled / np.linalg.norm(scaled, axis=1, keepdims=True), triangles


def sphere_mesh(faces: int) -> tuple[Array, Index]:
    """Unit icosphere with the number of faces 20 * 4^k nearest (in ratio) to `faces`."""
    level = max(0, round(float(np.log(max(faces, 20) / 20.0) / np.log(4.0))))
    (a, b), triangles = ICOSAHEDRON, np.array(ICOSAHEDRON_FACES)
    signs = np.array([(-1, 1), (1, 1), (-1, -1), (1, -1)])
    corners = np.column_stack([signs * (a, b), np.zeros(4)])  # (4, 3)
    vertices = np.concatenate([np.roll(corners, k, axis=1) for k in range(3)])
    for _ in range(level):
        vertices, triangles = _divided(vertices, triangles)
        length = np.sqrt(np.dot(vertices**2, [1, 1, 1]))[:, None]
        vertices += vertices / length * (1.0 - length)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), triangles


def _divided(vertices: Array, triangles: Index) -> tuple[Array, Index]:
    """Every triangle divided into four at the midpoints of its edges, which come last."""
    edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, first, inverse = np.unique(
        edges[:, 0] + len(vertices) * edges[:, 1], return_index=True, return_inverse=True
    )
    middle = vertices[edges[first]].mean(axis=1)
    (i, j, k), (ij, jk, ki) = triangles.T, len(vertices) + inverse.reshape(-1, 3).T
    parts = np.stack([i, ij, ki, ij, j, jk, ki, jk, k, ij, jk, ki], axis=1)
    return np.concatenate([vertices, middle]), parts.reshape(-1, 3)


def _capped(
    length: float,
    rows: int,
    upper: tuple[Array, Array],
    lower: tuple[Array, Array],
    counts: list[int],
) -> list[Array]:
    """Closed rings of points (count, 3), m, of a cylinder of `length` with a cap at each end.

    `upper`, `lower`: heights of the rings of a cap over the end of the cylinder, and their radii;
    the last ring of the upper cap is the end of the cylinder. `counts`: points of the upper rings.
    Every second ring of the cylinder is rotated by half a step: its triangles are equilateral.
    """
    n, side = len(counts) - 1, np.linspace(0.5, -0.5, rows + 1)[1:] * length
    heights = [*(0.5 * length + upper[0]), *side, *(-0.5 * length + lower[0])]
    radial = [*upper[1], *[upper[1][-1]] * rows, *lower[1]]
    points = [*counts, *[counts[-1]] * rows, *counts[:n][::-1]]
    rings = []
    for k, (z, r, count) in enumerate(zip(heights, radial, points, strict=True)):
        shift = 0.5 * ((k - n) % 2) if n <= k <= n + rows else 0.0
        a = (np.arange(count) + shift) * 2.0 * np.pi / count
        rings.append(np.column_stack([r * np.cos(a), r * np.sin(a), np.full(count, z)]))
    return rings


def _stitch(rings: list[Array]) -> tuple[Array, Index]:
    """Triangulate between closed rings of points, top to bottom, in the order of their angles."""
    starts = np.cumsum([0, *map(len, rings)])
    faces = []
    for upper, lower, a, b in zip(rings[:-1], rings[1:], starts[:-2], starts[1:-1], strict=True):
        n, m = len(upper), len(lower)
        ends = [  # angles at the ends of the edges of both; a point has none
            np.arctan2(ring[0, 1], ring[0, 0]) + np.arange(1, k + 1 if k > 1 else 1) * 2 * np.pi / k
            for ring, k in ((lower, m), (upper, n))
        ]
        below = np.argsort(np.concatenate(ends), kind="stable") < len(ends[0])
        j: Index = np.cumsum(below) - below  # corners of the lower ring before each triangle
        i: Index = np.arange(len(j)) - j
        apex = np.where(below, b + (j + 1) % m, a + (i + 1) % n)
        faces.append(np.stack([a + i % n, b + j % m, apex], axis=1))
    return np.concatenate(rings), np.concatenate(faces)
