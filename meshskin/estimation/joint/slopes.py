"""How the contacts' patches change over the body's surface, in the curvatures of which they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...contact import Patches
from ...core.se3 import Array

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ..data.measurements import Measurements

SLOPE_STEP = 5e-4
"""Step over which the curvatures' slopes on the surface are told, m."""
UMBILIC = 0.3
"""Turn of the principal direction over that step, rad, above which it is none: there the patch is
a circle."""


@dataclass(frozen=True)
class SurfaceGradients:
    """How m patches change over the surface, force and E* staying: tangents."""

    first: Array
    """Of ln a (m, 3), 1/m."""
    second: Array
    """Of ln b."""
    exponent: Array
    """Of the profile's exponent."""
    peak: Array
    """Of ln p_0."""
    spin: Array
    """Of the turn of the patch's axes about the normal (m, 3), rad/m."""

    @classmethod
    def about(cls, data: Measurements, body: Body) -> SurfaceGradients:
        """Those about the contacts of `data`, by central differences."""
        sides = data.directions, np.cross(data.normals, data.directions)
        found = []
        for side in sides:
            ends = [
                data.on(body.closest(data.points + step * side))
                for step in (SLOPE_STEP, -SLOPE_STEP)
            ]
            changes = [
                *(np.log(getattr(ends[0].patches, name) / getattr(ends[1].patches, name))
                  for name in ("first", "second")),
                ends[0].patches.exponent - ends[1].patches.exponent + np.zeros(len(side)),
                np.log(ends[0].patches.peak / ends[1].patches.peak),
                _spin(data, ends[0]) - _spin(data, ends[1]),
            ]  # fmt: skip
            found.append([change[:, None] * side / (2 * SLOPE_STEP) for change in changes])
        return cls(*(one + other for one, other in zip(*found, strict=True)))

    def patches(self, at: Patches, step: Array) -> Patches:
        """The patches after steps (m, 3), m, over the surface from `at`."""
        first, second, exponent, peak = (
            np.einsum("mi,mi->m", slope, step)
            for slope in (self.first, self.second, self.exponent, self.peak)
        )
        return at._replace(
            first=at.first * np.exp(first),
            second=at.second * np.exp(second),
            exponent=at.exponent + exponent,
            peak=at.peak * np.exp(peak),
        )


def _spin(here: Measurements, there: Measurements) -> Array:
    """Turn (m,), rad, about the normal of the principal directions; 0 where there is none."""
    beside = np.cross(here.normals, here.directions)
    along, across = (
        np.einsum("mi,mi->m", axis, there.directions) for axis in (here.directions, beside)
    )
    spin = across * np.where(along < 0, -1.0, 1.0)
    return np.asarray(np.where(np.abs(spin) < UMBILIC, spin, 0.0))
