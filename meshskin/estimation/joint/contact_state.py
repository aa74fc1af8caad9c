"""The contacts at values of the global parameters, as each group of taxels responds to them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ...contact import Patches
from ...core.arrays import Array


@dataclass(frozen=True)
class Contacts:
    """m contacts at values of the global parameters s (ks,), and their derivatives in s."""

    points: Array
    """(m, 3), body frame, m."""
    normals: Array
    """(m, 3)."""
    directions: Array
    """Unit tangents (m, 3) along the patches' first semi-axes."""
    patches: Patches
    """Semi-axes, m, and peaks p_0, Pa, of m contacts."""
    shape: tuple[Array, ...]
    """Derivatives (m, ks) of ln a, ln b and the exponent, as far as the contact model has them."""
    log_peak: Array
    """d ln p_0 / ds (m, ks)."""
    moves: Array | None
    """Derivatives (m, 6, ks) of the contacts' frames: of the points, m, and rotations, rad; None
    where they are constant."""
    s: Array = field(default_factory=lambda: np.empty(0))
    """The values (ks,)."""
    by_load: tuple[Array, ...] = ()
    """Derivatives (m,) in ln F of the entries of `shape`, and of ln p_0, where contacts have errors
    of their own; empty otherwise."""
    profile: Array = field(default_factory=lambda: np.empty(0))
    """Whitened coefficients of the learned profile; empty where it is not learned."""
    compression: float = 0.0
    """Compression of strong readings, relative to the nominal peak."""
    load_errors: Array = field(default_factory=lambda: np.empty(0))
    """Errors (m,) of ln F, where contacts have errors of their own; else empty."""
    group: int = 0
    """Group of taxels whose response patches, profile and compression are."""
    others: tuple[Contacts, ...] = ()
    """The same contacts with the responses of the further groups."""

    @property
    def each(self) -> tuple[Contacts, ...]:
        """These contacts with the response of each group."""
        return self, *self.others

    @cached_property
    def across(self) -> Array:
        """Unit tangents (m, 3) along the patches' second semi-axes."""
        return np.cross(self.normals, self.directions)

    @property
    def radii(self) -> Array:
        """Radii (m,), m, of the circles of the patches' areas."""
        return np.asarray(np.sqrt(self.patches.first * self.patches.second))

    @property
    def peaks(self) -> Array:
        """p_0 (m,), Pa."""
        return np.asarray(self.patches.peak)
