"""The rig of an exploration: the arm with the body on it, and the indenter under it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..contact.indenter import Indenter
from ..core.se3 import Array, orthonormal_basis, transform
from ..geometry.body import Body
from . import collision
from .arm import Arm


@dataclass(frozen=True)
class ContactRig:
    """What explores: the arm with the body, and the indenter under it."""

    body: Body
    indenter: Indenter
    depth: float
    """Depth to which the indenter is pressed in, m."""
    reach: float
    """Distance along the surface at which a contact is felt, m."""
    arm: Arm | None = None
    """None: the body moves freely, without an arm."""
    mount: Array | None = None
    """T_tip_body (4, 4)."""
    patch: float = 0.0
    """Longer semi-axis of the contact patch, m: no edge may be nearer than that."""
    holds: Callable[[Array], Array] | None = None
    """Principal curvatures (k, 2), 1/m -> why the contact model does not hold there: strings, ""
    where it does. None: it always does."""

    @cached_property
    def brink(self) -> Array:
        """Points (k, 3) on the body's edges."""
        return collision.edges(self.body, 0.2 * self.patch) if self.patch else np.zeros((0, 3))

    @cached_property
    def mounted(self) -> collision.Mounted | None:
        """What of the arm is not judged against the body; None: no arm."""
        if self.arm is None or self.mount is None:
            return None
        return collision.mounted(self.arm, self.body, self.mount)

    def fits(self, points: Array, normals: Array) -> Array:
        """Why the indenter cannot be pressed in at points (k, 3): see `clear.fits`, and `holds`."""
        why = collision.fits(self.body, points, normals, self.indenter, self.depth)
        why[(why == "") & collision.on_edges(points, self.brink, self.patch)] = collision.EDGE
        free = np.flatnonzero(why == "")
        if self.holds is not None and len(free):
            why[free] = self.holds(self.body.closest(points[free]).curvature)
        return why

    @property
    def gap(self) -> float:
        """Height of the indenter's centre over the contact point, m."""
        return self.indenter.radius - self.depth

    def tips(self, points: Array, normals: Array) -> Array:
        """The indenter's centre (..., 3), body frame, when it is pressed in at contact points."""
        return np.asarray(points + self.gap * normals)

    def poses(self, tips: Array, normals: Array, headings: Array) -> Array:
        """T_w_b (..., 4, 4) with the normals (..., 3) straight against the indenter.

        tips (..., 3): where the indenter's centre is in the body frame;
        headings (..., 3): unit tangents that come to lie along x of the indenter's frame.
        """
        tips, normals, headings = np.broadcast_arrays(tips, normals, headings)
        down, x = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
        local = orthonormal_basis(normals, headings)
        held = self.indenter.rotation @ orthonormal_basis(down, x)
        rotation = held @ np.swapaxes(local, -1, -2)
        place = np.array(self.indenter.position) - np.einsum("...ij,...j->...i", rotation, tips)
        return np.asarray(transform(rotation, place))
