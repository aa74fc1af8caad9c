"""Equations of motion of an arm as CasADi expressions, by the recursions of adam.

Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ..core.config import STANDARD_GRAVITY
from ..core.errors import ArmError
from .urdf import rotation

if TYPE_CHECKING:
    from .arm import Arm

GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""Acceleration of gravity (3,), world frame, m/s^2."""


class Dynamics:
    """Expressions of an arm's equations of motion, M(q) qdd + bias(q, qd) = torque + J^T wrench.

    Mimic joints are eliminated: with the positions of all joints G q + o the mass matrix is
    G^T M G and the bias G^T bias. Raises ArmError if a joint moves no link that has a mass.
    """

    def __init__(self, arm: Arm) -> None:
        names = [by.joint.name for by in arm.driven]
        _check_masses(arm)
        self._arm, self._adam = arm, _adam(arm.tree.reduced(arm.name, names), names)
        gather = np.zeros((len(names), len(arm.joint_names)))
        for row, by in enumerate(arm.driven):
            if by.column is not None:
                gather[row, by.column] = by.multiplier
        self._gather = ca.sparsify(ca.DM(gather))
        # in the base's axes, in which adam works; + 0.0: no zero is negative
        self._gravity = arm.base[:3, :3].T @ GRAVITY + 0.0

    def mass_matrix(self, q: ca.SX) -> ca.SX:
        """Mass matrix (n, n), kg m^2, with the motors' reflected inertia, at angles `q` (n,)."""
        m = self._adam.crba(ca.SX.eye(4), self._all(q))[0].array[6:, 6:]
        m = self._gather.T @ m @ self._gather
        return ca.densify(m + ca.diag(ca.DM(self._arm.reflected_inertia)))

    def bias(self, q: ca.SX, qd: ca.SX) -> ca.SX:
        """Coriolis, centrifugal and gravity torques (n,), N m, at `q` and velocities `qd` (n,)."""
        gravity = ca.SX([*self._gravity, 0.0, 0.0, 0.0])
        rates = self._gather @ qd
        torque = self._adam.rnea(ca.SX.eye(4), self._all(q), ca.SX(6, 1), rates, gravity).array
        return ca.densify(self._gather.T @ torque[6:])

    def _all(self, q: ca.SX) -> ca.SX:
        """Positions of all moving joints of the chain."""
        return ca.vertcat(*(by.position(q) for by in self._arm.driven))


def _check_masses(arm: Arm) -> None:
    """Raise ArmError if the last joint moves no mass, which makes the mass matrix singular."""
    names = [by.joint.name for by in arm.driven]
    last = arm.driven[-1]
    motor = last.column is not None and arm.reflected_inertia[last.column] > 0.0
    links = arm.tree.massless_links(last.joint, names)
    if links and not motor:
        raise ArmError(
            f"nothing that joint {last.joint.name!r} of {arm.name} moves has a mass",
            value=f"links {', '.join(links[:5])}{' ...' if len(links) > 5 else ''}",
            remedy="give one of them an <inertial>, or the arm a payload",
        )


def _adam(urdf: str, names: list[str]) -> Any:
    """adam's algorithms for the joints `names` of a bare URDF text."""
    from adam.casadi.casadi_like import SpatialMath
    from adam.core import RBDAlgorithms
    from adam.model import Model
    from adam.model.std_factories.std_joint import StdJoint
    from adam.model.std_factories.std_model import URDFModelFactory

    class ExactMath(SpatialMath):
        """adam's mathematics with exact quarter turns (40 % fewer instructions), and with prismatic
        joints that slide along their own axis (adam 0.5 takes it for the parent link's)."""

        def R_from_RPY(self, rpy: Any) -> Any:
            angles = ca.DM(rpy.array).full().ravel()
            return self.factory.asarray(ca.sparsify(ca.SX(rotation(angles))))

        def H_prismatic_joint(self, xyz: Any, rpy: Any, axis: Any, q: Any) -> Any:
            turn = self.R_from_RPY(rpy)
            return self.homogeneous(turn, xyz + self.mxv(turn, q * axis))

        def X_prismatic_joint(self, xyz: Any, rpy: Any, axis: Any, q: Any) -> Any:
            pose = self.H_prismatic_joint(xyz, rpy, axis, q)
            back = self.swapaxes(pose[..., :3, :3], -1, -2)
            return self.spatial_transform(back, self.mxv(-back, pose[..., :3, 3]))

    class ExactJoint(StdJoint):
        """adam's joint, with a motion subspace of six rows where it slides."""

        def motion_subspace(self) -> Any:
            if self.type != "prismatic":
                return super().motion_subspace()
            zero, axis = self.math.zeros(1), self.axis
            return self.math.vertcat(axis[0], axis[1], axis[2], zero, zero, zero)

    class ExactFactory(URDFModelFactory):
        """adam's factory of exact joints."""

        def build_joint(self, joint: Any) -> ExactJoint:
            return ExactJoint(joint, self.math)

    exact = ExactMath()
    model = Model.build(ExactFactory(urdf, exact), joints_name_list=names)
    return RBDAlgorithms(model, exact)
