"""Flat facets in place of the smooth surface, where the recorded contacts are computed.

The robot's software takes the point of the triangle mesh that is closest to the indenter. On flat
faces it stays behind, and jumps at the edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ...geometry.proximity import Proximity
from ...se3 import Array
from . import Context, Motion, Plain
from .frames import Foot, Frames


@dataclass(frozen=True)
class MeshFacets(Plain):
    """Contacts are those of the flat mesh."""

    name: ClassVar[str] = "mesh_facets"
    stage: ClassVar[str] = "geometry"
    cost: ClassVar[float] = 1.1e-7

    def bound(self, context: Context) -> float:
        """Twice the largest error for an indenter over each of the taxels, m."""
        skin = context.skin
        centres = skin.positions + context.indenter_radius * skin.normals
        smooth = context.body.closest(centres).point
        off = np.linalg.norm(facets(context)(centres)[0] - smooth, axis=1)
        return 2.0 * float(off.max())

    def build(self, context: Context) -> Motion:
        """A function without memory; what moves contacts afterwards does it on facets too."""
        foot = facets(context)

        def flatten(frames: Frames) -> Frames:
            return replace(frames, foot=foot).moved(frames.centres)

        return flatten


def facets(context: Context) -> Foot:
    """Closest points of the body's flat mesh."""
    surface = context.body.surface
    proximity = Proximity(surface.vertices, surface.faces)

    def foot(centres: Array) -> tuple[Array, Array]:
        corners = surface.vertices[surface.faces[proximity.exact(centres)]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return closest_on_triangle(centres, corners), normals

    return foot


def closest_on_triangle(points: Array, corners: Array) -> Array:
    """The points of triangles (k, 3, 3) closest to points (k, 3)."""
    a = corners[:, 0]
    edges = corners[:, 1:] - corners[:, :1]
    gram = edges @ edges.swapaxes(1, 2)
    weight = np.linalg.solve(gram, edges @ (points - a)[:, :, None])[:, :, 0]
    best = a + np.einsum("ij,ijk->ik", weight, edges)
    inside = (weight.min(axis=1) >= 0) & (weight.sum(axis=1) <= 1)
    gap = np.where(inside, np.sum((points - best) ** 2, axis=1), np.inf)
    for k in range(3):
        start, way = corners[:, k], corners[:, (k + 1) % 3] - corners[:, k]
        part = np.einsum("ij,ij->i", points - start, way) / np.einsum("ij,ij->i", way, way)
        on = start + np.clip(part, 0.0, 1.0)[:, None] * way
        other = np.sum((points - on) ** 2, axis=1)
        best = np.where((other < gap)[:, None], on, best)
        gap = np.minimum(gap, other)
    return np.asarray(best)
