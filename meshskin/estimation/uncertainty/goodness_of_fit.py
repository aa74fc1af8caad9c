"""Whether the model explains the readings: Pearson's chi-square test, in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass

SURE = 1e-3
"""Probability below which the model is said not to fit."""


@dataclass(frozen=True)
class GoodnessOfFit:
    """The squared residuals of the readings, in units of the noise, against what they should be."""

    chi2: float
    """Sum of the squared residuals, outlying readings left out."""
    freedom: float
    """Their number less the unknowns."""
    p: float
    """Probability of so large a sum where the model is right; NaN where the noise is not known."""
    words: str
    """What that means."""
    left_out: int = 0
    """Readings taken for outlying, silences that cannot be among them."""

    @property
    def reduced(self) -> float:
        """Squared residual per degree of freedom: 1 where the model is right."""
        return self.chi2 / self.freedom if self.freedom > 0 else float("nan")

    @property
    def good(self) -> bool | None:
        """Whether the model fits; None where that cannot be told."""
        return None if self.p != self.p else self.p >= SURE


def goodness(chi2: float, freedom: float, noise_known: bool, outlying: int = 0) -> GoodnessOfFit:
    """The test of `chi2` with `freedom` degrees; `outlying` readings were left out of it."""
    from scipy.stats import chi2 as distribution

    left_out = f" ({outlying} outlying readings left out)" if outlying else ""
    if not noise_known or freedom <= 0:
        reason = "the noise is not known" if not noise_known else "too few readings"
        return GoodnessOfFit(
            chi2, freedom, float("nan"), f"not tested: {reason}{left_out}", outlying
        )
    p, ratio = float(distribution.sf(chi2, freedom)), chi2 / freedom
    if p >= SURE:
        words = f"the model fits: residuals are {ratio**0.5:.3f} of the noise, p = {p:.2g}"
        if distribution.cdf(chi2, freedom) < SURE:
            words = f"the noise is overstated: residuals are {ratio**0.5:.3f} of it"
    else:
        words = (
            f"the model does not fit: residuals are {ratio**0.5:.3g} times the noise, p = {p:.2g}; "
            "declare what may be unknown (modulus, gain, force, indenter), believe another contact "
            "model (elliptic, layered), or state the true noise"
        )
    return GoodnessOfFit(chi2, freedom, p, words + left_out, outlying)
