"""What the data can determine: degrees of freedom, covariances, and the Cramér-Rao bound.

A round taxel's pressure depends on its two coordinates along the surface. The believed surface adds
the position along the normal and both tilts. The rotation about the normal is not observable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ellipe, log_ndtr, ndtr

from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...geometry.body import Body
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...skin.skin import Skin
from .. import chart
from ..data.gather import gather
from ..data.global_parameters import GlobalParameters
from ..data.measurements import Measurements
from ..data.pairs import REACH_MARGIN, near_pairs
from ..joint.contacts import LinearizedContacts
from ..joint.likelihood import Likelihood
from ..joint.readings import Readings
from ..trilateration.displacements import surface_motion

SURFACE_SIGMA = 1e-8
"""Standard deviation of the believed surface along its normal, m: the numerical error of the
closest point, for simulated contact points on the scene torus. contact_errors.py adds the body's
error."""
TILT_SIGMA = 1e-5
"""Standard deviation of the direction of its normal, rad: ten times the error on a fitted mesh."""
SPIN = 5
"""Column of the rotation about the taxel's own normal."""
MIN_INFORMATION = 1e-9
"""Least eigenvalue of a taxel's information, relative to the largest trace, with a finite bound."""


@dataclass(frozen=True)
class Bound:
    """The Cramér-Rao bound of n taxels, with the parameters that the belief declares unknown."""

    covariance: Array
    """(n, 2, 2), m^2, in the taxels' tangent planes; inf on the diagonal where unbounded."""
    global_sigma: Array
    """Bounds (ks,) on the standard deviations of the global parameters, priors included."""
    parameters: GlobalParameters
    """The global parameters."""

    @property
    def modulus_sigma(self) -> float:
        """Bound on the standard deviation of ln E*; 0 where E* is known."""
        return self.parameters.value("modulus", self.global_sigma)

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
        """Root mean square of the distance, m, over the taxels that have a bound."""
        trace = np.trace(self.covariance[self.bounded], axis1=1, axis2=2)
        return float(np.sqrt(np.mean(trace)))

    @property
    def bounded(self) -> np.ndarray:
        """Whether each taxel has a finite bound (n,) bool."""
        return np.asarray(np.isfinite(self.covariance).all(axis=(1, 2)))


def cramer_rao(recording: Recording, belief: Belief, skin: Skin) -> Bound:
    """The bound at the truth, from the contacts of `recording` and the noise of `belief`.

    The expected Fisher information of a reading with mean mu, censored at the threshold, is
    [1 - Phi(c) + c phi(c) + phi(c)^2 / Phi(c)] / sigma^2 with c = (threshold - mu) / sigma.
    Raises CalibrationError if the belief knows no noise.
    """
    data = gather(recording, belief, repeated=True)
    if data.noise is None:
        raise CalibrationError(
            "the Cramér-Rao bound needs the noise of the readings",
            value="belief.noise_sigma = None",
            remedy="give the belief a noise_sigma",
        )
    points = true_positions(skin, data.ids)
    contact, taxel = near_pairs(
        data, points, data.body.closest(points).normal, data.reach() + REACH_MARGIN
    )
    return _bound(_information(data, points, contact, taxel), data.parameters)


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
    data: Measurements, points: Array, contact: np.ndarray, taxel: np.ndarray
) -> Array:
    """Expected information (n, c, c) of pairs of a contact and a taxel, at nominal parameters.

    The c unknowns are two coordinates, the nuisance parameters and the global parameters.
    """
    charts, parameters = chart.charts_at(data.body, points), data.parameters
    nominal = np.zeros(len(parameters.sigma))
    contacts = LinearizedContacts(data, nominal).at(nominal)
    order = np.argsort(taxel, kind="stable")
    contact, taxel = contact[order], taxel[order]
    model = Likelihood(data, Readings.none())
    nuisance = np.zeros((len(taxel), len(parameters.nuisance_names)))
    mu, slope = model.predict(contact, points[taxel], nuisance, contacts)
    weight = censored_information(data.threshold / data.sigma - mu)
    slope = np.concatenate([np.einsum("kia,ik->ak", charts.tangents[taxel], slope[:3]), slope[3:]])
    size = len(slope)
    h = np.zeros((len(points), size, size))
    for r in range(size):
        for c in range(r + 1):
            h[:, r, c] = h[:, c, r] = np.bincount(taxel, weight * slope[r] * slope[c], len(points))
    for k, sigma in enumerate(model.nuisance_sigma, 2):
        h[:, k, k] += sigma**-2
    return h


def _bound(h: Array, parameters: GlobalParameters) -> Bound:
    """The bound from information blocks (n, c, c) with the global parameters in the last rows."""
    local = h.shape[1] - len(parameters.sigma)
    size = np.trace(h[:, :2, :2], axis1=1, axis2=2)
    least = np.linalg.eigvalsh(h[:, :2, :2])[:, 0]
    seen = least > MIN_INFORMATION * max(float(size.max(initial=0.0)), 1e-300)
    covariance = np.tile(np.diag([np.inf, np.inf]), (len(h), 1, 1))
    inverse = np.linalg.inv(h[seen, :local, :local])
    response = inverse @ h[seen, :local, local:]
    rest = h[seen, local:, local:].sum(axis=0) - np.einsum(
        "nik,nil->kl", h[seen, :local, local:], response
    )
    common = np.linalg.inv(rest + np.diag(parameters.sigma**-2))
    full = inverse + response @ common @ np.swapaxes(response, 1, 2)
    covariance[seen] = full[:, :2, :2]
    return Bound(covariance, np.sqrt(np.diag(common)), parameters)


def censored_information(c: Array) -> Array:
    """Fisher information (k,) on the mean, in units of 1/sigma^2; c = (threshold - mean)/sigma."""
    log_density = -(c**2) / 2 - np.log(2 * np.pi) / 2
    density = np.exp(log_density)
    return np.asarray(ndtr(-c) + c * density + np.exp(2 * log_density - log_ndtr(c)))


def mean_distance(covariance: Array) -> Array:
    """Expected length (n,) of Gaussian vectors (n, 2) with zero mean: sqrt(2/pi) s_1 E(m).

    E is the complete elliptic integral of the second kind at the parameter m = 1 - (s_2/s_1)^2,
    s_1 >= s_2 the standard deviations along the principal axes; inf for an infinite covariance.
    """
    out = np.full(len(covariance), np.inf)
    good = np.isfinite(covariance).all(axis=(1, 2))
    small, large = np.linalg.eigvalsh(covariance[good]).T
    ratio = np.maximum(small, 0.0) / np.where(large > 0, large, 1.0)
    out[good] = np.sqrt(2 * large / np.pi) * ellipe(1 - ratio)
    return out


def pose_covariance(tangential: Array, shape: Array) -> Array:
    """Covariances (n, 6, 6) in the taxels' frames from those along the surface (n, 2, 2), m^2.

    shape (n, 2, 2), 1/m: shape operators, which give the tilt of a move along the surface. The
    variance about the normal is infinite; all are for a taxel with an infinite `tangential`.
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
