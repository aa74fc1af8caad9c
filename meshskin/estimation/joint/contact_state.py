"""The contacts at values of the global parameters, as each group of taxels responds to them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...contact import Patches
from ...core.arrays import Array
from ..data.global_parameters import GlobalParameters

SIZE_NORM = 1.91, 3.95
"""Sums over all readings of products of their derivatives in ln size with those in ln F, and of
squares of the former, relative to squares of the latter: 1.90 to 1.92 and 3.91 to 3.97 for Hertz'
patches under discs of half their radius, in bodies/sphere.toml, ellipsoid.toml and on a spiral."""


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


def with_own_size(
    contacts: Contacts,
    parameters: GlobalParameters,
    levels: tuple[float, float],
    slopes: tuple[Array, ...],
    load: Array,
) -> tuple[Contacts, tuple[Array, ...]]:
    """The contacts, and the slopes of their patches, with errors `load` (m,) of ln F with which
    sizes grow by another exponent than with the force.

    On a half-space that is less by 1/3 where the errors are those of the amplitude alone, which
    compression leaves at the level of gains. Readings change as much by an error whatever the
    exponent is: one that made errors smaller at the same readings would be preferred for that.

    levels: as `Measurements.response_levels`; slopes: in ln F, as `Contacts.by_load`, by the model
    under compression.
    """
    column = parameters.columns_of(contacts.group)["exponents"].stop - 1
    first = parameters.columns_of(0)["compression"].start
    more, compression, (both, square) = contacts.s[column], contacts.s[first], SIZE_NORM
    kept = float((1 + 2 * both * more + square * more**2) ** -0.5)
    lost = -(both + square * more) * kept**2
    amplified, apart = 1 + levels[1] * compression, 3 * (levels[1] - levels[0])
    *sizes, peak = (kept * slope for slope in slopes)
    shape, log_peak = tuple(x.copy() for x in contacts.shape), contacts.log_peak.copy()
    for axis in range(min(len(sizes), 2)):
        sizes[axis] = sizes[axis] + kept * amplified * more
        shape[axis][:, column] = load * (kept * amplified + lost * sizes[axis])
    bare = apart * peak / amplified
    peak = peak + compression * more * bare
    log_peak[:, column] = load * (lost * peak + compression * bare)
    log_peak[:, first] += load * more * bare / amplified
    return replace(contacts, shape=shape, log_peak=log_peak), (*sizes, peak)
