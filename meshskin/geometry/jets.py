"""Vertex jets: polynomial height fields fitted to the vertices around each vertex.

At vertex i, in a frame (t1, t2, n) at the vertex, the surface is n-height h_i(x, y), a polynomial
without constant term (it passes through the vertex) fitted by least squares to the 2-ring. Rings do
not pass a crease; a vertex on a crease, or whose ring no polynomial fits, keeps its flat faces.
Source: Cazals and Pouget, "Estimating differential quantities using polynomial fitting of
osculating jets", Computer Aided Geometric Design 22 (2005): a degree-d jet gives normals to order
h^d and curvatures to order h^(d-1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import patch

Array = NDArray[np.float64]
Index = NDArray[np.intp]

DEGREE = 4
POWERS = tuple((d - j, j) for d in range(1, DEGREE + 1) for j in range(d + 1))  # 14, no constant
INDEPENDENT = 1e-4
"""smallest sine of the angle between a column of the fit and the columns before it"""
CREASE = np.radians(40.0)
"""angle between two faces' normals from which their edge is a crease"""
STEEP, WAVY = 2.0, 0.8
"""bounds of the sums of absolute coefficients, all and those above degree 2, of a believable fit;
on a sphere, with q = ring radius over sphere radius, they are q + q^3 / 2 and q^3 / 2"""
MISS = 0.01
"""bound of a believable fit's residual, RMS over the ring, relative to the ring's radius"""
CHUNK = 2048
"""vertices fitted at once: bounds the memory"""
BULGE = 3.0
"""largest lift of a patch from its face, over what its normals account for"""


@dataclass(frozen=True)
class Jets:
    """Height fields at n vertices."""

    origin: Array
    """(n, 3) vertices, in m"""
    frame: Array
    """(n, 3, 3) rows t1, t2, normal"""
    scale: Array
    """(n,) radius of the ring in m; the coefficients are of coordinates divided by it"""
    coefficients: Array
    """(n, 14) of x^i y^j in the order of POWERS; the height, too, is divided by the scale"""
    degree: NDArray[np.int64]
    """(n,) degree of each fit; 0: the faces stay flat here"""


def vertex_normals(vertices: Array, faces: Index) -> Array:
    """Outward unit normals (n, 3) at the vertices, each face weighted by its area."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    cross = np.cross(b - a, c - a)
    weights = np.repeat(cross, 3, axis=0)
    flat = faces.ravel()
    total = np.stack(
        [np.bincount(flat, weights[:, k], minlength=len(vertices)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), [0.0, 0.0, 1.0])


def tangent_frames(normals: Array) -> Array:
    """Right-handed frames (n, 3, 3), rows t1, t2, normal, of unit normals (n, 3).

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6 (2017).
    """
    x, y, z = normals.T
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    t1 = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    t2 = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([t1, t2, normals], axis=1)


def creases(vertices: Array, faces: Index, across: Index) -> NDArray[np.bool_]:
    """Which vertices (n,) lie on a crease; `across` (m, 3) are the faces over the edges."""
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    bend = np.einsum("mc,mkc->mk", normal, normal[across])
    sharp = (bend < np.cos(CREASE)) & (across >= 0)
    out = np.zeros(len(vertices), dtype=bool)
    for k in range(3):
        out[faces[sharp[:, k]][:, [(k + 1) % 3, (k + 2) % 3]]] = True
    return out


def rings(faces: Index, count: int, order: int, stop: NDArray[np.bool_]) -> tuple[Index, Index]:
    """Vertices within `order` edges of each of `count` vertices: CSR (start (n + 1,), index).

    Ways do not lead through the vertices of `stop` (n,).
    """
    from scipy.sparse import csr_array, eye_array

    i = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    j = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    ones = np.ones(len(i), dtype=np.float32)
    step = csr_array((ones, (i, j)), shape=(count, count)) + eye_array(count, dtype=np.float32)
    reach = step = csr_array(step)
    onward = step.multiply(~stop[:, None]).tocsr() if stop.any() else step
    for _ in range(order - 1):
        reach = reach @ onward + step
    return reach.indptr.astype(np.intp), reach.indices.astype(np.intp)


def fit(vertices: Array, faces: Index, across: Index, degree: int = DEGREE, order: int = 2) -> Jets:
    """Jets of the given degree (2 to 4) on the `order`-ring of every vertex.

    Where a ring is too small or too regular for the degree, or the fit is not believable, the next
    lower one is fitted. `across` (m, 3): the faces over the faces' edges, -1 where there is none.
    """
    n = len(vertices)
    sharp = creases(vertices, faces, across)
    start, index = rings(faces, n, order, sharp)
    size = np.diff(start)
    frame = tangent_frames(vertex_normals(vertices, faces))
    scale = np.ones(n)
    coefficients = np.zeros((n, len(POWERS)))
    reached = np.zeros(n, dtype=np.int64)
    for members in size_groups(size):
        ring = index[start[members][:, None] + np.arange(size[members[0]])]
        offset = vertices[ring] - vertices[members][:, None]
        local = offset @ np.swapaxes(frame[members], 1, 2)
        radius = np.sqrt(np.max(np.sum(local[..., :2] ** 2, axis=2), axis=1))
        radius[radius == 0.0] = 1.0
        local /= radius[:, None, None]
        scale[members] = radius
        pending = np.flatnonzero(~sharp[members])
        for trial in range(degree, 1, -1):
            if not len(pending):
                break
            solved, values = _solve(local[pending], trial)
            done = pending[solved]
            coefficients[members[done], : values.shape[1]] = values[solved]
            reached[members[done]] = trial
            pending = pending[~solved]
    return Jets(vertices, frame, scale, coefficients, reached)


def size_groups(size: Index) -> list[Index]:
    """Indices grouped by equal `size` (n,), in groups of at most CHUNK."""
    by_size = np.argsort(size, kind="stable")
    cuts = np.flatnonzero(np.diff(size[by_size])) + 1
    groups = np.split(by_size, cuts)
    return [g[k : k + CHUNK] for g in groups for k in range(0, len(g), CHUNK)]


def _solve(local: Array, degree: int) -> tuple[NDArray[np.bool_], Array]:
    """Least-squares heights of rings (g, k, 3): which to believe (g,), coefficients (g, c)."""
    columns = _columns(local[..., 0], local[..., 1], degree)  # (g, c, k)
    g, c, k = columns.shape
    if k - 1 < c:  # the vertex itself, among the k, says nothing
        return np.zeros(g, dtype=bool), np.zeros((g, c))
    length = np.sqrt(np.einsum("gck,gck->gc", columns, columns))
    length[length == 0.0] = 1.0
    columns /= length[:, :, None]
    normal = columns @ np.swapaxes(columns, 1, 2) + 1e-13 * np.eye(c)  # never exactly singular
    diagonal = np.diagonal(np.linalg.cholesky(normal), axis1=1, axis2=2)
    values = np.linalg.solve(normal, columns @ local[..., 2:])[..., 0] / length
    size = np.abs(values)
    believable = (size.sum(axis=1) < STEEP) & (size[:, 5:].sum(axis=1) < WAVY)
    miss = np.einsum("gck,gc->gk", columns, values * length) - local[..., 2]
    believable &= np.einsum("gk,gk->g", miss, miss) < MISS**2 * k
    return (np.min(diagonal, axis=1) > INDEPENDENT) & believable, values


def _columns(x: Array, y: Array, degree: int) -> Array:
    """Monomials x^i y^j, 1 <= i + j <= degree, of x, y (g, k) -> (g, c, k)."""
    out = np.empty((x.shape[0], (degree + 1) * (degree + 2) // 2 - 1, x.shape[1]))
    out[:, 0], out[:, 1] = x, y
    start = 0
    for d in range(2, degree + 1):
        here = start + d
        out[:, here : here + d] = out[:, start:here] * x[:, None]
        out[:, here + d] = out[:, here - 1] * y
        start = here
    return out


def flatten_bulges(jets: Jets, faces: Index) -> Jets:
    """The jets, but flat at the vertices of faces whose patches bulge beyond belief.

    Normals that turn by theta from the face's over its longest side L lift an arc by L theta / 4.
    """
    corners = jets.origin[faces]
    side = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).max(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    turn = np.einsum("mkc,mc->mk", jets.frame[faces][:, :, 2], normal).min(axis=1)
    theta = np.arccos(np.clip(turn, -1.0, 1.0))
    nodes, flat = _nodes(corners)
    basis = patch.monomials(nodes[:, 0], nodes[:, 1])
    lift = np.linalg.norm(basis @ blend(jets, faces) - flat, axis=2).max(axis=1)
    bulging = lift > BULGE * side * (0.25 * theta + 1e-3)
    if not bulging.any():
        return jets
    degree = jets.degree.copy()
    degree[faces[bulging]] = 0
    return replace(jets, degree=degree)


def heights(coefficients: Array, x: Array, y: Array) -> Array:
    """Heights h(x, y) of jets (m, 14) at x, y (m, k), all relative to their scales."""
    c = {power: coefficients[:, k, None] for k, power in enumerate(POWERS)}
    total = np.zeros_like(x)
    for i in range(DEGREE, -1, -1):  # Horner in x, whose coefficients are Horner in y
        row = np.zeros_like(x)
        for j in range(DEGREE - i, -1, -1):
            row *= y
            if i or j:
                row += c[i, j]
        total *= x
        total += row
    return total


def blend(jets: Jets, faces: Index) -> Array:
    """Patches (m, 21, 3) of the faces: the barycentric blend of the three vertices' jets.

    S = sum_i w_i P_i, where P_i lifts the flat point sum_j w_j V_j along jet i's normal to jet i.
    Two faces share the jets of their common edge, so the patches meet exactly there.
    """
    corners = jets.origin[faces]  # (m, 3, 3)
    nodes, flat = _nodes(corners)
    weights = np.column_stack([1.0 - nodes.sum(axis=1), nodes])
    values = flat.copy()
    for k in range(3):
        vertex = faces[:, k]
        frame, scale = jets.frame[vertex], jets.scale[vertex]
        edges = (corners - corners[:, [k]]) @ np.swapaxes(frame, 1, 2) / scale[:, None, None]
        local = weights @ edges  # (m, 21, 3): the flat points in jet k's frame
        lift = heights(jets.coefficients[vertex], local[..., 0], local[..., 1]) - local[..., 2]
        lift *= weights[:, k] * (scale * (jets.degree[vertex] > 0))[:, None]
        values += lift[..., None] * frame[:, None, 2]
    inverse = np.linalg.inv(patch.monomials(nodes[:, 0], nodes[:, 1]))
    return np.asarray(inverse @ values)


def _nodes(corners: Array) -> tuple[Array, Array]:
    """(u, v) (21, 2) of the points that fix a quintic, and those points (m, 21, 3) on the faces."""
    nodes = np.array(patch.POWERS) / patch.DEGREE
    return nodes, np.column_stack([1.0 - nodes.sum(axis=1), nodes]) @ corners
