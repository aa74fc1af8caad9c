"""Several contacts at once: where a sphere pressed on a hollow body touches it, and how hard.

A contact is a local minimum of the distance from the sphere's centre to the surface that is below
the sphere's radius. Faces in reach come from the KD-tree of the mesh's vertices; among them, those
that no face at their vertices undercuts, or that are nearest inside, not on an edge, are the
starts, and Newton walks on the smooth surface end in the minima. Each contact is then solved by
itself: the displacement that one causes under another, about F / (pi E* distance) on a half-space,
is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import ContactError
from ..core.se3 import Array
from ..geometry.body import Body
from ..geometry.mesh.triangles import closest_on_triangles
from . import elliptic, layered
from .patch import Patch
from .problem import ContactProblem

SAME = 1e-2
"""Distance, in indenter radii, up to which two minima are one contact."""
ON_EDGE = 0.02
"""Angle, rad, between surface normal and line of centres above which a contact is on an edge."""
CONFORMING = 1e-3
"""Convexity of the gap, relative to the sphere's, below which contact is along a curve."""
INSIDE = 1e-6
"""Least barycentric weight of a foot inside a face."""
_SLACK = 0.15
"""How far a smooth patch may leave its flat face, in longest edges."""


@dataclass(frozen=True)
class IndenterContacts:
    """The n places where a sphere penetrates a body, deepest first; body frame, SI units."""

    point: Array
    """(n, 3) nearest points of the surface, m"""
    normal: Array
    """(n, 3) unit vectors from there to the sphere's centre"""
    curvature: Array
    """(n, 2) principal curvatures of the body, 1/m, positive where convex, larger first"""
    depth: Array
    """(n,) penetrations, m"""
    face: NDArray[np.intp]
    """(n,) faces of the mesh"""
    smooth: NDArray[np.bool_]
    """(n,) False on an edge or a corner, where no contact model here holds"""

    def __len__(self) -> int:
        """Number of contacts."""
        return len(self.depth)


def find_contacts(body: Body, centre: ArrayLike, indenter_radius: float) -> IndenterContacts:
    """All contacts of a sphere of `indenter_radius`, m, centred at `centre` (3,), body frame, m.

    None in reach gives an empty answer. Raises ContactError where the centre is inside the body,
    and where the sphere fits the body along a curve.
    """
    c = np.asarray(centre, dtype=float).reshape(3)
    if not (np.isfinite(c).all() and np.isfinite(indenter_radius) and indenter_radius > 0):
        raise ContactError(
            "centre and indenter radius must be finite, the radius positive",
            value=f"{c.tolist()}, {indenter_radius} m",
        )
    starts = _starts(body, c, indenter_radius)
    surface, here = body.surface, np.broadcast_to(c, (len(starts), 3))
    hit = surface.descend(here, starts)
    way = c - hit.point
    distance = np.linalg.norm(way, axis=1)
    normal = way / np.maximum(distance, 1e-300)[:, None]
    smooth = np.linalg.norm(normal - hit.normal, axis=1) < ON_EDGE
    # seen from inside: the far side of a thin wall, or the centre is in the body
    outside = np.linalg.norm(normal + hit.normal, axis=1) > ON_EDGE
    if not outside.any() and (len(starts) or body.mesh.is_watertight):
        _refuse_inside(body, c)
    bend = np.where(smooth, 1 + hit.curvature[:, 1] * distance, 1.0)
    # where the distance bends down it has a saddle or a maximum, which is no contact
    keep = np.flatnonzero(outside & (bend > -CONFORMING) & (distance < indenter_radius))
    if len(keep) and bend[keep].min() < CONFORMING:
        raise ContactError(
            "the indenter touches along a curve: no single contact point",
            value=f"1 + curvature * distance = {bend[keep].min():.2g}",
            limit=f"> {CONFORMING:g}",
            remedy="use a smaller indenter",
        )
    keep = _distinct(hit.point, keep[np.argsort(distance[keep])], SAME * indenter_radius)
    return IndenterContacts(
        point=hit.point[keep],
        normal=normal[keep],
        curvature=hit.curvature[keep],
        depth=indenter_radius - distance[keep],
        face=hit.face[keep],
        smooth=smooth[keep],
    )


def _refuse_inside(body: Body, centre: Array) -> None:
    """Raise ContactError if the indenter's centre (3,), body frame, m, lies in the body."""
    signed = float(body.closest(centre[None]).distance[0])
    if signed <= 0:
        raise ContactError(
            "the indenter's centre lies inside the body",
            value=f"signed distance {signed:.4g} m",
            limit="> 0 m",
            remedy="start farther out, or check the body's orientation",
        )


def solve_contacts(
    body: Body,
    centre: ArrayLike,
    indenter_radius: float,
    *,
    modulus: float,
    poisson: float,
    thickness: float | None = None,
) -> tuple[IndenterContacts, Array, list[Patch]]:
    """The contacts of a sphere at `centre`, their forces (n,), N, and their patches.

    modulus: Young's, Pa; thickness, m, of a bonded layer (`layered`), None for a half-space
    (`elliptic`). Raises ContactError for a contact on an edge, for patches that meet, and for what
    leaves the model's range.
    """
    found = find_contacts(body, centre, indenter_radius)
    if not found.smooth.all():
        place = found.point[np.argmin(found.smooth)]
        raise ContactError(
            "the indenter rests on an edge, where no contact model holds",
            value="point " + ", ".join(f"{x:.4g}" for x in place) + " m",
            remedy="keep the path off the body's edges, or round them",
        )
    e_star = modulus / (1 - poisson**2)
    if thickness is None:
        force = elliptic.force(found.depth, found.curvature, indenter_radius, e_star)
    else:
        layer = layered.BondedLayer(poisson, thickness)
        force = layer.force(found.depth, found.curvature, indenter_radius, e_star)
    model = elliptic if thickness is None else layered
    patches = [
        model.solve(
            ContactProblem(float(f), tuple(k), indenter_radius, modulus, poisson, thickness)
        )
        for f, k in zip(force, found.curvature, strict=True)
    ]
    _refuse_meeting(found, patches)
    return found, np.asarray(force), patches


def _starts(body: Body, centre: Array, reach: float) -> NDArray[np.intp]:
    """Faces near the sphere that hold a minimum by themselves, or that no neighbour undercuts."""
    mesh = body.mesh
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    longest = float(mesh.edges_unique_length.max())
    # no point of a triangle is farther from all its vertices than its longest edge / sqrt(3)
    near = mesh.kdtree.query_ball_point(centre, reach + longest * (3**-0.5 + _SLACK))
    if not near:
        return np.zeros(0, dtype=np.intp)
    candidates = np.unique(mesh.vertex_faces[near])
    candidates = candidates[candidates >= 0]
    a, b, c = (vertices[faces[candidates, k]] for k in range(3))
    gap2, uv = closest_on_triangles(centre[None], a, b - a, c - a)
    gap, within = np.sqrt(gap2), np.minimum(uv.min(axis=1), 1.0 - uv.sum(axis=1)) > INSIDE
    edge = np.sqrt(np.max([np.sum((v - w) ** 2, axis=1) for v, w in ((a, b), (b, c), (c, a))], 0))
    inside = gap < reach + _SLACK * edge
    candidates, gap, within = candidates[inside], gap[inside], within[inside]
    corners = faces[candidates]
    around = np.full(len(vertices), np.inf)  # least gap of the faces at each vertex
    np.minimum.at(around, corners.ravel(), np.repeat(gap, 3))
    lowest = gap <= around[corners].min(axis=1) * (1 + 1e-9)
    return np.asarray(candidates[lowest | within])


def _distinct(points: Array, rows: NDArray[np.intp], same: float) -> NDArray[np.intp]:
    """`rows` without those whose point is within `same` of an earlier one's."""
    kept: list[int] = []
    for row in rows:
        if all(np.linalg.norm(points[row] - points[k]) > same for k in kept):
            kept.append(int(row))
    return np.array(kept, dtype=np.intp)


def _refuse_meeting(found: IndenterContacts, patches: list[Patch]) -> None:
    for i, one in enumerate(patches):
        for k in range(i):
            apart = float(np.linalg.norm(found.point[i] - found.point[k]))
            together = float(one.semi_axes[0] + patches[k].semi_axes[0])
            if apart < together:
                raise ContactError(
                    "the patches of two contacts meet",
                    value=f"{apart * 1e3:.3g} mm apart",
                    limit=f"> {together * 1e3:.3g} mm",
                    remedy="lower the force, or use a smaller indenter",
                )
