"""Several contacts at once: where a sphere pressed on a body with hollows touches it, and how hard.

A contact is a local minimum of the distance from the sphere's centre to the surface that is smaller
than the sphere's radius. Candidate faces come from the KD-tree of the mesh's vertices. Those whose
neighbours are not closer, or whose closest point lies in their interior, are starting points of
Newton iterations on the smooth surface, which end in the minima. Each contact is then solved
separately: the displacement that one causes at another, about F / (pi E* distance) on a half-space,
is neglected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshskin.contact import ContactModel, Patch, solve
from meshskin.contact.problem import effective_modulus
from meshskin.core.arrays import Array, far_apart
from meshskin.core.errors import ContactError
from meshskin.geometry.body import Body
from meshskin.geometry.mesh.triangles import closest_on_triangles
from meshskin.geometry.surface import newton

MERGE_DISTANCE = 1e-2
"""Distance, in indenter radii, up to which two minima are one contact: far below the width of a
patch, far above the convergence of Newton's iterations."""
MAX_NORMAL_ANGLE = 0.02
"""Angle, rad, between surface normal and line of centres above which a contact is on an edge: at a
minimum on a smooth surface it is zero, within the accuracy of the surface's normals (1e-3)."""
MIN_CONVEXITY = 1e-3
"""Least 1 + curvature * distance, the convexity of the gap relative to that of the sphere: below,
the sphere fits the body along a curve."""
MIN_BARYCENTRIC = 1e-6
"""Least barycentric weight of a closest point in the interior of a face; excludes rounding."""
MAX_BULGE = 0.15
"""Largest distance of the smooth surface from its flat face, in longest edges: that of an arc of
67 degrees per edge, tan(67 deg / 4) / 2."""


@dataclass(frozen=True)
class IndenterContacts:
    """The n points where a sphere penetrates a body, deepest first; body frame, SI units."""

    point: Array
    """Closest points (n, 3) of the surface, m."""
    normal: Array
    """Unit vectors (n, 3) from the points to the sphere's centre."""
    curvature: Array
    """Principal curvatures (n, 2) of the body, 1/m, positive where convex, larger first."""
    depth: Array
    """Penetrations (n,), m."""
    face: NDArray[np.intp]
    """Faces (n,) of the mesh."""
    smooth: NDArray[np.bool_]
    """(n,) False on an edge or a corner, where no contact model is valid."""

    def __len__(self) -> int:
        """Number of contacts."""
        return len(self.depth)


def find_contacts(body: Body, centre: ArrayLike, indenter_radius: float) -> IndenterContacts:
    """All contacts of a sphere of `indenter_radius`, m, centred at `centre` (3,), body frame, m.

    Empty where the sphere does not touch the body. Raises ContactError where the centre is inside
    the body, and where the sphere fits the body along a curve.
    """
    c = np.asarray(centre, dtype=float).reshape(3)
    if not (np.isfinite(c).all() and np.isfinite(indenter_radius) and indenter_radius > 0):
        raise ContactError(
            "centre and indenter radius must be finite, the radius positive",
            value=f"{c.tolist()}, {indenter_radius} m",
        )
    starts = _start_faces(body, c, indenter_radius)
    query = np.broadcast_to(c, (len(starts), 3))
    surface = body.surface
    hit = surface.at(*newton.descend(surface, starts, query, newton.point_distance), query)
    offset = c - hit.point
    distance = np.linalg.norm(offset, axis=1)
    normal = offset / np.maximum(distance, 1e-300)[:, None]
    smooth = np.linalg.norm(normal - hit.normal, axis=1) < MAX_NORMAL_ANGLE
    # seen from the inside: the far side of a thin wall, or the centre is in the body
    outside = np.linalg.norm(normal + hit.normal, axis=1) > MAX_NORMAL_ANGLE
    if not outside.any() and (len(starts) or body.mesh.is_watertight):
        signed = float(body.closest(c[None]).distance[0])
        if signed <= 0:
            raise ContactError(
                "the indenter's centre lies inside the body",
                value=f"signed distance {signed:.4g} m",
                limit="> 0 m",
                remedy="start farther out, or check the body's orientation",
            )
    convexity = np.where(smooth, 1 + hit.curvature[:, 1] * distance, 1.0)
    # a negative convexity is a saddle or a maximum of the distance, which is no contact
    keep = np.flatnonzero(outside & (convexity > -MIN_CONVEXITY) & (distance < indenter_radius))
    if len(keep) and convexity[keep].min() < MIN_CONVEXITY:
        raise ContactError(
            "the indenter touches along a curve: no single contact point",
            value=f"1 + curvature * distance = {convexity[keep].min():.2g}",
            limit=f"> {MIN_CONVEXITY:g}",
            remedy="use a smaller indenter",
        )
    nearest_first = keep[np.argsort(distance[keep])]
    merge = MERGE_DISTANCE * indenter_radius
    keep = far_apart(hit.point, nearest_first, merge, len(nearest_first))
    return IndenterContacts(
        point=hit.point[keep],
        normal=normal[keep],
        curvature=hit.curvature[keep],
        depth=indenter_radius - distance[keep],
        face=hit.face[keep],
        smooth=smooth[keep],
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

    modulus: Young's modulus, Pa; thickness, m, of a bonded layer (`layered`), None for a half-space
    (`elliptic`). Raises ContactError for a contact on an edge, for patches that overlap, and for
    contacts out of range of the model.
    """
    found = find_contacts(body, centre, indenter_radius)
    if not found.smooth.all():
        point = found.point[np.argmin(found.smooth)]
        raise ContactError(
            "the indenter rests on an edge, where no contact model is valid",
            value="point " + ", ".join(f"{x:.4g}" for x in point) + " m",
            remedy="keep the path off the edges of the body, or round them",
        )
    model = "elliptic" if thickness is None else "layered"
    force = ContactModel(model, poisson, thickness).force(
        depth=found.depth,
        curvature=found.curvature,
        indenter_radius=indenter_radius,
        effective_modulus=effective_modulus(modulus, poisson),
    )
    patches = [
        solve(
            model,
            force=f,
            curvature=tuple(k),
            indenter_radius=indenter_radius,
            modulus=modulus,
            poisson=poisson,
            thickness=thickness,
        )
        for f, k in zip(force, found.curvature, strict=True)
    ]
    _check_separate(found, patches)
    return found, np.asarray(force), patches


def _start_faces(body: Body, centre: Array, reach: float) -> NDArray[np.intp]:
    """Faces near the sphere that contain a minimum, or whose neighbours are not closer."""
    mesh = body.mesh
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    longest = float(mesh.edges_unique_length.max())
    # no point of a triangle is farther from all its vertices than its longest edge / sqrt(3)
    near = mesh.kdtree.query_ball_point(centre, reach + longest * (3**-0.5 + MAX_BULGE))
    if not near:
        return np.zeros(0, dtype=np.intp)
    candidates = np.unique(mesh.vertex_faces[near])
    candidates = candidates[candidates >= 0]
    a, b, c = (vertices[faces[candidates, k]] for k in range(3))
    gap2, uv = closest_on_triangles(centre[None], a, b - a, c - a)
    gap, weight = np.sqrt(gap2), np.minimum(uv.min(axis=1), 1.0 - uv.sum(axis=1))
    edge = np.sqrt(np.max([np.sum((v - w) ** 2, axis=1) for v, w in ((a, b), (b, c), (c, a))], 0))
    reached = gap < reach + MAX_BULGE * edge
    candidates, gap, interior = candidates[reached], gap[reached], weight[reached] > MIN_BARYCENTRIC
    corners = faces[candidates]
    around = np.full(len(vertices), np.inf)  # least gap of the faces at each vertex
    np.minimum.at(around, corners.ravel(), np.repeat(gap, 3))
    lowest = gap <= around[corners].min(axis=1) * (1 + 1e-9)
    return np.asarray(candidates[lowest | interior])


def _check_separate(found: IndenterContacts, patches: list[Patch]) -> None:
    """Raise ContactError where two patches overlap."""
    for i, one in enumerate(patches):
        for k in range(i):
            distance = float(np.linalg.norm(found.point[i] - found.point[k]))
            limit = float(one.semi_axes[0] + patches[k].semi_axes[0])
            if distance < limit:
                raise ContactError(
                    "the patches of two contacts overlap",
                    value=f"distance {distance * 1e3:.3g} mm",
                    limit=f"> {limit * 1e3:.3g} mm",
                    remedy="lower the force, or use a smaller indenter",
                )
