"""Coulomb friction of the sliding contact: shear displaces the skin and so the pressure on it.

The indenter drags the surface along by u, at most

    |u| <= 3 mu F (2 - nu) / (16 a G),

the tangential displacement at which a Hertz contact on a half-space begins to slide. Until then the
contact sticks, and u grows with the motion of the contact. A taxel at X lies at X + u, so that in
the coordinates of the undeformed skin the patch lags behind the contact by u. Pressure and force
are unchanged (the half-space is nearly incompressible: shear does not lift its surface). Partial
slip within the patch and a rolling indenter are not modelled. Source: K. L. Johnson, "Contact
Mechanics" (1985), eq. 7.42, section 7.1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, FrameTransform
from .frames import MAX_FRAME_GAP, Frames


@dataclass(frozen=True)
class Friction(BaseEffect, stage="contact", cost=9e-8):
    """The patch lags behind the contact by the shear displacement of the skin."""

    coefficient: float = quantity("", 0.2, least=0.0, most=5.0)
    """Coefficient of friction mu."""

    def slip(self, context: Context) -> float:
        """Shear displacement at which the contact slides, m, at the reference force."""
        stiffness = 16.0 * context.contact_radius * context.shear_modulus / (2.0 - context.poisson)
        return 3.0 * self.coefficient * context.force / stiffness

    def bound(self, context: Context) -> float:
        """The shear displacement of a sliding contact, m."""
        return self.slip(context)

    def build(self, context: Context) -> FrameTransform:
        """A transform that keeps the shear displacement from batch to batch."""
        slip, max_gap = self.slip(context), MAX_FRAME_GAP * context.period
        shear = np.zeros(3)
        last: tuple[float, np.ndarray] | None = None

        def drag(frames: Frames) -> Frames:
            nonlocal shear, last
            shears = np.empty_like(frames.points)
            limits = slip * (frames.force / context.force) ** (2.0 / 3.0)  # F / a
            for k, (time, point) in enumerate(zip(frames.time, frames.points, strict=True)):
                if last is None or time - last[0] > max_gap:
                    shear = np.zeros(3)
                else:
                    shear = shear + (point - last[1])
                shear = shear - (shear @ frames.normals[k]) * frames.normals[k]
                size = float(np.sqrt(shear @ shear))
                if size > limits[k]:
                    shear = shear * (limits[k] / size)
                shears[k], last = shear, (time, point)
            return replace(frames, points=frames.points - shears)

        return drag
