"""Newton's method on the patches of a surface: closest points, and intersections with rays.

The iterate is a pair (u, v) on one patch. A step that leaves the patch's triangle ends on the edge,
and the iteration goes on in the face across it. What is minimized is half the squared distance from
a point or from a ray. The compiled search (compiled_search.c) serves closest points alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index
from ..mesh.topology import NEXT, PREVIOUS
from . import patch

if TYPE_CHECKING:
    from .surface import Surface

Mask = NDArray[np.bool_]
Objective = Callable[[tuple[Array, ...], Array], tuple[Array, Array, Mask]]
"""(S, Su, Sv, Suu, Suv, Svv of the patches at n iterates, targets (n, ...)) -> gradients (n, 2),
Hessians (n, 3) as uu, uv, vv, and which Hessians (n,) are those of Newton's method"""

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""(u, v) of a face's vertices"""
NEWTON_TOLERANCE = 1e-5
"""barycentric step after which Newton's method has converged: the error that is left is about the
square of the step, 1e-10 of a face"""
STEP_TOLERANCE = 1e-11
"""the same of steps with an approximate Hessian, whose error is as large as the step"""
STEPS = 80
"""most steps; after a quarter of them steps are halved, against cycles near the medial axis"""
HOPS = 40
"""most edges that are crossed; after them the iteration stays on the edge that it meets"""


def descend(
    surface: Surface, face: Index, target: Array, objective: Objective, start: Array | None = None
) -> tuple[Index, Array]:
    """Local minima from the middles of `face` (n,), or from `start` (n, 2): face (n,), uv (n, 2).

    An iterate that returns to the face it came from (at a crease, or where two patches meet at an
    angle), that meets a border, or that has crossed HOPS edges, is constrained to that edge: it
    converges there or at the edge's end.
    """
    n = len(face)
    face, uv = face.copy(), np.full((n, 2), 1.0 / 3.0) if start is None else start.copy()
    hops, returns = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp)
    previous = np.full(n, -1)
    edge = np.full(n, -1)  # to which a row is constrained, by its opposite corner
    active = np.arange(n)
    for k in range(STEPS):
        if not len(active):
            break
        f, here, on = face[active], uv[active], edge[active]
        derivatives = patch.evaluate(surface.patches[f], here[:, 0], here[:, 1])
        gradient, hessian, newton = objective(derivatives, target[active])
        move = _newton_step(gradient, hessian)
        rows = np.flatnonzero(on >= 0)
        if len(rows):
            move[rows] = _edge_step(on[rows], gradient[rows], hessian[rows])
        if k > STEPS // 4:
            move *= 0.5
        size = np.max(np.abs(move), axis=1)
        move *= np.minimum(1.0, 1.0 / np.maximum(size, 1e-300))[:, None]
        uv[active], exit_edge = _clip(here, move, on)
        leaving = exit_edge >= 0
        crossing = np.flatnonzero(leaving & (on < 0))
        if len(crossing):
            rows, edges = active[crossing], exit_edge[crossing]
            beyond = surface.neighbours[face[rows], edges]
            returns[rows] += beyond == previous[rows]
            stay = (beyond < 0) | (returns[rows] > 1) | (hops[rows] >= HOPS)
            edge[rows[stay]] = edges[stay]
            go, over = rows[~stay], edges[~stay]
            uv[go] = _across(uv[go], over, surface.slot[face[go], over])
            previous[go], face[go] = face[go], beyond[~stay]
            hops[go] += 1
        converged = size < np.where(newton, NEWTON_TOLERANCE, STEP_TOLERANCE)
        at_vertex = leaving & (on >= 0)
        active = active[~(at_vertex | (converged & ~leaving))]
    return face, uv


def least_of_rows(row: Index, value: Array) -> Index:
    """Where among (k,) the least value of each row is; rows that do not occur have none."""
    order = np.lexsort((value, row))
    return np.asarray(order[np.unique(row[order], return_index=True)[1]])


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def point_distance(derivatives: tuple[Array, ...], points: Array) -> tuple[Array, Array, Mask]:
    """Half the squared distances from points (n, 3), as an Objective.

    Beyond a focal point the Hessian is not positive definite; the first fundamental form takes its
    place there (Gauss-Newton), with which steps still descend.
    """
    s, su, sv, suu, suv, svv = derivatives
    r = s - points
    gradient = np.stack([_dot(r, su), _dot(r, sv)], axis=1)
    first = np.stack([_dot(su, su), _dot(su, sv), _dot(sv, sv)], axis=1)
    full = first + np.stack([_dot(r, suu), _dot(r, suv), _dot(r, svv)], axis=1)
    area2 = first[:, 0] * first[:, 2] - first[:, 1] ** 2
    exact = (full[:, 0] > 0) & (full[:, 0] * full[:, 2] - full[:, 1] ** 2 > 1e-3 * area2)
    return gradient, np.where(exact[:, None], full, first), exact


def ray_distance(derivatives: tuple[Array, ...], rays: Array) -> tuple[Array, Array, Mask]:
    """Half the squared distances from rays (n, 3, 3), as an Objective, by Gauss-Newton.

    Rows of a ray: a point of it, and two unit vectors across it. At an intersection, where the
    distance is zero, the Hessian is exact.
    """
    s, su, sv = derivatives[:3]
    origin, e1, e2 = rays[:, 0], rays[:, 1], rays[:, 2]
    r = np.stack([_dot(s - origin, e1), _dot(s - origin, e2)], axis=1)
    au = np.stack([_dot(su, e1), _dot(su, e2)], axis=1)
    av = np.stack([_dot(sv, e1), _dot(sv, e2)], axis=1)
    gradient = np.stack([_dot(r, au), _dot(r, av)], axis=1)
    hessian = np.stack([_dot(au, au), _dot(au, av), _dot(av, av)], axis=1)
    return gradient, hessian, np.ones(len(s), dtype=bool)


def _newton_step(gradient: Array, hessian: Array) -> Array:
    a, b, c = hessian.T
    gu, gv = gradient.T
    determinant = a * c - b * b
    determinant = np.where(np.abs(determinant) > 1e-300, determinant, 1e-300)
    return np.stack([b * gv - c * gu, b * gu - a * gv], axis=1) / determinant[:, None]


def _edge_step(edge: Index, gradient: Array, hessian: Array) -> Array:
    """Newton steps along the edges opposite corners `edge` (n,)."""
    d = CORNERS[PREVIOUS[edge]] - CORNERS[NEXT[edge]]
    second = hessian[:, 0] * d[:, 0] ** 2 + 2 * hessian[:, 1] * d[:, 0] * d[:, 1]
    second += hessian[:, 2] * d[:, 1] ** 2
    return np.asarray(-(_dot(gradient, d) / np.maximum(second, 1e-300))[:, None] * d)


def _clip(uv: Array, move: Array, edge: Index) -> tuple[Array, Index]:
    """uv + move, cut where it leaves the triangle, and the edge it leaves by, or -1.

    Edges are given by their opposite corners. A row constrained to an edge does not leave by it.
    """
    now = np.column_stack([1.0 - uv[:, 0] - uv[:, 1], uv])
    change = np.column_stack([-move[:, 0] - move[:, 1], move])
    outward = (now + change < 0) & (np.arange(3) != edge[:, None])
    part = np.where(outward, np.maximum(now, 0.0) / np.where(outward, -change, 1.0), np.inf)
    exit_edge = np.argmin(part, axis=1)
    least = part[np.arange(len(uv)), exit_edge]
    leaving = np.isfinite(least)
    after = uv + np.where(leaving, least, 1.0)[:, None] * move
    return after, np.where(leaving, exit_edge, -1)


def _across(uv: Array, edge: Index, slot: Index) -> Array:
    """Points of the edges opposite the corners `edge`, in the faces across (corner `slot`)."""
    weight = np.column_stack([1.0 - uv[:, 0] - uv[:, 1], uv])
    rows = np.arange(len(uv))
    head = np.clip(weight[rows, PREVIOUS[edge]], 0.0, 1.0)
    there = np.zeros((len(uv), 3))
    there[rows, NEXT[slot]] = head
    there[rows, PREVIOUS[slot]] = 1.0 - head
    return there[:, 1:]
