"""What an error of each joint that varies with its angle would explain of the contacts' heights.

    r = a_j (alpha + beta cos q_j + gamma sin q_j) + rest,    a_j = d height / d q_j

r are the heights that are left after the estimate of constant offsets. An eccentric encoder or a
bent link shows as a joint that explains much more of them than chance does, 3 / m of m contacts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array
from ...geometry.body import Body
from ...robot.contact_kinematics import DELAYS, JOINTS, ContactKinematics, JointPath
from .heights import design_effect
from .mesh_error import CELL

SIGNIFICANCE = 1e-3
"""Probability by chance below which a joint is named: one robot of 170 with six sound joints is."""
LARGEST = 0.05
"""Standard deviation of alpha, beta and gamma before, rad: three degrees, more than any encoder
that works is off. It keeps joints that hardly move the body from standing for others."""
CORRELATED = 10.0
"""Contacts, at least, that count as one, as neighbouring ones share the errors of mesh and joints;
more where what the joint leaves unexplained is alike in cells of the body (design_effect)."""
CELLS = CELL * np.array([1.0, 2.0, 4.0, 8.0])
"""Sizes of these cells, m: from those of a mesh's errors to half a link."""


@dataclass(frozen=True)
class JointResidual:
    """What one joint would explain."""

    joint: str
    """Its name."""
    error: float
    """RMS, rad (m where it slides), of the error that would explain most."""
    explained: float
    """Part of the sum of squares of the heights that it explains."""
    chance: float
    """Probability that a sound joint explains as much."""

    @property
    def words(self) -> str:
        """One line about it; empty where chance explains as much."""
        if self.chance > SIGNIFICANCE:
            return ""
        return (
            f"{self.joint}: an error that varies with its angle would explain {self.explained:.0%} "
            "of the heights left; check its encoder and its link's length"
        )


def joint_residuals(
    kinematics: ContactKinematics, path: JointPath, time: Array, body: Body, r: Array, s: Array
) -> tuple[JointResidual, ...]:
    """What each joint of the chain would explain of heights r (m,), m, at times (m,), s, with the
    unknowns s (K,) of `kinematics`.
    """
    from scipy.special import fdtrc

    time = time - kinematics.value("clock_offset", s)
    names = [name for name in (JOINTS, DELAYS) if name in kinematics.columns]
    alone = replace(kinematics, unknown={JOINTS: 1.0} | dict.fromkeys(names, 1.0))
    known = np.zeros(len(alone.labels))
    for name in names:
        known[alone.columns[name]] = s[kinematics.columns[name]]
    centres, slopes = alone.centres(path, time, known)
    hit = body.closest(centres)
    by_joint = np.einsum("mi,mij->mj", hit.normal, slopes[:, :, alone.columns[JOINTS]])
    angles, total = path.at(time, alone.delays(known))[0], max(float(r @ r), 1e-24)
    found = []
    for k, name in enumerate(alone.chain.joint_names):
        q = angles[:, k]
        shapes = np.stack([np.ones_like(q), np.cos(q), np.sin(q)], axis=1)
        effect = by_joint[:, k, None] * shapes
        prior = np.eye(3) * total / len(r) / LARGEST**2
        weights = np.linalg.solve(effect.T @ effect + prior, effect.T @ r)
        rest = r - by_joint[:, k] * (shapes @ weights)
        explained = 1 - float(rest @ rest) / total
        alike = max(CORRELATED, *(design_effect(hit.point, rest, size) for size in CELLS))
        free = max(len(r) / alike - 3, 1.0)
        ratio = explained / 3 / max((1 - explained) / free, 1e-12)
        error = float(np.sqrt(np.mean((shapes @ weights) ** 2)))
        found.append(JointResidual(name, error, explained, float(fdtrc(3, free, ratio))))
    return tuple(found)
