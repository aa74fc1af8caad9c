"""Walking over patches: Newton steps on a face's patch, and through its edges into the next.

A step gives the gradient and Hessian of what is minimised, in (u, v): half the squared distance to
a point, or to a ray.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..mesh.edges import edge_of, twins
from . import patch

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Step = Callable[[tuple[Array, ...], Array], tuple[Array, Array, Mask]]
"""(derivatives of the patches at n feet, what each walks towards) -> gradients (n, 2), Hessians
(n, 3), and which rows (n,) make a Newton step"""

AFTER, BEFORE = np.array([1, 2, 0]), np.array([2, 0, 1])
"""corner numbers after and before corner k of a face"""
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
"""(u, v) of a face's vertices"""
QUADRATIC = 1e-5
"""a Newton step this small (barycentric) leaves an error of its square"""
STILL = 1e-11
"""a damped or projected step this small is taken as the last"""
FAR = 6
"""hops after which a walk is checked against the global nearest face"""
HOPS, STEPS = 40, 80
"""hops after which a walk is held on the edge it meets; steps after which it is given up"""


def neighbours(faces: Index) -> tuple[Index, Index]:
    """Faces (m, 3) across the edge opposite each corner, and there the corner off that edge.

    -1 at a border, at an edge of more than two faces, and where the two faces' windings differ.
    """
    tail = faces[:, AFTER].ravel()  # edge opposite corner k runs from k + 1 to k + 2
    head = faces[:, BEFORE].ravel()
    one, two = twins(edge_of(tail, head, int(faces.max(initial=-1)) + 1))
    opposed = tail[one] != tail[two]
    one, two = one[opposed], two[opposed]
    other = np.full(faces.size, -1)
    other[one], other[two] = two, one
    across = other.reshape(faces.shape)
    return np.where(across >= 0, across // 3, -1), across % 3


def walk(
    patches: Array,
    across: tuple[Index, Index],
    target: Array,
    face: Index,
    step: Step,
    start: Array | None = None,
) -> tuple[Index, Array, Index]:
    """Iterate `step` on `face` (n,) from `start` (n, 2), or the middles, until every row is still.

    Gives faces (n,), uv (n, 2), and the edges crossed (n,), at least FAR for a held row. A row
    that returns to the face it came from (a crease, or the seam of two patches), that meets a
    border, or that has crossed HOPS edges, is held on that edge: it ends there or at its end.
    """
    beyond_edge, slot_there = across
    n = len(face)
    face, uv = face.copy(), np.full((n, 2), 1.0 / 3.0) if start is None else start.copy()
    hops, back = np.zeros(n, dtype=np.intp), np.zeros(n, dtype=np.intp)
    came = np.full(n, -1)
    held = np.full(n, -1)  # edge (by its opposite corner) on which a row is held
    active = np.arange(n)
    for k in range(STEPS):
        if not len(active):
            break
        f, here = face[active], uv[active]
        derivatives = patch.evaluate(patches[f], here[:, 0], here[:, 1])
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
            beyond = beyond_edge[face[rows], edges]
            back[rows] += beyond == came[rows]
            hold = (beyond < 0) | (back[rows] > 1) | (hops[rows] >= HOPS)
            held[rows[hold]] = edges[hold]
            go, over = rows[~hold], edges[~hold]
            slot = slot_there[face[go], over]
            uv[go] = _across(uv[go], over, slot)
            came[go], face[go] = face[go], beyond[~hold]
            hops[go] += 1
        active = active[~(ended | (still & ~leaving))]
    return face, uv, np.where(held >= 0, np.maximum(hops, FAR), hops)


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)


def closest_step(derivatives: tuple[Array, ...], points: Array) -> tuple[Array, Array, Mask]:
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


def ray_step(derivatives: tuple[Array, ...], rays: Array) -> tuple[Array, Array, Mask]:
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
    d = CORNERS[BEFORE[edge]] - CORNERS[AFTER[edge]]
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
    head = np.clip(weight[rows, BEFORE[edge]], 0.0, 1.0)
    there = np.zeros((len(uv), 3))
    there[rows, AFTER[slot]] = head
    there[rows, BEFORE[slot]] = 1.0 - head
    return there[:, 1:]
