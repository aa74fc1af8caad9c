"""Flat facets in place of the smooth surface, where the recorded contacts are computed.

The robot's software takes the point of the triangle mesh that is closest to the indenter. On flat
faces it stays behind, and jumps at the edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..geometry.surface.facets import Facets
from . import BaseEffect, Context, FrameTransform
from .frames import ClosestPoint, Frames


@dataclass(frozen=True)
class MeshFacets(BaseEffect):
    """Contacts are those of the flat mesh."""

    name: ClassVar[str] = "mesh_facets"
    stage: ClassVar[str] = "geometry"
    cost: ClassVar[float] = 2e-8

    def bound(self, context: Context) -> float:
        """Twice the largest error for an indenter over each of the taxels, m."""
        skin = context.skin
        centres = skin.positions + context.indenter_radius * skin.normals
        smooth = context.body.closest(centres).point
        off = np.linalg.norm(facets(context)(centres)[0] - smooth, axis=1)
        return 2.0 * float(off.max())

    def build(self, context: Context) -> FrameTransform:
        """A function without memory; what moves contacts afterwards does it on facets too."""
        foot = facets(context)

        def flatten(frames: Frames) -> Frames:
            return replace(frames, foot=foot).moved(frames.centres)

        return flatten


def facets(context: Context) -> ClosestPoint:
    """Closest points of the flat mesh that the robot's software has."""
    return Facets(context.body.facets).closest
