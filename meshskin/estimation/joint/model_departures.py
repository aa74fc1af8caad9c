"""What the readings show beyond a contact model that all taxels are estimated with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ...core.arrays import Array
from ..result import ALIKE_CONTACTS, SHARED_ERRORS, EstimatorResult
from ..uncertainty.goodness_of_fit import GoodnessOfFit
from . import fault_detection, gain_changes, rejected_readings
from .departures import FittedReadings, fitted_readings
from .joint_estimator import JointEstimator
from .jump import Jump, jump_by_outliers
from .leaks import crosstalk_score
from .parametrization import SurfaceParametrization
from .pressure import OBSERVED
from .rejected_readings import SecondFits, second_fits
from .residual_correlations import (
    ContactFields,
    SharedErrors,
    contact_fields,
    larger,
    shared_errors,
)  # fmt: skip
from .small_effects import HELD_LAGS, NAMED, SHIFTED, held_lags, shifted_patches

CONTACT_ERRORS = "errors of the contacts"
"""Name of the departure that `contact_score` tests."""
PAIRED = 1e-12
"""Least variance of the sum over pairs, as a share of that of all readings: rounding is below."""


@dataclass(frozen=True)
class ModelDepartures:
    """What the readings of single taxels show beyond the model; nothing of rigid modules, or where
    the residuals are errors of computing, which are alike in neighbouring contacts."""

    fitted: FittedReadings | None = None
    jump: Jump = field(default_factory=Jump)
    errors: SharedErrors | None = None
    fields: ContactFields | None = None
    second: SecondFits | None = None
    outlying: bool = False
    """Whether readings are outlying."""

    @classmethod
    def of(cls, estimator: JointEstimator, fit: GoodnessOfFit) -> ModelDepartures:
        """At the estimate."""
        single = isinstance(estimator.problem.parametrization, SurfaceParametrization)
        if not single or fit.of_computing(estimator.data.pressure):
            return cls()
        fitted = fitted_readings(estimator, estimator.likelihood.readings.weight)
        errors, fields = shared_errors(fitted), contact_fields(fitted)
        jump, second = jump_by_outliers(estimator), second_fits(estimator)
        return cls(fitted, jump, errors, fields, second, fit.left_out > 0)

    def with_jump(self, learned: EstimatorResult | None) -> EstimatorResult | None:
        """An estimate with a learned response, if there is one, with the jump that outlying
        readings show here: there errors of the contacts stand in for it."""
        jump = self.jump
        if learned is None or learned.jump.any() or not (self.outlying and jump.shown.any()):
            return learned
        return replace(
            learned, jump=jump.shown, departures={**learned.departures, **jump.departure}
        )

    def covariances(self) -> tuple[Array, list[str]]:
        """What these and lags add to the tangential covariances (n, 2, 2), m^2, and in words."""
        if not (self.fitted and self.errors and self.fields):
            return np.zeros((2, 2)), []
        by_errors, by_fields = self.errors.covariances(self.fitted), self.fields.covariances
        words = [SHARED_ERRORS.format(self.errors.where)] if by_errors.any() else []
        words += [ALIKE_CONTACTS] if by_fields.any() else []
        added = larger(by_errors, by_fields)
        for name, effects in ((HELD_LAGS, held_lags), (SHIFTED, shifted_patches)):
            held = effects(self.fitted)
            words += [name] if held.score > NAMED else []
            added = added + held.covariances
        return added, words

    def rejected(self, estimator: JointEstimator, noise: float) -> Array:
        """What readings that were left out, and gains that change, add to the tangential
        covariances (n, 2, 2), m^2; noise: factor of the readings' standard deviations."""
        if self.fitted is None or self.second is None:
            return np.zeros((2, 2))
        readings = self.fitted.readings
        spread = fault_detection.spread(readings, noise)
        spread /= np.sqrt(np.maximum(readings.precision, 1e-300))
        moved = rejected_readings.displacements(self.fitted, readings.precision, spread)
        whole = fitted_readings(estimator, np.ones_like(readings.weight))
        both = np.stack([moved, gain_changes.displacements(whole, noise)])
        second = 0.0 if self.jump.shown.any() else self.second.covariances  # counted with the jump
        return np.asarray(np.einsum("sni,snj->nij", both, both) + second)

    def scores(self, estimator: JointEstimator) -> dict[str, float]:
        """The score of each, in standard deviations, by its name."""
        found = {CONTACT_ERRORS: contact_score(estimator)}
        if self.fitted is not None:
            found |= {name: score for name, (score, _) in self.fitted.scores().items()}
            found["crosstalk"] = crosstalk_score(self.fitted, found["crosstalk"])
        for part in (self.errors, self.fields, self.jump, self.second):
            found |= part.departure if part else {}
        return found


def contact_score(estimator: JointEstimator) -> float:
    """The larger of two scores, in standard deviations, of errors that the readings of a contact
    share: a displacement of its point, and an error of its force.

    The sum over all pairs of readings of a contact of the products of their residuals, weighted by
    what each would change: zero on average for independent errors, whatever their variance.
    """
    problem, state, m = estimator.problem, estimator.state, len(estimator.data.points)
    contacts = problem.contacts.with_errors(state.s, np.zeros((m, 3)))
    readings = estimator.likelihood.readings
    nuisance = problem.nuisance(state.z)
    jacobian = estimator.likelihood.derivatives(problem.points(state), nuisance, contacts)[-3:]
    used = (readings.kind == OBSERVED) & (readings.weight > 0.5)
    owner, found = readings.contact[used], []
    product = jacobian[:, used] * (np.sqrt(readings.precision) * estimator.residuals())[used]
    for rows in (slice(0, 2), slice(2, 3)):
        excess, variance = 0.0, 1e-300
        for x in product[rows]:
            squares = np.bincount(owner, x**2, m)
            pairs = squares**2 - np.bincount(owner, x**4, m)
            excess += float(np.sum(np.bincount(owner, x, m) ** 2 - squares))
            variance += 2 * float(max(np.sum(pairs), PAIRED * np.sum(squares**2)))
        found.append(excess / variance**0.5)
    return max(found)
