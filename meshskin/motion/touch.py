"""Contact of the indenter with the surface patch, as CasADi expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from ..geometry.patch import POWERS, casadi_foot
from ..physics.contact import hertz
from .loop import Parameters


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
    curvature: ca.SX
    """Mean of the principal curvatures, 1/m."""
    radius: ca.SX
    """Relative radius of the two surfaces, m."""
    depth: ca.SX
    """Penetration, m; negative in the air."""
    force: ca.SX
    """N."""
    stiffness: ca.SX
    """K_c of F = K_c depth^(3/2), N/m^(3/2)."""

    @property
    def slope(self) -> ca.SX:
        """dF/d(depth), N/m."""
        return 1.5 * self.stiffness * ca.sqrt(ca.fmax(self.depth, 1e-12)) * (self.depth > 0)


def touch(anchor: ca.SX, uv: ca.SX, centre: ca.SX, p: Parameters, newton: int = 1) -> Touch:
    """The contact of an indenter centred at `centre` (3,), body frame.

    anchor (69,) and uv (2,), the last foot: see loop.ANCHOR; newton: steps towards the foot, one
    where the last foot is a step of a first-order method away.
    """
    patch = ca.reshape(anchor[: 3 * len(POWERS)], len(POWERS), 3)
    change = ca.reshape(anchor[3 * len(POWERS) :], 2, 3)
    start = change @ ca.vertcat(uv, 1.0)
    u, v, point, normal, curvatures = casadi_foot(patch, start[0], start[1], centre, newton)
    depth = p.indenter_radius - ca.dot(normal, centre - point)
    curvature = 0.5 * (curvatures[0] + curvatures[1])
    radius = 1.0 / (curvature + 1.0 / p.indenter_radius)
    return Touch(
        u=u,
        v=v,
        point=point,
        normal=normal,
        curvature=curvature,
        radius=radius,
        depth=depth,
        force=hertz.force(depth, radius, p.effective_modulus),
        stiffness=4.0 / 3.0 * p.effective_modulus * ca.sqrt(radius),
    )


def reference_depth(p: Parameters, radius: ca.SX) -> ca.SX:
    """Depth at which Hertz gives the reference force; `radius` relative, m."""
    return (0.75 * p.force_reference / p.effective_modulus) ** (2 / 3) / radius ** (1 / 3)
