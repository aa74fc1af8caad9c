"""The smooth surface of a mesh: closest points by Newton's method on patches, hopping over edges.

Each face carries a quintic patch (jets.py, patch.py); neighbouring patches meet exactly. A query
starts at the nearest of a set of samples of the mesh, then walks: a Newton step on the patch, and
where the step leaves the face, on through the edge into the next face.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MeshError
from . import jets, patch
from .closest import Closest

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # (u, v) of a face's vertices
QUADRATIC = 1e-5
"""a Newton step this small (barycentric) leaves an error of its square"""
STILL = 1e-11
"""a damped or projected step this small is taken as the last"""
FAR = 6
"""hops after which a walk is checked against the global nearest face"""
HOPS, STEPS = 40, 80
"""hops after which a walk is held on the edge it meets; steps after which it is given up"""


class Surface:
    """Smooth surface over a triangle mesh (an object with `.vertices` (n, 3) m, `.faces` (m, 3)).

    Faces are counter-clockwise seen from outside. Vertices are in the body frame.
    """

    def __init__(self, mesh: Any) -> None:
        self.vertices: Array = np.array(mesh.vertices, dtype=float)
        self.faces: Index = np.array(mesh.faces, dtype=np.intp)
        self.neighbours, self._slot = neighbours(self.faces)

    @cached_property
    def jets(self) -> jets.Jets:
        """Height fields at the vertices."""
        fitted = jets.fit(self.vertices, self.faces, self.neighbours)
        return jets.flatten_bulges(fitted, self.faces)

    @cached_property
    def patches(self) -> Array:
        """Patch coefficients (m, 21, 3), m, in the order of patch.POWERS."""
        return jets.blend(self.jets, self.faces)

    @cached_property
    def smooth(self) -> bool:
        """Whether no vertex keeps its flat faces."""
        return bool(np.all(self.jets.degree > 0))

    @cached_property
    def scale(self) -> float:
        """Largest extent of the mesh in m: proximity searches divide by it."""
        return float(np.max(np.ptp(self.vertices, axis=0)))

    @cached_property
    def _samples(self) -> tuple[Any, Index]:
        """A KD-tree of points on the faces (in units of the scale) and the face of each."""
        from scipy.spatial import KDTree

        points, face = sample_faces(self.vertices, self.faces)
        return KDTree((points - self.vertices[0]) / self.scale), face

    def closest(self, points: ArrayLike, face: ArrayLike | None = None) -> Closest:
        """Closest points of the smooth surface to `points` (n, 3), body frame, m.

        `face` (n,) may name the faces to start from (warm start). Raises MeshError where a point
        is not finite.
        """
        p = _finite(points)
        start = self._start(p) if face is None else np.array(face, dtype=np.intp)
        foot, uv, hops = self._walk(p, start, _closest_step)
        far = np.flatnonzero(hops >= FAR)
        if len(far):
            again, again_uv, _ = self._walk(p[far], self.nearest_face(p[far]), _closest_step)
            before = self._gap(p[far], foot[far], uv[far])
            better = self._gap(p[far], again, again_uv) < before
            foot[far[better]], uv[far[better]] = again[better], again_uv[better]
        return self.at(foot, uv, p)

    def at(self, face: ArrayLike, uv: ArrayLike, points: ArrayLike | None = None) -> Closest:
        """The surface at `face` (n,), `uv` (n, 2); distances are those of `points` (n, 3), m."""
        face, uv = np.asarray(face, dtype=np.intp), np.asarray(uv, dtype=float)
        s, su, sv, *second = patch.evaluate(self.patches[face], uv[:, 0], uv[:, 1])
        normal, curvature = patch.shape((su, sv), (second[0], second[1], second[2]))
        offset = np.zeros_like(s) if points is None else np.asarray(points, dtype=float) - s
        height = np.einsum("ij,ij->i", offset, normal)
        distance = np.copysign(np.sqrt(np.einsum("ij,ij->i", offset, offset)), height)
        return Closest(s, distance, normal, curvature, face, uv)

    def trace(self, origins: Array, directions: Array, face: Index) -> tuple[Index, Array]:
        """Where rays (n, 3) meet the surface near the faces `face` (n,): faces (n,), uv (n, 2)."""
        e1, e2 = np.swapaxes(jets.tangent_frames(directions)[:, :2], 0, 1)
        target = np.stack([origins, e1, e2], axis=1)
        return self._walk(target, face, _ray_step)[:2]

    def nearest_face(self, points: Array, candidates: int = 24) -> Index:
        """The nearest flat face (n,) among those of the `candidates` nearest samples."""
        tree, owner = self._samples
        query = (points - self.vertices[0]) / self.scale
        near = owner[tree.query(query, k=min(candidates, len(owner)))[1].reshape(len(points), -1)]
        corners = self.vertices[self.faces[near]]
        gap = triangle_distance2(points[:, None], corners[..., 0, :], *_edges(corners))
        return np.asarray(near[np.arange(len(near)), np.argmin(gap, axis=1)])

    def _start(self, points: Array) -> Index:
        if not self.smooth:  # sheets may lie close, and edges end walks
            return self.nearest_face(points, candidates=12)
        tree, owner = self._samples
        return np.asarray(owner[tree.query((points - self.vertices[0]) / self.scale)[1]])

    def _gap(self, points: Array, face: Index, uv: Array) -> Array:
        s = np.einsum("nk,nkc->nc", patch.monomials(uv[:, 0], uv[:, 1]), self.patches[face])
        return np.asarray(np.sum((s - points) ** 2, axis=1))

    def _walk(self, target: Array, face: Index, step: Any) -> tuple[Index, Array, Index]:
        """Iterate `step` from the middles of `face` (n,) until every row is still.

        Gives faces (n,), uv (n, 2), and the edges crossed (n,), at least FAR for a held row. A row
        that returns to the face it came from (a crease, or the seam of two patches), that meets a
        border, or that has crossed HOPS edges, is held on that edge: it ends there or at its end.
        """
        n = len(face)
        face, uv = face.copy(), np.full((n, 2), 1.0 / 3.0)
        hops, back = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp)
        came = np.full(n, -1)
        held = np.full(n, -1)  # edge (by its opposite corner) on which a row is held
        active = np.arange(n)
        for k in range(STEPS):
            if not len(active):
                break
            f, here = face[active], uv[active]
            derivatives = patch.evaluate(self.patches[f], here[:, 0], here[:, 1])
            gradient, hessian, newton = step(derivatives, target[active])
            move = _solve(gradient, hessian)
            on = held[active]
            edge = np.flatnonzero(on >= 0)
            if len(edge):
                move[edge] = _along(on[edge], gradient[edge], hessian[edge])
            if k > STEPS // 4:
                move *= 0.5  # breaks cycles of points near the medial axis
            size = np.max(np.abs(move), axis=1)
            move *= np.minimum(1.0, 1.0 / np.maximum(size, 1e-300))[:, None]
            after, exit_edge = _clip(here, move, on)
            uv[active] = after
            still = size < np.where(newton, QUADRATIC, STILL)
            leaving = exit_edge >= 0
            ended = leaving & (on >= 0)  # held, and at the edge's end: the answer is a vertex
            crossing = np.flatnonzero(leaving & (on < 0))
            if len(crossing):
                rows, edges = active[crossing], exit_edge[crossing]
                beyond = self.neighbours[face[rows], edges]
                back[rows] += beyond == came[rows]
                hold = (beyond < 0) | (back[rows] > 1) | (hops[rows] >= HOPS)
                held[rows[hold]] = edges[hold]
                go, over = rows[~hold], edges[~hold]
                slot = self._slot[face[go], over]
                uv[go] = _across(uv[go], over, slot)
                came[go], face[go] = face[go], beyond[~hold]
                hops[go] += 1
            active = active[~(ended | (still & ~leaving))]
        return face, uv, np.where(held >= 0, np.maximum(hops, FAR), hops)


@dataclass(frozen=True)
class _Corner:
    """Corner numbers after and before corner k of a face."""

    after = np.array([1, 2, 0])
    before = np.array([2, 0, 1])


def neighbours(faces: Index) -> tuple[Index, Index]:
    """Faces (m, 3) across the edge opposite each corner, and there the corner off that edge.

    -1 at a border, at an edge of more than two faces, and where the two faces' windings differ.
    """
    m = len(faces)
    tail = faces[:, _Corner.after].ravel()  # edge opposite corner k runs from k + 1 to k + 2
    head = faces[:, _Corner.before].ravel()
    size = int(faces.max()) + 1 if m else 1
    key, twin = tail * size + head, head * size + tail
    order = np.argsort(key)
    ordered = key[order]
    at = np.minimum(np.searchsorted(ordered, twin), len(key) - 1)
    found = ordered[at] == twin
    unique, counts = np.unique(key, return_counts=True)
    many = unique[counts > 1]
    found &= ~(np.isin(key, many) | np.isin(twin, many))
    other = np.where(found, order[at], -1).reshape(m, 3)
    return np.where(other >= 0, other // 3, -1), other % 3


def sample_faces(vertices: Array, faces: Index, limit: int = 400_000) -> tuple[Array, Index]:
    """Points (k, 3) on the faces, and their faces (k,), dense enough for a nearest-face guess.

    A face gets its centroid; one larger than twice the median also the middles of equal parts.
    """
    corners = vertices[faces]
    radius = np.max(np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2), axis=1)
    aim = max(2.0 * float(np.median(radius)), 1e-30)
    aim = max(aim, float(np.sqrt(np.sum(radius**2) / limit)))
    parts = np.clip(np.ceil(radius / aim), 1, 64).astype(np.intp)
    points, owners = [], []
    for count in np.unique(parts):
        which = np.flatnonzero(parts == count)
        weights = part_middles(int(count))  # (count^2, 3)
        points.append((weights @ corners[which]).reshape(-1, 3))
        owners.append(np.repeat(which, len(weights)))
    return np.concatenate(points), np.concatenate(owners)


def part_middles(count: int) -> Array:
    """Barycentric middles (count^2, 3) of a triangle cut into count^2 equal triangles."""
    up = [(3 * i + 1, 3 * j + 1) for i in range(count) for j in range(count - i)]
    down = [(3 * i + 2, 3 * j + 2) for i in range(count - 1) for j in range(count - 1 - i)]
    uv = np.array(up + down) / (3.0 * count)
    return np.column_stack([1.0 - uv.sum(axis=1), uv])


def triangle_distance2(p: Array, a: Array, ab: Array, ac: Array) -> Array:
    """Squared distances from points p to triangles a, a + ab, a + ac (all (..., 3))."""
    ap = p - a
    inside = _barycentric(ap, ab, ac)
    flat = ap - inside[..., :1] * ab - inside[..., 1:] * ac
    best = np.where(
        (inside.min(axis=-1) >= 0) & (inside.sum(axis=-1) <= 1), np.sum(flat**2, axis=-1), np.inf
    )
    for start, edge in ((ap, ab), (ap, ac), (ap - ab, ac - ab)):
        length2 = np.maximum(np.sum(edge * edge, axis=-1), 1e-300)
        t = np.clip(np.sum(start * edge, axis=-1) / length2, 0.0, 1.0)
        best = np.minimum(best, np.sum((start - t[..., None] * edge) ** 2, axis=-1))
    return best


def _barycentric(offset: Array, ab: Array, ac: Array) -> Array:
    """Weights (..., 2) of ab and ac in the projection of offsets on their planes."""
    e, f, g = (np.sum(x * y, axis=-1) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    x, y = np.sum(offset * ab, axis=-1), np.sum(offset * ac, axis=-1)
    area2 = np.maximum(e * g - f * f, 1e-300)
    return np.stack([(g * x - f * y) / area2, (e * y - f * x) / area2], axis=-1)


def _edges(corners: Array) -> tuple[Array, Array]:
    return corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]


def _finite(points: ArrayLike) -> Array:
    p = np.array(points, dtype=float).reshape(-1, 3)
    bad = ~np.isfinite(p).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise MeshError("a query point is not finite", value=p[row].tolist(), remedy=f"row {row}")
    return p


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _closest_step(derivatives: tuple[Array, ...], points: Array) -> tuple[Array, Array, Any]:
    """Gradient (n, 2) and Hessian (n, 3) of half the squared distance, and which is Newton's.

    Beyond a focal point the Hessian is not positive; there the first fundamental form serves
    (Gauss-Newton), which still descends.
    """
    s, su, sv, suu, suv, svv = derivatives
    r = s - points
    gradient = np.stack([_dot(r, su), _dot(r, sv)], axis=1)
    first = np.stack([_dot(su, su), _dot(su, sv), _dot(sv, sv)], axis=1)
    full = first + np.stack([_dot(r, suu), _dot(r, suv), _dot(r, svv)], axis=1)
    area2 = first[:, 0] * first[:, 2] - first[:, 1] ** 2
    newton = (full[:, 0] > 0) & (full[:, 0] * full[:, 2] - full[:, 1] ** 2 > 1e-3 * area2)
    return gradient, np.where(newton[:, None], full, first), newton


def _ray_step(derivatives: tuple[Array, ...], rays: Array) -> tuple[Array, Array, Any]:
    """Gauss-Newton on the offset from a ray, in the two directions across it."""
    s, su, sv = derivatives[:3]
    origin, e1, e2 = rays[:, 0], rays[:, 1], rays[:, 2]
    r = np.stack([_dot(s - origin, e1), _dot(s - origin, e2)], axis=1)
    au = np.stack([_dot(su, e1), _dot(su, e2)], axis=1)
    av = np.stack([_dot(sv, e1), _dot(sv, e2)], axis=1)
    gradient = np.stack([_dot(r, au), _dot(r, av)], axis=1)
    hessian = np.stack([_dot(au, au), _dot(au, av), _dot(av, av)], axis=1)
    return gradient, hessian, np.ones(len(s), dtype=bool)


def _solve(gradient: Array, hessian: Array) -> Array:
    a, b, c = hessian.T
    gu, gv = gradient.T
    determinant = a * c - b * b
    determinant = np.where(np.abs(determinant) > 1e-300, determinant, 1e-300)
    return np.stack([b * gv - c * gu, b * gu - a * gv], axis=1) / determinant[:, None]


def _along(edge: Index, gradient: Array, hessian: Array) -> Array:
    """The Newton step along the edges opposite corners `edge` (n,)."""
    d = CORNERS[_Corner.before[edge]] - CORNERS[_Corner.after[edge]]
    bend = hessian[:, 0] * d[:, 0] ** 2 + 2 * hessian[:, 1] * d[:, 0] * d[:, 1]
    bend += hessian[:, 2] * d[:, 1] ** 2
    return np.asarray(-(_dot(gradient, d) / np.maximum(bend, 1e-300))[:, None] * d)


def _clip(uv: Array, move: Array, held: Index) -> tuple[Array, Index]:
    """uv + move, cut where it leaves the face, and the corner opposite the edge left by (or -1).

    A row held on an edge leaves by one of the other two only.
    """
    now = np.column_stack([1.0 - uv[:, 0] - uv[:, 1], uv])
    change = np.column_stack([-move[:, 0] - move[:, 1], move])
    outward = (now + change < 0) & (np.arange(3) != held[:, None])
    fraction = np.where(outward, np.maximum(now, 0.0) / np.where(outward, -change, 1.0), np.inf)
    exit_edge = np.argmin(fraction, axis=1)
    least = fraction[np.arange(len(uv)), exit_edge]
    leaving = np.isfinite(least)
    after = uv + np.where(leaving, least, 1.0)[:, None] * move
    return after, np.where(leaving, exit_edge, -1)


def _across(uv: Array, edge: Index, slot: Index) -> Array:
    """The same points of the edges opposite corners `edge`, in the faces across (corner `slot`)."""
    weight = np.column_stack([1.0 - uv[:, 0] - uv[:, 1], uv])
    rows = np.arange(len(uv))
    head = np.clip(weight[rows, _Corner.before[edge]], 0.0, 1.0)
    there = np.zeros((len(uv), 3))
    there[rows, _Corner.after[slot]] = head
    there[rows, _Corner.before[slot]] = 1.0 - head
    return there[:, 1:]
