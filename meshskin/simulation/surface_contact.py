"""Contact of the indenter with a surface patch as CasADi expressions, and its delayed measurement.

A delay of k steps adds k pairs (depth, force) to the state, the oldest first. The dynamics always
use the present contact; the law uses the oldest pair. Before the first measurement arrives the
pairs hold what `Simulator.rest_state` put there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from ..contact import ContactModel
from ..geometry.surface.patch import POWERS, casadi_foot
from .closed_loop_model import Parameters

MIN_DEPTH = 1e-12
"""Depth, m, below which the force's slope is evaluated at this depth: sqrt has no slope at 0. A
micrometre's millionth, far below any depth of a contact."""


@dataclass(frozen=True)
class SurfaceContact:
    """The contact in the body frame; all members are expressions."""

    u: ca.SX
    v: ca.SX
    """(u, v): foot point of the indenter's centre in the patch's parameters."""
    point: ca.SX
    """Contact point (3,), m."""
    normal: ca.SX
    """Outward unit normal (3,)."""
    curvatures: ca.SX
    """Principal curvatures (2,), 1/m, larger first."""
    depth: ca.SX
    """Penetration, m; negative without contact."""
    force: ca.SX
    """Normal force, N."""
    model: ContactModel
    """Contact model that gives the force."""
    p: Parameters
    """Parameters of the step."""

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
        """dF/d(depth), N/m; zero without contact."""
        return self.slope_at(ca.fmax(self.depth, MIN_DEPTH)) * (self.depth > 0)

    @property
    def output(self) -> ca.SX:
        """The part of a step's output that is of the contact; see ClosedLoopModel.outputs."""
        return ca.vertcat(self.point, self.normal, self.force, self.depth, self.radius)

    def force_at(self, depth: ca.SX) -> ca.SX:
        """The force, N, at another depth, m."""
        return self.model.force(depth=depth, **self._geometry)

    def slope_at(self, depth: ca.SX) -> ca.SX:
        """dF/d(depth), N/m, at another depth > 0, m."""
        return self.model.slope(depth=depth, **self._geometry)

    @property
    def reference_depth(self) -> ca.SX:
        """Depth at which the contact has the reference force, m."""
        return self.model.patches(force=self.p.force_reference, **self._geometry).depth

    def with_modulus(self, effective_modulus: float | None) -> SurfaceContact:
        """This contact with another E*, Pa; None: unchanged."""
        if effective_modulus is None:
            return self
        return replace(self, p=replace(self.p, effective_modulus=effective_modulus))

    @property
    def _geometry(self) -> dict[str, Any]:
        return {
            "curvature": self.curvatures,
            "indenter_radius": self.p.indenter_radius,
            "effective_modulus": self.p.effective_modulus,
        }


def surface_contact(
    anchor: ca.SX, uv: ca.SX, centre: ca.SX, p: Parameters, model: ContactModel, newton: int = 1
) -> SurfaceContact:
    """The contact of an indenter centred at `centre` (3,), body frame, m.

    anchor (69,): see closed_loop_model.ANCHOR; uv (2,): the previous foot point. newton: number of
    Newton steps from there to the new foot point; one suffices for a method of order 1.
    """
    patch = ca.reshape(anchor[: 3 * len(POWERS)], len(POWERS), 3)
    face_map = ca.reshape(anchor[3 * len(POWERS) :], 2, 3)
    start = face_map @ ca.vertcat(uv, 1.0)
    u, v, point, normal, curvatures = casadi_foot(patch, start[0], start[1], centre, newton)
    depth = p.indenter_radius - ca.dot(normal, centre - point)
    force = model.force(
        depth=depth,
        curvature=curvatures,
        indenter_radius=p.indenter_radius,
        effective_modulus=p.effective_modulus,
    )
    return SurfaceContact(u, v, point, normal, curvatures, depth, force, model, p)


def delayed_reading(memory: ca.SX, contact: SurfaceContact) -> tuple[ca.SX, ca.SX]:
    """Depth, m, and force, N, that the law receives; memory (2 k,): the delayed measurements."""
    if memory.shape[0] == 0:
        return contact.depth, contact.force
    return memory[0], memory[1]


def shift_memory(memory: ca.SX, contact: SurfaceContact) -> ca.SX:
    """The delayed measurements (2 k,) after this step: the oldest leaves, the present enters."""
    if memory.shape[0] == 0:
        return memory
    return ca.vertcat(memory[2:], contact.depth, contact.force)
