"""What the data can determine: degrees of freedom, covariances, and the Cramér-Rao bound.

A round taxel's pressure depends on its two coordinates along the surface. The body's surface adds
the position along the normal and both tilts, as far as it is trusted. Nothing shows the spin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...core.errors import CalibrationError
from ...core.se3 import Array
from .. import chart
from ..data.global_parameters import GlobalParameters
from ..data.measurements import Measurements, gather, reach
from ..data.pairs import SPARE, near_pairs
from ..joint.contacts import LinearizedContacts
from ..joint.likelihood import Likelihood, Readings
from ..trilateration.displacements import surface_motion

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...skin.skin import Skin

SURFACE_SIGMA = 1e-6
"""Standard deviation to which the believed surface is trusted along its normal, m."""
TILT_SIGMA = 1e-5
"""The same for the direction of its normal, rad."""
SPIN = 5
"""Column of the rotation about the taxel's own normal."""


@dataclass(frozen=True)
class Bound:
    """The Cramér-Rao bound of n taxels, all that the belief declares being unknown too."""

    covariance: Array
    """(n, 2, 2), m^2, in the taxels' tangent planes; inf on the diagonal where unbounded."""
    shared_sigma: Array
    """Least standard deviations (ks,) of the shared unknowns, their priors included."""
    shared: GlobalParameters
    """Which these are."""

    @property
    def modulus_sigma(self) -> float:
        """Least standard deviation of ln E*; 0 where E* is known."""
        at = self.shared.columns
        return float(self.shared_sigma[at["modulus"]][0]) if "modulus" in at else 0.0

    @property
    def expected(self) -> Array:
        """Expected distance (n,), m, of an estimate that reaches the bound; inf where unbounded."""
        return mean_distance(self.covariance)

    @property
    def mean(self) -> float:
        """Mean of `expected` over the taxels that have a bound, m."""
        return float(np.mean(self.expected[self.bounded]))

    @property
    def rms(self) -> float:
        """Root of the mean squared error of such an estimate, m, over the same taxels."""
        trace = np.trace(self.covariance[self.bounded], axis1=1, axis2=2)
        return float(np.sqrt(np.mean(trace)))

    @property
    def bounded(self) -> np.ndarray:
        """Whether the data of each taxel bound it (n,)."""
        return np.asarray(np.isfinite(self.covariance).all(axis=(1, 2)))


def cramer_rao(recording: Recording, belief: Belief, skin: Skin) -> Bound:
    """The bound at the truth, from the contacts of `recording` and the noise of `belief`.

    The expected Fisher information of a reading with mean mu, censored at the threshold, is
    [1 - Phi(c) + c phi(c) + phi(c)^2 / Phi(c)] / sigma^2 with c = (threshold - mu) / sigma.
    Raises CalibrationError if the belief knows no noise.
    """
    data = gather(recording, belief)
    if not data.noise:
        raise CalibrationError(
            "the Cramér-Rao bound needs the noise of the readings",
            value="belief.noise_sigma = None",
            remedy="give the belief a noise_sigma",
        )
    points = true_positions(skin, data.ids)
    contact, taxel = near_pairs(data, points, reach(data) + SPARE)
    h = _information(data, belief.body, points, contact, taxel)
    return _bound(h, data.shared)


def true_positions(skin: Skin, ids: np.ndarray) -> Array:
    """Positions (n, 3), m, of the taxels `ids` (n,) of a skin. Raises CalibrationError for taxels
    that it lacks.
    """
    row = {int(k): r for r, k in enumerate(skin.ids)}
    missing = [int(k) for k in ids if int(k) not in row]
    if missing:
        raise CalibrationError("the true skin lacks taxels", value=f"ids {missing[:5]}")
    return np.asarray(skin.positions)[[row[int(k)] for k in ids]]


def _information(
    data: Measurements, body: Body, points: Array, contact: np.ndarray, taxel: np.ndarray
) -> Array:
    """Expected information (n, c, c) on the two coordinates, the taxel's and the shared unknowns of
    the pairs, at their nominal values.
    """
    charts = chart.charts_at(body, points)
    shared = data.shared
    nominal = np.zeros(len(shared.sigma))
    contacts = LinearizedContacts(shared, data, body, nominal).at(nominal)
    order = np.argsort(taxel, kind="stable")
    contact, taxel = contact[order], taxel[order]
    model = Likelihood(data, Readings.none(), shared)
    extras = np.zeros((len(taxel), len(shared.local_names)))
    mu, slope = model.predict(contact, points[taxel], extras, contacts)
    weight = censored_information(data.threshold / data.sigma - mu)
    slope = np.concatenate([np.einsum("kia,ik->ak", charts.tangents[taxel], slope[:3]), slope[3:]])
    size = len(slope)
    h = np.zeros((len(points), size, size))
    for r in range(size):
        for c in range(r + 1):
            h[:, r, c] = h[:, c, r] = np.bincount(taxel, weight * slope[r] * slope[c], len(points))
    for k, sigma in enumerate(model.local_sigma, 2):
        h[:, k, k] += sigma**-2
    return h


def _bound(h: Array, shared: GlobalParameters) -> Bound:
    """The bound of information blocks (n, c, c), whose last rows are the shared unknowns'."""
    local = h.shape[1] - len(shared.sigma)
    size = np.trace(h[:, :2, :2], axis1=1, axis2=2)
    least = np.linalg.eigvalsh(h[:, :2, :2])[:, 0]
    seen = least > 1e-9 * max(float(size.max(initial=0.0)), 1e-300)
    covariance = np.tile(np.diag([np.inf, np.inf]), (len(h), 1, 1))
    inverse = np.linalg.inv(h[seen, :local, :local])
    lift = inverse @ h[seen, :local, local:]
    rest = h[seen, local:, local:].sum(axis=0) - np.einsum(
        "nik,nil->kl", h[seen, :local, local:], lift
    )
    common = np.linalg.inv(rest + np.diag(shared.sigma**-2))
    full = inverse + lift @ common @ np.swapaxes(lift, 1, 2)
    covariance[seen] = full[:, :2, :2]
    return Bound(covariance, np.sqrt(np.diag(common)), shared)


def censored_information(c: Array) -> Array:
    """Fisher information (k,) on the mean, in units of 1/sigma^2; c = (threshold - mean)/sigma."""
    from scipy.special import log_ndtr, ndtr

    log_density = -(c**2) / 2 - np.log(2 * np.pi) / 2
    density = np.exp(log_density)
    return np.asarray(ndtr(-c) + c * density + np.exp(2 * log_density - log_ndtr(c)))


def mean_distance(covariance: Array) -> Array:
    """Expected length (n,) of Gaussian vectors (n, 2) with zero mean: sqrt(2/pi) s_1 E(m).

    E is the complete elliptic integral of the second kind at the parameter m = 1 - (s_2/s_1)^2,
    s_1 >= s_2 the standard deviations along the principal axes; inf for an infinite covariance.
    """
    from scipy.special import ellipe

    out = np.full(len(covariance), np.inf)
    good = np.isfinite(covariance).all(axis=(1, 2))
    small, large = np.linalg.eigvalsh(covariance[good]).T
    ratio = np.maximum(small, 0.0) / np.where(large > 0, large, 1.0)
    out[good] = np.sqrt(2 * large / np.pi) * ellipe(1 - ratio)
    return out


def pose_covariance(tangential: Array, shape: Array) -> Array:
    """Covariances (n, 6, 6) in the taxels' frames from those along the surface (n, 2, 2), m^2.

    `shape` (n, 2, 2), 1/m, is the shape operator: it carries a move along the surface into tilt.
    The spin has an infinite variance, and so has all of a taxel with an infinite `tangential`.
    """
    out = np.zeros((len(tangential), 6, 6))
    good = np.isfinite(tangential).all(axis=(1, 2))
    into = surface_motion(shape[good])
    surface = np.diag(np.square([0.0, 0.0, SURFACE_SIGMA, TILT_SIGMA, TILT_SIGMA, 0.0]))
    out[good] = into @ tangential[good] @ np.swapaxes(into, 1, 2) + surface
    out[~good] = np.diag([np.inf] * 6)
    out[:, SPIN, SPIN] = np.inf
    return out


def degrees_of_freedom(covariance: Array, limit: float) -> np.ndarray:
    """Which degrees of freedom (n, 6) are determined: their variance is finite, and the standard
    deviation along the surface is below `limit`, m (beyond it the estimate is only a start).
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    observed = np.isfinite(variance)
    worst = np.full(len(covariance), np.inf)
    good = observed[:, :2].all(axis=1)
    worst[good] = np.sqrt(np.linalg.eigvalsh(covariance[good, :2, :2])[:, 1])
    return np.asarray(observed & (worst < limit)[:, None])


def shape_operators(body: Body, points: Array, rotations: Array) -> Array:
    """Shape operators (n, 2, 2), 1/m, at `points` in the tangents of `rotations`; 0 where NaN."""
    out = np.zeros((len(points), 2, 2))
    good = np.isfinite(points).all(axis=1)
    if good.any():
        out[good] = chart.charts_at(body, points[good], rotations[good]).shape
    return out
