"""How far the readings determine each effect, as the restricted likelihood needs it.

With P the prior precision of the effects and C their posterior covariance, the trace of
W = 1 - P^(1/2) C P^(1/2) is the number of effects that the readings determine. Fisher's information
on the logarithms of two variances is half the sum of the squares of W's entries between their
effects. The sum of a row of that matrix bounds it from above: steps by it do not go too far. For
the profile, whose few coefficients depend on all else, the diagonal entry is taken.

Traces are Hutchinson's but for the profile's, which is exact. Source: Hutchinson, Commun. Stat.
Simul. Comput. 18 (1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..joint.coupled_system import CoupledSystem
from ..joint.reading_sums import CONTACT_SIZE, Parts
from ..joint.readings import Readings
from .deviations import Effects

MIN_PROBES, MAX_PROBES, PROBED = 2, 6, 6000
"""Hutchinson's probes: with n taxels the sums are known to about 1 / sqrt(probes n), and n times
the probes are PROBED where the limits allow it."""


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
    """What the readings determine of the effects under given variances; W as in the module."""

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

    def effects(self, name: str, square: float, count: int) -> Effects:
        """The effects of the deviation `name`; square: the sum of their squares relative to its."""
        return Effects(square, self.determined[name], self.information[name], count)


def _columns(x: Parts, chosen: slice) -> Parts:
    return x[0][..., chosen], x[1][..., chosen], x[2][..., chosen]
