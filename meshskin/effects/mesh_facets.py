"""Contacts computed on the flat facets of the mesh instead of the smooth surface.

    x_c <- the point of the triangles with the least |x_c - x_e|, x_e: centre of the indenter

On a flat face this point lags behind the contact, and it jumps at the edges.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.surface.surface import Facets
from .base import BaseEffect, Context, FrameTransform
from .frames import ClosestPoint


@dataclass(frozen=True)
class MeshFacets(BaseEffect, stage="geometry", cost=2e-8):
    """Recorded contacts are those of the flat mesh."""

    def bound(self, context: Context) -> float:
        """Twice the largest error of the contact point for an indenter above each taxel, m."""
        skin = context.skin
        centres = skin.positions + context.indenter_radius * skin.normals
        smooth = context.body.closest(centres).point
        error = np.linalg.norm(facets(context)(centres)[0] - smooth, axis=1)
        return 2.0 * float(error.max())

    def build(self, context: Context) -> FrameTransform:
        """A stateless transform; effects that move contacts later use the facets too."""
        flat = facets(context)
        return lambda frames: replace(frames, closest_point=flat).with_centres(frames.centres)


def facets(context: Context) -> ClosestPoint:
    """The closest-point function of the flat mesh that the robot's software uses."""
    return Facets(context.body.facets).closest
