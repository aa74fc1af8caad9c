"""What the closed loop is made of: its parts, its parameters, and the layout of its arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact import ContactModel
from ..core.arguments import check_name
from ..core.se3 import Array
from ..scene.settings import INTEGRATORS, MODES, Law

if TYPE_CHECKING:
    from ..robot.arm import Arm

REFERENCE = 18
"""A row of the path: body position 3, body rotation 9 (columns), velocity 3, angular velocity 3."""
ANCHOR = 69
"""What a step knows of the surface: a face's patch (21, 3) and the map (2, 3), column-major.

The map takes (u, v, 1) of the last step's foot, on the last step's face, to this face."""


@dataclass(frozen=True)
class Parameters:
    """Numbers of the closed loop that are inputs of its step, so that changing one needs no new
    function: floats, or CasADi symbols when the gains are to be chosen by optimisation."""

    dt: Any
    """s."""
    gamma: Any
    """1/s."""
    rate: Any
    """Velocity gain: 1/s with shape "inertia", N m s/rad with shape "identity"."""
    force_reference: Any
    """N."""
    approach_speed: Any
    """m/s."""
    tracking: Any
    """1/s."""
    effective_modulus: Any
    """E*, Pa."""
    indenter_radius: Any
    """m."""
    free: Any = 0.0
    """0: the law holds the force along the normal; 1: the body follows the path there too."""

    @classmethod
    def split(cls, vector: Any) -> Parameters:
        """The parameters in a CasADi or NumPy vector."""
        return cls(*(vector[k] for k in range(len(fields(cls)))))

    @property
    def values(self) -> list[Any]:
        """The parameters in order."""
        return [getattr(self, f.name) for f in fields(self)]


PARAMETERS = len(fields(Parameters))
APPROACH_SPEED = [f.name for f in fields(Parameters)].index("approach_speed")


@dataclass(frozen=True)
class ClosedLoopModel:
    """What the step function needs to know of a scene."""

    arm: Arm
    """The arm with its payload."""
    mount: Array
    """T_tip_body (4, 4)."""
    indenter_position: Array
    """Centre of the indenter (3,), world, m."""
    indenter_radius: float
    effective_modulus: float
    """E*, Pa."""
    law: Law
    dt: float
    """Step, s."""
    integrator: str = "semi_implicit"
    """One of INTEGRATORS; with mode "quasi_static" the body follows the law's velocity exactly."""
    mode: str = "arm"
    """"arm": the arm's dynamics; "quasi_static": the body moves as the law asks, without an arm."""
    contact: ContactModel = field(default_factory=ContactModel)
    """Contact model that gives the force."""
    delay: int = 0
    """Steps by which the reading of the contact that the law hears is old."""
    indenter_direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit vector (3,), world, in which the indenter points and the body is lifted off."""

    def __post_init__(self) -> None:
        check_name("integrator", self.integrator, INTEGRATORS)
        check_name("mode of the closed loop", self.mode, MODES)

    @property
    def joints(self) -> int:
        """Number of joints n; 0 without an arm."""
        return len(self.arm.joint_names) if self.mode == "arm" else 0

    @property
    def memory(self) -> int:
        """Numbers of the state that are readings on their way to the law, see motion.delay."""
        return 2 * self.delay

    @property
    def parameters(self) -> Parameters:
        """The numbers that are inputs of the step."""
        law = self.law
        return Parameters(
            dt=self.dt,
            gamma=law.gamma,
            rate=law.rate if law.shape == "inertia" else law.gain,
            force_reference=law.force_reference,
            approach_speed=law.approach_speed,
            tracking=law.tracking,
            effective_modulus=self.effective_modulus,
            indenter_radius=self.indenter_radius,
        )

    @property
    def outputs(self) -> dict[str, slice]:
        """Rows of a step's output: contact point and normal (body frame), force, depth, relative
        radius of the surfaces, joint torques."""
        n = self.joints
        return {
            "point": slice(0, 3),
            "normal": slice(3, 6),
            "force": slice(6, 7),
            "depth": slice(7, 8),
            "radius": slice(8, 9),
            "torque": slice(9, 9 + n),
        }


def flat_anchor(patch: Array, change: Array | None = None) -> Array:
    """The row (69,) of a step's input `anchor`: patch (21, 3), map (2, 3), or the identity."""
    change = np.eye(2, 3) if change is None else change
    return np.concatenate([patch.T.ravel(), change.T.ravel()])
