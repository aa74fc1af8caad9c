"""What the readings show beyond a contact model that all taxels are estimated with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ...core.arrays import Array
from ..result import ALIKE_CONTACTS, SHARED_ERRORS, EstimatorResult
from ..uncertainty.goodness_of_fit import GoodnessOfFit
from . import fault_detection, gain_changes, rejected_readings
from .contact_fields import ContactFields, contact_fields
from .departures import FittedReadings, departure_scores, fitted_readings
from .held_lags import HELD_LAGS, NAMED, held_lags
from .joint_estimator import JointEstimator
from .jump import Jump, jump_by_outliers
from .leaks import crosstalk_score
from .parametrization import SurfaceParametrization
from .residual_correlations import SharedErrors, larger, shared_errors
from .second_fits import SecondFits, second_fits
from .shifted_patches import SHIFTED, shifted_patches


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
        """The score of each, by its name."""
        found = departure_scores(estimator, self.fitted)
        if self.fitted is not None:
            found["crosstalk"] = crosstalk_score(self.fitted, found["crosstalk"])
        for part in (self.errors, self.fields, self.jump, self.second):
            found |= part.departure if part else {}
        return found
