"""The belief with estimated unknowns of the robot, and the estimate on the clock of the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...geometry.body import Body
from ...robot.contact_kinematics import ContactKinematics
from ...scene.belief import Belief
from ...scene.contact_motion import ContactMotion
from ..calibration import Calibration


def with_clock(found: Calibration, clock: float) -> Calibration:
    """The calibration with the offset of the clocks, s, that its contacts were moved by before: the
    table of its belief is about that offset, too."""
    if not clock:
        return found
    name, belief = "clock_offset", found.belief
    assert belief is not None
    assert belief.contact_motion is not None
    value, sigma = found.unknowns[name]
    motion = belief.contact_motion
    mean = motion.mean + clock * (np.array(motion.labels) == name)
    belief = replace(belief, contact_motion=replace(motion, mean=mean))
    return replace(found, belief=belief, unknowns={**found.unknowns, name: (value + clock, sigma)})


def corrected(
    belief: Belief, kinematics: ContactKinematics, s: Array, motion: ContactMotion
) -> Belief:
    """The belief with the body's scale and the indenter's radius of s (K,), and its motion."""
    scale = float(np.exp(kinematics.value("mesh_scale", s)))
    radius = belief.indenter.radius + kinematics.value("indenter_radius", s)
    return replace(
        belief,
        body=belief.body if scale == 1.0 else _scaled(belief.body, scale),
        indenter=replace(belief.indenter, radius=radius),
        contact_motion=motion,
    )


def _scaled(body: Body, scale: float) -> Body:
    """The body with its mesh scaled about the origin of its frame."""
    mesh = body.mesh.copy()
    mesh.apply_scale(scale)
    return replace(body, mesh=mesh, exact=None, robot_mesh=None)
