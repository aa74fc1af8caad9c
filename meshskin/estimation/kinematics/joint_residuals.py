"""What an error of each joint that varies with its angle would explain of the contacts' heights.

    r = a_j (alpha + beta cos q_j + gamma sin q_j) + rest,    a_j = d height / d q_j

r are the heights that are left after the estimate of constant offsets. An eccentric encoder or a
bent link shows as a joint that explains much more of them than it would of errors of the surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.special import fdtrc

from ...core.arrays import Array
from ...geometry.body import Body
from ...robot.contact_kinematics import JOINT_DELAY, JOINT_OFFSET, ContactKinematics, JointPath
from ..data.registration import CELL

SIGNIFICANCE = 1e-3
"""Probability by chance below which a joint is named: one robot of 170 with six sound joints is."""
LARGEST = 0.05
"""Standard deviation of alpha, beta and gamma before, rad: three degrees, more than any encoder
that works is off. It keeps joints that hardly move the body from standing for others."""
LENGTHS = CELL * np.array([0.5, 1.0, 2.0, 4.0, 8.0])
"""Lengths, m, over which errors of the surface are alike: from dents of a mesh to half a link."""
NOISES = (1e-3, 1e-1)
"""Variances of the noise of a contact over that of these errors."""
MOST = 400
"""Contacts that are compared, evenly spaced in the log: neighbouring ones tell the same."""


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
    unknowns s (K,) of `kinematics`. The chance is that of the likelihood ratio, as F.
    """
    time = time - kinematics.value("clock_offset", s)
    names = [name for name in (JOINT_OFFSET, JOINT_DELAY) if name in kinematics.columns]
    alone = replace(kinematics, unknown={JOINT_OFFSET: 1.0} | dict.fromkeys(names, 1.0))
    known = np.zeros(len(alone.labels))
    for name in names:
        known[alone.columns[name]] = s[kinematics.columns[name]]
    centres, slopes = alone.centres(path, time, known)
    hit = body.closest(centres)
    by_joint = np.einsum("mi,mij->mj", hit.normal, slopes[:, :, alone.columns[JOINT_OFFSET]])
    angles, total = path.at(time, alone.delays(known))[0], max(float(r @ r), 1e-24)
    found, rests = [], [r]
    for k, name in enumerate(alone.chain.joint_names):
        q = angles[:, k]
        shapes = np.stack([np.ones_like(q), np.cos(q), np.sin(q)], axis=1)
        effect = by_joint[:, k, None] * shapes
        prior = np.eye(3) * total / len(r) / LARGEST**2
        weights = np.linalg.solve(effect.T @ effect + prior, effect.T @ r)
        rests.append(r - effect @ weights)
        error = float(np.sqrt(np.mean((shapes @ weights) ** 2)))
        found.append(JointResidual(name, error, 1 - float(rests[-1] @ rests[-1]) / total, 1.0))
    likelihoods = _log_likelihoods(hit.point, np.stack(rests, axis=1))
    count = min(len(r), MOST)
    free = max(count - 3, 1)
    ratios = np.expm1(np.maximum(likelihoods[1:] - likelihoods[0], 0.0) * 2 / count) * free / 3
    return tuple(
        replace(one, chance=float(fdtrc(3, free, ratio)))
        for one, ratio in zip(found, ratios, strict=True)
    )


def _log_likelihoods(points: Array, heights: Array) -> Array:
    """Log likelihoods (K,) of heights (m, K) as errors of the surface at points (m, 3), m.

    These are a process that is alike over a distance on the body, of the length, noise and variance
    that are likeliest for each column.
    """
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), MOST)).round().astype(int))
    apart = np.linalg.norm(points[rows, None] - points[rows], axis=2)
    found = []
    for covariance in _covariances(apart):
        factor = cholesky(covariance, lower=True)
        white = solve_triangular(factor, heights[rows], lower=True)
        squares = np.maximum(np.sum(white**2, axis=0), 1e-24)
        found.append(-len(rows) / 2 * np.log(squares) - np.log(np.diag(factor)).sum())
    return np.asarray(np.max(found, axis=0))


def _covariances(apart: Array) -> Iterator[Array]:
    """Covariances (m, m) of errors of contacts that are `apart` (m, m), m (Matern, 3/2)."""
    one = np.eye(len(apart))
    yield one
    for length in LENGTHS:
        x = np.sqrt(3) * apart / length
        for noise in NOISES:
            yield (1 + x) * np.exp(-x) + noise * one
