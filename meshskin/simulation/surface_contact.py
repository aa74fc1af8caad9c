"""Contact of the indenter with the surface patch, as CasADi expressions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from ..contact import ContactModel
from ..geometry.surface.patch import POWERS, casadi_foot
from .closed_loop_model import Parameters

SHALLOW = 1e-12
"""Depth, m, at which the slope of the force is taken for less."""


@dataclass(frozen=True)
class Touch:
    """The contact in the body frame; all members are expressions."""

    u: ca.SX
    v: ca.SX
    """Foot of the indenter's centre on the patch."""
    point: ca.SX
    """(3,), m."""
    normal: ca.SX
    """Outward (3,)."""
    curvatures: ca.SX
    """Principal (2,), 1/m, larger first."""
    depth: ca.SX
    """Penetration, m; negative in the air."""
    force: ca.SX
    """N."""
    model: ContactModel
    """Contact model that gives the force."""
    p: Parameters

    @property
    def curvature(self) -> ca.SX:
        """Mean of the principal curvatures, 1/m."""
        return 0.5 * (self.curvatures[0] + self.curvatures[1])

    @property
    def radius(self) -> ca.SX:
        """Relative radius of the two surfaces, m."""
        return 1.0 / (self.curvature + 1.0 / self.p.indenter_radius)

    @property
    def slope(self) -> ca.SX:
        """dF/d(depth), N/m; zero in the air."""
        return self.slope_at(ca.fmax(self.depth, SHALLOW)) * (self.depth > 0)

    def force_at(self, depth: ca.SX) -> ca.SX:
        """The force, N, at another depth, m."""
        return self.model.force(depth=depth, **self._place)

    def slope_at(self, depth: ca.SX) -> ca.SX:
        """dF/d(depth), N/m, at another depth > 0, m."""
        return self.model.slope(depth=depth, **self._place)

    @property
    def reference_depth(self) -> ca.SX:
        """Depth at which the contact has the reference force, m."""
        return self.model.patches(force=self.p.force_reference, **self._place).depth

    def believed(self, effective_modulus: float | None) -> Touch:
        """This contact as it is taken to be with another E*, Pa; None: as it is."""
        if effective_modulus is None:
            return self
        return replace(self, p=replace(self.p, effective_modulus=effective_modulus))

    @property
    def _place(self) -> dict[str, Any]:
        return {
            "curvature": self.curvatures,
            "indenter_radius": self.p.indenter_radius,
            "effective_modulus": self.p.effective_modulus,
        }


def touch(
    anchor: ca.SX, uv: ca.SX, centre: ca.SX, p: Parameters, model: ContactModel, newton: int = 1
) -> Touch:
    """The contact of an indenter centred at `centre` (3,), body frame.

    anchor (69,) and uv (2,), the last foot: see loop.ANCHOR; newton: steps towards the foot, one
    where the last foot is a step of a first-order method away.
    """
    patch = ca.reshape(anchor[: 3 * len(POWERS)], len(POWERS), 3)
    change = ca.reshape(anchor[3 * len(POWERS) :], 2, 3)
    start = change @ ca.vertcat(uv, 1.0)
    u, v, point, normal, curvatures = casadi_foot(patch, start[0], start[1], centre, newton)
    depth = p.indenter_radius - ca.dot(normal, centre - point)
    force = model.force(
        depth=depth,
        curvature=curvatures,
        indenter_radius=p.indenter_radius,
        effective_modulus=p.effective_modulus,
    )
    return Touch(u, v, point, normal, curvatures, depth, force, model, p)
