"""Whether the model explains the readings: Pearson's chi-square test, in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtr, chdtrc, fdtrc

from ...core.arrays import Array
from ...scene.belief import RAW, Belief

SIGNIFICANCE = 1e-3
"""Probability below which the model is said not to fit: one false alarm in 1000 calibrations."""

MIN_PAIRS = 30
"""Fewest pairs of neighbouring contacts that estimate the noise: to 13 %."""
STRONG = 0.9
"""Quantile of the readings that stands for the strong ones."""
NUMERICAL = 1e-4
"""Residuals, relative to strong readings, below which they are numerical errors. Without noise they
are 1e-6 on a sphere and 1.5e-5 to 6e-5 on 12 link meshes, whose curvature changes from face to
face. Such errors displace a taxel by 1e-4 of a contact radius, some tenths of a micrometre; a
sensor of 12 bits rounds its readings by as much."""
REMEDY = (
    "declare what may be unknown (modulus, gain, force, indenter), believe another contact model "
    "(elliptic, layered)"
)
"""Next steps where the model does not fit."""
OF_CONTACTS = "body_offset", "indenter_offset"
OF_ROBOT = "mount", "indenter_position", "indenter_radius", "mesh_scale"
"""Unknowns of the places of contacts: of recorded points, and of points from joint angles."""


def undeclared(belief: Belief) -> str:
    """What may still be declared unknown of where the contacts are, in words; "" for nothing."""
    motion = belief.contact_motion
    by_joints = motion is not None and motion.by_joints
    known = {*belief.unknown, *(label.split()[0] for label in (motion.labels if motion else ()))}
    names = [name for name in (OF_ROBOT if by_joints else OF_CONTACTS) if name not in known]
    return f"declare {' or '.join(names)} unknown" if names else ""


def remedy_of_learned(belief: Belief) -> str:
    """Next steps where a learned response does not fit; raw readings have no contact model."""
    other = "" if belief.readings == RAW else "believe a contact model (elliptic, layered)"
    return ", or ".join(filter(None, (undeclared(belief), other))) or "see the other reasons"


@dataclass(frozen=True)
class GoodnessOfFit:
    """The squared residuals of the readings, in units of the noise, and their expectation."""

    chi2: float
    """Sum of the squared residuals, outlying readings left out."""
    freedom: float
    """Degrees of freedom: their number less the leverages."""
    p: float
    """Probability of so large a sum where the model is right; NaN where it was not tested."""
    words: str
    """The result in words."""
    left_out: int = 0
    """Number of outlying readings, among them silences that are not plausible."""
    noise: float = float("nan")
    """Standard deviation of a reading, Pa, known or estimated, in whose units the residuals are."""
    pairs: int = 0
    """Pairs of readings that the noise was estimated from; 0: it is known, or was not estimated."""

    @property
    def reduced(self) -> float:
        """Squared residual per degree of freedom: 1 where the model is right."""
        return self.chi2 / self.freedom if self.freedom > 0 else float("nan")

    @property
    def good(self) -> bool | None:
        """Whether the model fits; None where it was not tested."""
        return None if self.p != self.p else self.p >= SIGNIFICANCE

    def of_computing(self, pressure: Array) -> bool:
        """Whether the residuals of readings `pressure` (k,), Pa, are errors of computing: these are
        alike in neighbouring contacts, and contradict no model."""
        return self.noise * self.reduced**0.5 < NUMERICAL * float(np.quantile(pressure, STRONG))


def chance(chi2: float, freedom: float, pairs: int = 0) -> float:
    """Probability of so large a sum of squared residuals, with `freedom` degrees, in units of the
    noise; pairs: of readings that it was estimated from, 0: it is known."""
    return float(fdtrc(freedom, pairs, chi2 / freedom) if pairs else chdtrc(freedom, chi2))


def goodness_of_fit(
    chi2: float,
    freedom: float,
    noise_known: bool,
    outlying: int = 0,
    pairs: int = 0,
    remedy: str = REMEDY,
) -> GoodnessOfFit:
    """The test of `chi2` with `freedom` degrees; `outlying` readings were left out of it.

    pairs: where the noise is not known, the number of independent pairs of neighbouring contacts
    that it was estimated from; the ratio of the two variances then has an F distribution.
    remedy: next steps where the model does not fit.
    """
    left_out = f" ({outlying} outlying readings left out)" if outlying else ""
    if not noise_known and freedom > 0 and pairs >= MIN_PAIRS:
        p, ratio = chance(chi2, freedom, pairs), chi2 / freedom
        words = f"residuals are {ratio**0.5:.3g} times the scatter between neighbouring contacts"
        words = (
            f"the model does not fit: {words}, p = {p:.2g}; {remedy}"
            if p < SIGNIFICANCE
            else f"the model fits: {words}, p = {p:.2g}"
        )
        return GoodnessOfFit(chi2, freedom, p, words + left_out, outlying, pairs=pairs)
    if not noise_known or freedom <= 0:
        reason = "too few readings" if noise_known else "the noise is not known"
        words = f"not tested: {reason}{left_out}"
        return GoodnessOfFit(chi2, freedom, float("nan"), words, outlying, pairs=pairs)
    p, ratio = chance(chi2, freedom), chi2 / freedom
    if p < SIGNIFICANCE:
        words = (
            f"the model does not fit: residuals are {ratio**0.5:.3g} times the noise, p = {p:.2g}; "
            f"{remedy}, or state the true noise"
        )
    elif chdtr(freedom, chi2) < SIGNIFICANCE:
        words = f"the noise is overstated: residuals are {ratio**0.5:.3f} of it"
    else:
        words = f"the model fits: residuals are {ratio**0.5:.3f} of the noise, p = {p:.2g}"
    return GoodnessOfFit(chi2, freedom, p, words + left_out, outlying, pairs=pairs)
