"""Standard deviations of the random effects and of the noise, and how the data move them.

An effect x with the posterior variance V has the expectation E[x^2] = s^2 - V at its true variance
s^2: the score of the restricted likelihood in ln s^2 is (sum x^2 / s^2 - d) / 2, where
d = sum (1 - V / s^2) is the number of effects that the readings determine.

With P the prior precision of the effects and C their posterior covariance, the trace of
W = 1 - P^(1/2) C P^(1/2) is d. Fisher's information on the logarithms of two variances is half the
sum of the squares of W's entries between their effects. The sum of a row of that matrix bounds it
from above: steps by it do not go too far. For the profile, whose few coefficients depend on all
else, the diagonal entry is taken. Traces are Hutchinson's but for the profile's, which is exact.

Sources: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58 (1971); Hutchinson, Commun. Stat. Simul. Comput. 18 (1989).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array
from ..joint.coupled_system import CoupledSystem
from ..joint.fault_detection import MIN_SCALE
from ..joint.reading_sums import CONTACT_SIZE, Parts
from ..joint.readings import Readings

MAX_FACTOR = 50.0
"""Largest factor of a variance between two steps: few steps lead to the floor, and none goes so far
that other effects take the part of this one."""
MIN_FREEDOM = 0.05
"""Least mean degrees of freedom of a residual: with fewer the noise is not known."""
NOISE_ITERATIONS = 20
"""Largest number of weighted fits of the noise's two parts; three are usual."""
SHAPE_READINGS = 4.0
"""Readings that the belief about uneven contacts counts as. Chosen: the residuals of a few say
little, for taxels move with them; those of a hundred decide."""
SMALL_GAIN = 0.05
"""Expected increase of the restricted likelihood below which a variance stays: it is within a third
of its standard error, and where it moved on, the unknowns that follow it would never come to rest.
"""
MIN_DETERMINED = 1e-6
"""Share of the effects that the readings determine, below which their variance has no score."""
MIN_INFORMATION = 1e-12
"""Least information of a variance, against division by zero."""
FLOOR = {
    "position": 1e-6,
    "force": 1e-4,
    "profile": 1e-4,
    "gain": 1e-4,
    "offset": 1e-3,
    "drift": 1e-3,
    "skew": 1e-6,
}
"""Least deviations: far below what any recording can tell from zero."""
UNMEASURED_FORCE = 0.3
"""Least deviation of ln F where forces were not measured: neighbouring contacts of a stroke share
their errors, which a smaller one would take for independent. With it each contact's own readings
determine its force. A touch is left out where its force is below 0.6 of that in the same place
(kinematics/steady.py): the others are within a factor of 1.4 or so."""
HELD_FORCE = 0.015
"""Deviation of ln F up to which a force that was not measured was held: 0.009 was found in strokes
of a constant force, 0.025 to 0.04 where it varies by 5 %."""
MIN_PROBES, MAX_PROBES, PROBED = 2, 6, 6000
"""Hutchinson's probes: with n taxels the sums are known to about 1 / sqrt(probes n), and n times
the probes are PROBED where the limits allow it."""


@dataclass(frozen=True)
class Effects:
    """What the estimate says of `count` effects of one variance, relative to it."""

    square: float
    """Sum of squares."""
    determined: float
    """Trace of W: number of effects that the readings determine."""
    information: float
    """Fisher's information on the logarithm of the variance, times 2, or a bound above it."""
    count: int


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of the random effects and of the noise."""

    noise: float = 1.0
    """Constant part of a reading's noise, in units of `Measurements.sigma`."""
    relative: float = 0.0
    """Part of the noise proportional to the reading."""
    shape: float = 1.0
    """Standard deviation by contacts over edges of the body, relative to `Measurements.uneven`."""
    position: float = 1e-4
    """Of a contact's displacement along each tangent, m."""
    force: float = 0.02
    """Of ln F of a contact."""
    profile: float = 0.1
    """Of the learned profile, relative to the peak."""
    gain: float = 0.1
    """Of ln gain of a taxel."""
    offset: float = 3.0
    """Of a taxel's offset, in units of `Measurements.sigma`."""
    drift: float = 1.0
    """Of the offset's drift over the recording, in units of `Measurements.sigma`."""
    skew: float = 1e-4
    """Of the distance of the patches behind the contacts when a taxel is read, m."""
    least_force: float = FLOOR["force"]
    """Least `force` above HELD_FORCE; UNMEASURED_FORCE where the forces were not measured."""

    def noise_of(self, mu: Array, uneven: Array | float = 0.0) -> Array:
        """Standard deviation (k,) of readings with the expectations mu (k,), in contacts with
        `Measurements.uneven` (k,), all in units of `Measurements.sigma`."""
        noise = np.hypot(self.noise, self.relative * np.maximum(mu, 0.0))
        return np.asarray(np.hypot(noise, self.shape * np.asarray(uneven)))

    def moved(self, effects: dict[str, Effects], careful: bool = False) -> tuple[Deviations, float]:
        """The deviations after a step of Fisher scoring, and the largest expected increase of the
        restricted likelihood by one of them; effects: by name of the deviation; careful: as of
        `log_step`."""
        found, largest = {}, 0.0
        for name, effect in effects.items():
            sigma = getattr(self, name)
            step, gain = log_step(effect, careful)
            if 0.0 < gain < SMALL_GAIN:
                step = 0.0
            found[name], least = float(sigma * np.exp(step / 2)), FLOOR[name]
            if name == "force" and found[name] > HELD_FORCE:
                least = max(self.least_force, least)
            found[name] = max(found[name], least)
            largest = max(largest, gain if found[name] > least else 0.0)
        return replace(self, **found), largest

    def with_noise(
        self, mu: Array, uneven: Array, squares: Array, free: Array, parts: int
    ) -> Deviations:
        """The deviations with the constant part of the noise, or both `parts`, and that of the
        shape, as squared residuals (k,) of readings have it; mu and uneven (k,) as of `noise_of`.

        free (k,): 1 less the leverage, the part of a reading's variance that its residual has.
        The belief that uneven patches read as their heights counts as SHAPE_READINGS readings.
        """
        free = free * max(1.0, MIN_FREEDOM / max(float(np.mean(free)), 1e-300))
        part = np.column_stack([np.ones(len(mu)), np.maximum(mu, 0.0) ** 2, uneven**2])
        used = np.array([True, parts > 1, bool(np.any(uneven > 0))])
        variance = np.where(used, [self.noise**2, self.relative**2, self.shape**2], 0.0)
        typical = float(np.sum(uneven**4) / max(np.sum(uneven**2), 1e-300))
        believed = np.array([[1.0, 0.0, typical]])
        part, free = np.concatenate([part, believed]), np.append(free, 1.0)
        count = np.append(np.ones(len(mu)), SHAPE_READINGS if used[2] else 0.0)
        for _ in range(NOISE_ITERATIONS):
            expected = np.append(squares, variance[0] + typical)
            weighted = part * (count / np.maximum(part @ variance, 1e-12) ** 2)[:, None]
            new = _positive_solution(
                weighted.T @ (part * free[:, None]), weighted.T @ expected, used
            )
            new[0] = max(new[0], MIN_SCALE**2)
            close = np.allclose(new, variance, rtol=1e-3)
            variance = new
            if close:
                break
        found = dict(zip(("noise", "relative", "shape"), np.sqrt(variance), strict=True))
        return replace(self, **{name: float(found[name]) for name in np.array([*found])[used]})


def _positive_solution(normal: Array, right: Array, used: np.ndarray) -> Array:
    """Solution (p,) of normal equations in the terms `used` (p,) bool that are positive: the most
    negative one is left out, again and again."""
    terms = np.flatnonzero(used)
    while True:
        found = np.linalg.lstsq(normal[np.ix_(terms, terms)], right[terms], rcond=None)[0]
        if len(terms) == 1 or found.min() > 0:
            break
        terms = np.delete(terms, np.argmin(found))
    out = np.zeros(len(right))
    out[terms] = found
    return out


def log_step(effects: Effects, careful: bool = False) -> tuple[float, float]:
    """Change of the logarithm of a variance by Fisher scoring of the restricted likelihood, and the
    expected increase of its logarithm; careful: a variance near zero grows where its score is more
    than chance."""
    if effects.determined <= MIN_DETERMINED * effects.count:
        return -math.log(MAX_FACTOR), 0.0
    score = effects.square - effects.determined
    factor = 1 + score / max(effects.information, MIN_INFORMATION)
    if not 1 / MAX_FACTOR < factor < MAX_FACTOR:
        gain = score**2 / max(4 * effects.information, MIN_INFORMATION)
        if careful and score > 0 and gain < SMALL_GAIN:  # near zero, by chance
            return 0.0, gain
        return math.copysign(math.log(MAX_FACTOR), score), math.inf  # far from the maximum
    step = math.log(factor)
    return step, abs(step * score) / 4


class Probes:
    """Random signs of the readings (k, p), and of the effects of n taxels and m contacts."""

    def __init__(self, readings: Readings, contacts: int, size: int) -> None:
        """contacts: their number m; size: number D of a taxel's unknowns, two of its place."""
        rng, n = np.random.default_rng(0), len(readings.starts) - 1
        self.count = min(max(PROBED // max(n, 1), MIN_PROBES), MAX_PROBES)

        def signs(*shape: int) -> Array:
            return rng.choice([-1.0, 1.0], size=(*shape, self.count))

        self.seen = np.diff(readings.starts) > 0
        self.touched = np.bincount(readings.contact, minlength=contacts) > 0
        """Taxels (n,) bool and contacts (m,) bool with readings."""
        self.taxels = signs(n, size) * self.seen[:, None, None]
        self.taxels[:, :2] = 0.0  # places have no variance
        self.contacts = signs(contacts, CONTACT_SIZE) * self.touched[:, None, None]
        self.readings = signs(len(readings.taxel))


@dataclass(frozen=True)
class Posterior:
    """What the readings determine of the effects under given variances."""

    determined: dict[str, float]
    """Trace of W over the effects of each deviation, by its name."""
    information: dict[str, float]
    """Twice the information on the logarithm of each variance."""
    leverages: Array
    """(k,), of the readings: each has the error of a few probes, they serve for sums of many."""

    @classmethod
    def of(
        cls,
        system: CoupledSystem,
        jacobian: Array,
        root: Array,
        prior: tuple[Array, Array, Array],
        probes: Probes,
        profile: slice,
        names: tuple[str, ...],
    ) -> Posterior:
        """Under the normal equations `system`; jacobian (k, D + ks + 3) and root (k,): derivatives
        of the readings, and the square roots of the second derivatives of their costs; prior:
        precisions of a taxel (D,), a contact (3,) and the global parameters (ks,); profile: rows of
        its coefficients among these; names (D - 2,): of a taxel's effects."""
        count = probes.count
        signs = root[:, None] * probes.readings
        # in units of the prior deviations no effect's probe drowns another's
        taxel, contact = (np.sqrt(part)[:, None] for part in prior[:2])
        none = np.zeros((len(prior[2]), count))
        effects = taxel * probes.taxels, contact * probes.contacts, none
        both = zip(system.transposed(jacobian, signs), effects, strict=True)
        solved = system.solve(*(np.concatenate(parts, axis=-1) for parts in both))
        fitted = system.forward(jacobian, _columns(solved, slice(count)))
        x = _columns(solved, slice(count, None))
        taxels = probes.taxels - taxel * x[0] * probes.seen[:, None, None]
        contacts = probes.contacts - contact * x[1] * probes.touched[:, None, None]

        def traces(signs: Array, rest: Array) -> list[Array]:
            return [np.einsum("nic,nic->i", a, rest) / count for a in (signs, rest)]

        own, own_squared = traces(probes.taxels, taxels)
        at, at_squared = traces(probes.contacts, contacts)
        free = np.eye(profile.stop - profile.start)
        free -= system.shared_covariance[profile, profile] * prior[2][profile]
        return cls(
            determined={
                "position": float(at[0] + at[1]),
                "force": float(at[2]),
                "profile": float(np.trace(free)),
                **dict(zip(names, map(float, own[2:]), strict=True)),
            },
            information={
                "position": float(at_squared[0] + at_squared[1]),
                "force": float(at_squared[2]),
                "profile": float(np.sum(free * free.T)),
                **dict(zip(names, map(float, own_squared[2:]), strict=True)),
            },
            leverages=np.mean(signs * fitted, axis=1),
        )


def _columns(x: Parts, chosen: slice) -> Parts:
    return x[0][..., chosen], x[1][..., chosen], x[2][..., chosen]
