"""Errors of the readings, estimated from the touches themselves.

What the recording does not state is fitted to all units as they are believed at present: the errors
sigma, tau and rho by their marginal likelihood with weak priors, the common changes of E* and of
the scale of the readings by least squares between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.special import log_ndtr

from ...core.arrays import Array
from ..data.measurements import NOMINAL_NOISE
from .blocks import Errors, all_log_likelihoods
from .hypotheses import Hypothesis
from .touches import Touches

PRIOR = {"sigma": (NOMINAL_NOISE, 1.5), "tau": (0.1e-3, 1.0), "rho": (0.03, 1.0)}
"""Medians and standard deviations of the logarithms of sigma, relative to the typical peak, of tau,
m, and of rho: noise of 0.2 to 5 %, touches placed to 0.04 to 0.3 mm and readings that the model
predicts to 1 to 8 % are ordinary; larger ones have to be shown by the readings."""
NAMES = tuple(PRIOR)
KNOWN_NOISE = 0.2
"""Standard deviation of ln sigma about a noise that the belief states."""
COMMON = (0.3, 0.1)
"""Prior standard deviations of ln E* and of ln of the scale of the readings, since the map was
made: soft layers stiffen by tens of percent as they age, force sensors drift by less."""
ROUNDS = 2
"""Fits of the common changes, each followed by one of the errors, in every pass over the units."""
MAX_UNITS = 60
"""Units, spread evenly, by which the errors are fitted: some hundred readings determine them."""


def start(touches: Touches) -> Errors:
    """The errors before any fit: those believed, or ordinary ones."""
    known = touches.data.noise
    sigma = PRIOR["sigma"][0] if known is None else known / touches.unit
    variance = np.square(COMMON)
    return Errors(
        sigma, PRIOR["tau"][0], PRIOR["rho"][0], touches.force_scatter,
        common=((variance[0], 0.0), (0.0, variance[1])),
    )  # fmt: skip


def fit(touches: Touches, states: Sequence[Hypothesis], errors: Errors) -> Errors:
    """The errors that explain the units in their states (u,) best."""
    answered = [np.isfinite(touches.level[:, rows]).any() for rows in touches.known.units]
    units = np.flatnonzero(answered).tolist()
    used = {u: states[u] for u in units[:: -(-len(units) // MAX_UNITS) or 1]}
    for _ in range(ROUNDS):
        errors = _fit_errors(touches, used, _fit_common(touches, used, errors))
    return errors


def _fit_common(touches: Touches, states: Mapping[int, Hypothesis], errors: Errors) -> Errors:
    """ln E* and ln scale by a Gauss-Newton step from where they are, with their covariance, by the
    units in their `states`."""
    at = np.array([errors.log_modulus, errors.log_scale])
    information = np.diag(1 / np.square(COMMON))
    score = -information @ at
    own = replace(errors, common=((0.0, 0.0), (0.0, 0.0)))
    for unit, state in states.items():
        block = touches.straight(unit, state, own)
        read = np.flatnonzero(block.read)
        if not len(read):
            continue
        c = block.covariance(own)[np.ix_(read, read)]
        by = np.stack([block.by_modulus, block.by_scale], axis=1)[read]
        solved = cho_solve(cho_factor(c, lower=True), by)
        information += by.T @ solved
        score += solved.T @ (block.level - block.mean)[read]
    covariance = np.linalg.inv(information)
    step = covariance @ score
    step *= min(1.0, 0.5 / max(np.abs(step).max(), 1e-12))
    common = ((covariance[0, 0], covariance[0, 1]), (covariance[1, 0], covariance[1, 1]))
    e, g = at + step
    return replace(errors, log_modulus=float(e), log_scale=float(g), common=common)


def _fit_errors(touches: Touches, states: Mapping[int, Hypothesis], errors: Errors) -> Errors:
    """sigma, tau and rho by the posterior mode of their logarithms."""
    blocks = [touches.straight(unit, state, errors) for unit, state in states.items()]
    centre, width = _scales(touches)

    def at(x: Array) -> Errors:
        sigma, tau, rho = map(float, np.exp(np.clip(width * x, -8, 8)) * centre)
        return replace(errors, sigma=sigma, tau=tau, rho=rho)

    def cost(x: Array) -> float:
        trial = at(x)
        likelihood = float(all_log_likelihoods(blocks, trial, touches.threshold).sum())
        return 0.5 * float(x @ x) - far_silence(trial, touches) - likelihood

    x0 = np.log([errors.sigma, errors.tau, errors.rho] / centre) / width
    simplex = np.concatenate([x0[None], x0 + 0.5 * np.eye(len(x0))])
    options = {"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.1, "maxfev": 80}
    return at(minimize(cost, x0, method="Nelder-Mead", options=options).x)


def far_silence(errors: Errors, touches: Touches) -> float:
    """ln of the probability that all taxels are silent far from the touches, to which the
    likelihoods of the units are relative: noise must not exceed the threshold there."""
    return touches.level.size * float(log_ndtr(touches.threshold / errors.sigma))


def log_prior(errors: Errors, touches: Touches) -> float:
    """ln of the prior density of the errors, but for a constant."""
    centre, width = _scales(touches)
    x = np.log([errors.sigma, errors.tau, errors.rho] / centre) / width
    common = np.array([errors.log_modulus, errors.log_scale])
    return -0.5 * float(x @ x + common @ (common / np.square(COMMON)))


def _scales(touches: Touches) -> tuple[Array, Array]:
    """Medians and standard deviations of the logarithms of sigma, tau and rho."""
    centre, width = np.array([PRIOR[name] for name in NAMES]).T
    if touches.data.noise is not None:
        centre[0], width[0] = touches.data.noise / touches.unit, KNOWN_NOISE
    return centre, width
